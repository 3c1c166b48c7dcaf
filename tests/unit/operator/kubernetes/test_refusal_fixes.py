"""Fixes for refusals of Kubernetes, by the text of the refusal."""

import pytest

from rosproxy_operator.kubernetes.status.refusal_fixes import (
    admission_fix,
    image_fix,
    scheduling_fix,
)
from tests.unit.operator.kubernetes.builders_api import rosproxy

POD = 'pods "rosproxy-arm-node1-1" is forbidden: '


@pytest.mark.parametrize(
    ("message", "fix"),
    [
        ("exceeded quota: q, requested: limits.memory=512Mi, used: limits.memory=1Gi, limited: "
         "limits.memory=1Gi", "Raise this ResourceQuota, or lower spec.resources"),
        ("exceeded quota: q, requested: pods=1, used: pods=9, limited: pods=9",
         "Raise this ResourceQuota"),
        ("insufficient quota to consume: count/pods", "Raise this ResourceQuota"),
        ("failed quota: q: must specify limits.cpu for: rosproxy; requests.memory for: rosproxy",
         "Set spec.resources.limits.cpu and spec.resources.requests.memory, or a default in the "
         "LimitRange of the namespace"),
        ("failed quota: q: must specify cpu for: rosproxy",
         "Set spec.resources.requests.cpu, or a default in the LimitRange of the namespace"),
        ("minimum memory usage per Container is 128Mi, but request is 64Mi",
         "Raise spec.resources, or lower the minimum in the LimitRange of the namespace"),
        ("maximum memory usage per Container is 256Mi, but limit is 512Mi",
         "Lower spec.resources, or raise the maximum in the LimitRange of the namespace"),
        ("[maximum cpu usage per Container is 1.  No limit is specified, maximum memory usage per "
         "Pod is 1Gi, but limit is 2Gi]",
         "Set this resource in spec.resources, or a default in the LimitRange of the namespace"),
        ("memory max limit to request ratio per Container is 2, but provided ratio is 8.000000",
         "Set requests and limits in spec.resources that differ less, or raise the ratio in the "
         "LimitRange of the namespace"),
        ("no PriorityClass with name robots was found",
         "Create this PriorityClass, or correct the webhook that names it in pods"),
        ("violates PodSecurity \"baseline:latest\": hostPort (container uses hostPorts 1, 2)",
         "A proxy needs hostPorts. This requires Pod Security privileged. Run kubectl label "
         "namespace robots pod-security.kubernetes.io/enforce=privileged --overwrite"),
        ("etcdserver: request timed out", "The operator tries again"),
    ],
)  # fmt: skip
def test_a_refusal_of_the_api_server(message: str, fix: str) -> None:
    assert admission_fix(POD + message, rosproxy()) == fix


@pytest.mark.parametrize(
    ("message", "fix"),
    [
        ('admission webhook "policy.example" denied the request: no hostPorts',
         "Allow this object in the policy of the webhook"),
        ('Internal error occurred: failed calling webhook "policy.example": timeout',
         "Repair this webhook. The operator tries again"),
    ],
)  # fmt: skip
def test_a_refusal_of_a_webhook(message: str, fix: str) -> None:
    assert admission_fix(message, rosproxy()) == fix


@pytest.mark.parametrize(
    ("message", "fix"),
    [
        ("Unschedulable: 0/3 nodes are available: 1 node(s) had untolerated taint(s), 2 node(s) "
         "didn't satisfy plugin(s) [NodeAffinity]", "Set spec.tolerations as in your pods"),
        ("Unschedulable: 0/3 nodes are available: 1 Insufficient memory",
         "Make room on the node, or lower spec.resources.requests"),
        ("OutOfcpu: Node didn't have enough resource: cpu",
         "Make room on the node, or lower spec.resources.requests"),
        ("0/1 nodes are available: 1 Too many pods",
         "Remove pods from the node, or raise maxPods of its kubelet"),
        ("SysctlForbidden: forbidden sysctl",
         "Allow the sysctl net.ipv4.ip_local_port_range in the kubelet"),
        ("Evicted", "Make room on the node, or set spec.tolerations or spec.resources"),
    ],
)  # fmt: skip
def test_a_pod_that_no_node_takes(message: str, fix: str) -> None:
    assert scheduling_fix(message) == fix


@pytest.mark.parametrize(
    ("message", "fix"),
    [
        ('Container image "x:1" is not present with pull policy of Never',
         "Load the image on the node, or correct spec.image or spec.imagePullPolicy"),
        ("failed to pull and unpack image: pull access denied, repository does not exist or may "
         "require authorization", "Correct the image's name, or set spec.imagePullSecrets"),
        ('failed to do request: Head "https://r.example/v2/x": dial tcp: lookup r.example: no such '
         "host", "Let the node reach the registry, or load the image on the node"),
        ("failed to resolve reference r.example/x:1: not found",
         "Correct the image's name in spec.image or the chart's proxy.image, or load the image on "
         "the node"),
        ("ErrImagePull", "Load the image on the node, or set spec.image, spec.imagePullPolicy or "
         "spec.imagePullSecrets"),
    ],
)  # fmt: skip
def test_an_image_that_a_node_can_not_get(message: str, fix: str) -> None:
    assert image_fix(message) == fix
