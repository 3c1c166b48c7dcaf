"""Keeping up with a cluster, from an API server on loopback that forgets, refuses and restarts."""

import asyncio
import copy
from collections.abc import AsyncIterator
from typing import Any

import pytest

from rosproxy_operator.common.problem import Fault
from rosproxy_operator.kubernetes.api import api_client as api_module
from rosproxy_operator.kubernetes.api.api_client import Api, ApiError, ApiNotFound, ApiUnavailable
from rosproxy_operator.kubernetes.proxies import sandbox
from rosproxy_operator.kubernetes.proxies.sandbox import SandboxFailures
from rosproxy_operator.kubernetes.resources.cluster import (
    ClusterSnapshot,
    PodFailure,
)
from rosproxy_operator.kubernetes.resources.model import Name
from rosproxy_operator.kubernetes.resources.names import PLURAL
from rosproxy_operator.kubernetes.resources.objects import master_service
from rosproxy_operator.kubernetes.resources.records import READERS
from rosproxy_operator.kubernetes.watch import reflector
from rosproxy_operator.kubernetes.watch.reflector import Reflector, watched_collections
from rosproxy_operator.kubernetes.watch.store import ClusterStore, StoreChanges, read_master
from tests.unit.operator.kubernetes.api_server import ApiServer, until
from tests.unit.operator.kubernetes.builders_api import (
    INJECT,
    NAMESPACE,
    pod_obj,
    proxy_obj,
    rosproxy_obj,
    service_obj,
)

SERVICE = {"service": {"name": "roscore", "namespace": "ros", "port": 11311}}
SANDBOX = 'Failed to create pod sandbox: plugin "portmap" (id "{}"): cannot open hostport 11400'
KINDS = ("rosproxies", "nodes", "pods", "services", "networkpolicies")


class Seen:
    """A store with reflectors."""

    def __init__(self, api: Api) -> None:
        self.woken = self.back = self.lost = self.corrected = 0
        kinds = watched_collections(api)
        self.store = ClusterStore(
            kinds, api.namespaces_of(PLURAL), self.wake, self.come_back, self.correct
        )
        soon = asyncio.get_running_loop().call_soon_threadsafe
        self.all = [Reflector(api, collection, self.store, soon, self.lose) for collection in kinds]

    def wake(self) -> None:
        self.woken += 1

    def come_back(self) -> None:
        self.back += 1

    def lose(self) -> None:
        self.lost += 1

    def correct(self, count: int) -> None:
        self.corrected += count

    async def read(self) -> ClusterSnapshot:
        await self.store.check()
        return self.store.snapshot()

    def pods(self) -> set[str]:
        return {pod.id.name for pod in self.store.snapshot().pods}


@pytest.fixture
async def seen(api: Api, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Seen]:
    monkeypatch.setattr(reflector, "RETRY_PAUSES_S", (0.02,))
    monkeypatch.setattr(api_module, "MOST_PAGE_ITEMS", 2)
    reflected_store = Seen(api)
    yield reflected_store
    for collection_reflector in reflected_store.all:
        collection_reflector.stop()
    await asyncio.gather(*(asyncio.to_thread(r.join) for r in reflected_store.all))
    assert not [r for r in reflected_store.all if r._thread.is_alive()]


def start(seen: Seen) -> None:
    for collection_reflector in seen.all:
        collection_reflector.start()


async def begun(server: ApiServer, seen: Seen) -> ClusterSnapshot:
    """Start, wait for all watches, and return the snapshot."""
    start(seen)
    await until(lambda: all(server.watches(kind) == 1 for kind in KINDS))
    return await seen.read()


def node(name: str) -> dict[str, Any]:
    return {
        "metadata": {"name": name},
        "status": {"conditions": [{"type": "Ready", "status": "True"}]},
    }


def with_port(obj: dict[str, Any]) -> dict[str, Any]:
    obj["spec"]["containers"] = [{"name": "main", "ports": [{"hostPort": 80}]}]
    return obj


def changed(obj: dict[str, Any], **status: Any) -> dict[str, Any]:
    other = copy.deepcopy(obj)
    other.setdefault("status", {}).update(status)
    return other


def put_all(server: ApiServer) -> None:
    server.put("rosproxies", rosproxy_obj(), NAMESPACE)
    for name in ("node1", "node2", "node3"):
        server.put("nodes", node(name))
    server.put("pods", pod_obj("talker", INJECT), NAMESPACE)
    server.put("pods", pod_obj("stranger", {}), NAMESPACE)
    server.put("pods", pod_obj("far", {}, nodeName="node3"), NAMESPACE)
    server.put("pods", proxy_obj(node="node2"), NAMESPACE)
    for name in ("silent", "holder"):
        obj = pod_obj(name, {})
        obj["metadata"]["namespace"] = "other"
        server.put("pods", with_port(obj) if name == "holder" else obj, "other")


async def test_what_matters_is_seen(server: ApiServer, seen: Seen) -> None:
    put_all(server)
    snapshot = await begun(server, seen)
    assert [rosproxy.id.name for rosproxy in snapshot.rosproxies] == ["arm"]
    assert set(snapshot.nodes) == {"node1", "node2", "node3"}
    names = {pod.id.name for pod in snapshot.pods if not pod.id.name.startswith("rosproxy-")}
    assert names == {"talker", "stranger", "holder"}
    assert [proxy.node for proxy in snapshot.proxies] == ["node2"]
    assert snapshot.selected == {"uid-talker"}
    pages = [query for query in server.asked("GET", "pods") if "limit" in query]
    assert len(pages) == 3  # of two pods each


async def test_what_happens_is_seen(server: ApiServer, seen: Seen) -> None:
    put_all(server)
    await begun(server, seen)
    server.put("pods", pod_obj("second", INJECT), NAMESPACE)
    await until(lambda: "second" in seen.pods())
    server.drop("pods", "talker", NAMESPACE)
    await until(lambda: "talker" not in seen.pods())


async def test_a_proxy_that_vanishes_while_it_runs_is_noted(server: ApiServer, seen: Seen) -> None:
    """After a forced deletion, the kubelet ends the pod and frees the hostPorts seconds later."""
    running = {"containerStatuses": [{"name": "proxy", "state": {"running": {"startedAt": "1"}}}]}
    ended = {"containerStatuses": [{"name": "proxy", "state": {"terminated": {"exitCode": 0}}}]}
    put_all(server)
    await begun(server, seen)

    async def vanished(*places: str) -> None:
        await until(lambda: [p.node for p in seen.store.snapshot().vanished] == [*places])

    proxy = changed(proxy_obj(node="node2"), **running)
    server.put("pods", proxy, NAMESPACE)
    await until(lambda: all(p.runs for p in seen.store.snapshot().proxies))
    server.drop("pods", proxy["metadata"]["name"], NAMESPACE)
    await vanished("node2")

    server.put("pods", proxy, NAMESPACE)
    await vanished()

    server.put("pods", changed(proxy, **ended), NAMESPACE)
    server.drop("pods", proxy["metadata"]["name"], NAMESPACE)
    await until(lambda: not seen.store.snapshot().proxies)
    await vanished()


async def test_a_watch_that_is_too_old_begins_anew(server: ApiServer, seen: Seen) -> None:
    put_all(server)
    await begun(server, seen)
    server.forget("pods", "talker", NAMESPACE)  # without an event
    server.end_watches({"type": "ERROR", "object": {"code": 410, "message": "old"}})
    await until(lambda: "talker" not in seen.pods())
    await until(lambda: server.watches("pods") == 1)
    assert seen.corrected == 1
    assert seen.lost == len(KINDS)


async def test_a_watch_that_is_lost_goes_on(server: ApiServer, seen: Seen) -> None:
    put_all(server)
    await begun(server, seen)
    asked = len([query for query in server.asked("GET", "pods") if "limit" in query])
    server.end_watches({"type": "ERROR", "object": {"code": 500, "message": "etcd"}})
    server.put("pods", pod_obj("second", INJECT), NAMESPACE)
    await until(lambda: "second" in seen.pods())
    assert len([query for query in server.asked("GET", "pods") if "limit" in query]) == asked
    await seen.store.check()


async def test_after_a_lost_watch_no_event_comes_twice(server: ApiServer, seen: Seen) -> None:
    """With an old event, the pod would lose the address for a moment and count as gone."""
    put_all(server)
    await begun(server, seen)
    server.put("pods", pod_obj("second", INJECT), NAMESPACE)
    last = server.put("pods", pod_obj("third", INJECT), NAMESPACE)
    await until(lambda: seen.pods() >= {"second", "third"})
    server.end_watches({"type": "ERROR", "object": {"code": 500, "message": "etcd"}})
    began = [query for query in server.asked("GET", "pods") if "watch" in query]
    await until(lambda: server.watches("pods") == 1 and seen.lost >= len(KINDS))
    (again,) = [query for query in server.asked("GET", "pods") if "watch" in query][len(began) :]
    assert again["resourceVersion"] == last["metadata"]["resourceVersion"]


async def test_watches_that_end_at_once_are_not_asked_for_in_a_loop(
    server: ApiServer, seen: Seen, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reflector, "RETRY_PAUSES_S", (60.0,))
    monkeypatch.setattr(reflector, "LEAST_WATCH_S", 60.0)
    put_all(server)
    await begun(server, seen)

    async def end(lost: int, left: int) -> None:
        server.close_watches()
        await until(lambda: seen.lost == lost)
        await until(lambda: all(server.watches(kind) == left for kind in KINDS))

    await end(len(KINDS), 1)  # the first request is without a pause
    await end(2 * len(KINDS), 0)


async def test_it_is_checked_against_a_full_list(
    server: ApiServer, seen: Seen, monkeypatch: pytest.MonkeyPatch
) -> None:
    put_all(server)
    await begun(server, seen)
    server.forget("pods", "talker", NAMESPACE)
    monkeypatch.setattr(reflector, "RELIST_INTERVAL_S", 0.0)
    server.close_watches()
    await until(lambda: "talker" not in seen.pods())
    assert seen.corrected == 1


async def test_what_is_doubted_is_listed_anew(
    server: ApiServer, seen: Seen, monkeypatch: pytest.MonkeyPatch
) -> None:
    put_all(server)
    await begun(server, seen)
    server.forget("pods", "talker", NAMESPACE)
    monkeypatch.setattr(reflector, "LEAST_RELIST_INTERVAL_S", 0.0)
    for collection_reflector in seen.all:
        collection_reflector.relist()
    await until(lambda: "talker" not in seen.pods())


@pytest.mark.parametrize("kind", KINDS)
async def test_what_is_not_kept_up_with_is_told(server: ApiServer, seen: Seen, kind: str) -> None:
    put_all(server)
    await begun(server, seen)
    server.refuse("GET", kind, 503, "starting")
    server.end_watches({"type": "ERROR", "object": {"code": 500, "message": "etcd"}})
    await until(lambda: bool(seen.store._errors))
    with pytest.raises(ApiUnavailable, match="starting"):
        await seen.store.check()
    server.refusals.clear()
    await until(lambda: not seen.store._errors)
    assert seen.back == 1


async def test_a_store_that_was_set_back_is_listed_anew(server: ApiServer, seen: Seen) -> None:
    put_all(server)
    await begun(server, seen)
    asked = len([query for query in server.asked("GET", "pods") if "limit" in query])
    server.refuse("GET", "pods", 504, "Timeout: Too large resource version: 9, current: 3")
    server.close_watches()
    await until(lambda: bool(seen.store._errors))
    server.refusals.clear()
    await until(lambda: not seen.store._errors)
    assert len([query for query in server.asked("GET", "pods") if "limit" in query]) > asked


async def test_only_what_concerns_somebody_wakes(server: ApiServer, seen: Seen) -> None:
    put_all(server)
    await begun(server, seen)
    seen.store.take_changes()
    woken = seen.woken
    ready = {"type": "Ready", "status": "True", "lastHeartbeatTime": "2"}
    server.put("nodes", changed(server.get("nodes", "node1", ""), conditions=[ready]))
    arm = server.get("rosproxies", "arm", NAMESPACE)
    server.put("rosproxies", changed(arm, nodes=1), NAMESPACE)
    server.put("pods", pod_obj("another", {}), NAMESPACE)
    talker = server.get("pods", "talker", NAMESPACE)
    server.put("pods", changed(talker, startTime="2026-01-01T00:00:00Z"), NAMESPACE)
    server.put("services", {"metadata": {"name": "web"}, "spec": {}}, NAMESPACE)
    await until(lambda: "another" in seen.pods())
    last = {"metadata": {"name": "last", "namespace": "other"}}
    server.put("rosproxies", last, "other")
    await until(lambda: len(seen.store.snapshot().unusable) == 1)
    assert seen.store.take_changes() == StoreChanges({"other"}, set())
    assert seen.woken == woken + 1


async def test_changes_touch_their_namespaces_and_nodes(server: ApiServer, seen: Seen) -> None:
    put_all(server)
    server.put("rosproxies", rosproxy_obj({"master": SERVICE}, "leg"), NAMESPACE)
    await begun(server, seen)

    async def touches(namespaces: set[str], nodes: set[str]) -> None:
        changes = StoreChanges()

        def all_taken() -> bool:
            new = seen.store.take_changes()
            changes.namespaces.update(new.namespaces)
            changes.nodes.update(new.nodes)
            return changes == StoreChanges(namespaces, nodes)

        await until(all_taken)

    seen.store.take_changes()
    server.put("pods", {**pod_obj("talker", {})}, NAMESPACE)  # lost the label
    await touches({NAMESPACE}, {"node1"})
    server.put("pods", {**pod_obj("talker", {"rosproxy.io/injekt": "true"})}, NAMESPACE)
    await touches({NAMESPACE}, set())
    server.drop("pods", "holder", "other")
    await touches(set(), {"node1"})
    server.put("nodes", changed(server.get("nodes", "node1", ""), conditions=[]))
    await touches(set(), {"node1"})
    server.put("services", {"metadata": {"name": "roscore"}, "spec": {}}, "ros")
    await touches({NAMESPACE}, set())
    server.put("services", service_obj(), NAMESPACE)
    await touches({NAMESPACE}, set())
    proxy = server.get("pods", proxy_obj(node="node2")["metadata"]["name"], NAMESPACE)
    server.put("pods", changed(proxy, conditions=[{"type": "Ready", "status": "True"}]), NAMESPACE)
    await touches({NAMESPACE}, set())


async def test_what_another_operator_looks_after_is_others(api: Api, server: ApiServer) -> None:
    corrections: list[int] = []
    store = ClusterStore([("pods", "")], ("mine",), lambda: None, lambda: None, corrections.append)
    read = READERS["pods"]
    record = read(proxy_obj())
    assert record is not None
    store.listed("pods", "", {"key": record})
    assert store.snapshot().proxies == ()
    store.listed("pods", "", {"key": record})
    assert corrections == []


@pytest.mark.parametrize("obj", [{}, {"metadata": None}, {"metadata": {"labels": None}}])
@pytest.mark.parametrize("kind", KINDS)
def test_nonsense_does_no_harm(kind: str, obj: dict[str, Any]) -> None:
    READERS[kind](obj)


async def test_one_bad_rosproxy_does_not_stop_the_others(server: ApiServer, seen: Seen) -> None:
    put_all(server)
    server.put("rosproxies", rosproxy_obj({"master": {}}, "bad"), NAMESPACE)
    server.put("rosproxies", {"metadata": {"name": "worse"}, "spec": 3}, NAMESPACE)
    snapshot = await begun(server, seen)
    assert [rosproxy.id.name for rosproxy in snapshot.rosproxies] == ["arm"]
    assert {id.name for id in snapshot.unusable} == {"bad", "worse"}


async def test_a_missing_crd_is_told(server: ApiServer, seen: Seen) -> None:
    server.refuse("GET", "rosproxies", 404, "the server could not find the requested resource")
    start(seen)
    with pytest.raises(ApiError, match=r"rosproxies\.rosproxy\.io is not installed") as caught:
        await seen.read()
    assert type(caught.value) is ApiNotFound


async def test_what_only_an_event_tells(
    server: ApiServer, api: Api, seen: Seen, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sandbox, "WAIT_BEFORE_REQUEST_S", 0.0)
    put_all(server)
    name = proxy_obj(node="node2")["metadata"]["name"]
    server.drop("pods", name, NAMESPACE)
    starting = proxy_obj(status={"phase": "Pending"})
    server.put("pods", starting, NAMESPACE)
    for number, stamp in ((1, "2026-01-01T00:00:01Z"), (2, "2026-01-01T00:00:02Z")):
        event = {
            "metadata": {"name": f"e{number}"},
            "involvedObject": {"uid": starting["metadata"]["uid"]},
            "reason": "FailedCreatePodSandBox",
            "message": SANDBOX.format(f"{number}" * 64),
            "lastTimestamp": stamp,
        }
        server.put("events", event, NAMESPACE)
    snapshot = await begun(server, seen)
    failures = SandboxFailures(api)
    assert await failures.read(snapshot) == {NAMESPACE}
    (proxy,) = failures.with_messages(snapshot).proxies
    assert proxy.stuck is PodFailure.PORTS
    assert proxy.message == SANDBOX.format("…")
    assert await failures.read(snapshot) == set()
    assert len(server.asked("GET", "events")) == 1  # no repeated request at once


async def test_the_service_of_a_master(server: ApiServer, seen: Seen) -> None:
    obj = rosproxy_obj()
    obj["spec"] = {"master": SERVICE}
    server.put("rosproxies", obj, NAMESPACE)
    id = Name("ros", "roscore")
    assert (await begun(server, seen)).masters == {
        id: ("", Fault("does not exist", "Create the Service, or correct spec.master.service"))
    }
    ports = [{"port": 11311}]
    server.put(
        "services",
        {"metadata": {"name": "roscore"}, "spec": {"clusterIP": "10.96.1.1", "ports": ports}},
        "ros",
    )
    await until(lambda: seen.store.snapshot().masters == {id: ("10.96.1.1", None)})
    assert seen.store.snapshot().consents == {id: frozenset()}


async def test_who_may_name_a_service(server: ApiServer, seen: Seen) -> None:
    server.put("rosproxies", rosproxy_obj({"master": SERVICE}), NAMESPACE)
    notes = {"rosproxy.io/allow-from": f"{NAMESPACE}, arms ,No Name,"}
    server.put("services", {"metadata": {"name": "roscore", "annotations": notes}}, "ros")
    snapshot = await begun(server, seen)
    assert snapshot.consents == {Name("ros", "roscore"): {NAMESPACE, "arms"}}


async def test_a_role_without_the_right_to_policies_stops_nothing(
    server: ApiServer, seen: Seen
) -> None:
    put_all(server)
    refusal = (
        'networkpolicies.networking.k8s.io is forbidden: User "x" cannot list resource '
        '"networkpolicies" in API group "networking.k8s.io" at the cluster scope'
    )
    server.refuse("GET", "networkpolicies", 403, refusal)
    start(seen)
    snapshot = await seen.read()
    assert 'resources ["networkpolicies"], verbs ["list"]' in snapshot.policies_error
    assert [rosproxy.id.name for rosproxy in snapshot.rosproxies] == ["arm"]


@pytest.mark.parametrize(
    ("spec", "told"),
    [
        ({"type": "ClusterIP", "clusterIP": "None"}, "is headless. Delete the Service, and create"),
        ({"type": "ExternalName"}, "has no cluster IP (type ExternalName). Use a Service of type"),
        ({"clusterIP": "10.96.1.1", "ports": [{"port": 80}]}, "has no port 11311 (its ports: 80)"),
        ({"clusterIP": "10.96.1.1"}, "has no port 11311 (its ports: none)"),
        ({}, "has no cluster IP"),
    ],
)
def test_a_service_that_is_no_master(spec: dict[str, Any], told: str) -> None:
    service = master_service({"metadata": {"name": "roscore", "namespace": "ros"}, "spec": spec})
    address, problem = read_master(service, Name("ros", "roscore"), {11311})
    assert address == ""
    assert told in str(problem)
