"""The nodes of a labelled container after an event of the container.

The controller's log proves that a node was unregistered at once: the controller's update came
before the proxy's own clean-up, which takes some 30 seconds.
"""

import json
import re
import time

import pytest

from tests.docker.controller import Controller, Proxy, proxies, the_proxy
from tests.docker.engine import docker, pause, wait_until
from tests.docker.inside import Container, Inside
from tests.docker.nodes import LIBRARIES
from tests.docker.robot import Robot


def talker(net: Inside, network: str, robot: Robot, library: str = "roscpp") -> Container:
    """A node that publishes, known to the master."""
    node = net.node(network, library, "pub", "--topic", "/out", "--word", "inside")
    wait_until(lambda: robot.knows_proxied(node.node), 60, node.log.read)
    return node


def old_talker(net: Inside, network: str, robot: Robot) -> Container:
    """A talker that has run for four seconds: younger nodes get a second chance to answer."""
    node = talker(net, network, robot)
    node.log.wait_for("inside", count=80, verb="sent")
    return node


def unregistered(controller: Controller) -> int:
    """The number of nodes that proxies have unregistered after updates."""
    return sum(map(int, re.findall(r"nodes updated: \S+, (\d+) unregistered", controller.logs())))


@pytest.mark.parametrize(
    "end", [pytest.param("kill", marks=pytest.mark.smoke), "stop", "rm --force"]
)
def test_an_ended_containers_nodes_are_unregistered_at_once(
    end: str, controller: Controller, net: Inside, named: Robot
) -> None:
    network = net.network()
    neighbour = net.idle(network)
    node = old_talker(net, network, named)

    before = unregistered(controller)
    docker(*end.split(), node.name)

    seconds = wait_until(lambda: unregistered(controller) > before, 60, controller.logs)
    print(f"docker {end}: unregistered after {seconds:.1f} s")
    assert not named.uri(node.node)
    assert neighbour.state == "running"


@pytest.mark.smoke
@pytest.mark.parametrize("library", LIBRARIES)
def test_restarted_container_is_heard_again(
    library: str, controller: Controller, net: Inside, named: Robot
) -> None:
    node = talker(net, net.network(), named, library)
    listener = named.node("listener", library, "sub", "--topic", "/out")
    try:
        listener.wait_for("inside")

        docker("restart", "--time", "0", node.name)

        listener.wait_for("inside", since=time.time())
    finally:
        named.end("listener")


def test_paused_container_keeps_its_registrations(
    controller: Controller, net: Inside, named: Robot
) -> None:
    node = talker(net, net.network(), named)
    listener = named.node("listener", "roscpp", "sub", "--topic", "/out")
    try:
        listener.wait_for("inside")
        uri = named.uri(node.node)

        pause(node.name)
        wait_until(lambda: silent_for(listener.got()[-1].at, 4), 60, "nothing is heard any more")
        assert named.uri(node.node) == uri
        docker("unpause", node.name)

        listener.wait_for("inside", since=time.time())
        assert named.uri(node.node) == uri
    finally:
        named.end("listener")


def silent_for(last: float, seconds: float) -> bool:
    return time.time() - last > seconds


def test_renamed_container_goes_on(controller: Controller, net: Inside, named: Robot) -> None:
    node = talker(net, net.network(), named)
    listener = named.node("listener", "roscpp", "sub", "--topic", "/out")
    try:
        listener.wait_for("inside")
        before = time.time()

        docker("rename", node.name, node.name + "-renamed")

        listener.wait_for("inside", count=60, since=before)
        assert listener.lost("inside", before) == 0
        names = {row["name"] for row in controller.status()["containers"]}
        assert node.name + "-renamed" in names
    finally:
        named.end("listener")


@pytest.mark.parametrize("library", LIBRARIES)
def test_container_moves_to_another_network(
    library: str, controller: Controller, net: Inside, named: Robot
) -> None:
    old = net.network()
    new = net.network()
    node = talker(net, old, named, library)
    proxy = the_proxy()
    listener = named.node("listener", library, "sub", "--topic", "/out")
    try:
        listener.wait_for("inside")
        # rospy's accepting thread reads each connection's header without a time-out. A connection
        # that is cut before the header blocks this thread for ever.
        wait_until(lambda: proxy.flowing() == {"/out", "/rosout"}, 60, "both topics flow")

        docker("network", "disconnect", old, node.name)
        docker("network", "connect", new, node.name)

        wait_until(lambda: proxy.networks == {new}, 60, lambda: str(proxy.networks))
        listener.wait_for("inside", since=time.time())
    finally:
        named.end("listener")


def test_nodes_of_two_networks_hear_each_other(
    controller: Controller, net: Inside, named: Robot
) -> None:
    first = net.network()
    second = net.network("--internal")
    speaking = net.node(first, "roscpp", "pub", "--topic", "/across", "--word", "neighbour")
    hearing = net.node(second, "rospy", "sub", "--topic", "/across")

    hearing.log.wait_for("neighbour")

    assert the_proxy().networks == {first, second}
    assert named.knows_proxied(speaking.node)


def test_container_of_two_networks(controller: Controller, net: Inside, named: Robot) -> None:
    """The proxy serves the container on both. Leaving a network cuts nothing."""
    first = net.network()
    second = net.network()
    node = net.node(first, "roscpp", "pub", "--topic", "/out", "--word", "inside", verb="create")
    docker("network", "connect", second, node.name)
    docker("start", node.name)
    listener = named.node("listener", "roscpp", "sub", "--topic", "/out")
    try:
        listener.wait_for("inside")
        proxy = the_proxy()
        assert proxy.networks == {first, second}

        docker("network", "disconnect", proxy_free_network(node, proxy, first, second), node.name)

        wait_until(lambda: len(proxy.networks) == 1, 60, lambda: str(proxy.networks))
        listener.wait_for("inside", since=time.time())
    finally:
        named.end("listener")


def proxy_free_network(node: Container, proxy: Proxy, *networks: str) -> str:
    """The network by which the proxy does not reach the node."""
    status = json.loads(docker("exec", proxy.name, "rosproxy", "status", "--json"))
    (lease,) = (lease for lease in status["nodes"] if f"/{node.node}" in lease["nodes"])
    address = lease["address"].rpartition(":")[0]
    return next(network for network in networks if node.address(network) != address)


def test_network_can_be_removed_when_its_containers_are_gone(
    controller: Controller, net: Inside
) -> None:
    network = net.network()
    remaining = net.network()
    node = net.idle(network)
    net.idle(remaining)
    proxy = the_proxy()
    wait_until(lambda: proxy.networks == {network, remaining}, 60, "the proxy has joined both")

    docker("rm", "--force", node.name)
    wait_until(lambda: proxy.networks == {remaining}, 3, "the proxy has left")
    docker("network", "rm", network)

    net.networks.remove(network)
    assert proxy.running


def test_proxy_goes_with_its_last_container(
    controller: Controller, net: Inside, named: Robot
) -> None:
    """After the grace, here 3 seconds. The master has no registrations left."""
    node = talker(net, net.network(), named)
    assert proxies()

    docker("kill", node.name)

    wait_until(lambda: not proxies(), 60, "the proxy is removed")
    assert f"/{node.node}" not in named.nodes()


def test_proxy_stays_for_a_container_that_comes_back(
    controller: Controller, net: Inside, named: Robot
) -> None:
    node = talker(net, net.network(), named)
    number = the_proxy().id

    docker("restart", "--time", "0", node.name)
    wait_until(lambda: named.knows_proxied(node.node), 60, node.log.read)

    assert the_proxy().id == number


def test_network_taken_away_from_the_proxy_is_joined_again(
    controller: Controller, net: Inside, named: Robot
) -> None:
    network = net.network()
    node = talker(net, network, named)
    proxy = the_proxy()

    docker("network", "disconnect", network, proxy.sandbox)

    wait_until(lambda: network in proxy.networks, 60, "the proxy has joined again")
    assert node.resolve(named.name) == {proxy.address(network)}
