"""Tests: pods of which the proxy discovers no participant."""

import pytest

from rosproxy_operator.kubernetes.planner.pods.undiscovered import UNDISCOVERED_FOR_S
from rosproxy_operator.kubernetes.planner.state import ClusterState
from rosproxy_operator.kubernetes.resources.cluster import ClusterSnapshot, ProxyReport
from rosproxy_operator.kubernetes.resources.model import VALUE_AT_RUNTIME, PodContainer
from tests.unit.operator.kubernetes.objects import look, observed, proxy, service, told
from tests.unit.operator.kubernetes.test_ros2 import ADDRESS, of2, pod

SERVER = {"ROS_DISCOVERY_SERVER": "192.0.2.1:11811"}


def seen(variables: dict[str, str], report: ProxyReport | None, phase: str) -> ClusterSnapshot:
    of = of2()
    proxy_pod = proxy(of)
    container = PodContainer(variables={"ROS_STATIC_PEERS": ADDRESS, **variables})
    found = pod(container, phase=phase, workload="deployment/a")
    reports = {proxy_pod.pod.uid: report} if report else {}
    return observed(of, service(of), found, proxy_pod, reports=reports)


def reported(
    variables: dict[str, str], report: ProxyReport | None, phase: str = "Running"
) -> list[str]:
    """Return what is told when a pod has had these variables and this report for long."""
    first = look(seen(variables, report, phase), ClusterState(begun=True), 100.0)
    assert not told(first, "NotDiscovered")
    due = 100.0 + UNDISCOVERED_FOR_S
    return told(look(seen(variables, report, phase), first.state, due), "NotDiscovered")


def test_a_variable_that_may_prevent_discovery_is_told_after_a_while():
    """Nothing was told: the RosProxy was well, and no message arrived."""
    (text,) = reported(SERVER, ProxyReport(True))
    assert "discovered no participant of the pod. Possible cause, if one runs: variable" in text
    assert text.count("ROS_DISCOVERY_SERVER=192.0.2.1:11811") == 1
    assert text.endswith("Unset the variable. Edit the template: kubectl -n ros edit deployment/a")


@pytest.mark.parametrize(
    ("name", "value"),
    [("ROS_LOCALHOST_ONLY", "1"), ("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF"),
     ("ROS_DISCOVERY_SERVER", "localhost")],
)  # fmt: skip
def test_the_variables_of_ros2_are_told(name: str, value: str):
    (text,) = reported({name: value}, ProxyReport(True))
    assert f"variable {name}={value}" in text


def test_the_next_look_is_in_time():
    plan = look(seen(SERVER, ProxyReport(True), "Running"), ClusterState(begun=True), 100.0)
    assert plan.next_look_in is not None
    assert plan.next_look_in <= UNDISCOVERED_FOR_S


@pytest.mark.parametrize(
    ("variables", "report", "phase"),
    [
        ({}, ProxyReport(True), "Running"),
        ({"CYCLONEDDS_URI": VALUE_AT_RUNTIME}, ProxyReport(True), "Running"),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}, ProxyReport(True), "Running"),
        (SERVER, ProxyReport(True, participants={pod().ip: ("01",)}), "Running"),
        (SERVER, ProxyReport(False), "Running"),
        (SERVER, None, "Running"),
        (SERVER, ProxyReport(True), "Pending"),
    ],
    ids=["no variable", "unknown", "range", "discovered", "silent", "no report", "pending"],
)
def test_what_is_no_fault(variables: dict[str, str], report: ProxyReport | None, phase: str):
    assert not reported(variables, report, phase)


def test_a_pod_that_is_discovered_later_is_well():
    first = look(seen(SERVER, ProxyReport(True), "Running"), ClusterState(begun=True), 100.0)
    heard = ProxyReport(True, participants={pod().ip: ("01",)})
    second = look(seen(SERVER, heard, "Running"), first.state, 120.0)
    assert not second.state.undiscovered
