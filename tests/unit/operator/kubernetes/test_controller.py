"""The reconcile loop against an API server on loopback that comes and goes."""

import asyncio
import logging
from collections.abc import AsyncIterator
from typing import Any

import pytest
from aiohttp import web
from msgspec import structs

from rosproxy.shared.setting_kinds import hash_token
from rosproxy_operator.common import control_loop
from rosproxy_operator.common.operator_metrics import ClusterMetrics
from rosproxy_operator.kubernetes import controller as module
from rosproxy_operator.kubernetes.api.api_client import Api
from rosproxy_operator.kubernetes.controller import KubernetesController
from rosproxy_operator.kubernetes.planner.plan import ClusterPlan, plan
from rosproxy_operator.kubernetes.proxies import proxy_sync
from rosproxy_operator.kubernetes.proxies.sandbox import SandboxFailures
from rosproxy_operator.kubernetes.resources.cluster import ClusterSnapshot
from rosproxy_operator.kubernetes.resources.model import Name
from rosproxy_operator.kubernetes.settings import ClusterSettings, KubernetesSettings
from rosproxy_operator.kubernetes.watch import reflector
from rosproxy_operator.kubernetes.webhook.injector import Injector
from tests.unit.operator.kubernetes.api_server import ApiServer, until
from tests.unit.operator.kubernetes.builders_api import INJECT, NAMESPACE, pod_obj, rosproxy_obj

NODE = {
    "metadata": {"name": "node1"},
    "spec": {"podCIDRs": ["127.0.0.0/24"]},
    "status": {
        "addresses": [{"type": "InternalIP", "address": "192.0.2.11"}],
        "conditions": [{"type": "Ready", "status": "True"}],
    },
}


LOST = {"type": "ERROR", "object": {"code": 500, "message": "etcd"}}


class Running:
    """A controller at work."""

    def __init__(self, api: Api) -> None:
        self.metrics = ClusterMetrics()
        self.term = 1
        api.gate.open = lambda: bool(self.term)
        settings = KubernetesSettings(resync=60.0, key_secret=Name(NAMESPACE, "key"))
        self.webhook_since = ""
        self.controller = KubernetesController(
            settings, api, self.metrics, lambda: self.term, lambda: self.webhook_since
        )
        self.task = asyncio.create_task(self.controller.run())

    def looks(self, outcome: str = "ok") -> float:
        name = "rosproxy_operator_looks_total"
        labels = {"outcome": outcome}
        return self.metrics.registry.get_sample_value(name, labels) or 0.0


@pytest.fixture
async def running(api: Api, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Running]:
    monkeypatch.setattr(module, "LEAST_LOOK_INTERVAL_S", 0.01)
    monkeypatch.setattr(module, "RECHECK_AFTER_ACTION_S", 0.05)
    monkeypatch.setattr(module, "KEY_CHECK_INTERVAL_S", 0.05)
    monkeypatch.setattr(control_loop, "RETRY_PAUSES_S", (0.02,))
    monkeypatch.setattr(reflector, "RETRY_PAUSES_S", (0.02,))
    monkeypatch.setattr(proxy_sync, "POLL_INTERVAL_S", 0.05)
    monkeypatch.setattr(proxy_sync, "STARTING_POLL_INTERVAL_S", 0.02)
    monkeypatch.setattr(proxy_sync, "FORMER_POLL_INTERVAL_S", 0.05)
    started = Running(api)
    yield started
    started.task.cancel()
    await asyncio.gather(started.task, return_exceptions=True)


def put_all(server: ApiServer) -> None:
    server.put("nodes", dict(NODE))
    server.put("rosproxies", rosproxy_obj(), NAMESPACE)
    server.put("pods", pod_obj("talker", INJECT), NAMESPACE)


def proxies(server: ApiServer) -> list[dict[str, Any]]:
    pods = server.all("pods")
    return [pod for pod in pods if "rosproxy.io/proxy-of" in pod["metadata"].get("labels", {})]


async def test_a_labelled_pod_gets_a_proxy(server: ApiServer, running: Running) -> None:
    put_all(server)
    running.controller.wake()
    await until(lambda: bool(proxies(server)))
    (proxy,) = proxies(server)
    assert proxy["metadata"]["ownerReferences"][0]["uid"] == "uid-arm"

    def told() -> Any:
        return server.get("rosproxies", "arm", NAMESPACE)["status"].get("masterURI")

    await until(lambda: told() == "http://10.96.0.7:11311")


async def test_a_key_that_is_removed_makes_the_proxies_anew(
    server: ApiServer, running: Running
) -> None:
    server.put("secrets", {"metadata": {"name": "key"}}, NAMESPACE)
    put_all(server)
    await until(lambda: bool(proxies(server)))
    first = proxies(server)[0]["metadata"]["annotations"]
    server.put("secrets", {"metadata": {"name": "key"}}, NAMESPACE)
    await until(lambda: any(pod["metadata"]["annotations"] != first for pod in proxies(server)))


async def test_the_check_of_the_key_goes_on_after_an_internal_error(
    server: ApiServer,
    running: Running,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    server.put("secrets", {"metadata": {"name": "key"}}, NAMESPACE)
    put_all(server)
    await until(lambda: bool(proxies(server)))
    first = proxies(server)[0]["metadata"]["annotations"]
    key = running.controller._key
    read = key.read

    def broken() -> bytes:
        raise RuntimeError("oops")

    monkeypatch.setattr(key, "read", broken)
    await until(lambda: "checking the key of the proxies' tokens failed" in caplog.text)
    monkeypatch.setattr(key, "read", read)
    server.put("secrets", {"metadata": {"name": "key"}}, NAMESPACE)
    await until(lambda: any(pod["metadata"]["annotations"] != first for pod in proxies(server)))


async def test_a_pod_that_is_created_with_its_rosproxy_is_wired(
    server: ApiServer, api: Api, running: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The webhook waits for the Service that the operator makes."""
    monkeypatch.setattr("rosproxy_operator.kubernetes.webhook.injector.YOUNG_SERVICE_S", 0.0)
    await until(lambda: running.looks() > 0)
    put_all(server)
    injector = Injector(api, ClusterSettings(), running.metrics, running.controller.wake)
    wiring = await injector.wiring(pod_obj("talker", INJECT), dry_run=False)
    (service,) = server.all("services")
    uri = f"http://{service['spec']['clusterIP']}:11311"
    assert wiring.annotations == {"rosproxy.io/master-uri": uri}
    assert len(server.asked("POST", "services")) == 1


async def test_what_happens_during_a_look_is_seen_by_the_next_one(
    server: ApiServer, running: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And not only when everything is looked at, in a minute here."""
    put_all(server)
    server.drop("pods", "talker", NAMESPACE)
    await until(lambda: bool(server.all("services")) and running.looks() > 2)
    store = running.controller._store
    real = SandboxFailures.read

    async def read(self: SandboxFailures, observed: ClusterSnapshot) -> set[str]:
        namespaces = await real(self, observed)
        if not observed.pods:
            server.put("pods", pod_obj("talker", INJECT), NAMESPACE)
            await until(lambda: bool(store.snapshot().pods))
        return namespaces

    monkeypatch.setattr(SandboxFailures, "read", read)
    running.controller.wake()
    await until(lambda: bool(proxies(server)), 20.0)


async def test_it_settles(server: ApiServer, running: Running) -> None:
    """Nothing is written when nothing happens."""

    def written() -> int:
        return len([1 for method, _, _ in server.requests if method != "GET"])

    async def look() -> int:
        """The number of writes after another look."""
        looks = running.looks()
        running.controller.wake()
        await until(lambda: running.looks() > looks)
        return written()

    put_all(server)
    running.controller.wake()
    await until(lambda: bool(proxies(server)))
    before = -1
    now = await look()
    for _ in range(20):
        if now == before:
            break
        before = now
        now = await look()
    assert [await look() for _ in range(3)] == [now] * 3


async def test_an_operator_without_the_lead_only_looks(server: ApiServer, running: Running) -> None:
    """The operator acts at once with the lead, and stops without the lead."""

    def written() -> list[str]:
        return [method for method, _, _ in server.requests if method != "GET"]

    running.term = 0
    put_all(server)
    looks = running.looks()
    running.controller.wake()
    await until(lambda: running.looks() > looks + 1 or running.controller._last_standby_at > 0)
    assert written() == []
    assert running.controller.unready() is None
    running.term = 1
    running.controller.wake()
    await until(lambda: bool(proxies(server)))
    running.term = 0
    running.controller.wake()
    await until(lambda: running.controller._acting == 0)
    before = len(written())
    server.put("pods", pod_obj("late", INJECT, nodeName="node2"), NAMESPACE)
    server.put("nodes", {**NODE, "metadata": {"name": "node2"}})
    looks = running.looks()
    running.controller.wake()
    await until(lambda: running.looks() > looks)
    assert len(written()) == before
    running.term = 2
    running.controller.wake()
    await until(lambda: len(proxies(server)) == 2)


async def test_the_page_of_the_leader_tells_of_problems_of_the_operator(
    server: ApiServer, running: Running
) -> None:
    """A Secret that is missing, and a pod with a misspelt label."""

    def subjects() -> set[str]:
        return {problem.subject for problem in running.controller.problems()}

    put_all(server)
    server.put("pods", pod_obj("odd", {"rosproxy.io/injct": "true"}), NAMESPACE)
    await until(lambda: subjects() >= {"proxies' tokens", f"pod {NAMESPACE}/odd"})
    running.term = 0
    running.controller.wake()
    await until(lambda: not subjects())


async def test_an_api_server_that_is_away(
    server: ApiServer, running: Running, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    await until(lambda: running.looks() > 0)
    server.refuse("GET", "rosproxies", 503, "starting")
    server.end_watches(LOST)
    await until(lambda: running.looks("unavailable") > 3)
    assert running.controller.unready() == "the API server answers HTTP 503: starting"
    assert running.controller.dead() is None
    assert caplog.text.count("HTTP 503") == 1
    server.refusals.clear()
    await until(lambda: running.controller.unready() is None)
    assert "looks succeed again" in caplog.text


async def test_a_crd_that_comes_late(server: ApiServer, running: Running) -> None:
    server.refuse("GET", "rosproxies", 404, "not found")
    server.end_watches(LOST)
    await until(lambda: "CustomResourceDefinition" in (running.controller.unready() or ""))
    server.refusals.clear()
    await until(lambda: running.controller.unready() is None)


async def test_a_mistake_of_ours_does_not_end_it(
    server: ApiServer, running: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    await until(lambda: running.looks() > 0)

    def broken(*_: Any) -> ClusterPlan:
        raise RuntimeError("oops")

    real = plan
    monkeypatch.setattr(module, "plan", broken)
    running.controller.wake()
    await until(lambda: running.looks("failed") > 2)
    assert running.controller.unready() == "the operator failed: RuntimeError('oops')"
    monkeypatch.setattr(module, "plan", real)
    await until(lambda: running.controller.unready() is None)


async def test_a_plan_knows_since_when_the_webhook_is_served(
    running: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[str] = []

    def planned(observed: ClusterSnapshot, *rest: Any) -> ClusterPlan:
        seen.append(observed.webhook.since)
        return plan(observed, *rest)

    monkeypatch.setattr(module, "plan", planned)
    running.controller.wake()
    await until(lambda: "" in seen)
    running.webhook_since = "2026-01-03T00:00:00Z"
    running.controller.wake()
    await until(lambda: "2026-01-03T00:00:00Z" in seen)


async def test_a_failure_is_in_the_status(server: ApiServer, running: Running) -> None:
    put_all(server)
    server.refuse("POST", "pods", 403, 'violates PodSecurity "baseline:latest": hostPort')
    running.controller.wake()
    await until(lambda: "PodSecurity" in str(server.get("rosproxies", "arm", NAMESPACE)["status"]))


async def test_what_is_malformed_stops_nobody(server: ApiServer, running: Running) -> None:
    server.put("rosproxies", {"metadata": {"name": "bad"}, "spec": {"master": []}}, "other")
    server.put("pods", {"metadata": {"name": "x"}, "spec": {"nodeName": "node1"}}, "other")
    server.put("nodes", {"metadata": {"name": "node2"}})
    put_all(server)
    running.controller.wake()
    await until(lambda: bool(proxies(server)))
    await until(lambda: running.controller.unready() is None)
    assert server.get("rosproxies", "bad", "other")["status"]["conditions"]


async def test_a_proxy_is_asked_and_told(
    server: ApiServer, running: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The status has the proxy's answer. The operator repeats "gone" until the proxy confirms."""
    told: list[Any] = []

    async def status(_: web.Request) -> web.Response:
        return web.json_response({"settings": {}, "master": {"up": True}, "nodes": []})

    async def containers(request: web.Request) -> web.Response:
        body = await request.json()
        told.append((request.headers["Authorization"], body))
        first = "gone" in body and not any("gone" in earlier for _, earlier in told[:-1])
        return web.json_response({}, status=503 if first else 200)

    application = web.Application()
    application.router.add_get("/status", status)
    application.router.add_post("/containers", containers)
    runner = web.AppRunner(application)
    await runner.setup()
    await web.TCPSite(runner, "127.0.0.79", 11312).start()
    real = plan
    gone: dict[str, tuple[str, ...]] = {}

    def planned(observed: ClusterSnapshot, *rest: Any) -> ClusterPlan:
        cluster_plan = real(observed, *rest)
        briefings = {
            uid: structs.replace(briefing, gone=gone.get(uid, ()))
            for uid, briefing in cluster_plan.briefings.items()
        }
        return structs.replace(cluster_plan, briefings=briefings)

    monkeypatch.setattr(module, "plan", planned)
    put_all(server)
    running.controller.wake()
    await until(lambda: bool(proxies(server)))
    (proxy,) = proxies(server)
    ready = [{"type": "Ready", "status": "True"}]
    runs = {"phase": "Running", "podIP": "127.0.0.79", "conditions": ready}
    server.put("pods", {**proxy, "status": runs}, NAMESPACE)
    await until(
        lambda: server.get("rosproxies", "arm", NAMESPACE)["status"].get("proxies") == "1/1"
    )
    gone[proxy["metadata"]["uid"]] = ("10.244.1.9",)
    running.controller.wake()
    await until(lambda: len([1 for _, body in told if "gone" in body]) >= 2)
    gone.clear()
    env = proxy["spec"]["containers"][0]["env"]
    hashed = next(
        variable["value"] for variable in env if variable["name"] == "ROSPROXY_ADMIN_TOKEN_HASH"
    )
    (authorization,) = {authorization for authorization, _ in told}
    assert hash_token(authorization.removeprefix("Bearer ")) == hashed
    assert [body for _, body in told if "gone" in body][:2] == [{"gone": ["10.244.1.9"]}] * 2
    assert told[0][1] == {"selected": ["10.244.1.5"]}
    await runner.cleanup()
