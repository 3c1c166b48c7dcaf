"""A real Prometheus with the chart's monitors: scraped targets, dashboard, and alerts."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.chart.monitoring import expressions, of_docker
from tests.docker.engine import wait_until
from tests.docker.prometheus import Prometheus, running_prometheus
from tests.kubernetes import api, release
from tests.kubernetes.cluster.control_plane import API_SERVER
from tests.kubernetes.cluster.layout import NODES, node_named
from tests.kubernetes.cluster.node import without_host_ports
from tests.kubernetes.conftest import cluster
from tests.kubernetes.discovery import discovery
from tests.kubernetes.monitors import charts_configuration
from tests.kubernetes.pods import Namespace
from tests.kubernetes.robot import Robot
from tests.kubernetes.rosproxies import Proxy, RosProxy, rosproxy
from tests.kubernetes.traffic import flow


@pytest.fixture
def prometheus(tmp_path: Path) -> Iterator[Prometheus]:
    """On this machine, which reaches all pods. The cluster enforces no NetworkPolicy."""
    with (
        discovery() as url,
        running_prometheus(tmp_path, charts_configuration(tmp_path, url)) as server,
    ):
        yield server


def test_what_is_scraped_the_dashboard_and_alerts(
    net: Namespace, robot: Robot, prometheus: Prometheus
) -> None:
    """First all is well, then parts break in turn. At the end each panel has had data."""
    release.wait_operator()
    # The kernel forwards only for the other nodes: `docs/reference/policy.md`.
    hidden = {"action": "Deny", "kind": "Publish", "names": ["/secret"], "nodes": ["/victim"]}
    made = rosproxy(
        net.name, master={"uri": robot.master_uri}, ports=16, dataPlane="Kernel",
        policy={"rules": [hidden]},
    )  # fmt: skip
    with flow(net, robot, "rospy"):
        victim = net.node("roscpp", "pub", "--topic", "/secret", name="victim", on="node1",
                          restartPolicy="Never")  # fmt: skip
        net.idle(on="node2")
        proxies = [made.the_proxy(node.name) for node in NODES]
        wait_until(lambda: robot.knows_proxied(victim.node), 60, made.tell)
        check_targets(prometheus, proxies)
        wait_until(
            lambda: bool(prometheus.series("rosproxy_kernel_connections > 0")),
            30, lambda: proxies[0].run("rosproxy", "status"),
        )  # fmt: skip
        wait_for_calm(prometheus)

        nobody_leads(prometheus)
        wait_for_calm(prometheus)
        nobody_sees(prometheus)
        wait_for_calm(prometheus)

        # The proxy would unregister the node of a container that has ended at once.
        victim.hang()
        proxy = proxies[0].name
        prometheus.wait_for_alert("RosproxyNodeDown", instance=proxy, node="/victim")
        nobody_answers(prometheus, made)
        nobody_is_let_in(prometheus, made)
        robot.end("roscore")
        alert = prometheus.wait_for_alert("RosproxyMasterDown", instance=proxy)
        command = f"`kubectl -n {net.name} exec {proxy} -- rosproxy doctor`"
        assert command in alert["annotations"]["description"]

    # For ROS 2, rmw_zenoh and a range that is full see tests/docker/test_monitoring.py.
    elsewhere = ("rosproxy_ros2_", "rosproxy_zenoh_")
    asked = [
        (title, query)
        for title, query in expressions()
        if not of_docker(query) and not any(name in query for name in elsewhere)
    ]
    prometheus.wait_for_data(asked)


def check_targets(prometheus: Prometheus, proxies: list[Proxy]) -> None:
    """Each pod of the operator and of a proxy is scraped once, and nothing else is."""
    pods = {("rosproxy", proxy.namespace, proxy.name) for proxy in proxies}
    pods |= {("rosproxy-operator", pod.namespace, pod.name) for pod in release.operators()}
    expected = sorted((*pod, "up") for pod in pods)

    def scraped() -> list[tuple[str, ...]]:
        labels = [(target["labels"], target["health"]) for target in prometheus.targets()]
        return sorted(
            (names["job"], names["namespace"], names["instance"], health)
            for names, health in labels
        )

    wait_until(lambda: scraped() == expected, 60, lambda: f"{expected}: {scraped()}")


def wait_for_calm(prometheus: Prometheus) -> None:
    wait_until(lambda: prometheus.firing() == [], 60, lambda: str(prometheus.firing()))


def nobody_leads(prometheus: Prometheus) -> None:
    """Without rights on the Lease, the alert names each operator, and no other alert fires."""
    names = [pod.name for pod in release.operators()]
    expected = sorted(("RosproxyOperatorNoLeader", name) for name in names)

    def firing() -> list[tuple[str, str]]:
        labels = [alert["labels"] for alert in prometheus.firing()]
        return sorted((names["alertname"], names["instance"]) for names in labels)

    with no_rights_on_the_lease():
        wait_until(lambda: firing() == expected, 60, lambda: f"{expected}: {firing()}")
        alert = prometheus.wait_for_alert("RosproxyOperatorNoLeader", instance=names[0])
        command = f"`kubectl -n {release.NAMESPACE} logs {names[0]}`"
        assert command in alert["annotations"]["description"]


@contextmanager
def no_rights_on_the_lease() -> Iterator[None]:
    role = f"{release.FULL_NAME}-lease"
    rules = api.get("roles", release.NAMESPACE, role)["rules"]
    api.patch("roles", release.NAMESPACE, role, {"rules": []})
    try:
        yield
    finally:
        api.patch("roles", release.NAMESPACE, role, {"rules": rules})


def nobody_sees(prometheus: Prometheus) -> None:
    """Operators without an API server."""
    names = [pod.name for pod in release.operators()]
    API_SERVER.kill()
    try:
        for name in names:
            prometheus.wait_for_alert("RosproxyOperatorBlind", instance=name)
    finally:
        cluster("restart-apiserver")


def nobody_answers(prometheus: Prometheus, made: RosProxy) -> None:
    """End a proxy twice: before the second restart the kubelet waits ten seconds."""
    proxy = made.the_proxy("node2")
    proxy.crash()
    wait_until(lambda: proxy.restarts == 1 and proxy.ready, 60, made.tell)
    proxy.crash()
    alert = prometheus.wait_for_alert("RosproxyDown", instance=proxy.name)
    command = f"`kubectl -n {proxy.namespace} logs --previous {proxy.name}`"
    assert command in alert["annotations"]["description"]


def nobody_is_let_in(prometheus: Prometheus, made: RosProxy) -> None:
    """A proxy that outside cannot reach, because its node maps no hostPorts."""
    proxy = made.the_proxy("node2")
    with without_host_ports(node_named("node2")):
        proxy.remove()
        prometheus.wait_for_alert("RosproxyNotReachable", instance=proxy.name)
        prometheus.wait_for_alert("RosproxyOperatorProblems", instance=release.operator().name)
