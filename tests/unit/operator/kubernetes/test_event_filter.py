"""Which events are worth a look."""

import copy
from typing import Any

import pytest

from rosproxy_operator.kubernetes.event_filter import EventFilter
from rosproxy_operator.kubernetes.planner.model import Name
from rosproxy_operator.kubernetes.planner.spec import rosproxy
from rosproxy_operator.kubernetes.snapshot import Cluster
from tests.unit.operator.kubernetes.builders_api import pod_obj, proxy_obj, rosproxy_obj

INJECT = {"rosproxy.io/inject": "true"}


def cluster(**more: Any) -> Cluster:
    fields: dict[str, Any] = {
        "rosproxies": (rosproxy(rosproxy_obj()),),
        "unusable": {},
        "nodes": {},
        "pods": (),
        "proxies": (),
        "services": {},
        "masters": {},
        "selected": frozenset(),
    }
    return Cluster(**{**fields, **more})


@pytest.fixture
def concern() -> EventFilter:
    one = EventFilter()
    one.learn(cluster())
    return one


def changed(obj: dict[str, Any], **status: Any) -> dict[str, Any]:
    other = copy.deepcopy(obj)
    other.setdefault("status", {}).update(status)
    return other


def test_only_a_change_that_a_look_would_see(concern: EventFilter) -> None:
    pod = pod_obj("talker", INJECT)
    assert concern.pod("ADDED", pod)
    assert not concern.pod("MODIFIED", changed(pod, startTime="2026-01-01T00:00:00Z"))
    assert concern.pod("MODIFIED", changed(pod, podIP="10.0.0.9"))
    assert concern.pod("DELETED", pod)
    assert concern.pod("ADDED", pod)


def test_pods_that_nobody_selects_do_not_matter(concern: EventFilter) -> None:
    assert not concern.pod("ADDED", pod_obj("stranger", {}))


def test_a_pod_that_lost_its_label_matters(concern: EventFilter) -> None:
    concern.learn(cluster(selected=frozenset({"uid-talker"})))
    assert concern.pod("MODIFIED", pod_obj("talker", {}))


def test_everything_matters_before_the_first_look() -> None:
    assert EventFilter().pod("ADDED", pod_obj("stranger", {}))


def test_proxies_matter(concern: EventFilter) -> None:
    proxy = proxy_obj(status={"phase": "Pending"})
    assert concern.pod("ADDED", proxy)
    assert not concern.pod("MODIFIED", copy.deepcopy(proxy))
    ready = [{"type": "Ready", "status": "True"}]
    assert concern.pod("MODIFIED", changed(proxy, conditions=ready))


def test_our_own_status_does_not_matter(concern: EventFilter) -> None:
    obj = rosproxy_obj()
    assert concern.rosproxy(None, obj)
    assert not concern.rosproxy("MODIFIED", changed(obj, nodes=1))
    obj["metadata"]["generation"] += 1
    assert concern.rosproxy("MODIFIED", obj)


def test_a_nodes_heartbeat_does_not_matter(concern: EventFilter) -> None:
    ready = {"type": "Ready", "status": "True", "lastHeartbeatTime": "1"}
    node = {"metadata": {"name": "node1", "uid": "u"}, "status": {"conditions": [ready]}}
    assert concern.node("ADDED", node)
    beat = changed(node, conditions=[{**ready, "lastHeartbeatTime": "2"}])
    assert not concern.node("MODIFIED", beat)
    assert concern.node("MODIFIED", changed(node, conditions=[{**ready, "status": "Unknown"}]))


def test_services_of_masters_matter(concern: EventFilter) -> None:
    service = {"metadata": {"name": "roscore", "namespace": "ros", "uid": "u"}, "spec": {}}
    assert not concern.service("ADDED", service)
    concern.learn(cluster(masters={Name("ros", "roscore"): ("", "no such")}))
    assert concern.service("ADDED", service)
    assert not concern.service("MODIFIED", service)


@pytest.mark.parametrize("obj", [{}, {"metadata": None}, {"metadata": {"labels": None}}])
def test_nonsense_does_no_harm(concern: EventFilter, obj: dict[str, Any]) -> None:
    for of in (concern.pod, concern.node, concern.service, concern.rosproxy):
        of("ADDED", obj)


def test_memory_is_bounded(concern: EventFilter, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rosproxy_operator.kubernetes.event_filter.MOST", 5)
    for number in range(20):
        assert concern.pod("ADDED", pod_obj(f"talker{number}", INJECT))
    assert len(concern._seen) <= 5
