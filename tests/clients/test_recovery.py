"""Proxy killed and restarted: the nodes of each library just go on, with rospy and roscpp."""

from __future__ import annotations

import signal

import pytest

from rosproxy.shared.documents.status_document import EndpointStatus, parse_status
from tests.clients.matrix import CALL, LIBRARIES, PEERS, SERVE, able, each_client
from tests.ros.lab import Lab
from tests.ros.processes import Process, wait_until


def nodes_of(lab: Lab) -> tuple[EndpointStatus, ...]:
    return parse_status(lab.read("/status")).nodes


def is_new(node: EndpointStatus) -> bool:
    """Whether a node has not answered the proxy yet."""
    return node.state == "new"


def restart_proxy(lab: Lab) -> None:
    """Kill and restart the proxy, once the proxy has asked all nodes.

    A roslisp node ends if its caller dies before the node has answered, and the proxy asks each new
    node.
    """
    assert lab.proxy is not None
    wait_until("all nodes have answered", lambda: not any(is_new(node) for node in nodes_of(lab)))
    lab.proxy.kill()
    lab.start_proxy()


def wait_until_a_dead_node_is_unregistered(lab: Lab) -> None:
    name = lab.unique("dead")
    node = lab.node("rospy", "c1", "pub", name=name, topic=f"/{name}/topic")
    lab.wait_registered(name)
    node.kill()
    lab.wait_unregistered(name)


def test_nodes_that_live_stay_registered(lab: Lab) -> None:
    """The proxy asks each node again and again, and the libraries answer differently."""
    kinds = {"pub": LIBRARIES, "sub": LIBRARIES, "serve": able(SERVE)}
    names = {f"{kind}_{library}": (kind, library) for kind in kinds for library in kinds[kind]}
    for name, (kind, library) in names.items():
        endpoint = {"service" if kind == "serve" else "topic": f"/{name}/{kind}"}
        lab.node(library, "c1", kind, name=name, **endpoint).wait_for("^ready")

    def state() -> set[str]:
        """The registrations of each node, without the registrations of all nodes."""
        return {item for table in lab.ask_master("getSystemState") for item, _ in table} & wanted

    wanted = {f"/{name}/{kind}" for name, (kind, _) in names.items()}
    wait_until("all are registered", lambda: state() == wanted)
    restart_proxy(lab)
    for _ in range(2):  # in less time than the second takes, a node that is silent would be gone
        wait_until_a_dead_node_is_unregistered(lab)
    assert state() == wanted
    assert all(node.returncode is None for node in lab.nodes[: len(names)])


@pytest.mark.parametrize("library", LIBRARIES)
def test_a_node_that_was_paused_goes_on(lab: Lab, library: str) -> None:
    """The node finds the calls of the meantime. A roslisp node ends if the caller has gone."""
    topic = f"/{lab.unique('paused')}"
    node = lab.node(library, "c1", "pub", topic=topic)
    receivers = [lab.node(peer, "out", "sub", topic=topic) for peer in PEERS]
    for receiver in receivers:
        receiver.wait_for_count("^got ", 3)
    assert lab.proxy is not None
    mark = lab.proxy.mark()
    node.send(signal.SIGSTOP)
    lab.proxy.wait_for("does not answer", since=mark)
    node.send(signal.SIGCONT)
    lab.proxy.wait_for("answers again", since=mark)
    for receiver in receivers:
        receiver.wait_for_count("^got ", 3, since=receiver.mark())


@each_client()
def test_a_publisher_is_heard_again(lab: Lab, library: str, side: str, across: str) -> None:
    topic = f"/{lab.unique('out')}"
    sender = lab.node(library, side, "pub", topic=topic)
    receivers = [lab.node(peer, across, "sub", topic=topic) for peer in PEERS]
    for receiver in receivers:
        receiver.wait_for_count("^got ", 3)
    restart_proxy(lab)
    for receiver in receivers:
        receiver.wait_for_count("^got ", 10, since=receiver.mark())
    assert sender.returncode is None


@each_client()
def test_a_subscriber_hears_again(lab: Lab, library: str, side: str, across: str) -> None:
    topic = f"/{lab.unique('in')}"
    receiver = lab.node(library, side, "sub", topic=topic)
    for peer in PEERS:
        lab.node(peer, across, "pub", topic=topic, word=f"from-{peer}")
        receiver.wait_for_count(f"^got from-{peer} ", 3)
    restart_proxy(lab)
    mark = receiver.mark()
    for peer in PEERS:
        receiver.wait_for_count(f"^got from-{peer} ", 10, since=mark)


@each_client(SERVE)
def test_a_server_is_called_again(lab: Lab, library: str, side: str, across: str) -> None:
    service = f"/{lab.unique('served')}"
    lab.node(library, side, "serve", service=service).wait_for("^ready")
    lab.node("rospy", across, "call", service=service).wait_for("^reply ")
    restart_proxy(lab)
    for peer in PEERS:
        lab.node(peer, across, "call", service=service).wait_for("^reply ")


@each_client(CALL)
def test_a_caller_is_answered_again(lab: Lab, library: str, side: str, across: str) -> None:
    callers: list[Process] = []
    for peer in PEERS:
        service = f"/{lab.unique('called')}"
        lab.node(peer, across, "serve", service=service)
        callers.append(lab.node(library, side, "call", service=service, count=100000, rate=10))
        callers[-1].wait_for("^reply ")
    restart_proxy(lab)
    for caller in callers:
        caller.wait_for_count("^reply ", 3, since=caller.mark())
