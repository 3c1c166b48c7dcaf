"""Topics that the kernel forwards over IPv6: real nodes on machines that have nothing else."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.ros import kernel
from tests.ros.cpp import compiled_node
from tests.ros.forks import Forks
from tests.ros.ipv6 import ADDRESSES, PROXY_ADDRESSES, Lab6, Topology6
from tests.ros.kernel import LIMIT, talk
from tests.ros.lab import Lab
from tests.ros.processes import wait_until
from tests.ros.topology import ADVERTISED_NAME

pytestmark = pytest.mark.boundary

FORWARDING = "net.ipv6.conf.all.forwarding"


@pytest.fixture(scope="module")
def module_lab(tmp_path_factory: pytest.TempPathFactory, forks: Forks) -> Iterator[Lab]:
    compiled_node()
    topology = Topology6()
    lab = Lab6(topology, tmp_path_factory.mktemp("lab6"), forks)
    lab.advertise_host = ADVERTISED_NAME
    lab.proxy_options = ("--bind", "::", "--probe-interval", "0.5", "--linger", "1")
    try:
        topology.build()
        yield lab
    finally:
        lab.stop()
        topology.remove()


def flows(lab: Lab) -> str:
    return kernel.flows(lab, "ipv6")


MIXED = [("rospy", "roscpp"), ("roscpp", "rospy")]


@pytest.mark.parametrize(("publisher", "subscriber"), MIXED)
def test_the_kernel_forwards_a_topic(lab: Lab, publisher: str, subscriber: str) -> None:
    name, _, receiver = talk(lab, publisher, subscriber)
    plane = kernel.wait_forwarded(lab, name)
    assert plane["reason"] == ""
    assert plane["received"] > 0
    assert plane["port"] in kernel.forwarded_ports(lab)
    assert kernel.node_status(lab, name)["connections"] == []
    listed = [line for line in flows(lab).splitlines() if f"dport={plane['port']}" in line]
    assert any("ESTABLISHED" in line and f"src={ADDRESSES['c1']} " in line for line in listed)
    kernel.wait_more(receiver)
    wait_until("more is counted", lambda: kernel.plane_of(lab, name)["sent"] > plane["sent"])


def test_messages_go_on_while_the_proxy_is_dead_and_after(lab: Lab) -> None:
    name = kernel.outlive_a_kill(lab, "roscpp")
    assert kernel.node_status(lab, name)["connections"] == []


def test_a_graceful_stop_leaves_nothing_in_the_kernel(lab: Lab) -> None:
    kernel.end_without_a_trace(lab, "ipv6")


def test_the_port_of_a_killed_node_refuses(lab: Lab) -> None:
    name, sender, _ = talk(lab, "roscpp")
    port = kernel.wait_forwarded(lab, name)["port"]
    host = PROXY_ADDRESSES["out"]
    assert not kernel.refuses(lab, port, host)
    sender.kill()
    wait_until("the port refuses", lambda: kernel.refuses(lab, port, host), LIMIT)
    wait_until("nothing is forwarded", lambda: port not in kernel.forwarded_ports(lab), LIMIT)


def test_a_node_that_does_not_answer_the_kernel_is_served_by_the_proxy(lab: Lab) -> None:
    _, seen = kernel.status_of_unanswered(lab)
    assert seen["data_plane"]["plane"] == "splice"
    assert "did not answer through the kernel" in seen["data_plane"]["reason"]


def test_without_ipv6_forwarding_the_proxy_serves_and_says_why(lab: Lab) -> None:
    kernel.in_proxy(lab, "sysctl", "-q", "-w", f"{FORWARDING}=0", "net.ipv4.ip_forward=1")
    try:
        name, _, receiver = talk(lab)
        seen = kernel.plane_of(lab, name)
        assert seen["plane"] == "splice"
        assert FORWARDING in seen["reason"]
        kernel.wait_more(receiver)
    finally:
        kernel.in_proxy(lab, "sysctl", "-q", "-w", f"{FORWARDING}=1")
