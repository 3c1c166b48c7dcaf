"""Actions on the cluster, through the real client, with an API server on loopback."""

import copy
from collections.abc import AsyncIterator
from typing import Any

import pytest
from aiohttp import web
from msgspec.structs import replace

from rosproxy.shared.tasks import Tasks
from rosproxy_operator.common.proxy_client import ProxyClient
from rosproxy_operator.kubernetes.api.api_client import Api
from rosproxy_operator.kubernetes.apply import ClusterApplier
from rosproxy_operator.kubernetes.planner.actions import (
    Action,
    CreatePolicy,
    CreateProxy,
    CreateService,
    DeletePolicy,
    DeleteProxy,
    DeleteService,
    Emit,
    EvictPod,
    PatchStatus,
    SetImage,
    SetPolicy,
)
from rosproxy_operator.kubernetes.resources import objects
from rosproxy_operator.kubernetes.resources.cluster import ClusterSnapshot
from rosproxy_operator.kubernetes.resources.model import Name, Reference, RosProxy
from rosproxy_operator.kubernetes.resources.names import own_labels, token_of
from rosproxy_operator.kubernetes.resources.spec import rosproxy
from tests.unit.operator.kubernetes.api_server import ApiServer
from tests.unit.operator.kubernetes.builders_api import (
    NAMESPACE,
    pod_obj,
    proxy_obj,
    rosproxy_obj,
)
from tests.unit.operator.kubernetes.snapshots import snapshot_of

OF = Name(NAMESPACE, "arm")
KEY = b"k" * 32
OWNER = {"apiVersion": "rosproxy.io/v1alpha1", "kind": "RosProxy", "name": "arm", "uid": "uid-arm"}
ABOUT = Reference("RosProxy", Name(NAMESPACE, "arm"), "uid-arm")


class Carried:
    """An applier, and its counts."""

    def __init__(self, api: Api) -> None:
        self.counted: list[tuple[str, str]] = []
        self.tasks = Tasks()
        self.proxies = ProxyClient()
        self.applier = ClusterApplier(api, self.proxies, self.tasks, self.count, self.doubt)
        self.doubts = 0

    def doubt(self) -> None:
        self.doubts += 1

    def count(self, action: Action, outcome: str) -> None:
        self.counted.append((type(action).__name__, outcome))

    async def out(self, *actions: Action, **observed: Any) -> None:
        observed.setdefault("rosproxies", (seen(),))
        await self.applier.carry_out(actions, ClusterSnapshot(**observed))


@pytest.fixture
async def carry(api: Api) -> AsyncIterator[Carried]:
    carried = Carried(api)
    yield carried
    await carried.tasks.cancel()
    await carried.proxies.close()


def seen(status: dict[str, Any] | None = None) -> RosProxy:
    return rosproxy(rosproxy_obj(status=status))


def body(kind: str, name: str, **spec: Any) -> dict[str, Any]:
    return {
        "apiVersion": "v1",
        "kind": kind,
        "metadata": {
            "name": name,
            "namespace": NAMESPACE,
            "labels": own_labels("arm"),
            "ownerReferences": [OWNER],
        },
        "spec": spec,
    }


def create_pod(name: str = "proxy") -> CreateProxy:
    return CreateProxy(OF, body("Pod", name, containers=[{"name": "proxy"}]))


async def test_proxies_are_created(server: ApiServer, carry: Carried) -> None:
    await carry.out(create_pod("one"), create_pod("two"))
    assert [pod["metadata"]["name"] for pod in server.all("pods")] == ["one", "two"]
    assert carry.applier.failures == {OF: {}}
    assert (carry.applier.busy, carry.applier.failed) == (0, 0)
    assert carry.counted == [("CreateProxy", "ok")] * 2


async def test_a_policy_is_made_mended_and_deleted(server: ApiServer, carry: Carried) -> None:
    server.put("rosproxies", rosproxy_obj(), NAMESPACE)
    made = {**body("NetworkPolicy", "rosproxy-arm"), "apiVersion": "networking.k8s.io/v1"}
    id = Name(NAMESPACE, "rosproxy-arm")
    await carry.out(CreatePolicy(OF, made))
    await carry.out(CreatePolicy(OF, made))  # the policy exists now
    assert carry.applier.failures == {OF: {}}
    (policy,) = server.all("networkpolicies")
    uid = policy["metadata"]["uid"]
    await carry.out(SetPolicy(OF, id, uid, {"policyTypes": ["Ingress"]}))
    assert server.get("networkpolicies", id.name, NAMESPACE)["spec"] == {"policyTypes": ["Ingress"]}
    await carry.out(SetPolicy(OF, id, "another", {}), DeletePolicy(OF, id, "another", "old"))
    assert server.get("networkpolicies", id.name, NAMESPACE)["spec"] == {"policyTypes": ["Ingress"]}
    await carry.out(DeletePolicy(OF, id, uid, "--no-network-policy"))
    assert server.all("networkpolicies") == []
    assert carry.applier.failures == {OF: {}}


async def test_one_that_is_there_already_is_no_failure(server: ApiServer, carry: Carried) -> None:
    """The list that was planned from lacked what had just been created."""
    server.put("pods", body("Pod", "proxy"), NAMESPACE)
    await carry.out(create_pod())
    assert carry.applier.failures == {OF: {}}


async def test_somebody_elses_pod_is_left_alone(server: ApiServer, carry: Carried) -> None:
    server.put("pods", {"metadata": {"name": "proxy"}}, NAMESPACE)
    await carry.out(create_pod())
    ((id, text),) = carry.applier.failures[OF].items()
    assert id == Name(NAMESPACE, "proxy")
    assert "that the operator did not create" in text
    assert (carry.applier.busy, carry.applier.failed) == (0, 1)
    assert server.get("pods", "proxy", NAMESPACE)["metadata"].get("labels") is None


async def test_a_lost_service_gets_its_address_or_another(
    server: ApiServer, carry: Carried, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The address of a deleted Service is free only some time after the deletion."""
    monkeypatch.setattr("time.sleep", lambda _: None)
    server.address_refusals.update({"10.96.0.5": 2, "10.96.9.9": 1000})
    service = body("Service", "rosproxy-arm", clusterIP="10.96.0.5")
    taken = body("Service", "rosproxy-leg", clusterIP="10.96.9.9")
    await carry.out(CreateService(OF, service), CreateService(OF, taken))
    assert server.get("services", "rosproxy-arm", NAMESPACE)["spec"]["clusterIP"] == "10.96.0.5"
    assert server.get("services", "rosproxy-leg", NAMESPACE)["spec"]["clusterIP"] == "10.96.0.7"
    assert carry.applier.failures == {OF: {}}


async def test_a_headless_service_gets_no_address(server: ApiServer, carry: Carried) -> None:
    server.address_refusals["None"] = 1000
    await carry.out(CreateService(OF, body("Service", "hubs", clusterIP="None")))
    assert server.all("services") == []
    assert carry.applier.failures[OF].keys() == {Name(NAMESPACE, "hubs")}


async def test_nothing_is_deleted_but_what_was_seen(server: ApiServer, carry: Carried) -> None:
    server.put("rosproxies", rosproxy_obj(), NAMESPACE)
    old = proxy_obj()
    new = proxy_obj(node="node2")
    for pod in (old, new):
        server.put("pods", pod, NAMESPACE)
    server.put("services", body("Service", "new"), NAMESPACE)
    names = [Name(NAMESPACE, pod["metadata"]["name"]) for pod in (old, new)]
    actions = (
        DeleteProxy(OF, names[0], old["metadata"]["uid"], "why"),
        DeleteProxy(OF, names[1], "another", "why"),
        DeleteProxy(OF, Name(NAMESPACE, "never was"), "x", "why"),
        DeleteService(OF, Name(NAMESPACE, "new"), "another", "why"),
    )
    await carry.applier.carry_out(actions, snapshot_of(server))
    assert [pod["metadata"]["name"] for pod in server.all("pods")] == [names[1].name]
    assert server.all("services")
    assert carry.applier.failures == {OF: {}}


async def test_an_object_that_stays_different_from_the_snapshot_is_doubted(
    server: ApiServer, carry: Carried
) -> None:
    """A single difference may be a watch that lags."""
    server.put("rosproxies", rosproxy_obj(), NAMESPACE)
    old = server.put("pods", proxy_obj(), NAMESPACE)
    action = DeleteProxy(
        OF, Name(NAMESPACE, old["metadata"]["name"]), old["metadata"]["uid"], "why"
    )
    seen = snapshot_of(server)
    server.drop("rosproxies", "arm", NAMESPACE)
    for times in (0, 1, 1, 2):
        await carry.applier.carry_out([action], seen)
        assert carry.doubts == times
    assert server.all("pods")
    assert carry.applier.failures == {OF: {}}


async def test_a_vanished_object_is_doubted_no_more(server: ApiServer, carry: Carried) -> None:
    server.put("rosproxies", rosproxy_obj(), NAMESPACE)
    proxies = [server.put("pods", proxy_obj(node=node), NAMESPACE) for node in ("one", "two")]
    seen = snapshot_of(server)
    server.drop("rosproxies", "arm", NAMESPACE)
    names = [(Name(NAMESPACE, p["metadata"]["name"]), p["metadata"]["uid"]) for p in proxies]
    await carry.applier.carry_out([DeleteProxy(OF, *name, "why") for name in names], seen)
    left = [proxies[0]["metadata"]["uid"]]
    assert len(carry.applier._stale) == 2

    pods = tuple(pod for pod in seen.pods if pod.uid in left)
    await carry.applier.carry_out([], replace(seen, pods=pods))
    assert [*carry.applier._stale] == left


async def test_another_image(server: ApiServer, carry: Carried) -> None:
    pod = body("Pod", "proxy", containers=[{"name": "proxy", "image": "a"}])
    uid = server.put("pods", pod, NAMESPACE)["metadata"]["uid"]
    id = Name(NAMESPACE, "proxy")
    await carry.out(SetImage(OF, id, uid, "b"), SetImage(OF, id, "another", "c"))
    assert server.get("pods", "proxy", NAMESPACE)["spec"]["containers"][0]["image"] == "b"
    assert carry.applier.failures == {OF: {}}


async def test_a_status_is_replaced_whole(server: ApiServer, carry: Carried) -> None:
    old = {"message": "old", "perNode": [{"name": "a"}, {"name": "b"}]}
    server.put("rosproxies", rosproxy_obj(status=old), NAMESPACE)
    await carry.out(PatchStatus(OF, seen().uid, {"perNode": []}), rosproxies=(seen(old),))
    stored = server.get("rosproxies", "arm", NAMESPACE)
    assert stored["status"] == {"perNode": []}
    assert stored["spec"] == rosproxy_obj()["spec"]
    assert server.requests[-1][1].endswith("/rosproxies/arm/status")


async def test_the_status_of_a_new_rosproxy_of_that_name_is_left_alone(
    server: ApiServer, carry: Carried
) -> None:
    again = rosproxy_obj()
    again["metadata"]["uid"] = "another"
    server.put("rosproxies", again, NAMESPACE)
    await carry.out(PatchStatus(OF, seen().uid, {"nodes": 1}))
    assert server.get("rosproxies", "arm", NAMESPACE)["status"] == {}
    assert not carry.applier.problems


async def test_a_status_that_cannot_be_written_is_a_problem_until_it_can(
    server: ApiServer, carry: Carried
) -> None:
    server.put("rosproxies", rosproxy_obj(), NAMESPACE)
    server.refuse("PATCH", "rosproxies", 422, "status.nodes: Invalid value")
    await carry.out(PatchStatus(OF, seen().uid, {"nodes": "?"}))
    (problem,) = carry.applier.problems.values()
    assert problem.subject == f"rosproxy {OF}"
    assert problem.text == "the operator can't write the status: status.nodes: Invalid value"
    server.refusals.clear()
    await carry.out(PatchStatus(OF, seen().uid, {"nodes": 2}))
    assert not carry.applier.problems


async def test_a_failure_stops_no_other_action_but_what_tells_of_success(
    server: ApiServer, carry: Carried
) -> None:
    server.put("rosproxies", rosproxy_obj(), NAMESPACE)
    server.refuse("POST", "pods", 403, 'violates PodSecurity "baseline:latest": hostPort')
    service = CreateService(OF, body("Service", "rosproxy-arm"))
    await carry.out(
        create_pod(),
        service,
        Emit(OF, ABOUT, "Normal", "ProxyCreated", "created"),
        Emit(OF, ABOUT, "Warning", "Invalid", "warned"),
        PatchStatus(OF, seen().uid, {"nodes": 1}),
    )
    refused = 'violates PodSecurity "baseline:latest": hostPort'
    assert carry.applier.failures[OF] == {Name(NAMESPACE, "proxy"): refused}
    assert server.all("services")
    assert [event["reason"] for event in server.all("events")] == ["Invalid"]
    assert server.get("rosproxies", "arm", NAMESPACE)["status"] == {"nodes": 1}
    server.refusals.clear()
    await carry.out(create_pod())
    assert carry.applier.failures == {OF: {}}


async def test_a_namespace_that_is_being_deleted_is_no_failure(
    server: ApiServer, carry: Carried
) -> None:
    text = "unable to create new content in namespace robots because it is being terminated"
    for kind in ("pods", "services", "events"):
        server.refuse("POST", kind, 403, text)
    service = CreateService(OF, body("Service", "rosproxy-arm", clusterIP="10.96.0.5"))
    await carry.out(create_pod(), service, Emit(OF, ABOUT, "Warning", "Invalid", "warned"))
    assert carry.applier.failures == {OF: {}}
    assert len(server.asked("POST", "services")) == 1


async def test_failures_of_a_deleted_rosproxy_are_forgotten(
    server: ApiServer, carry: Carried
) -> None:
    server.refuse("POST", "pods", 422, "no")
    before = carry.applier.failures
    await carry.out(create_pod())
    assert carry.applier.failures
    assert not before  # callers compare the former dictionary
    await carry.out(rosproxies=())
    assert not carry.applier.failures


async def test_a_mistake_of_ours_is_a_failure_like_any(server: ApiServer, carry: Carried) -> None:
    broken = {"kind": "Pod", "metadata": {"name": "broken"}}
    await carry.out(CreateProxy(OF, broken), create_pod())
    (text,) = carry.applier.failures[OF].values()
    assert "the operator failed: KeyError('namespace')" in text
    assert [pod["metadata"]["name"] for pod in server.all("pods")] == ["proxy"]


async def test_an_event_is_made_once_and_counted_now_and_then(
    server: ApiServer, carry: Carried
) -> None:
    event = Emit(OF, ABOUT, "Warning", "PortConflict", "port 11400 is taken")
    for _ in range(3):
        await carry.out(event)
    (made,) = server.all("events")
    assert (made["count"], made["involvedObject"]["uid"]) == (1, ABOUT.uid)
    assert made["metadata"]["namespace"] == NAMESPACE
    made["lastTimestamp"] = "2026-01-01T00:00:00Z"
    await carry.out(event)
    (made,) = server.all("events")
    assert made["count"] == 2
    assert made["lastTimestamp"] > "2026-01-02"
    await carry.out(Emit(OF, ABOUT, "Warning", "PortConflict", "port 11401 is taken"))
    assert len(server.all("events")) == 2


async def test_a_retired_proxy_unregisters_first(server: ApiServer, carry: Carried) -> None:
    told: list[str] = []

    async def retire(request: web.Request) -> web.Response:
        told.append(request.headers["Authorization"])
        assert server.all("pods")
        return web.json_response({"unregistered": 2})

    application = web.Application()
    application.router.add_post("/retire", retire)
    runner = web.AppRunner(application)
    await runner.setup()
    await web.TCPSite(runner, "127.0.0.77", 11312).start()
    await _retire(server, carry, "127.0.0.77")
    token = token_of(KEY, Name(NAMESPACE, proxy_obj()["metadata"]["name"]), "node1")
    assert told == [f"Bearer {token}"]
    assert not server.all("pods")
    await runner.cleanup()


async def test_a_retired_proxy_that_is_dead_is_deleted_all_the_same(
    server: ApiServer, carry: Carried
) -> None:
    await _retire(server, carry, "127.0.0.78")
    assert not server.all("pods")


async def _retire(server: ApiServer, carry: Carried, ip: str) -> None:
    from rosproxy_operator.kubernetes.resources.objects import proxy_pod

    obj = proxy_obj(status={"phase": "Running", "podIP": ip})
    server.put("pods", obj, NAMESPACE)
    proxy = proxy_pod(obj)
    seen = snapshot_of(server, KEY)
    assert proxy is not None
    action = DeleteProxy(OF, proxy.pod.id, proxy.pod.uid, "RosProxy deleted", retire=True)
    await carry.applier.carry_out([action, action], seen)
    for task in [*carry.tasks._tasks]:
        await task
    await carry.applier.carry_out([action], seen)  # a pod that ends slowly is told once
    assert not carry.tasks._tasks


def evict(server: ApiServer) -> tuple[EvictPod, dict[str, Any]]:
    """The eviction of a pod that is there, and what was seen."""
    labels = {"rosproxy.io/inject": "true"}
    server.put("rosproxies", rosproxy_obj(), NAMESPACE)
    server.put("pods", pod_obj("talker", labels), NAMESPACE)
    id = Name(NAMESPACE, "talker")
    observed = {"pods": (objects.pod(server.get("pods", "talker", NAMESPACE)),)}
    return EvictPod(OF, id, "uid-talker", "it is not wired"), observed


async def test_pods_are_evicted(server: ApiServer, carry: Carried) -> None:
    action, observed = evict(server)
    await carry.out(action, **observed)
    assert server.all("pods") == []
    assert carry.counted == [("EvictPod", "ok")]
    assert "/pods/talker/eviction" in server.requests[-1][1]


async def test_a_pod_that_was_wired_meanwhile_is_not_evicted(
    server: ApiServer, carry: Carried
) -> None:
    action, observed = evict(server)
    wired = copy.deepcopy(server.get("pods", "talker", NAMESPACE))
    wired["metadata"]["annotations"] = {"rosproxy.io/master-uri": "http://10.96.0.7:11311"}
    server.put("pods", wired, NAMESPACE)
    await carry.out(action, **observed)
    assert len(server.all("pods")) == 1


async def test_a_budget_that_does_not_allow_an_eviction(server: ApiServer, carry: Carried) -> None:
    """A single request for each plan."""
    action, observed = evict(server)
    server.retry_after = "10"
    server.refuse("POST", "pods", 429, "Cannot evict pod: disruption budget")
    await carry.out(action, **observed)
    assert len(server.asked("POST", "pods")) == 1
    assert "disruption budget" in str(carry.applier.failures)


async def test_one_that_leads_no_more_has_failed_at_nothing(
    server: ApiServer, carry: Carried, api: Api
) -> None:
    api.gate.open = lambda: False
    await carry.out(create_pod())
    assert (server.requests, carry.counted) == ([], [])
    assert carry.applier.failed == 0
