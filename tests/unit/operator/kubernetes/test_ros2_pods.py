"""Tests: what the operator tells of pods whose ROS 2 nodes the proxy can't discover."""

import pytest
from msgspec.structs import replace

from rosproxy_operator.kubernetes.planner.pods.recreation import needs_recreation
from rosproxy_operator.kubernetes.planner.pods.ros2_pods import ros2_findings
from rosproxy_operator.kubernetes.planner.pods.undiscovered import UNDISCOVERED_FOR_S
from rosproxy_operator.kubernetes.planner.state import ClusterState
from rosproxy_operator.kubernetes.resources import names, objects
from rosproxy_operator.kubernetes.resources.cluster import ProxyReport
from rosproxy_operator.kubernetes.resources.model import (
    VALUE_AT_RUNTIME,
    Pod,
    PodContainer,
    Ros2Spec,
)
from tests.unit.operator.kubernetes import objects as some
from tests.unit.operator.kubernetes.objects import look, observed, proxy, service, told
from tests.unit.operator.kubernetes.test_ros2 import ADDRESS, of2, pod

UNSET = PodContainer()
WIRED = PodContainer(variables={"ROS_STATIC_PEERS": ADDRESS})
WIRED_TO_3 = PodContainer(variables={**WIRED.variables, "ROS_DOMAIN_ID": "3"})
ELSEWHERE = PodContainer(variables={"ROS_STATIC_PEERS": "192.0.2.7"})


@pytest.mark.parametrize(
    ("reason", "container"),
    [
        ("NoDds", PodContainer(variables={"RMW_IMPLEMENTATION": "rmw_zenoh_cpp"})),
        ("TooOld", PodContainer("docker.io/osrf/ros:humble-desktop")),
        ("TooOld", PodContainer(variables={"ROS_DISTRO": "foxy"})),
        ("NotWired", PodContainer(variables={"ROS_STATIC_PEERS": "192.0.2.7"})),
        ("OtherDomain", PodContainer(variables={"ROS_DOMAIN_ID": "9"})),
    ],
)
def test_what_a_pod_cannot_have_is_told(reason: str, container: PodContainer):
    (finding,) = ros2_findings(pod(container), of2(), ADDRESS)
    assert (finding.reason, finding.fatal) == (reason, False)
    assert finding.about is not None
    assert finding.about.kind == "Pod"
    (of_deployment,) = ros2_findings(pod(container, workload="deployment/a"), of2(), ADDRESS)
    assert ": kubectl -n ros edit deployment/a" in of_deployment.message
    assert list(ros2_findings(pod(container), some.rosproxy(), ADDRESS)) == []


@pytest.mark.parametrize(
    "container",
    [
        PodContainer("ros:jazzy", {"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"}),
        PodContainer("registry/exhumble-thing:1", {"ROS_DISTRO": "kilted"}),
        PodContainer(variables={"ROS_STATIC_PEERS": f"192.0.2.7;{ADDRESS}"}),
        PodContainer(variables={"ROS_STATIC_PEERS": "rosproxy-robot.ros.svc.cluster.local"}),
        PodContainer(variables={"ROS_DOMAIN_ID": "0"}),
        PodContainer("humble/nav:1", {"ROS_DISTRO": "jazzy"}),
        PodContainer(variables={"ROS_DOMAIN_ID": ""}),
    ],
)
def test_what_is_well_is_not_told(container: PodContainer):
    assert list(ros2_findings(pod(container), of2(), ADDRESS)) == []


def test_a_reference_to_another_variable_is_unknown():
    """ROS_DOMAIN_ID=$(FLEET_DOMAIN) was told as another domain."""
    env = [
        {"name": "ROS_DOMAIN_ID", "value": "$(FLEET_DOMAIN)"},
        {"name": "ROS_STATIC_PEERS", "value": "$(ROSPROXY_ROBOT_SERVICE_HOST)"},
    ]
    found = objects.pod({"spec": {"containers": [{"env": env}]}})
    assert {*found.containers[0].variables.values()} == {VALUE_AT_RUNTIME}
    assert list(ros2_findings(found, of2(Ros2Spec(domain=5)), ADDRESS)) == []


@pytest.mark.parametrize(
    ("container", "is_undiscovered", "reasons"),
    [
        (WIRED, True, ["OtherDomain"]),
        (WIRED, False, []),
        (WIRED_TO_3, True, []),
        (UNSET, True, ["NotWired"]),
    ],
)
def test_a_template_with_peers_and_without_the_domain_is_told(
    container: PodContainer, is_undiscovered: bool, reasons: list[str]
):
    """Without the webhook, the template has the variables. Nothing told of a missing domain."""
    of = of2(Ros2Spec(domain=3))
    found = pod(container, static_peers="", workload="deployment/a")
    findings = [*ros2_findings(found, of, ADDRESS, is_undiscovered=is_undiscovered)]
    assert [finding.reason for finding in findings] == reasons
    if reasons == ["OtherDomain"]:
        assert "has no variable ROS_DOMAIN_ID (so 0)" in findings[0].message
        assert "Add ROS_DOMAIN_ID=3 to the template" in findings[0].message


def test_an_empty_domain_is_domain_0():
    """The nodes were in domain 0, and the operator reported nothing."""
    container = PodContainer(variables={"ROS_DOMAIN_ID": ""})
    (finding,) = ros2_findings(pod(container), of2(Ros2Spec(domain=5)), ADDRESS)
    assert finding.reason == "OtherDomain"
    assert "ROS_DOMAIN_ID=(empty, so 0) is not domain 5 of RosProxy" in finding.message
    assert finding.message.endswith(". Or change spec.domain: kubectl -n ros edit rosproxy robot")


@pytest.mark.parametrize(("container", "wired_domain"), [(WIRED, ""), (WIRED_TO_3, "3")])
def test_a_pod_that_was_wired_to_a_former_domain_is_restarted(
    container: PodContainer, wired_domain: str
):
    """The operator advised to edit the template, or told nothing if there was no domain before."""
    of = of2(Ros2Spec(domain=5))
    former = pod(container, wired_domain=wired_domain, labels={names.INJECT: "true"})
    (finding,) = ros2_findings(former, of, ADDRESS)
    assert finding.reason == "OtherDomain"
    assert finding.message == (
        f"was wired {f'to domain {wired_domain}' if wired_domain else 'without a domain'}, but "
        "RosProxy robot has domain 5 now. "
        "Run kubectl -n ros delete pod talker, and create the pod again"
    )
    # The image may set the domain.
    assert needs_recreation(former, of, ADDRESS) == bool(wired_domain)


def test_the_image_may_set_the_domain():
    found = pod(WIRED, labels={names.INJECT: "true"})
    of = replace(of2(Ros2Spec(domain=5)), discovered=frozenset({found.ip}))
    assert list(ros2_findings(found, of, ADDRESS)) == []
    assert not needs_recreation(found, of, ADDRESS)


def test_the_domain_of_a_template_is_no_reason_to_recreate_the_pod():
    found = pod(WIRED_TO_3, labels={names.INJECT: "true"})
    of = of2(Ros2Spec(domain=5))
    (finding,) = ros2_findings(found, of, ADDRESS)
    assert "Remove the variable from the template" in finding.message
    assert not needs_recreation(found, of, ADDRESS)


def test_a_pod_that_no_webhook_has_seen_is_told():
    (finding,) = ros2_findings(pod(UNSET, static_peers=""), of2(), ADDRESS)
    assert finding.reason == "NotWired"
    assert finding.message.endswith(
        ". Run kubectl -n ros delete pod talker, and create the pod again"
    )


def test_a_pod_that_was_wired_to_a_former_address_is_restarted():
    """The operator advised to remove the variable from the template, which does not have it."""
    former = "10.96.9.9"
    container = PodContainer(variables={"ROS_STATIC_PEERS": former})
    (finding,) = ros2_findings(pod(container, static_peers=former), of2(), ADDRESS)
    assert f"was wired to {former} (ROS_STATIC_PEERS)" in finding.message
    assert f"the proxy is at {ADDRESS} now. Run kubectl -n ros delete pod" in finding.message


@pytest.mark.parametrize(
    ("containers", "static_peers"),
    [
        ((ELSEWHERE,), ""),
        ((ELSEWHERE, UNSET), ""),
        ((UNSET,), ""),
        ((UNSET, UNSET), "10.96.9.9"),
        ((PodContainer("ros:humble", WIRED.variables),), ADDRESS),
    ],
)
def test_a_pod_that_the_proxy_discovers_without_static_peers_is_well(
    containers: tuple[PodContainer, ...], static_peers: str
):
    """Messages flowed, but the doctor told an error."""
    found = pod(*containers, static_peers=static_peers)
    assert ros2_findings_of(found, is_undiscovered=True)
    assert not ros2_findings_of(found, is_undiscovered=False)


def test_the_participants_may_be_of_another_container():
    found = pod(WIRED, ELSEWHERE)
    assert ros2_findings_of(found, is_undiscovered=False) == ["NotWired"]


def test_another_domain_is_told_of_a_discovered_pod():
    found = pod(PodContainer(variables={**WIRED.variables, "ROS_DOMAIN_ID": "9"}))
    assert ros2_findings_of(found, is_undiscovered=False) == ["OtherDomain"]


def ros2_findings_of(of: Pod, *, is_undiscovered: bool) -> list[str]:
    found = ros2_findings(of, of2(), ADDRESS, is_undiscovered=is_undiscovered)
    return [finding.reason for finding in found]


def test_a_plan_knows_the_participants_of_the_proxies():
    of = of2()
    proxy_pod = proxy(of)
    found = pod(ELSEWHERE, static_peers="")
    begun = ClusterState(begun=True)

    def after_a_while(first: ProxyReport, second: ProxyReport) -> list[str]:
        early = observed(of, service(of), found, proxy_pod, reports={proxy_pod.pod.uid: first})
        plan = look(early, begun, 100.0)
        assert not told(plan, "NotWired")
        late = replace(early, reports={proxy_pod.pod.uid: second})
        return told(look(late, plan.state, 100.0 + UNDISCOVERED_FOR_S), "NotWired")

    without = ProxyReport(True, True)
    silent = ProxyReport(False)
    heard = ProxyReport(True, True, participants={found.ip: ("01",)})
    assert after_a_while(without, without)
    assert after_a_while(without, silent)
    assert not after_a_while(without, heard)
    assert not after_a_while(silent, without)
