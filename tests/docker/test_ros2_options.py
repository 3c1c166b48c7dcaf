"""A controller's options for ROS 2, and taken ports of the host."""

import socket
import time
from collections.abc import Callable

from tests.docker.controller import WINDOW, Controller, Proxy, published_ranges, the_proxy
from tests.docker.engine import docker, inspect, pause, wait_until
from tests.docker.images import update
from tests.docker.inside import ENABLE
from tests.docker.ros2 import (
    OPTIONS,
    THERE,
    Flow,
    Inside2,
    Outside,
    all_run,
    domain,
    ports,
    ports_are_kept,
)


def test_udp_ports_that_are_taken_are_not_chosen(
    start_controller: Callable[..., Controller], inside2: Inside2
) -> None:
    """Ports of another container, and of a program on this host."""
    network = inside2.made.network()
    first = WINDOW[0]
    web = inside2.made.idle(network, labels=(), options=("--publish", f"{first + 3}:80/udp"))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bound_socket:
        bound_socket.bind(("0.0.0.0", first + 30))
        start_controller(*OPTIONS)
        inside2.node(network, "jazzy", "pub", "/out")

        proxy = the_proxy()

        assert proxy.ports == range(first + 31, first + 31 + 32)
        bindings = inspect(proxy.sandbox)["HostConfig"]["PortBindings"]
        assert len(bindings) == 31
        assert all(port.endswith("/udp") for port in bindings)
        assert web.state == "running"


def test_participants_rediscover_each_other_on_another_range(
    start_controller: Callable[..., Controller], lan: Outside, inside2: Inside2
) -> None:
    """Outside ignores new locators of a known participant: both sides have to forget first."""
    controller = start_controller(*OPTIONS)
    try:
        flow = Flow(lan, inside2)
        proxy = the_proxy()
        before = proxy.ports
        wait_until(lambda: ports_are_kept(proxy), 30, lambda: str(domain(proxy).inside))
        time.sleep(6)  # the operator looks every five seconds
        pause(controller.container)
        lost = time.time()
        docker("kill", proxy.name, proxy.lan_relay, proxy.sandbox)
        taken = ("--publish", f"{before[4]}:80/udp")
        inside2.made.idle(inside2.made.network(), labels=(), options=taken)

        docker("unpause", controller.container)

        wait_until(
            lambda: [before[4] in port_range for port_range in published_ranges()] == [False],
            60,
            controller.logs,
        )
        wait_until(lambda: all_run(proxy), 60, lambda: docker("ps", "--all"))
        flow.wait(since=time.time())
        print(f"another range: {flow.gaps(lost)}")
    finally:
        lan.end()


def test_range_taken_by_another_while_neither_proxy_nor_operator_was_there(
    start_controller: Callable[..., Controller], lan: Outside, inside2: Inside2
) -> None:
    """No program remembers the participants. Users have to restart them, like ROS 1 nodes."""
    controller = start_controller(*OPTIONS)
    try:
        Flow(lan, inside2)
        proxy = the_proxy()
        before = proxy.ports
        controller.kill()
        docker("kill", proxy.name, proxy.lan_relay, proxy.sandbox)
        taken = ("--publish", f"{before[4]}:80/udp")
        inside2.made.idle(inside2.made.network(), labels=(), options=taken)

        controller.start()

        wait_until(
            lambda: [before[4] in port_range for port_range in published_ranges()] == [False],
            60,
            controller.logs,
        )
        wait_until(lambda: all_run(proxy), 60, lambda: docker("ps", "--all"))
        lan.end()
        Flow(lan, inside2)
        assert "has left ports" in controller.logs()
    finally:
        lan.end()


def test_range_grows_in_place(
    start_controller: Callable[..., Controller], lan: Outside, inside2: Inside2
) -> None:
    """The former port of the LAN relay is published, and the LAN relay gets another port."""
    start_controller(*OPTIONS)
    try:
        flow = Flow(lan, inside2)
        proxy = the_proxy()
        wait_until(lambda: ports_are_kept(proxy), 30, lambda: str(domain(proxy).inside))
        before = proxy.ports
        participant_ports = ports(proxy)
        changed = time.time()

        inside2.made.idle(inside2.made.network(), labels=(ENABLE, "rosproxy.ports=40"))

        wait_until(
            lambda: [len(port_range) for port_range in published_ranges()] == [40],
            60,
            "the range has grown",
        )
        wait_until(lambda: all_run(proxy), 60, lambda: docker("ps", "--all"))
        wait_until(
            lambda: ports(proxy) == participant_ports,
            60,
            lambda: f"{ports(proxy)} is not {participant_ports}",
        )
        flow.wait(since=time.time())
        print(f"range extended: {flow.gaps(changed)}")
        assert proxy.ports[0] == before[0]
        assert domain(proxy).lan_relay.endswith(f":{proxy.ports[-1]}")
    finally:
        lan.end()


def test_peers_without_multicast(
    start_controller: Callable[..., Controller], lan: Outside, inside2: Inside2
) -> None:
    controller = start_controller(*OPTIONS, "--ros2-lan", "none", "--ros2-peer", THERE)
    try:
        flow = Flow(lan, inside2)
        proxy = the_proxy()
        assert domain(proxy).peers == (THERE,)
        assert not inspect(proxy.lan_relay, check=False)
        flow.wait(since=time.time())
        assert "domain 0, no LAN relay" in controller.command("status", check=False)
    finally:
        lan.end()


def test_a_new_image_replaces_proxy_and_lan_relay(
    start_controller: Callable[..., Controller], moving_image: str, lan: Outside, inside2: Inside2
) -> None:
    start_controller("--proxy-image", moving_image, *OPTIONS)
    try:
        flow = Flow(lan, inside2)
        proxy = the_proxy()
        wait_until(lambda: ports_are_kept(proxy), 30, lambda: str(domain(proxy).inside))
        before = ids(proxy)
        participant_ports = ports(proxy)
        changed = time.time()

        update(moving_image)

        wait_until(
            lambda: not ids(proxy) & {*before, ""}, 60, lambda: docker("ps", "--all")
        )  # fmt: skip
        wait_until(
            lambda: ports(proxy) == participant_ports,
            60,
            lambda: f"{ports(proxy)} is not {participant_ports}",
        )
        flow.wait(since=time.time())
        print(f"image updated: {flow.gaps(changed)}")
    finally:
        lan.end()


def ids(proxy: Proxy) -> set[str]:
    """The ids of the proxy's and the LAN relay's containers, empty if missing."""
    return {inspect(name, check=False).get("Id", "") for name in (proxy.name, proxy.lan_relay)}


def test_on_an_internal_network_the_proxy_is_the_way_out(
    start_controller: Callable[..., Controller], lan: Outside, inside2: Inside2
) -> None:
    start_controller(*OPTIONS)
    try:
        flow = Flow(lan, inside2, inside2.made.network("--internal"))
        proxy = the_proxy()
        assert "ROSPROXY_DIRECTION=both" in inspect(proxy.name)["Config"]["Env"]
        outside = [peer for peer in domain(proxy).outside if peer.vendor == "Fast DDS"]
        assert outside
        assert all(participant.leases for participant in outside)
        docker("kill", proxy.name)
        flow.wait(since=time.time())
    finally:
        lan.end()


def test_rules_are_kept_from_the_start(
    start_controller: Callable[..., Controller], lan: Outside, inside2: Inside2
) -> None:
    """The rules of a label, and the operator's rules for all."""
    start_controller(*OPTIONS, "--policy", "deny publish /hidden")
    try:
        network = inside2.made.network()
        denied = [lan.node("jazzy", "sub", topic) for topic in ("/secret", "/hidden")]
        heard = lan.node("jazzy", "sub", "/open")
        labels = (ENABLE, "rosproxy.policy=deny publish /secret")
        for topic in ("/secret", "/hidden", "/open"):
            inside2.node(network, "jazzy", "pub", topic, labels=labels)
        heard.log.wait_for("hello", count=30)
        assert not any("got" in node.log.read() for node in denied)
    finally:
        lan.end()
