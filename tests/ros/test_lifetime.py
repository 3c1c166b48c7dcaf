"""Nodes end, die, hang and come back; the master and the ports always tell the truth."""

from __future__ import annotations

import asyncio
import signal
import socket
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from rosproxy.ros1.clients.kept_connections import KeptConnections
from rosproxy.ros1.clients.master_client import MasterClient
from rosproxy.ros1.clients.node_client import NodeClient
from rosproxy.ros1.registry.node_health import ProbeResult
from rosproxy.shared.addresses import HostPort
from rosproxy.telemetry.metrics import Metrics
from tests.ros.combinations import LIBRARIES, each_library
from tests.ros.lab import Lab
from tests.ros.processes import Process, wait_until
from tests.ros.topology import MASTER_PORT

PROXY_OPTIONS = (
    *("--probe-interval", "0.5", "--probe-timeout", "1"),
    *("--cleanup-after", "3", "--linger", "2", "--master-interval", "0.5"),
)

Measure = Callable[[str, float], None]

ROLES = {"publisher": "pub", "subscriber": "sub", "server": "serve"}
each_role = pytest.mark.parametrize("role", ROLES.values(), ids=ROLES.keys())


def start(
    lab: Lab, library: str, role: str, machine: str = "c1", name: str = ""
) -> tuple[Process, str]:
    """A registered node of a role, and the node's name."""
    name = name or lab.unique("mortal")
    names = {"serve": {"service": f"/{name}/service"}}.get(role, {"topic": f"/{name}/topic"})
    node = lab.node(library, machine, role, name=name, **names)
    node.wait_for("^ready")
    lab.wait_registered(name)
    return node, name


def port_of(lab: Lab, name: str) -> int:
    """The port under which outside sees the node."""
    uri = lab.node_uri(name)
    assert uri is not None
    return int(uri.split(":")[2].split("/")[0])


def refuses(lab: Lab, port: int) -> bool:
    """Whether a connection from outside to that port of the host is refused."""
    address = (lab.place("host").address, port)
    with lab.place("out").entered():
        try:
            socket.create_connection(address, timeout=1).close()
        except ConnectionRefusedError:
            return True
    return False


@each_role
@each_library
def test_a_node_ended_by_sigint_leaves_nothing(lab: Lab, library: str, role: str) -> None:
    node, name = start(lab, library, role)
    port = None if lab.flat else port_of(lab, name)
    assert node.stop(signal.SIGINT) == 0
    lab.wait_unregistered(name, timeout=2)  # by itself, before --cleanup-after 3
    if port:
        wait_until("the port refuses", lambda: refuses(lab, port))


@pytest.mark.boundary
@each_library
def test_nodes_ended_by_sigkill_are_cleaned_up(lab: Lab, library: str, measure: Measure) -> None:
    started = [start(lab, library, role) for role in ROLES.values()]
    ports = [port_of(lab, name) for _, name in started]
    for node, _ in started:
        node.kill()
    killed = time.time()
    for port in ports:
        wait_until("the port refuses", partial(refuses, lab, port))
    for _, name in started:
        lab.wait_unregistered(name)
        assert lab.node_uri(name) is None
    measure("cleaned up, --cleanup-after 3", time.time() - killed)


@pytest.mark.boundary
@each_library
def test_a_node_answers_over_a_single_connection_until_its_end(lab: Lab, library: str) -> None:
    """Like the proxy's calls to a healthy node."""
    node, name = start(lab, library, "pub")
    own = lab.ask_master("lookupNode", f"/{name}", role="c1")
    address = HostPort(lab.place("c1").address, urlsplit(own).port)
    with lab.place("host").entered():
        asyncio.run(asked_until_it_ends(address, node))


async def asked_until_it_ends(address: HostPort, node: Process) -> None:
    upstream = MasterClient("http://127.0.0.1:1", "test", Metrics())
    nodes = NodeClient(upstream, 5.0)
    connections = KeptConnections[str](nodes, within=60.0)
    connections.most = 1
    pid = (await nodes.probe(address)).pid
    assert pid is not None

    def told() -> list[ProbeResult | None]:
        return list(connections.collect(0.0).values())

    assert connections.ask("first", address, pid, 0.0)
    for _ in range(3):
        assert connections.ask("first", address, pid, 0.0)
        assert not connections.ask("second", address, pid, 0.0)  # that would be another connection
        wait_until("the node answers", lambda: told() == [ProbeResult.ANSWERED])
    node.kill()
    wait_until("the end is noticed", lambda: told() == [None])
    connections.close_all()
    await upstream.close()


@pytest.mark.boundary
@each_library
def test_stopped_nodes_that_go_on_are_registered_and_served_again(lab: Lab, library: str) -> None:
    started = [start(lab, library, role) for role in ROLES.values()]
    (publisher, pub), (subscriber, sub), (_, serve) = started
    for node, _ in started:
        node.send(signal.SIGSTOP)
    for _, name in started:
        lab.wait_unregistered(name)
    for node, _ in started:
        node.send(signal.SIGCONT)
    for _, name in started:
        lab.wait_registered(name)
    lab.node(library, "out", "pub", topic=f"/{sub}/topic")
    for peer in LIBRARIES:
        lab.node(peer, "out", "sub", topic=f"/{pub}/topic").wait_for_count("^got ", 3)
        lab.node(peer, "out", "call", service=f"/{serve}/service").wait_for("^reply ask 0 ")
    subscriber.wait_for_count("^got ", 3)
    assert f"Pid: {publisher.pid}" in lab.run("out", "rosnode", "info", pub).output


@pytest.mark.boundary
@each_library
def test_a_short_hang_is_nobodys_loss(lab: Lab, library: str) -> None:
    """Shorter than the clean-up time: no registration and no connection is lost."""
    node, name = start(lab, library, "pub")
    port = port_of(lab, name)
    receiver = lab.node(library, "out", "sub", topic=f"/{name}/topic")
    receiver.wait_for_count("^got ", 3)
    node.send(signal.SIGSTOP)
    with pytest.raises(AssertionError):
        lab.wait_unregistered(name, timeout=1.5)
    node.send(signal.SIGCONT)
    receiver.wait_for_count("^got ", 3, since=receiver.mark())
    assert port_of(lab, name) == port


WAYS_TO_END = {
    "after-sigint": signal.SIGINT,
    "after-sigkill": signal.SIGKILL,
    "while-it-lives": None,
}


@pytest.mark.parametrize("way", WAYS_TO_END.values(), ids=WAYS_TO_END.keys())
@pytest.mark.parametrize("machine", ["c1", "c2"], ids=["same-address", "another-address"])
@each_library
def test_a_restart_under_the_same_name(
    lab: Lab, library: str, machine: str, way: signal.Signals | None
) -> None:
    """Subscribers of the old node hear the new node, without any help."""
    name = lab.unique("phoenix")
    topic = f"/{name}/topic"
    old = lab.node(library, "c1", "pub", name=name, topic=topic, word="old")
    receivers = [lab.node(peer, "out", "sub", topic=topic) for peer in LIBRARIES]
    for receiver in receivers:
        receiver.wait_for("^got old ")
    if way is signal.SIGINT:
        assert old.stop() == 0
    elif way is signal.SIGKILL:
        old.kill()
    new = lab.node(library, machine, "pub", name=name, topic=topic, word="new")
    for receiver in receivers:
        receiver.wait_for_count("^got new ", 3)
    if way is None:
        old.wait(timeout=60)
    assert f"Pid: {new.pid}" in lab.run("out", "rosnode", "info", name).output


@each_library
@pytest.mark.parametrize("machine", ["c1", "c2"], ids=["same-address", "another-address"])
def test_a_server_killed_and_restarted_under_the_same_name(
    lab: Lab, library: str, machine: str
) -> None:
    old, name = start(lab, library, "serve")
    lab.node("roscpp", "out", "call", service=f"/{name}/service").wait_for("^reply ask 0 ")
    old.kill()
    new, _ = start(lab, library, "serve", machine, name)
    for caller in ("out", "c2"):
        client = lab.node(library, caller, "call", service=f"/{name}/service", size=999)
        client.wait_for("^reply ask 0 size 999 ")
    new.wait_for_count("^request ask 0 size 999 ", 2)


def descriptors(lab: Lab) -> int:
    """The number of the proxy's open descriptors, without kept connections to the master."""
    assert lab.proxy is not None
    to_master = lab.run("px", "ss", "-Htn", "dst", f":{MASTER_PORT}").output.splitlines()
    return len(list(Path(f"/proc/{lab.proxy.pid}/fd").iterdir())) - len(to_master)


@pytest.mark.boundary
def test_twenty_nodes_leave_no_descriptor_in_the_proxy(lab: Lab) -> None:
    before = descriptors(lab)
    nodes = [start(lab, "roscpp", "pub") for _ in range(20)]
    receivers = [lab.node("roscpp", "out", "sub", topic=f"/{name}/topic") for _, name in nodes]
    for receiver in receivers:
        receiver.wait_for("^got ")
    assert descriptors(lab) > before + 40
    lab.stop_nodes()
    wait_until("as few descriptors as before", lambda: descriptors(lab) <= before)
