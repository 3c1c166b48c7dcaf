"""The test network: a real boundary, so that passing traffic proves something."""

from __future__ import annotations

import socket

import pytest

from tests.ros.combinations import each_library
from tests.ros.lab import MASTER_URI, Lab
from tests.ros.topology import OUT_NODE, SPLIT

pytestmark = pytest.mark.boundary


def test_outside_cannot_open_a_connection_to_inside(lab: Lab) -> None:
    with (
        lab.place("out").entered(),
        pytest.raises(TimeoutError),
        socket.create_connection((lab.place("c1").address, 80), timeout=0.5),
    ):
        pass


@pytest.mark.direct
def test_inside_reaches_outside_with_the_address_of_the_host(lab: Lab) -> None:
    with lab.place("out").entered(), socket.create_server((OUT_NODE, 0)) as server:
        port = server.getsockname()[1]
        with lab.place("c1").entered():
            client = socket.create_connection((OUT_NODE, port), timeout=2)
        accepted, peer = server.accept()
        client.close()
        accepted.close()
    assert peer[0] == lab.place("host").address


def test_the_host_name_of_a_container_is_known_in_it_alone(lab: Lab) -> None:
    assert lab.run("c1", "hostname").output == "c1box\n"
    assert lab.run("c1", "getent", "hosts", "c1box").returncode == 0
    for role in ("out", "px", "c2"):
        assert lab.run(role, "getent", "hosts", "c1box", check=False).returncode != 0


@pytest.mark.direct
def test_split_networks_do_not_reach_each_other(lab: Lab, topology_of) -> None:
    places = topology_of(SPLIT).places
    with (
        places["c1"].entered(),
        pytest.raises(TimeoutError),
        socket.create_connection((places["c2"].address, 80), timeout=0.5),
    ):
        pass


@pytest.mark.direct
@each_library
def test_without_the_proxy_outside_hears_nothing_from_inside(lab: Lab, library: str) -> None:
    topic = f"/{lab.unique('unheard')}"
    receiver = lab.node(library, "out", "sub", topic=topic)
    receiver.wait_for("^ready")
    direct = {"ROS_MASTER_URI": MASTER_URI, "ROS_IP": lab.place("c1").address}
    sender = lab.node(library, "c1", "pub", topic=topic, env=direct)
    sender.wait_for("^sent hello 20 ")
    assert "got" not in receiver.output()


@pytest.mark.direct
@pytest.mark.parametrize("first", ["publisher", "subscriber"], ids=lambda w: f"{w}-first")
def test_datagrams_of_an_inside_publisher_pass_through_nat(lab: Lab, first: str) -> None:
    """UDPROS without the proxy: the subscriber outside names the target of the datagrams."""
    topic = f"/{lab.unique('udp')}"
    if first == "subscriber":
        receiver = lab.node("roscpp", "out", "sub", topic=topic, udp=1)
        receiver.wait_for("^ready")
    lab.node("roscpp", "c1", "pub", topic=topic, rate=50).wait_for("^sent hello 2 ")
    if first == "publisher":
        receiver = lab.node("roscpp", "out", "sub", topic=topic, udp=1)
    receiver.wait_for_count("^got hello ", 20)
