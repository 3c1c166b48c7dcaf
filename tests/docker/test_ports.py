"""The ports of a proxy on a host with other published and listening ports."""

import socket
import time
from collections.abc import Callable
from contextlib import ExitStack, closing

import pytest

from tests.docker.controller import WINDOW, Controller, published_ranges, the_proxy
from tests.docker.engine import docker, wait_until
from tests.docker.inside import ENABLE, Inside
from tests.docker.robot import Robot
from tests.docker.traffic import traffic

FIRST = WINDOW[0]
UNUSED = range(13500, 13600)
"""Ports of no other test. At these ports, no connections of an earlier proxy are in TIME_WAIT."""


def occupy(port: int, *, listen: bool) -> socket.socket:
    """Hold a port of this host. A port without `listen` is in no list of listening sockets."""
    with ExitStack() as stack:
        holder = stack.enter_context(socket.socket())
        if listen:  # connections of an earlier proxy may still be in TIME_WAIT at the port
            holder.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        holder.bind(("0.0.0.0", port))
        if listen:
            holder.listen()
        stack.pop_all()
        return holder


@pytest.fixture
def publisher(net: Inside, base_image: str) -> Callable[..., str]:
    """Makes containers that publish a port and have nothing to do with ROS."""

    def publish(port: int, verb: str = "run") -> str:
        options = ("--publish", f"{port}:80")
        return net.idle("bridge", image=base_image, labels=(), uri="", options=options,
                        verb=verb).name  # fmt: skip

    return publish


def test_range_keeps_clear_of_all_others(
    start_controller: Callable[..., Controller], net: Inside, publisher: Callable[..., str]
) -> None:
    """A created container, a running container, and a listening program."""
    publisher(FIRST + 1, "create")
    publisher(FIRST + 5)
    with closing(occupy(FIRST + 9, listen=True)):
        start_controller("--ports", "4")
        net.idle(net.network())

        assert the_proxy().ports == range(FIRST + 10, FIRST + 14)


def test_next_range_when_the_engine_says_taken(
    start_controller: Callable[..., Controller], net: Inside
) -> None:
    taken = UNUSED.start + 1
    with closing(occupy(taken, listen=False)):
        window = f"{UNUSED[0]}-{UNUSED[-1]}"
        controller = start_controller("--ports", "4", "--port-window", window)
        net.idle(net.network())

        ports = the_proxy().ports

    assert len(ports) == 4
    assert taken not in ports
    assert str(taken) in controller.logs()


def test_exhausted_window_is_told_with_numbers(
    start_controller: Callable[..., Controller], net: Inside
) -> None:
    controller = start_controller("--port-window", f"{FIRST}-{FIRST + 7}")
    node = net.idle(net.network(), labels=(ENABLE, "rosproxy.ports=9"))

    wait_until(lambda: f"{FIRST}-{FIRST + 7}" in controller.logs(), 60, controller.logs)

    text = controller.problems()
    assert "9" in text
    assert "--port-window" in text
    assert node.state == "running"


def test_range_grows_in_place(
    start_controller: Callable[..., Controller], net: Inside, named: Robot
) -> None:
    """A new container asks for more ports. Existing nodes keep their ports."""
    start_controller()
    network = net.network()
    with traffic(net, named, network, "roscpp") as flow:
        before = the_proxy().ports
        uri = named.uri(flow.talker.node)
        net.idle(network, labels=(ENABLE, "rosproxy.ports=12"))
        changed = time.time()

        wait_until(
            lambda: [len(port_range) for port_range in published_ranges()] == [12],
            60,
            "the range has grown",
        )

        flow.wait(since=time.time())
        print(f"range extended: {flow.gaps(changed)}")
        assert the_proxy().ports[0] == before[0]
        assert named.uri(flow.talker.node) == uri


def test_range_taken_by_another_while_the_proxy_was_down(
    start_controller: Callable[..., Controller],
    net: Inside,
    named: Robot,
    publisher: Callable[..., str],
) -> None:
    """The controller takes another range, and reports that nodes have to be restarted."""
    controller = start_controller("--ports", "4")
    node = net.node(net.network(), "roscpp", "pub", "--topic", "/out", "--word", "inside")
    wait_until(lambda: named.knows_proxied(node.node), 60, controller.logs)
    proxy = the_proxy()
    before = proxy.ports
    controller.kill()
    docker("kill", proxy.name, proxy.sandbox)
    publisher(before[1])

    controller.start()

    wait_until(
        lambda: [before[1] in port_range for port_range in published_ranges()] == [False],
        40,
        controller.logs,
    )
    the_proxy(40)
    wait_until(lambda: "has left ports" in controller.problems(), 40, controller.problems)
    assert "has left ports" in controller.logs()
    assert "Restart the nodes" in controller.problems()
    left = named.uri(node.node)
    docker("restart", "--time", "0", node.name)
    # roscpp prefers the reply to its subscription, even if an update is newer.
    wait_until(lambda: named.uri(node.node) not in ("", left), 60, node.log.read)
    listener = named.node("listener", "roscpp", "sub", "--topic", "/out")
    try:
        listener.wait_for("inside")
    finally:
        named.end("listener")
