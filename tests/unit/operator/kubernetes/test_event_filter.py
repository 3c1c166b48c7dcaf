"""Which events are worth a look."""

import copy
from typing import Any

import pytest

from rosproxy_operator.kubernetes.event_filter import EventFilter
from rosproxy_operator.kubernetes.resources.model import ClusterSnapshot, Name
from rosproxy_operator.kubernetes.resources.spec import rosproxy
from tests.unit.operator.kubernetes.builders_api import INJECT, pod_obj, proxy_obj, rosproxy_obj


def cluster(**more: Any) -> ClusterSnapshot:
    return ClusterSnapshot(**{"rosproxies": (rosproxy(rosproxy_obj()),), **more})


@pytest.fixture
def event_filter() -> EventFilter:
    one = EventFilter()
    one.last = cluster()
    return one


def changed(obj: dict[str, Any], **status: Any) -> dict[str, Any]:
    other = copy.deepcopy(obj)
    other.setdefault("status", {}).update(status)
    return other


def test_only_a_change_that_a_look_would_see(event_filter: EventFilter) -> None:
    pod = pod_obj("talker", INJECT)
    assert event_filter.pod("ADDED", pod)
    assert not event_filter.pod("MODIFIED", changed(pod, startTime="2026-01-01T00:00:00Z"))
    assert event_filter.pod("MODIFIED", changed(pod, podIP="10.0.0.9"))
    assert event_filter.pod("DELETED", pod)
    assert event_filter.pod("ADDED", pod)


def test_pods_that_nobody_selects_do_not_matter(event_filter: EventFilter) -> None:
    assert not event_filter.pod("ADDED", pod_obj("stranger", {}))


def test_a_pod_that_lost_its_label_matters(event_filter: EventFilter) -> None:
    event_filter.last = cluster(selected=frozenset({"uid-talker"}))
    assert event_filter.pod("MODIFIED", pod_obj("talker", {}))


def test_everything_matters_before_the_first_look() -> None:
    assert EventFilter().pod("ADDED", pod_obj("stranger", {}))


def test_proxies_matter(event_filter: EventFilter) -> None:
    proxy = proxy_obj(status={"phase": "Pending"})
    assert event_filter.pod("ADDED", proxy)
    assert not event_filter.pod("MODIFIED", copy.deepcopy(proxy))
    ready = [{"type": "Ready", "status": "True"}]
    assert event_filter.pod("MODIFIED", changed(proxy, conditions=ready))


def test_our_own_status_does_not_matter(event_filter: EventFilter) -> None:
    obj = rosproxy_obj()
    assert event_filter.rosproxy(None, obj)
    assert not event_filter.rosproxy("MODIFIED", changed(obj, nodes=1))
    obj["metadata"]["generation"] += 1
    assert event_filter.rosproxy("MODIFIED", obj)


def test_a_nodes_heartbeat_does_not_matter(event_filter: EventFilter) -> None:
    ready = {"type": "Ready", "status": "True", "lastHeartbeatTime": "1"}
    node = {"metadata": {"name": "node1", "uid": "u"}, "status": {"conditions": [ready]}}
    assert event_filter.node("ADDED", node)
    beat = changed(node, conditions=[{**ready, "lastHeartbeatTime": "2"}])
    assert not event_filter.node("MODIFIED", beat)
    assert event_filter.node("MODIFIED", changed(node, conditions=[{**ready, "status": "Unknown"}]))


def test_services_of_masters_matter(event_filter: EventFilter) -> None:
    service = {"metadata": {"name": "roscore", "namespace": "ros", "uid": "u"}, "spec": {}}
    assert not event_filter.service("ADDED", service)
    event_filter.last = cluster(masters={Name("ros", "roscore"): ("", "no such")})
    assert event_filter.service("ADDED", service)
    assert not event_filter.service("MODIFIED", service)


@pytest.mark.parametrize("obj", [{}, {"metadata": None}, {"metadata": {"labels": None}}])
def test_nonsense_does_no_harm(event_filter: EventFilter, obj: dict[str, Any]) -> None:
    for of in (event_filter.pod, event_filter.node, event_filter.service, event_filter.rosproxy):
        of("ADDED", obj)


def test_memory_is_bounded(event_filter: EventFilter, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rosproxy_operator.kubernetes.event_filter.MOST", 5)
    for number in range(20):
        assert event_filter.pod("ADDED", pod_obj(f"talker{number}", INJECT))
    assert len(event_filter._seen) <= 5
