"""A label is enough: nodes of ROS 2 in containers and on the LAN meet, in all directions."""

import re
import time
from collections.abc import Iterator
from datetime import datetime

import pytest

from tests.docker.controller import Controller, proxies, the_proxy
from tests.docker.engine import docker, inspect, logs, wait_until
from tests.docker.inside import ENABLE
from tests.docker.nodes import Log
from tests.docker.robot import Robot
from tests.docker.ros2 import OPTIONS as ROS2_OPTIONS
from tests.docker.ros2 import (
    Inside2,
    Outside,
    domain,
    ports,
    ros2_proxies,
    wait_for_line,
)

OPTIONS = ROS2_OPTIONS
PAIRS = [
    pytest.param("jazzy", "jazzy", marks=pytest.mark.smoke),
    ("jazzy", "kilted"),
    ("kilted", "jazzy"),
    ("cyclone", "jazzy"),
    ("jazzy", "cyclone"),
]
BOTH_WAYS = pytest.mark.parametrize("outward", [True, False], ids=["outward", "inward"])

pytestmark = pytest.mark.usefixtures("controller", "_nodes_end")


@pytest.fixture
def _nodes_end(lan: Outside) -> Iterator[None]:
    yield
    lan.end()


@pytest.mark.parametrize(("vendor_inside", "vendor_outside"), PAIRS)
def test_topics(vendor_inside: str, vendor_outside: str, lan: Outside, inside2: Inside2) -> None:
    lan_listener = lan.node(vendor_outside, "sub", "/out")
    lan.node(vendor_outside, "pub", "/back", "--word", "outside")
    network = inside2.made.network()
    started = time.time()

    inside2.node(network, vendor_inside, "pub", "/out", "--word", "inside")
    listener = inside2.node(network, vendor_inside, "sub", "/back")

    outward = lan_listener.log.wait_for("inside")
    inward = listener.log.wait_for("outside")
    print(f"{vendor_inside} inside, {vendor_outside} outside: the first message outside "
          f"{outward - started:.1f} s after docker run, inside "
          f"{inward - started:.1f} s")  # fmt: skip


@pytest.mark.parametrize("vendor", ["jazzy", "cyclone"])
def test_one_more_where_a_proxy_is(vendor: str, lan: Outside, inside2: Inside2) -> None:
    """On a network of the proxy, and on a network that the proxy has to join."""
    listener = lan.node("jazzy", "sub", "/out")
    network = inside2.made.network()
    inside2.node(network, "jazzy", "pub", "/out", "--word", "first")
    listener.log.wait_for("first")

    for place, text in ((network, "near"), (inside2.made.network(), "far")):
        started = time.time()
        node = inside2.node(place, vendor, "pub", "/out", "--word", text)
        heard = listener.log.wait_for(text)
        sent = datetime.fromisoformat(
            docker("logs", "--timestamps", node.name).split()[0]
        ).timestamp()
        print(f"{vendor}, {text}: outside receives {heard - started:.1f} s after docker run, "
              f"{heard - sent:.1f} s after the node's first message")  # fmt: skip
    assert len(ros2_proxies()) == 1


@BOTH_WAYS
@pytest.mark.parametrize("vendor", ["jazzy", "kilted"])
def test_services(vendor: str, outward: bool, lan: Outside, inside2: Inside2) -> None:
    wait_for_line(exchange("serve", "call", "/add", vendor, outward, lan, inside2), "^reply ")


@BOTH_WAYS
def test_actions(outward: bool, lan: Outside, inside2: Inside2) -> None:
    log = exchange("act", "pursue", "/fibonacci", "jazzy", outward, lan, inside2)
    wait_for_line(log, "^feedback ")
    wait_for_line(log, "^result 0 1 1 2 3 5 8 13 21$", count=1)


def exchange(
    server: str, client: str, topic: str, vendor: str, outward: bool, lan: Outside, inside2: Inside2
) -> Log:
    """The output of a client with its server on the other side. With ``outward`` the server is
    inside.
    """
    network = inside2.made.network()
    if outward:
        inside2.node(network, vendor, server, topic)
        return lan.node("jazzy", client, topic).log
    lan.node("jazzy", server, topic)
    return inside2.node(network, vendor, client, topic).log


def test_domains_are_apart(lan: Outside, inside2: Inside2) -> None:
    """The domain of the variable. Outside has another domain, and receives nothing."""
    network = inside2.made.network()
    inside2.node(network, "jazzy", "pub", "/out", options=("--env", "ROS_DOMAIN_ID=7"))
    heard = inside2.node(network, "jazzy", "pub", "/out", "--word", "zero")
    listener = lan.node("jazzy", "sub", "/out")

    listener.log.wait_for("zero", count=10)

    assert listener.log.got("hello") == []
    wait_until(
        lambda: sorted(domain(proxy).domain for proxy in ros2_proxies()) == [0, 7],
        30, "a proxy for each domain, which answers",
    )  # fmt: skip
    assert heard.state == "running"


@pytest.mark.parametrize("end", ["kill", "rm --force"])
def test_a_container_that_is_gone_takes_its_participants_with_it(
    end: str, lan: Outside, inside2: Inside2
) -> None:
    """Without dispose messages, outside would keep the participants for the lease duration
    of 20 s.
    """
    network = inside2.made.network()
    neighbour = inside2.node(network, "jazzy", "pub", "/other", "--word", "neighbour")
    node = inside2.node(network, "jazzy", "pub", "/out")
    watcher = lan.node("jazzy", "names", "/any")
    listener = lan.node("jazzy", "sub", "/other")
    wait_for_line(watcher.log, rf"^nodes .*\b{node.node}\b")
    wait_for_line(watcher.log, rf"^nodes .*\b{neighbour.node}\b")
    proxy = the_proxy()

    docker(*end.split(), node.name)

    def gone() -> bool:
        line = re.findall("^nodes .* end$", watcher.log.read(), re.MULTILINE)[-1]
        return node.node not in line.split()

    seconds = wait_until(gone, 8, watcher.log.read)
    print(f"docker {end}: outside has forgotten the node after {seconds:.1f} s")
    wait_until(lambda: len(domain(proxy).inside) == 1, 5, lambda: str(domain(proxy).inside))
    listener.log.wait_for("neighbour", since=time.time())


def test_a_neighbour_without_a_label_is_not_let_in(lan: Outside, inside2: Inside2) -> None:
    network = inside2.made.network()
    secret = inside2.node(network, "jazzy", "pub", "/secret", labels=())
    wait_for_line(secret.log, "^sent ")
    inside2.node(network, "jazzy", "pub", "/out", "--word", "inside")
    listener = lan.node("jazzy", "sub", "/out")
    spy = lan.node("jazzy", "sub", "/secret")

    listener.log.wait_for("inside", count=50)

    assert spy.log.got() == []
    assert len(ports(the_proxy())) == 1


def test_a_network_that_its_proxy_has_left_is_heard_again(lan: Outside, inside2: Inside2) -> None:
    """The proxy leaves a network with the last container there, and comes back with the next."""
    other = inside2.made.network()
    network = inside2.made.network()
    inside2.node(other, "jazzy", "pub", "/other", "--word", "neighbour")
    first = inside2.node(network, "jazzy", "pub", "/out", "--word", "first")
    neighbour = lan.node("jazzy", "sub", "/other")
    listener = lan.node("jazzy", "sub", "/out")
    listener.log.wait_for("first")
    proxy = the_proxy()

    first.remove()
    wait_until(lambda: network not in proxy.networks, 30, "the proxy has left the network")
    inside2.node(network, "jazzy", "pub", "/out", "--word", "second")

    listener.log.wait_for("second")
    neighbour.log.wait_for("neighbour", since=time.time())
    assert "Traceback" not in logs(proxy.name)


def test_a_container_with_both_versions_has_two_proxies(
    controller: Controller, inside2: Inside2, named: Robot
) -> None:
    network = inside2.made.network()
    both = inside2.made.idle(
        network, uri=named.master_uri, labels=(ENABLE, "rosproxy.ros=1,2"),
    )  # fmt: skip

    wait_until(lambda: [proxy.running for proxy in proxies()] == [True, True], 60, controller.logs)

    first, second = (set(proxy.ports) for proxy in proxies())
    assert not first & second
    rows = [row for row in controller.status()["containers"] if row["name"] == both.name]
    assert {row["ros"] for row in rows} == {"1", "2"}
    assert "domain 0" in controller.command("status", "--wait", "60")
    assert controller.command("plan") == "Nothing to do."


def test_the_lan_relay_has_the_hosts_network_and_no_other_right(inside2: Inside2) -> None:
    inside2.node(inside2.made.network(), "jazzy", "pub", "/out")
    proxy = the_proxy()
    wait_until(lambda: bool(inspect(proxy.lan_relay, check=False)), 30, "the LAN relay is there")

    inspection = inspect(proxy.lan_relay)

    assert inspection["Config"]["User"] == "10001:10001"
    host = inspection["HostConfig"]
    assert (host["NetworkMode"], host["ReadonlyRootfs"], host["Privileged"]) == (
        "host",
        True,
        False,
    )
    assert host["CapDrop"] == ["ALL"]
    assert not host["CapAdd"]
    assert not host["Binds"]
    assert host["RestartPolicy"]["Name"] == "always"
