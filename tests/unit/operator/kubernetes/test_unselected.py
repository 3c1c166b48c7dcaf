"""Pods with a label for a proxy that no RosProxy selects."""

from typing import Any

import pytest
from msgspec.structs import replace

from rosproxy_operator.kubernetes.planner.actions import Emit
from rosproxy_operator.kubernetes.planner.pods.unselected import MOST_PODS, UNSELECTED_FOR_S
from rosproxy_operator.kubernetes.resources.model import InvalidRosProxy, Name, Pod, Reference
from rosproxy_operator.kubernetes.resources.names import INJECT
from tests.unit.operator.kubernetes.api_server import ApiServer
from tests.unit.operator.kubernetes.builders_api import NAMESPACE, pod_obj, rosproxy_obj
from tests.unit.operator.kubernetes.objects import (
    complete,
    look,
    observed,
    pod,
    rosproxy,
    status,
    told,
    written,
)
from tests.unit.operator.kubernetes.snapshots import snapshot_of, store_of

LOST = "so outside can't reach the ROS nodes of the pod"


def astray(name: str = "astray", label: str = "robott", **changes: Any) -> Pod:
    changes = {"workload": "deployment/talker", **changes}
    return pod(name, labels={INJECT: label}, **changes)


@pytest.mark.parametrize(
    ("label", "fix"),
    [
        ("robott", "Set the label to robot in the template: kubectl -n ros edit deployment/talker"),
        ("True", "Set the label to true in lower case in the template: kubectl -n ros edit"),
    ],
)
def test_a_typo_in_the_label_is_an_event_and_a_line_of_the_status(label: str, fix: str) -> None:
    """At admission only the ReplicaSet controller gets the warning, and drops it."""
    seen = complete(unselected_pods=(astray(label=label),))
    first = look(seen)
    assert told(first, "NotWired") == []

    second = look(seen, first.state, now=100.0 + UNSELECTED_FOR_S)
    (event,) = (a for a in second.actions if isinstance(a, Emit) and a.type == "Warning")
    text = f"label {INJECT}={label} names no RosProxy of namespace ros, {LOST}. {fix}"
    assert event.message.startswith(text)
    assert event.about == Reference("Pod", Name("ros", "astray"), "uid-astray")
    degraded = next(c for c in status(second)["conditions"] if c["type"] == "Degraded")
    assert degraded["message"].startswith(f"pod ros/astray: {text}")

    third = look(written(seen, second), second.state, now=300.0)
    assert not [a for a in third.actions if isinstance(a, Emit)]


def test_a_namespace_without_a_rosproxy_is_reported_at_the_pod() -> None:
    seen = observed(unselected_pods=(astray(label="true"),))
    first = look(seen)
    assert (first.actions, first.next_look_in) == ((), UNSELECTED_FOR_S)
    (event,) = look(seen, first.state, now=200.0).actions
    assert isinstance(event, Emit)
    assert event.message == (
        f"namespace ros has no RosProxy, {LOST}. Create a RosProxy there, then run "
        "kubectl -n ros rollout restart deployment/talker"
    )


def test_a_rosproxy_that_follows_its_pods_is_no_mistake() -> None:
    first = look(observed(unselected_pods=(astray(),)))
    second = look(complete(), first.state, now=130.0)
    assert second.state.unselected == {}
    assert told(look(complete(), second.state, now=200.0), "NotWired") == []


def test_the_ready_condition_does_not_advise_the_label_that_the_pod_has() -> None:
    seen = observed(rosproxy(), unselected_pods=(astray(),))
    plan = look(seen, look(seen).state, now=200.0)
    assert "no pod has a proxy. pod ros/astray: label" in status(plan)["conditions"][0]["message"]


def test_many_pods_make_few_events() -> None:
    pods = tuple(astray(f"p{number:02}") for number in range(MOST_PODS + 30))
    seen = observed(rosproxy(), unselected_pods=pods[::-1])
    texts = told(look(seen, look(seen).state, now=200.0), "NotWired")
    assert [text[:11] for text in texts] == [f"pod ros/p{n:02}:"[:11] for n in range(MOST_PODS)]


def test_beside_a_rosproxy_that_can_not_be_read_nothing_is_said() -> None:
    """The pod may mean that RosProxy, which has a condition."""
    broken = InvalidRosProxy(Name("ros", "robott"), "uid", 1, "spec.ports: is 0")
    seen = replace(observed(unselected_pods=(astray(),)), unusable={broken.id: broken})
    assert told(look(seen, look(seen).state, now=200.0), "NotWired") == []


def test_which_pods_are_seen() -> None:
    server = ApiServer()
    server.put("rosproxies", rosproxy_obj(), NAMESPACE)
    labels = {"a": "true", "b": "armm", "c": "false", "d": "", "e": "arm", "f": "True"}
    for name, label in labels.items():
        server.put("pods", pod_obj(name, {INJECT: label}), NAMESPACE)
    elsewhere: dict[str, Any] = pod_obj("g", {INJECT: "true"})
    elsewhere["metadata"]["namespace"] = "elsewhere"
    server.put("pods", elsewhere, "elsewhere")
    ended: dict[str, Any] = pod_obj("h", {INJECT: "armm"})
    ended["status"]["phase"] = "Succeeded"
    server.put("pods", ended, NAMESPACE)
    assert [p.id.name for p in snapshot_of(server).unselected_pods] == ["b", "f", "g"]


def test_pods_are_known_by_their_addresses() -> None:
    server = ApiServer()
    server.put("rosproxies", rosproxy_obj(), NAMESPACE)
    addresses = {"talker": "10.244.1.9", "host": "192.0.2.1", "ended": "10.244.1.8"}
    for name, address in addresses.items():
        obj: dict[str, Any] = pod_obj(name, {})
        obj["status"] |= {
            "podIP": address,
            "podIPs": [{"ip": address}, {"ip": f"::ffff:{address}"}],
        }
        server.put("pods", obj, NAMESPACE)
    host = server.get("pods", "host", NAMESPACE)
    host["spec"]["hostNetwork"] = True
    server.put("pods", host, NAMESPACE)
    ended = server.get("pods", "ended", NAMESPACE)
    ended["status"]["phase"] = "Failed"
    server.put("pods", ended, NAMESPACE)
    assert store_of(server).pod_names() == {"10.244.1.9": "talker"}
