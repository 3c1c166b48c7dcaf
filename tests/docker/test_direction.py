"""Containers whose only way out is the proxy: on an internal network, or by label."""

import json
import time

import pytest

from tests.docker.controller import Controller, the_proxy
from tests.docker.engine import docker, inspect
from tests.docker.inside import ENABLE, Inside, unique
from tests.docker.nodes import LIBRARIES
from tests.docker.robot import Robot
from tests.docker.test_proxy_lost import recovered
from tests.docker.traffic import traffic

CONNECT = "import socket, sys; socket.create_connection((sys.argv[1], int(sys.argv[2])), 2)"


def told_direction() -> str:
    """The direction in the proxy's settings."""
    env = dict(variable.split("=", 1) for variable in inspect(the_proxy().name)["Config"]["Env"])
    return env.get("ROSPROXY_DIRECTION", "out")


@pytest.mark.parametrize("library", LIBRARIES)
def test_containers_on_an_internal_network_hear_and_are_heard(
    library: str, controller: Controller, net: Inside, named: Robot
) -> None:
    network = net.network("--internal")
    service = f"/{unique('far').replace('-', '_')}"
    with traffic(net, named, network, library) as flow:
        flow.wait()
        assert told_direction() == "both"
        route = flow.listener.run("python3", "-c", CONNECT, named.address, "11311", check=False)
        assert "Error" in route  # no other way out
        named.node("far", library, "serve", "--service", service)
        try:
            caller = net.node(network, library, "call", "--service", service)
            caller.log.wait_for("ask", count=1, verb="reply")
        finally:
            named.end("far")

        proxy = the_proxy()
        lost = time.time()
        docker("rm", "--force", proxy.name)

        flow.wait(since=recovered(lost), seconds=40)
        print(f"docker rm --force, {library}: {flow.gaps(lost)}")
    assert "Traceback" not in controller.logs()


def test_the_label_alone_is_enough(controller: Controller, net: Inside, named: Robot) -> None:
    with traffic(
        net, named, net.network(), "roscpp", labels=(ENABLE, "rosproxy.direction=both")
    ) as flow:
        flow.wait()
        assert told_direction() == "both"
        document = json.loads(
            docker("exec", the_proxy().name, "rosproxy", "status", "--json", check=False)
        )
        assert sum(stand_in["connections"] for stand_in in document["stand_ins"]) > 0


def test_udpros_of_the_robot_reaches_a_container_that_asks_for_it(
    controller: Controller, net: Inside, named: Robot
) -> None:
    """And the reverse, for which no port is published; also after the proxy was removed."""
    network = net.network("--internal")
    words = ("--topic", "/quick", "--udp", "1")
    back = ("--topic", "/back", "--rate", "20", "--word", "back")
    named.node(
        "robot_talker", "roscpp", "pub", "--topic", "/quick", "--rate", "20", "--word", "quick"
    )
    listener = net.node(network, "roscpp", "sub", *words, labels=(ENABLE, "rosproxy.udp=true"))
    net.node(network, "roscpp", "pub", *back)
    robot_listener = named.node("robot_listener", "roscpp", "sub", "--topic", "/back", "--udp", "1")
    try:
        listener.log.wait_for("quick", count=10)
        robot_listener.wait_for("back", count=10)
        document = json.loads(docker("exec", the_proxy().name, "rosproxy", "status", "--json"))
        assert {row["topic"] for row in document["udpros"]} == {"/quick", "/back"}

        lost = time.time()
        docker("rm", "--force", the_proxy().name)

        listener.log.wait_for("quick", count=10, since=recovered(lost))
        robot_listener.wait_for("back", count=10, since=recovered(lost))
    finally:
        named.end("robot_talker")
        named.end("robot_listener")
    assert "Traceback" not in controller.logs()
