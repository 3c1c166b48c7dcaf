"""Defaults for the pods of all proxies: parsing, and use in RosProxies."""

from typing import Any

import pytest
from msgspec.structs import replace

from rosproxy.shared.addresses import HostPort
from rosproxy_operator.kubernetes.planner import manifests
from rosproxy_operator.kubernetes.planner.actions import DeleteProxy
from rosproxy_operator.kubernetes.planner.steps.image_check import image_check_pod
from rosproxy_operator.kubernetes.planner.steps.lan_relay import lan_relay_pod
from rosproxy_operator.kubernetes.resources import names
from rosproxy_operator.kubernetes.resources.fields import InvalidField
from rosproxy_operator.kubernetes.resources.model import Json, Ros2Spec, RosProxySpec
from rosproxy_operator.kubernetes.resources.pod_defaults import (
    RESOURCES,
    PodDefaults,
    pod_defaults,
    with_pod_defaults,
)
from tests.unit.operator.kubernetes.objects import (
    SETTINGS,
    creation,
    done,
    kinds,
    look,
    node,
    observed,
    pod,
    proxy,
    rosproxy,
    scene,
    service,
    site,
)

TOLERATION = {"key": "robot", "operator": "Exists", "effect": "NoSchedule"}
DEFAULTS = PodDefaults(
    image_pull_secrets=({"name": "registry"},),
    node_selector={"zone": "a"},
    tolerations=(TOLERATION,),
    resources={"limits": {"memory": "1Gi"}},
    priority_class="high",
    labels={"team": "arms"},
    annotations={"note": "x"},
    run_as_user=10002,
)
WITH_DEFAULTS = replace(SETTINGS, pod=DEFAULTS)
VALUES = {
    "imagePullSecrets": [{"name": "registry"}],
    "nodeSelector": {"zone": "a"},
    "tolerations": [TOLERATION],
    "resources": {"limits": {"memory": "1Gi"}},
    "priorityClassName": "high",
    "labels": {"team": "arms"},
    "annotations": {"note": "x"},
    "runAsUser": 10002,
}


def completed(**changes: Any) -> RosProxySpec:
    """The spec of a RosProxy with the planner's defaults."""
    seen = with_pod_defaults(observed(rosproxy(**changes)), DEFAULTS)
    return seen.rosproxies[0].spec


def test_all_values_are_read() -> None:
    assert pod_defaults(VALUES) == DEFAULTS
    assert pod_defaults({}) == PodDefaults(resources={}, run_as_user=None)


@pytest.mark.parametrize(
    ("value", "told"),
    [
        ([], "proxy.pod: [] is not valid. Write a map of fields"),
        ({"affinity": {}}, "proxy.pod: 'affinity' is unknown. Use imagePullSecrets, "),
        ({"imagePullSecrets": ["x"]}, "proxy.pod.imagePullSecrets[0]: 'x' is not valid"),
        ({"imagePullSecrets": [{}]}, "proxy.pod.imagePullSecrets[0]: {} names no Secret. Write"),
        ({"nodeSelector": {"a b": "c"}}, "proxy.pod.nodeSelector: 'a b' can't be the key of a"),
        ({"tolerations": [{"value": "x"}]}, "proxy.pod.tolerations[0]: {'value': 'x'} has no key"),
        (
            {"tolerations": [{"operator": "Exists", "value": "x"}]},
            "proxy.pod.tolerations[0].value: 'x' goes with the operator Equal only. Remove",
        ),
        (
            {"tolerations": [{"key": "a", "tolerationSeconds": 3}]},
            "proxy.pod.tolerations[0].tolerationSeconds: 3 goes with the effect NoExecute only",
        ),
        (
            {"resources": {"limits": {"memory": "1 GB"}}},
            "proxy.pod.resources.limits.memory: '1 GB' is not a quantity. Write a quantity such",
        ),
        ({"priorityClassName": "High"}, "proxy.pod.priorityClassName: 'High' can't be the name"),
        ({"runAsUser": 0}, "proxy.pod.runAsUser: 0 is not valid. Write an integer from 1 to"),
        ({"labels": {"a": "b c"}}, "proxy.pod.labels.a: 'b c' can't be the value of a label"),
        (
            {"labels": {names.PROXY_OF: "x"}},
            "proxy.pod.labels: 'rosproxy.io/proxy-of' has a prefix that the operator uses itself. "
            "Choose another prefix",
        ),
        (
            {"annotations": {names.NAME_LABEL: "x"}},
            "proxy.pod.annotations: 'app.kubernetes.io/name' has a prefix",
        ),
    ],
)
def test_a_wrong_value_is_named(value: Any, told: str) -> None:
    with pytest.raises(InvalidField) as raised:
        pod_defaults(value)
    assert str(raised.value).startswith(told)


def test_a_rosproxy_without_the_fields_has_the_defaults() -> None:
    spec = completed()
    assert spec.image_pull_secrets == DEFAULTS.image_pull_secrets
    assert spec.node_selector == DEFAULTS.node_selector
    assert spec.tolerations == DEFAULTS.tolerations
    assert spec.resources == DEFAULTS.resources


def test_a_rosproxys_own_fields_come_first_even_if_empty() -> None:
    empty: dict[str, Any] = {
        "image_pull_secrets": (),
        "node_selector": {},
        "tolerations": (),
        "resources": {},
    }
    assert completed(**empty) == rosproxy(**empty).spec


def made(kind: str) -> Json:
    """A pod of a RosProxy that leaves the fields out."""
    of = rosproxy(ros2=Ros2Spec(multicast=True))
    (of,) = with_pod_defaults(observed(of), DEFAULTS).rosproxies
    place = site(of, node())
    if kind == names.LAN_RELAY:
        return lan_relay_pod(place, HostPort("192.0.2.1", 11431), proxy(of), WITH_DEFAULTS)
    if kind == names.IMAGE_CHECK:
        return image_check_pod(place, WITH_DEFAULTS)
    return manifests.proxy_pod(place, WITH_DEFAULTS)


@pytest.mark.parametrize("kind", [names.PROXY, names.LAN_RELAY, names.IMAGE_CHECK])
def test_every_pod_has_the_defaults(kind: str) -> None:
    body = made(kind)
    assert body["spec"]["imagePullSecrets"] == [{"name": "registry"}]
    assert TOLERATION in body["spec"]["tolerations"]
    assert body["spec"]["priorityClassName"] == "high"
    labels = body["metadata"]["labels"]
    assert labels == {"team": "arms", **names.own_labels("robot", kind)}
    assert body["metadata"]["annotations"]["note"] == "x"
    assert body["spec"]["securityContext"]["runAsUser"] == 10002
    (container,) = body["spec"]["containers"]
    own = container["resources"] == DEFAULTS.resources
    assert own is (kind == names.PROXY)


def test_the_service_selects_by_the_operators_own_labels() -> None:
    assert manifests.service(rosproxy())["spec"]["selector"] == names.own_labels("robot")


def test_without_a_user_the_cluster_chooses_one() -> None:
    """Nor is there a group, which an SCC of OpenShift could refuse."""
    settings = replace(SETTINGS, pod=PodDefaults(run_as_user=None))
    place = site(rosproxy(), node())
    for body in (manifests.proxy_pod(place, settings), image_check_pod(place, settings)):
        context = body["spec"]["securityContext"]
        assert not {"runAsUser", "runAsGroup", "supplementalGroups"} & context.keys()
        assert context["runAsNonRoot"] is True


def test_the_kernel_plane_needs_the_images_group() -> None:
    settings = replace(SETTINGS, pod=PodDefaults(run_as_user=None))
    place = site(rosproxy(data_plane="kernel"), node())
    context = manifests.proxy_pod(place, settings)["spec"]["securityContext"]
    assert context["supplementalGroups"] == [10001]
    assert not {"runAsUser", "runAsGroup"} & context.keys()


def test_without_the_option_a_proxy_has_resources() -> None:
    (container,) = creation(look(scene())).body["spec"]["containers"]
    assert container["resources"] == RESOURCES


def test_the_node_selector_decides_which_nodes_have_a_proxy() -> None:
    on = node(labels={"zone": "a"})
    assert creation(look(scene(on), settings=WITH_DEFAULTS)).of == rosproxy().id
    assert done(look(scene(node()), settings=WITH_DEFAULTS)) == []


def test_a_change_creates_the_proxies_anew_one_after_the_other() -> None:
    nodes = [node(name) for name in ("one", "two")]
    pods = [pod(name, on=name) for name in ("one", "two")]
    of = replace(rosproxy(), spec=replace(rosproxy().spec, resources=RESOURCES))
    proxies = [proxy(of, on) for on in nodes]
    seen = observed(rosproxy(), service(), *nodes, *pods, *proxies)
    assert done(look(seen)) == []
    changed = replace(SETTINGS, pod=PodDefaults(priority_class="high"))
    assert kinds(look(seen, settings=changed)) == [DeleteProxy]
