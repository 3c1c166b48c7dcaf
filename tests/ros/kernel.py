"""Helpers for the tests of the kernel plane: the proxy's status, and the kernel's tables."""

from __future__ import annotations

import contextlib
import json
import re
import signal
from collections.abc import Iterator
from typing import Any

from tests.ros.lab import Lab
from tests.ros.processes import Process, wait_until
from tests.ros.topology import OUT_HOST

TABLE = "rosproxy-11311"
MARKS = f"{11311 << 16}/0xffff0000"
LIMIT = 60.0
"""Seconds."""


def talk(lab: Lab, library: str = "rospy", sink: str = "rospy") -> tuple[str, Process, Process]:
    """A publisher inside and a subscriber outside, connected: name and processes."""
    topic = f"/{lab.unique('topic')}"
    name = lab.unique("talker")
    sender = lab.node(library, "c1", "pub", name=name, topic=topic, rate=50)
    lab.wait_registered(name)
    receiver = lab.node(sink, "out", "sub", topic=topic)
    receiver.wait_for_count("^got ", 5, LIMIT)
    return name, sender, receiver


def status(lab: Lab) -> dict[str, Any]:
    """The proxy's status."""
    return json.loads(lab.rosproxy("status", "--json").output)


def node_status(lab: Lab, name: str) -> dict[str, Any]:
    """The row of a node in the status."""
    matching_nodes = (node for node in status(lab)["nodes"] if f"/{name}" in node["nodes"])
    return next(matching_nodes, {"data_plane": {}, "connections": []})


def in_table(lab: Lab, name: str) -> bool:
    """Whether ``rosproxy status`` has as many connections through the kernel as the JSON."""
    plane = plane_of(lab, name)
    text = lab.rosproxy("status").output
    counted = text.replace("1 connection ", "1 connections ")
    return f"{plane['connections']} connections through port {plane['port']}" in counted


def plane_of(lab: Lab, name: str) -> dict[str, Any]:
    """The data plane of a node's topics in the status."""
    return node_status(lab, name)["data_plane"]


def in_proxy(lab: Lab, *argv: str) -> str:
    """The output of a program on the proxy's machine."""
    return lab.run("px", *argv).output


def flows(lab: Lab, family: str = "ipv4") -> str:
    """The connections that the kernel forwards for the proxy."""
    return in_proxy(lab, "conntrack", "-L", "-f", family, "-p", "tcp", "--mark", MARKS)


def tables(lab: Lab) -> str:
    """All tables on the proxy's machine."""
    return in_proxy(lab, "nft", "list", "tables")


def forwarded_ports(lab: Lab) -> list[int]:
    """The ports that the kernel forwards."""
    text = in_proxy(lab, "nft", "list", "map", "inet", TABLE, "ports")
    return [int(port) for port in re.findall(r"(\d+) : \d+", text)]


def wait_forwarded(lab: Lab, name: str) -> dict[str, Any]:
    """Waits until the kernel forwards a node's topics and counts bytes. Returns the plane's
    status.
    """

    def is_forwarded() -> bool:
        plane = plane_of(lab, name)
        return plane.get("plane") == "kernel" and plane["connections"] > 0 and plane["sent"] > 0

    wait_until(f"{name} is forwarded by the kernel", is_forwarded, LIMIT)
    return plane_of(lab, name)


def wait_more(receiver: Process, count: int = 10) -> None:
    """Waits until a subscriber has got more messages."""
    receiver.wait_for_count("^got ", count, LIMIT, since=receiver.mark())


def numbers(receiver: Process) -> list[int]:
    """The numbers of a subscriber's messages, in order of arrival."""
    return [int(number) for number in re.findall(r"^got \S+ (\d+) ", receiver.output(), re.M)]


def refuses(lab: Lab, port: int, host: str = OUT_HOST) -> bool:
    """Whether a port of the host refuses connections from outside at once."""
    import socket

    with lab.place("out").entered():
        try:
            socket.create_connection((host, port), timeout=2).close()
        except ConnectionRefusedError:
            return True
    return False


def outlive_a_kill(lab: Lab, library: str) -> str:
    """Checks that a topic goes on during and after a kill of the proxy, on the same port. Returns
    the node's name.
    """
    name, _, receiver = talk(lab, library, library)
    before = wait_forwarded(lab, name)
    assert lab.proxy is not None
    lab.proxy.kill()
    wait_more(receiver, 30)
    lab.start_proxy()
    wait_more(receiver, 30)
    assert wait_forwarded(lab, name)["port"] == before["port"]
    wait_more(receiver, 30)
    return name


def end_without_a_trace(lab: Lab, family: str = "ipv4") -> None:
    """A stopped proxy leaves nothing in the kernel. The next proxy forwards again."""
    name, _, receiver = talk(lab)
    wait_forwarded(lab, name)
    assert lab.proxy is not None
    assert TABLE in tables(lab)
    lab.proxy.stop(signal.SIGTERM)
    assert "rosproxy" not in tables(lab)
    assert "mark=" not in flows(lab, family)
    lab.start_proxy()
    wait_more(receiver)
    wait_forwarded(lab, name)


def status_of_unanswered(lab: Lab) -> tuple[str, dict[str, Any]]:
    """A topic that arrives without answers through the kernel, and its node's status."""
    topic = f"/{lab.unique('topic')}"
    name = lab.unique("talker")
    lab.node("roscpp", "c1", "pub", name=name, topic=topic, rate=50)
    lab.wait_registered(name)
    with dropping(lab):
        receiver = lab.node("roscpp", "out", "sub", topic=topic)
        receiver.wait_for_count("^got ", 5, 2 * LIMIT)
        return topic, node_status(lab, name)


@contextlib.contextmanager
def dropping(lab: Lab) -> Iterator[None]:
    """A filter that the proxy can't know of drops what the kernel forwards."""
    block = "table inet block { chain forward { type filter hook forward priority 10; "
    block += "ct status dnat ct state new drop; }; }"
    in_proxy(lab, "nft", block)
    try:
        yield
    finally:
        in_proxy(lab, "nft", "delete", "table", "inet", "block")


@contextlib.contextmanager
def other_proxy(lab: Lab, prefix: tuple[str, ...] = (), path: str = "") -> Iterator[None]:
    """Runs the proxy in another way, and restores the usual way afterwards."""
    assert lab.proxy is not None
    before = lab.proxy_prefix, lab.proxy_path
    lab.proxy.stop()
    lab.proxy_prefix = prefix
    lab.proxy_path = path or lab.proxy_path
    lab.ensure_running()
    try:
        yield
        lab.check_proxy()
    finally:
        lab.proxy_prefix, lab.proxy_path = before
        lab.proxy.stop()
        lab.ensure_running()
