"""Why pods are not wired, and fixes that work."""

from typing import Any

import pytest
from msgspec.structs import replace

from rosproxy_operator.kubernetes.planner.pods.pod_fixes import edit_fix, recreate_command
from rosproxy_operator.kubernetes.planner.pods.recreation import needs_recreation
from rosproxy_operator.kubernetes.planner.pods.ros1_pods import ros1_finding
from rosproxy_operator.kubernetes.resources import objects
from rosproxy_operator.kubernetes.resources.cluster import WebhookState
from rosproxy_operator.kubernetes.resources.names import INJECT
from tests.unit.operator.kubernetes.builders_api import CLUSTER_IP, URI, pod, rosproxy

ADD_LABEL = f"Add the label {INJECT}=arm to the template: kubectl -n robots edit"
SET_BY_HAND = "Set ROS_MASTER_URI=http://rosproxy-arm:11311, and ROS_IP from status.podIP,"
RESTART = "Run kubectl -n robots rollout restart deployment/talker"


@pytest.mark.parametrize(
    ("changes", "reason", "fix"),
    [
        ({"labelled_later": True}, "was added after the pod was created", ADD_LABEL),
        ({"labels": {}}, f"the pod has no label {INJECT}", ADD_LABEL),
        ({"controller": "Node", "workload": ""}, "can't change a static pod", SET_BY_HAND),
        (
            {"not_wired_because": "is selected by two"},
            "could not wire the pod when it was created (is selected by two)",
            RESTART,
        ),
        ({}, "although an operator was ready", "Allow connections from the API server"),
    ],
)
def test_why_a_pod_is_not_wired(changes: dict[str, Any], reason: str, fix: str):
    """All these pods were told to allow connections from the API server, and to restart."""
    since = "2026-01-01T00:00:00Z"
    of = rosproxy(created=since)
    labels = {INJECT: "true"}
    given = {"labels": labels, "workload": "deployment/talker", "created": "2026-02-01T00:00:00Z"}
    finding = ros1_finding(pod(**given | changes), of, CLUSTER_IP, WebhookState(since=since))
    assert finding is not None
    assert reason in finding.text
    assert finding.fix.startswith(fix)


def test_a_pod_whose_template_names_a_former_master_is_not_recreated():
    """The restart that was advised let the nodes bypass the proxy."""
    of = rosproxy(created="2026-01-01T00:00:09Z")
    old = pod(
        wired_master_uri=URI,
        replaced_master_uri="http://former:11311",
        running_since="2026-01-01T00:00:00Z",
        workload="deployment/talker",
        labels={INJECT: "true"},
    )
    finding = ros1_finding(old, of, CLUSTER_IP)
    assert finding is not None
    assert finding.fix == (
        "Remove ROS_MASTER_URI=http://former:11311 from the template, which is not spec.master: "
        "kubectl -n robots edit deployment/talker"
    )
    assert not needs_recreation(old, of, CLUSTER_IP)
    assert needs_recreation(replace(old, replaced_master_uri=""), of, CLUSTER_IP)


def test_fixes_for_the_pod_of_a_job():
    """The template of a Job can't be changed, and the Job may not create the pod again."""
    of_job = pod(workload="job/survey", controller="Job")
    again = "kubectl -n robots delete job/survey, and create the Job again"
    assert recreate_command(of_job) == again
    assert edit_fix("Remove it", of_job) == (
        f"Remove it in the file of the Job or CronJob, then run {again}"
    )


@pytest.mark.parametrize(
    ("setters", "later"),
    [
        ([], False),
        ([{"f:metadata": {"f:labels": {f"f:{INJECT}": {}}}, "f:spec": {}}], False),
        ([{"f:metadata": {"f:labels": {"f:app": {}}}, "f:spec": {}}], False),
        (
            [
                {"f:metadata": {"f:labels": {"f:app": {}}}, "f:spec": {}},
                {"f:metadata": {"f:labels": {f"f:{INJECT}": {}}}},
            ],
            True,
        ),
        (["nonsense", {"f:metadata": 3}], False),
    ],
)
def test_whether_a_pod_got_the_label_after_its_creation(setters: list[Any], later: bool):
    meta = {"name": "a", "managedFields": [{"fieldsV1": fields} for fields in setters]}
    assert objects.pod({"metadata": meta}).labelled_later == later


def test_a_pod_that_names_the_proxy_by_hand_is_told_that_its_nodes_are_unregistered():
    of = rosproxy(created="2026-01-01T00:00:09Z")
    old = pod(own_masters=("http://rosproxy-arm:11311",), running_since="2026-01-01T00:00:00Z")
    finding = ros1_finding(old, of, CLUSTER_IP)
    assert finding is not None
    assert "is older than RosProxy arm" in finding.text
