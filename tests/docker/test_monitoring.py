"""A real Prometheus with the guide's configuration: the dashboard shows, and alerts fire."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.certificates import Authority
from tests.chart.monitoring import expressions, of_kubernetes
from tests.docker.controller import Controller, Proxy, proxies
from tests.docker.engine import docker, wait_until
from tests.docker.inside import ENABLE, Container, Inside, inside
from tests.docker.nodes import node_command
from tests.docker.prometheus import Prometheus, guides_configuration, running_prometheus
from tests.docker.robot import Robot, named_robot
from tests.docker.ros2 import HERE, Inside2, Outside, ros2_proxies
from tests.docker.traffic import traffic
from tests.docker.zenoh import NODE

PATROL = 86
OPERATOR = "127.0.0.1:21313"
NODES = 5
"""Three nodes for traffic, a node with a hidden topic, and a node that is killed."""
LINK = "tls/192.0.2.1:7447"
"""A link to another site, which has no router."""
LABELS = (ENABLE, "rosproxy.data-plane=kernel", f"rosproxy.ports={2 * NODES}")
"""The kernel's share of the range is there for each node."""


@pytest.fixture
def patrol(ros_image: str) -> Iterator[Robot]:
    """A robot with its own master, which the test ends."""
    with named_robot(ros_image, "patrol", PATROL) as robot:
        robot.start_master()
        yield robot


@pytest.fixture
def cell(ros_image: str, patrol: Robot) -> Iterator[Inside]:
    """Networks and containers for inside nodes of that master."""
    with inside(ros_image, patrol.master_uri) as made:
        yield made


@pytest.fixture
def prometheus(tmp_path: Path) -> Iterator[Prometheus]:
    with running_prometheus(tmp_path, guides_configuration(tmp_path, OPERATOR)) as server:
        yield server


@pytest.fixture
def operator(
    start_controller: Callable[..., Controller], patrol: Robot, tmp_path: Path
) -> Controller:
    names = {patrol.name: patrol.address}
    certificates = Authority().write(tmp_path / "link")
    links = ("--allow-link", "tls/192.0.2.1", "--zenoh-link-certificates", str(certificates))
    return start_controller("--allow-data-plane", "kernel", *links, names=names)


@pytest.fixture
def cell_of_zenoh(zenoh_image: str) -> Iterator[Inside]:
    """Networks and containers for nodes of rmw_zenoh."""
    with inside(zenoh_image, "") as made:
        yield made


def ros1_proxy() -> Proxy:
    (name,) = {proxy.name for proxy in proxies()} - {proxy.name for proxy in ros2_proxies()}
    return Proxy(name)


def test_dashboard_and_alerts(
    operator: Controller, prometheus: Prometheus, cell: Inside, patrol: Robot,
    lan: Outside, inside2: Inside2, cell_of_zenoh: Inside,
) -> None:  # fmt: skip
    """First all is well, then parts break in turn. At the end each panel has had data."""
    network = cell.network()
    listener = lan.node("jazzy", "sub", "/out")
    labels = (ENABLE, f"rosproxy.advertise-host={HERE}", "rosproxy.ports=16")
    inside2.node(inside2.made.network(), "jazzy", "pub", "/out", "--word", "inside", labels=labels)
    with traffic(cell, patrol, network, "rospy", labels=LABELS):
        hidden = (*LABELS, "rosproxy.policy=deny publish /secret")
        cell.node(network, "roscpp", "pub", "--topic", "/secret", labels=hidden)
        box = cell.idle(network, labels=LABELS)
        start_node(box, "victim")
        listener.log.wait_for("inside")
        proxy = ros1_proxy()
        everybody = {("rosproxy", target.name) for target in (proxy, *ros2_proxies())}
        everybody |= {("rosproxy-operator", "rosproxy-operator")}
        wait_until(lambda: prometheus.answering() == everybody, 30, str(everybody))
        wait_until(
            lambda: bool(prometheus.series("rosproxy_kernel_connections > 0")),
            30, lambda: docker("exec", proxy.name, "rosproxy", "status"),
        )  # fmt: skip
        wait_until(lambda: patrol.knows_proxied("victim"), 30, operator.logs)
        wait_until(lambda: prometheus.firing() == [], 30, lambda: str(prometheus.firing()))

        # Only now, because the link to the other site is down.
        linked = (ENABLE, f"rosproxy.zenoh-link={LINK}")
        cell_of_zenoh.run(cell_of_zenoh.network(), *NODE, "pub", "talker", "chatter", labels=linked)

        box.run("sh", "-c", "kill -KILL $(cat /tmp/victim.pid)")
        alert = prometheus.wait_for_alert("RosproxyNodeDown", instance=proxy.name, node="/victim")
        assert f"The ROS node /victim behind {proxy.name}" in alert["annotations"]["summary"]

        elsewhere = (ENABLE, "rosproxy.advertise-host=192.0.2.1")
        cell.idle(cell.network(), labels=elsewhere)
        prometheus.wait_for_alert("RosproxyNotReachable")

        # A filler gets the port of the dead node, and the last filler gets none.
        for number in range(NODES + 2):
            start_node(box, f"filler_{number}")
        prometheus.wait_for_alert("RosproxyRangeFull", instance=proxy.name)
        prometheus.wait_for_alert("RosproxyNodesRefused", instance=proxy.name)

        docker("kill", patrol.container)
        alert = prometheus.wait_for_alert("RosproxyMasterDown", instance=proxy.name)
        assert f"docker exec {proxy.name} rosproxy doctor" in alert["annotations"]["description"]

        operator.kill()
        docker("kill", proxy.name)
        prometheus.wait_for_alert("RosproxyOperatorDown", instance="rosproxy-operator")
        prometheus.wait_for_alert("RosproxyDown", instance=proxy.name)

    asked = [(title, query) for title, query in expressions() if not of_kubernetes(query)]
    prometheus.wait_for_data(asked)


def start_node(box: Container, name: str) -> None:
    """Start another node in a running container, so that a test can kill this node alone."""
    words = " ".join(node_command("roscpp", "pub", "--topic", f"/{name}", f"__name:={name}"))
    box.start("sh", "-c", f"echo $$ >/tmp/{name}.pid; exec {words}")
