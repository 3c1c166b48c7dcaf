"""A subscriber that gave its publisher up gets updates again, and no other is disturbed."""

from __future__ import annotations

import re
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from urllib.parse import urlsplit

import pytest

from tests.ros import wire
from tests.ros.combinations import each_library
from tests.ros.lab import CALLER, Lab
from tests.ros.processes import wait_until
from tests.ros.test_recovery import restart_proxy
from tests.ros.topology import OUT_HOST, SHARED

pytestmark = pytest.mark.boundary

PLAN = replace(SHARED, name="w", forwarding=True)

GIVING_UP = 1.0
"""Seconds in which roscpp tries to reconnect. After an immediate failure roscpp gives up."""
LOOKED_AFTER = 45.0
"""Seconds in which the proxy looks for subscribers without connection."""


@pytest.fixture(params=["splice", "kernel"])
def lab_with_plane(lab: Lab, request: pytest.FixtureRequest) -> Iterator[Lab]:
    """A proxy with a relay in user space, or with the kernel plane."""
    before = lab.proxy_options
    lab.proxy_options = ("--data-plane", request.param)
    restart_proxy(lab)
    yield lab
    lab.proxy_options = before


def test_a_subscriber_that_gave_up_after_a_restart_hears_its_publisher_again(
    lab_with_plane: Lab,
) -> None:
    lab = lab_with_plane
    topic = f"/{lab_with_plane.unique('topic')}"
    lab.node("roscpp", "c1", "pub", topic=topic, rate=50)
    nodes = {
        name: lab.node(library, "out", "sub", name=name, topic=topic, udp=udp)
        for name, library, udp in (
            (lab.unique("lost"), "roscpp", 0),
            (lab.unique("cpp"), "roscpp", 0),
            (lab.unique("py"), "rospy", 0),
            (lab.unique("udp"), "roscpp", 1),
        )
    }
    for node in nodes.values():
        node.wait_for_count("^got ", 5)
    restart_proxy(lab)
    assert lab.proxy is not None
    lab.proxy.wait_for(r"recovered \d+ nodes")
    for node in nodes.values():
        node.wait_for_count("^got ", 20, since=node.mark())

    lost, *others = nodes
    before = [connection(lab, name, topic) for name in others]
    silence(lab, connection(lab, lost, topic))
    nodes[lost].wait_for_count("^got ", 20, LOOKED_AFTER, since=nodes[lost].mark())
    assert [connection(lab, name, topic) for name in others] == before


@pytest.mark.parametrize("lab_with_plane", ["kernel"], indirect=True)
@each_library
def test_what_the_kernel_forwards_is_not_interrupted_by_a_restart(
    lab_with_plane: Lab, library: str
) -> None:
    lab = lab_with_plane
    topic = f"/{lab_with_plane.unique('topic')}"
    lab.node("roscpp", "c1", "pub", topic=topic, rate=50)
    name = lab.unique("listener")
    receiver = lab.node(library, "out", "sub", name=name, topic=topic)
    receiver.wait_for_count("^got ", 5)
    before = connection(lab, name, topic)
    restart_proxy(lab)
    assert lab.proxy is not None
    lab.proxy.wait_for(r"recovered \d+ nodes")
    receiver.wait_for_count("^got ", 300, since=receiver.mark())
    assert connection(lab, name, topic) == before


def silence(lab: Lab, connection: str) -> None:
    """Break a subscriber's connection, and let the next attempt fail at once."""
    (port,) = re.findall(r"on port (\d+) to", connection)
    with no_connections(lab), reset(lab, port):
        # The kernel may give the same port to a connection elsewhere.
        alive = f"sport = :{port} and dst = {OUT_HOST}"
        wait_until(
            "the connection is broken",
            lambda: not lab.run("out", "ss", "-Hnt", "state", "established", alive).output,
        )
        time.sleep(GIVING_UP)


def connection(lab: Lab, name: str, topic: str) -> str:
    """A subscriber's only connection for a topic, with the ports, from getBusInfo."""
    port = urlsplit(lab.node_uri(name)).port
    out = lab.place("out")
    assert isinstance(port, int)
    rows = wire.call(out, out.address, port, "getBusInfo", CALLER)
    (mine,) = [row for row in rows if row[4] == topic]
    return str(mine)


@contextmanager
def reset(lab: Lab, port: str) -> Iterator[None]:
    """Answers what a program outside sends from a port with a reset."""
    outside(lab, "nft", "-f", "-", text=RESET.format(port=port))
    try:
        yield
    finally:
        outside(lab, "nft", "delete table ip broken")


@contextmanager
def no_connections(lab: Lab) -> Iterator[None]:
    """Let every new connection from outside fail at once, without a free local port."""
    option = "net.ipv4.ip_local_reserved_ports"
    outside(lab, "sysctl", "-w", f"{option}=1-65535")
    try:
        yield
    finally:
        outside(lab, "sysctl", "-w", f"{option}=")


RESET = """
table ip broken {{
  chain output {{
    type filter hook output priority filter
    tcp sport {port} reject with tcp reset
  }}
}}
"""


def outside(lab: Lab, *command: str, text: str = "") -> None:
    """Runs a command of root's outside."""
    enter = ("ip", "netns", "exec", lab.place("out").namespace)
    done = subprocess.run(
        [*enter, *command], input=text, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
