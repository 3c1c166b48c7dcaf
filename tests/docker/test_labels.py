"""Containers with a label as the only setting, and a robot and a laptop outside.

ROS_MASTER_URI is http://robot:11311 everywhere. Containers reach this name only through the proxy,
and no machine outside reaches a container.
"""

import pytest

from tests.docker.controller import WINDOW, Controller, published_ranges, the_proxy
from tests.docker.engine import docker, inspect, wait_until
from tests.docker.inside import ENABLE, Inside
from tests.docker.machines import Machine
from tests.docker.nodes import LIBRARIES
from tests.docker.robot import Robot


@pytest.mark.parametrize("library", LIBRARIES)
def test_label_alone_is_heard_and_hears(
    library: str, controller: Controller, net: Inside, named: Robot, other_machine: Machine
) -> None:
    network = net.network()
    net.node(network, library, "pub", "--topic", "/out", "--word", "inside")
    hearing = net.node(network, library, "sub", "--topic", "/in")
    outside = {"robot": named, "laptop": other_machine}
    for name, machine in outside.items():
        machine.node("talker_" + name, library, "pub", "--topic", "/in", "--word", name)
    listeners = [machine.node("listener_" + name, library, "sub", "--topic", "/out")
            for name, machine in outside.items()]  # fmt: skip
    try:
        for listener in listeners:
            listener.wait_for("inside")
        for name in outside:
            hearing.log.wait_for(name)
    finally:
        for name, machine in outside.items():
            machine.end("listener_" + name)
            machine.end("talker_" + name)


@pytest.mark.parametrize("library", LIBRARIES)
def test_services_both_ways(
    library: str, controller: Controller, net: Inside, named: Robot, other_machine: Machine
) -> None:
    """The robot's service URIs name the robot: rosrpc://robot:40001."""
    network = net.network()
    net.node(network, library, "serve", "--service", "/in")
    named.node("server", library, "serve", "--service", "/out")
    caller = net.node(network, library, "call", "--service", "/out", "--count", "3",
                      "--size", "5000")  # fmt: skip
    callers = [machine.node(f"caller_{number}", library, "call", "--service", "/in", "--count", "3")
               for number, machine in enumerate((named, other_machine))]  # fmt: skip
    try:
        caller.log.wait_for("ask", verb="reply")
        for log in callers:
            log.wait_for("ask", verb="reply")
    finally:
        named.end("server")


def test_only_published_ports_are_known_outside(
    controller: Controller, net: Inside, named: Robot
) -> None:
    node = net.node(net.network(), "rospy", "pub", "--topic", "/out")
    proxy = the_proxy()
    wait_until(lambda: named.knows_proxied(node.node), 60, node.log.read)

    address = named.uri(node.node).split("/")[2]

    assert int(address.rsplit(":")[1]) in proxy.ports
    assert set(proxy.ports) <= set(WINDOW)


def test_proxy_carries_both_names(controller: Controller, net: Inside, named: Robot) -> None:
    network = net.network()
    node = net.idle(network)
    proxy = the_proxy()

    wait_until(lambda: network in proxy.networks, 60, "the proxy has joined the network")

    address = proxy.address(network)
    assert node.resolve(named.name) == node.resolve("rosproxy") == {address}


def test_proxy_containers_have_no_rights(controller: Controller, net: Inside) -> None:
    net.idle(net.network())
    proxy = the_proxy()

    for name in (proxy.name, proxy.sandbox):
        inspection = inspect(name)
        host = inspection["HostConfig"]
        config = inspection["Config"]
        assert config["User"] == "10001:10001"
        assert host["ReadonlyRootfs"]
        assert host["CapDrop"] == ["ALL"]
        assert not host["CapAdd"]
        assert not host["Privileged"]
        assert not inspection["Mounts"]
        assert any(option.startswith("no-new-privileges") for option in host["SecurityOpt"])
        assert host["RestartPolicy"]["Name"] == "always"


def test_publishes_what_is_asked_for_by_ipv4_only(controller: Controller, net: Inside) -> None:
    net.idle(net.network(), labels=(ENABLE, "rosproxy.ports=7"))
    # A former test may have left a proxy with fewer ports, which is replaced.
    wait_until(lambda: list(map(len, published_ranges())) == [7], 60, controller.logs)
    proxy = the_proxy()

    published = inspect(proxy.sandbox)["NetworkSettings"]["Ports"]

    bound = [(port, binding["HostIp"], binding["HostPort"])
             for port, bindings in published.items() for binding in bindings or ()]  # fmt: skip
    assert sorted(bound) == [(f"{port}/tcp", "0.0.0.0", str(port)) for port in proxy.ports]
    assert len(bound) == 7


BAD = {
    "rosproxy.ports=many": "rosproxy.ports",
    "rosproxy.ports=0": "rosproxy.ports",
    "rosproxy.enable=perhaps": "rosproxy.enable",
    "rosproxy.master-uri=robot": "rosproxy.master-uri",
    "rosproxy.master-uri=http://localhost:11311": "rosproxy.master-uri",
    "rosproxy.network=nosuch": "rosproxy.network",
}


def test_bad_labels_leave_out_their_container_alone(
    controller: Controller, net: Inside, named: Robot
) -> None:
    network = net.network()
    bad = {
        net.idle(network, labels=(ENABLE, label)).name: expected for label, expected in BAD.items()
    }
    good = net.node(network, "roscpp", "pub", "--topic", "/out")

    wait_until(lambda: named.knows_proxied(good.node), 60, good.log.read)

    status = controller.status()
    proxy_of = {row["name"]: row["proxy"] for row in status["containers"]}
    assert proxy_of[good.name] == the_proxy().name
    for name, expected in bad.items():
        assert not proxy_of.get(name)
        texts = [problem["text"] for problem in status["problems"] if name in problem["subject"]]
        assert any(expected in text for text in texts), (name, texts)


def test_misspelt_label_is_named_with_the_right_one(controller: Controller, net: Inside) -> None:
    node = net.idle(net.network(), labels=(ENABLE, "rosproxy.port=20"))

    wait_until(lambda: "rosproxy.ports" in controller.logs(), 60, controller.logs)

    problems = [
        problem for problem in controller.status()["problems"] if node.name in problem["subject"]
    ]
    assert [problem["fatal"] for problem in problems] == [False]
    assert "rosproxy.port " in problems[0]["text"] or "'rosproxy.port'" in problems[0]["text"]
    assert the_proxy().running


def test_no_label_no_proxy(controller: Controller, net: Inside) -> None:
    network = net.network()
    plain = net.idle(network, labels=())
    off = net.idle(network, labels=("rosproxy.enable=false",))
    on = net.idle(net.network())

    proxy = the_proxy()
    wait_until(lambda: bool(proxy.networks), 60, "the proxy has joined a network")

    assert network not in proxy.networks
    listed = {row["name"] for row in controller.status()["containers"]}
    assert on.name in listed
    assert plain.name not in listed
    assert off.name not in listed


def test_labels_name_master_ports_host_and_network(
    controller: Controller, net: Inside, named: Robot
) -> None:
    """A container on two networks, with the proxy's name in ROS_MASTER_URI."""
    wanted = net.network()
    other = net.network()
    labels = (ENABLE, f"rosproxy.master-uri={named.master_uri}", "rosproxy.ports=9",
              f"rosproxy.advertise-host={named.address[:-1]}1",
              f"rosproxy.network={wanted}")  # fmt: skip
    node = net.node(other, "roscpp", "pub", "--topic", "/out", uri="http://rosproxy:11311",
                    labels=labels, verb="create")  # fmt: skip
    docker("network", "connect", wanted, node.name)
    docker("start", node.name)

    wait_until(lambda: named.knows_proxied(node.node), 60, node.log.read)

    proxy = the_proxy()
    assert proxy.networks == {wanted}
    assert len(proxy.ports) == 9


def test_default_bridge_is_told_to_be_of_no_use(
    controller: Controller, net: Inside, named: Robot
) -> None:
    node = net.idle("bridge")

    wait_until(lambda: node.name in controller.logs(), 60, controller.logs)

    texts = [
        problem["text"]
        for problem in controller.status()["problems"]
        if node.name in problem["subject"]
    ]
    assert any("network" in text for text in texts), texts


def test_container_in_anothers_network(controller: Controller, net: Inside, named: Robot) -> None:
    """network_mode: service:… in Compose."""
    network = net.network()
    owner = net.idle(network, labels=())
    node = net.node(f"container:{owner.name}", "rospy", "pub", "--topic", "/out")

    wait_until(lambda: named.knows_proxied(node.node), 60, node.log.read)


def test_name_that_a_neighbour_holds_is_not_taken(
    controller: Controller, net: Inside, named: Robot
) -> None:
    """Otherwise proxy and neighbour would answer in turn."""
    network = net.network()
    squatter = net.idle(network, labels=(), options=("--network-alias", named.name))
    node = net.idle(network)
    proxy = the_proxy()
    wait_until(lambda: network in proxy.networks, 60, "the proxy has joined the network")

    assert node.resolve("rosproxy") == {proxy.address(network)}
    assert node.resolve(named.name) == {squatter.address(network)}
    assert "http://rosproxy:11311" in controller.problems()
