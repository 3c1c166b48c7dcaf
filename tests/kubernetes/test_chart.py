"""The objects of the chart for combinations of values, checked by the API server."""

import json
import time
from collections.abc import Iterator
from functools import cache
from typing import Any

import pytest

from tests.chart.chart import NAMESPACE, combinations, objects
from tests.docker.engine import wait_until
from tests.kubernetes import api, release
from tests.kubernetes.api import Json
from tests.kubernetes.cluster.control_plane import kubectl
from tests.kubernetes.cluster.layout import NODES
from tests.kubernetes.pods import Namespace, namespace
from tests.kubernetes.robot import Robot
from tests.kubernetes.rosproxies import NOWHERE, RosProxy, rosproxy
from tests.kubernetes.traffic import START, wait_for_service

FOREIGN = {"cert-manager.io/v1", "monitoring.coreos.com/v1"}
"""Groups without definitions in this cluster."""
SECRET = "rosproxy-operator-webhook"


@pytest.fixture(scope="module")
def namespaces(_release: None) -> Iterator[None]:
    """The namespaces that the combinations name."""
    with namespace("robots"), namespace("arms"), namespace("monitoring"):
        yield


@pytest.fixture(scope="module")
def restored(_release: None) -> Iterator[None]:
    """Restore the usual values of the release afterwards."""
    yield
    release.upgrade()


@cache
def every_object() -> list[Json]:
    """Each object of any combination, once."""
    distinct = {json.dumps(body, sort_keys=True): body
                for _, values in combinations(2) for body in objects(values)
                if body["apiVersion"] not in FOREIGN}  # fmt: skip
    return list(distinct.values())


def try_to_create(body: Json) -> str:
    """Create an object in a dry run. Return the API server's objections.

    The API server reports an existing name last, after all checks. A missing RosProxy is right,
    because a dry run creates nothing.
    """
    group, _, version = body["apiVersion"].rpartition("/")
    start = f"/apis/{group}/{version}" if group else f"/api/{version}"
    place = body["metadata"].get("namespace")
    middle = f"/namespaces/{place}" if place else ""
    url_path = f"{start}{middle}/{plural(body['kind'])}"
    try:
        _, warnings = api.call("POST", url_path, body,
                               query={"dryRun": "All", "fieldValidation": "Strict"})  # fmt: skip
    except api.Refused as refused:
        exists = refused.status == 409 and "already exists" in refused.text
        return "" if exists else refused.text
    return "" if "has no RosProxy" in warnings else warnings


def plural(kind: str) -> str:
    singular = kind.lower()
    return (
        {"y": f"{singular[:-1]}ies"}.get(singular[-1], f"{singular}s")
        if kind != "RosProxy"
        else "rosproxies"
    )


def test_every_combination_is_accepted(namespaces: None) -> None:
    bodies = every_object()
    assert len({body["kind"] for body in bodies}) == 16
    assert len(bodies) > 50
    refused = {f"{body['kind']} {body['metadata']['name']}": text
               for body in bodies if (text := try_to_create(body))}  # fmt: skip
    assert refused == {}


def test_every_pod_is_restricted(namespaces: None) -> None:
    """The API server itself checks the standard, which the release's namespace enforces."""
    pods = {
        json.dumps(spec, sort_keys=True): spec for spec in map(pod_spec, every_object()) if spec
    }
    assert len(pods) > 5
    for spec in pods.values():
        plain = {**spec, "serviceAccountName": "default"}
        plain.pop("priorityClassName", None)
        body = {"apiVersion": "v1", "kind": "Pod", "spec": plain,
                "metadata": {"name": "a-pod", "namespace": NAMESPACE}}  # fmt: skip
        assert try_to_create(body) == ""


def pod_spec(body: Json) -> Any:
    if body["kind"] == "Pod":
        return body["spec"]
    return body["spec"]["template"]["spec"] if body["kind"] == "Deployment" else None


GOOD: list[Json] = [
    {"master": {"uri": "http://robot"}},
    {"master": {"uri": "http://robot.local:11311/"}},
    {"master": {"uri": "http://my_robot:1", "address": "2001:db8::1"}},
    {"master": {"uri": "http://[2001:db8::1]:65535/"}},
    {"master": {"uri": "http://localhost.example:11311"}},
    {"master": {"service": {"name": "m", "namespace": "n", "port": 1}, "publish": 11399}},
    {"master": {"uri": "http://r"}, "ports": 500, "portWindow": {"first": 29500}},
    {"master": {"uri": "http://r"}, "podSelector": {}},
    {
        "master": {"uri": "http://r"},
        "tolerations": [
            {"operator": "Exists"},
            {"key": "a", "value": "b", "effect": "NoExecute", "tolerationSeconds": 3},
        ],
    },
    {"master": {"uri": "http://r"}, "resources": {"limits": {"cpu": 1, "memory": "1Gi"}}},
    {"master": {"uri": "http://r"}, "resources": {}, "cleanupAfterSeconds": 0, "graceSeconds": 0},
    {"master": {"uri": "http://r"}, "hostAliases": [{"ip": "1.2.3.4", "hostnames": ["Robot"]}]},
    {"master": {"uri": "http://r"}, "policy": {"slaveControl": "Master"}},
    {"master": {"uri": "http://r"}, "dataPlane": "Kernel"},
    {"master": {"uri": "http://r"}, "direction": "Both"},
    {"master": {"uri": "http://r"}, "direction": "Both", "podEgress": "Proxy", "udp": True},
]
BAD: list[tuple[Json, str]] = [
    ({"master": {"uri": "http://r:65536"}}, "must be of the form http://host:11311"),
    ({"master": {"uri": "http://r:0"}}, "must be of the form http://host:11311"),
    ({"master": {"uri": "http://r /"}}, "must be of the form http://host:11311"),
    ({"master": {"uri": "http://LocalHost"}}, "a loopback address"),
    ({"master": {"uri": "http://[::1]:11311"}}, "a loopback address"),
    ({"master": {"uri": "http://r", "address": "1.2.3.256"}}, "an IP address such as"),
    ({"master": {"service": {"name": "m"}, "address": "1.2.3.4"}}, "a service needs none"),
    ({"master": {"service": {"name": "m"}, "publish": 11311}}, "the proxy's own ports"),
    ({"master": {"service": {"name": "m"}, "publish": 11412}}, "lies in portWindow"),
    ({"master": {"uri": "http://r", "publish": 11300}}, "is outside already"),
    ({"master": {"uri": "http://r"}, "portWindow": {"last": 70000}}, "portWindow.last"),
    ({"master": {"uri": "http://r"}, "dataPlane": "kernel"}, "dataPlane"),
    ({"master": {"uri": "http://r"}, "direction": "In"}, "direction"),
    ({"master": {"uri": "http://r"}, "podEgress": "Proxy"}, "direction: Both"),
    ({"master": {"uri": "http://r"}, "udp": True}, "direction: Both"),
    ({"master": {"uri": "http://r"}, "tolerations": [{"key": "", "operator": "Exists"}]}, "key"),
    ({"master": {"uri": "http://r"}, "tolerations": [{"value": "a"}]}, "needs the operator Exists"),
    (
        {
            "master": {"uri": "http://r"},
            "tolerations": [{"key": "a", "operator": "Exists", "value": "b"}],
        },
        "has no value",
    ),
    (
        {"master": {"uri": "http://r"}, "tolerations": [{"key": "a", "tolerationSeconds": 1}]},
        "NoExecute only",
    ),
    ({"master": {"uri": "http://r"}, "resources": {"limits": {"cpu": "many"}}}, "limits.cpu"),
    ({"master": {"uri": "http://r"}, "hostAliases": [{"ip": "1.2.3.4"}]}, "hostnames"),
    ({"master": {"uri": "http://r"}, "typo": 1}, "typo"),
]


@pytest.mark.parametrize("spec", GOOD, ids=str)
def test_good_specs(spec: Json, namespaces: None) -> None:
    assert try_to_create(rosproxy_of(spec)) == ""


@pytest.mark.parametrize(("spec", "words"), BAD)
def test_bad_specs(spec: Json, words: str, namespaces: None) -> None:
    assert words in try_to_create(rosproxy_of(spec))


def rosproxy_of(spec: Json) -> Json:
    return {"apiVersion": "rosproxy.io/v1alpha1", "kind": "RosProxy", "spec": spec,
            "metadata": {"name": "robot", "namespace": "robots"}}  # fmt: skip


def test_upgrade_keeps_the_certificate(restored: None) -> None:
    wait_until(lambda: certificate() != (None, None), 60, "a certificate")
    before = certificate()
    assert all(before)
    release.upgrade(webhook={"timeoutSeconds": 7}, commonLabels={"changed": "yes"})
    assert certificate() == before
    (webhook,) = api.get("mutatingwebhookconfigurations", "", release.FULL_NAME)["webhooks"]
    assert webhook["timeoutSeconds"] == 7


def test_the_readmes_command_and_the_notes_example(net: Namespace, robot: Robot) -> None:
    try:
        example = release.install_as_the_readme_says(net.name, robot.master_uri)
        release.wait_operator(namespace=net.name)
        assert f"uri: {robot.master_uri}\n" in example
        kubectl("-n", net.name, "apply", "-f", "-", input=example)
        made = RosProxy(net.name, "robot")
        wait_for_service(net)
        net.node("rospy", "pub", "--topic", "/readme", "--word", "inside", on="node1")
        listener = robot.node("listener_readme", "rospy", "sub", "--topic", "/readme")
        listener.wait_for("inside", seconds=START)
        made.wait_for("MasterReachable")
        made.wait_for("Degraded", "False")
    finally:
        release.remove()
        release.install()
        release.wait_operator()


def certificate() -> tuple[Any, Any]:
    """The certificate of the webhook, and the CA bundle for the API server."""
    secret = api.get("secrets", release.NAMESPACE, SECRET)
    (webhook,) = api.get("mutatingwebhookconfigurations", "", release.FULL_NAME)["webhooks"]
    return secret.get("data"), webhook["clientConfig"].get("caBundle")


def test_deleted_certificate_is_made_anew(net: Namespace, restored: None) -> None:
    """Helm restores the empty Secret, and the operator fills the Secret."""
    wait_until(lambda: certificate() != (None, None), 60, "a certificate")
    before = certificate()
    api.delete("secrets", release.NAMESPACE, SECRET)
    release.upgrade(commonLabels={"changed": "again"})
    wait_until(lambda: all(certificate()), 60, "a certificate")
    assert certificate() != before
    rosproxy(net.name, master=NOWHERE)
    wait_until(lambda: bool(net.idle().environment.get("ROS_MASTER_URI")), 60, "a wired pod")


def test_operators_in_the_networks_of_their_nodes(
    net: Namespace, robot: Robot, restored: None
) -> None:
    level = "pod-security.kubernetes.io/enforce"
    nodes = {node.address for node in NODES}
    blocks = [{"ipBlock": {"cidr": f"{address}/32"}} for address in sorted(nodes)]
    kubectl("label", "--overwrite", "namespace", release.NAMESPACE, f"{level}=privileged")
    try:
        release.upgrade(hostNetwork=True, proxy={"networkPolicy": {"metricsFrom": blocks}})
        release.wait_operator(namespace=net.name)
        assert {pod.ip for pod in release.operators()} == nodes
        made = rosproxy(net.name, master={"uri": robot.master_uri}, ports=8)
        wait_for_service(net)
        net.node("rospy", "pub", "--topic", "/host", "--word", "inside", on="node1")
        listener = robot.node("listener_host", "rospy", "sub", "--topic", "/host")
        listener.wait_for("inside", seconds=START)
        made.wait_for("MasterReachable")
        made.wait_for("Degraded", "False")
    finally:
        release.upgrade()
        release.wait_operator()
        kubectl("label", "--overwrite", "namespace", release.NAMESPACE, f"{level}=restricted")


def test_rights_in_named_namespaces(net: Namespace, restored: None) -> None:
    """With `namespaces`, Roles suffice; RosProxies elsewhere are left alone."""
    with namespace() as other:
        release.upgrade(namespaces=[net.name])
        rosproxy(other.name, master=NOWHERE)
        made = rosproxy(net.name, master=NOWHERE, ports=4)
        wait_until(lambda: bool(made.service), 60, made.tell)
        net.idle()
        other.idle()
        made.wait_event("ProxyCreated")
        wait_until(lambda: bool(made.proxies), 60, made.tell)
        started = time.monotonic()
        wait_until(lambda: time.monotonic() > started + 2, 5, "a few more looks")
        assert api.get("services", other.name, "rosproxy-robot") == {}
        assert api.get("rosproxies", other.name, "robot").get("status", {}) == {}
