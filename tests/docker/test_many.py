"""Twenty labelled containers at once."""

import time
from collections.abc import Callable

from tests.docker.controller import Controller, the_proxy
from tests.docker.engine import docker, wait_until
from tests.docker.inside import Inside
from tests.docker.robot import Robot

COUNT = 20


def test_twenty_containers_at_once(
    start_controller: Callable[..., Controller], net: Inside, named: Robot
) -> None:
    start_controller("--ports", str(COUNT + 4))
    network = net.network()
    texts = [f"number{number}" for number in range(COUNT)]
    listener = named.node("listener", "roscpp", "sub", "--topic", "/out")
    nodes = [
        net.node(network, ("rospy", "roscpp")[number % 2], "pub", "--topic", "/out", "--rate", "2",
                 "--word", text, verb="create")
        for number, text in enumerate(texts)
    ]  # fmt: skip
    started = time.time()
    docker("start", *(node.name for node in nodes), seconds=120)
    try:
        heard = [listener.wait_for(text, seconds=60) for text in texts]

        print(f"{COUNT} containers: the first heard after {min(heard) - started:.1f} s, "
              f"the last after {max(heard) - started:.1f} s")  # fmt: skip
        assert len({named.uri(node.node) for node in nodes}) == COUNT
        assert all(named.knows_proxied(node.node) for node in nodes)
        assert len(the_proxy().ports) == COUNT + 4
        docker("kill", *(node.name for node in nodes))
        gone = wait_until(lambda: not any(named.uri(node.node) for node in nodes), 25, "all gone")
        print(f"{COUNT} containers killed: unregistered after {gone:.1f} s")
    finally:
        named.end("listener")
