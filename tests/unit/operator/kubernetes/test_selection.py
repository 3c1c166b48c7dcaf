"""The pods that a RosProxy selects."""

from typing import Any

import pytest
from msgspec.structs import replace

from rosproxy_operator.common.zenoh import tcp_endpoint
from rosproxy_operator.kubernetes.planner.pods.selection import (
    ambiguity_warning,
    matches,
    on_node,
    select_rosproxy,
    why_not_selected,
)
from rosproxy_operator.kubernetes.resources.model import ClusterFinding, ClusterNode, Name, Selector
from rosproxy_operator.kubernetes.resources.names import own_labels, router_of
from tests.unit.operator.kubernetes.builders_api import pod, rosproxy

INJECT = "rosproxy.io/inject"
ALL = Selector()


def expression(key: str, operator: str, *values: str) -> Selector:
    return Selector(expressions=((key, operator, frozenset(values)),))


@pytest.mark.parametrize(
    ("selector", "labels", "fits"),
    [
        (ALL, {}, True),
        (Selector({"a": "1"}), {"a": "1", "b": "2"}, True),
        (Selector({"a": "1"}), {"a": "2"}, False),
        (Selector({"a": ""}), {}, False),
        (expression("a", "In", "1", "2"), {"a": "2"}, True),
        (expression("a", "In", "1"), {}, False),
        (expression("a", "NotIn", "1"), {"a": "1"}, False),
        (expression("a", "NotIn", "1"), {}, True),
        (expression("a", "Exists"), {"a": ""}, True),
        (expression("a", "Exists"), {}, False),
        (expression("a", "DoesNotExist"), {}, True),
        (expression("a", "DoesNotExist"), {"a": ""}, False),
        (expression("a", "Gt", "1"), {"a": "2"}, False),
    ],
)
def test_label_selectors(selector, labels, fits):
    assert matches(selector, labels) is fits


@pytest.mark.parametrize(
    ("more", "taken"),
    [
        ({"labels": {INJECT: "true"}}, True),
        ({"labels": {INJECT: "arm"}}, True),
        ({"labels": {INJECT: "leg"}}, False),
        ({"namespace": "other"}, False),
    ],
)
def test_a_pod_is_taken_by_its_label_in_its_namespace(more, taken):
    arm = rosproxy()

    assert select_rosproxy(pod(**more), [arm]) is (arm if taken else None)


@pytest.mark.parametrize(
    "labels",
    [
        {INJECT: "false"},
        {INJECT: ""},
        own_labels("arm"),
        {"app.kubernetes.io/name": "rosproxy", "app.kubernetes.io/component": "operator"},
        {"app.kubernetes.io/part-of": "rosproxy", "app.kubernetes.io/component": "operator"},
    ],
)
def test_pods_that_no_selector_takes(labels):
    assert select_rosproxy(pod(labels=labels), [rosproxy(selector=ALL)]) is None


def test_a_rosproxy_that_is_being_deleted_takes_no_pod():
    gone = rosproxy("gone", deleting=True)
    new = rosproxy("new")

    assert select_rosproxy(pod(), [gone, new]) is new


def test_of_two_the_label_decides():
    arm = rosproxy("arm", ALL)
    leg = rosproxy("leg", ALL)

    assert select_rosproxy(pod(labels={INJECT: "leg"}), [arm, leg]) is leg


@pytest.mark.parametrize("labels", [{INJECT: "true"}, {}, {INJECT: "third"}])
def test_a_pod_that_two_select_has_none(labels):
    arm = rosproxy("arm", ALL)
    leg = rosproxy("leg", ALL)

    finding = select_rosproxy(pod(labels=labels), [leg, arm])

    assert isinstance(finding, ClusterFinding)
    assert (finding.reason, finding.of) == ("Ambiguous", arm.id)
    assert finding.subject == "pod robots/talker"
    assert finding.about is not None
    assert (finding.about.kind, finding.about.uid) == ("Pod", "uid-talker")
    assert "arm and leg" in finding.message
    assert f"{INJECT}=arm" in finding.message


@pytest.mark.parametrize(
    "wired",
    [
        {"wired_master_uri": "http://10.96.0.7:11311"},
        {"static_peers": "10.96.0.7"},
        {"router_endpoint": tcp_endpoint(router_of("10.96.0.7"))},
    ],
)
def test_a_wired_pod_stays_when_a_second_rosproxy_selects_the_pod(wired):
    """Without its proxy, the nodes of the pod would be unregistered at the master for good."""
    arm = rosproxy("arm", ALL, cluster_ip="10.96.0.7")
    leg = rosproxy("leg", ALL, cluster_ip="10.96.0.8")
    talker = pod(workload="deployment/talker", **wired)

    assert select_rosproxy(talker, [leg, arm]) is arm
    text = str(ambiguity_warning(talker, [leg, arm]))
    assert "is selected by RosProxy arm and leg. This pod stays with arm, but a new pod" in text
    assert f"{INJECT}=arm in the template: kubectl -n robots edit deployment/talker" in text


def test_a_clear_choice_has_no_warning():
    arm = rosproxy("arm", ALL, cluster_ip="10.96.0.7")
    leg = rosproxy("leg", ALL, cluster_ip="10.96.0.8")
    wired: Any = {"wired_master_uri": "http://10.96.0.7:11311"}

    assert not ambiguity_warning(pod(**wired), [arm])
    assert not ambiguity_warning(pod(), [arm, leg])
    assert not ambiguity_warning(pod(labels={INJECT: "arm"}, **wired), [arm, leg])
    assert select_rosproxy(pod(labels={INJECT: "leg"}, **wired), [arm, leg]) is leg


def test_a_pod_in_its_nodes_own_network_is_left_out():
    finding = select_rosproxy(pod(host_network=True, workload="deployment/a"), [rosproxy()])

    assert isinstance(finding, ClusterFinding)
    assert (finding.reason, finding.of) == ("HostNetwork", Name("robots", "arm"))
    assert finding.message.endswith("from the template: kubectl -n robots edit deployment/a")
    of = rosproxy("arm", Selector({"app": "x"}))
    by_selector = select_rosproxy(pod(labels={"app": "x"}, host_network=True), [of])
    assert isinstance(by_selector, ClusterFinding)
    assert by_selector.fix.startswith(
        f"Remove hostNetwork from the template, or add the label {INJECT}=false, then "
    )


def test_a_pod_that_is_not_labelled_needs_no_warning():
    assert not why_not_selected(pod(labels={}), [])
    assert not why_not_selected(pod(labels={INJECT: "false"}), [])


@pytest.mark.parametrize(
    ("label", "rosproxies", "said"),
    [
        ("true", [], "namespace robots has no RosProxy"),
        ("true", [rosproxy("arm", namespace="other")], "namespace robots has no RosProxy"),
        ("leg", [rosproxy("arm"), rosproxy("hand")], "Set the label to arm or hand"),
        ("true", [rosproxy("arm", Selector({"app": "x"}))], "spec.podSelector of RosProxy arm"),
        ("arm", [rosproxy("arm", Selector({"app": "x"}))], "spec.podSelector of RosProxy arm"),
    ],
)
def test_why_no_rosproxy_takes_a_labelled_pod(label, rosproxies, said):
    text = str(why_not_selected(pod(labels={INJECT: label}), rosproxies))

    assert said in text
    assert "create" in text


def test_labels_that_do_not_match_are_named_with_the_commands():
    """The text named neither the labels nor a command for the selector."""
    labels = (expression("tier", "In", "b", "a"), expression("zone", "NotIn", "z"),
              expression("old", "DoesNotExist"), expression("new", "Exists"))  # fmt: skip
    every = tuple(e for selector in labels for e in selector.expressions)
    rosproxies = [rosproxy("leg", Selector({"app": "x"}, every)), rosproxy("arm")]

    talker = pod(labels={INJECT: "leg"}, workload="deployment/a")
    text = str(why_not_selected(talker, rosproxies))

    assert "RosProxy leg (app=x,tier in (a,b),zone notin (z),!old,new), so" in text
    assert text.endswith(
        "Add the missing labels to the template: kubectl -n robots edit deployment/a. Or correct "
        "the selector: kubectl -n robots edit rosproxy leg; then run kubectl -n robots rollout "
        "restart deployment/a"
    )


@pytest.mark.parametrize(
    ("wanted", "fits"), [({}, True), ({"disk": "ssd"}, True), ({"disk": "hdd"}, False)]
)
def test_nodes_that_may_have_a_proxy(wanted, fits):
    arm = rosproxy()
    picky = replace(arm, spec=replace(arm.spec, node_selector=wanted))

    assert on_node(picky, ClusterNode("node1", {"disk": "ssd"})) is fits
