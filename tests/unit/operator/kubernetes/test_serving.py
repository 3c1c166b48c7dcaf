"""kopf in its thread, with an API server on loopback. If kopf ends, everything else goes on."""

import asyncio
import base64
import json
import ssl
import threading
import time
import urllib.error
import urllib.request
from collections.abc import AsyncIterator, Callable
from datetime import UTC, datetime, timedelta
from typing import Any, cast

import jsonpatch
import kopf
import pytest

from examples.demo.fake_http import free_ports
from rosproxy.shared.addresses import HostPort
from rosproxy_operator.common.operator_admin import MOST_CONNECTIONS
from rosproxy_operator.common.operator_metrics import ClusterMetrics
from rosproxy_operator.common.threads import in_thread
from rosproxy_operator.kubernetes import serving
from rosproxy_operator.kubernetes.api.api_client import Api
from rosproxy_operator.kubernetes.serving import ClusterServing
from rosproxy_operator.kubernetes.settings import Bounds, ClusterSettings, KubernetesSettings
from rosproxy_operator.kubernetes.webhook import certificates
from rosproxy_operator.kubernetes.webhook.injector import Injector
from rosproxy_operator.kubernetes.webhook.rotation import CertificateDirectory, CertificateRotation
from rosproxy_operator.kubernetes.webhook.webhook_server import WebhookServer
from tests.unit.operator.kubernetes.api_server import ApiServer, until
from tests.unit.operator.kubernetes.builders_api import (
    INJECT,
    NAMESPACE,
    pod_obj,
    rosproxy_obj,
    service_obj,
)

PAIR = certificates.make(["localhost"], certificates.now())
OTHER = {**service_obj()["metadata"]["ownerReferences"][0], "uid": "another"}


class Woken:
    """A controller that counts wake-ups, and runs ``makes`` at each."""

    def __init__(self) -> None:
        self.makes: Callable[[], object] = lambda: None
        self.times = 0
        self.reason: str | None = None

    def wake(self) -> None:
        self.times += 1
        self.makes()

    def dead(self) -> str | None:
        return self.reason


class Running:
    """The webhook and the liveness endpoint of a replica, with an API server."""

    def __init__(self, server: ApiServer, api: Api) -> None:
        self.server = server
        self.controller = Woken()
        self.metrics = ClusterMetrics()
        self.liveness = free_ports(1)
        self.webhook = free_ports(1)
        rotation = CertificateRotation(CertificateDirectory(""), self.metrics)
        rotation.pair = PAIR
        plan = ClusterSettings(bounds=Bounds(max_ports=64))
        settings = KubernetesSettings(plan, liveness=HostPort("127.0.0.1", self.liveness))
        serving = WebhookServer(HostPort("127.0.0.1", self.webhook), rotation)
        injector = Injector(api, settings.plan, self.metrics, self.controller.wake)
        controller: Any = self.controller
        self.serving = ClusterServing(settings, controller, (injector, serving))

    async def health(self) -> tuple[int, str]:
        return await in_thread(get, f"http://127.0.0.1:{self.liveness}/healthz")

    async def admit(self, pod: dict[str, Any], **more: Any) -> dict[str, Any]:
        """The webhook's answer for a pod."""
        review = {
            "apiVersion": "admission.k8s.io/v1",
            "kind": "AdmissionReview",
            "request": {
                "uid": "u1",
                "operation": "CREATE",
                "resource": {"group": "", "version": "v1", "resource": "pods"},
                "userInfo": {"username": "me"},
                "object": pod,
                **more,
            },
        }
        response: dict[str, Any] = await in_thread(post, self.webhook, "/wire", review)
        assert response["response"]["uid"] == "u1"
        assert response["response"]["allowed"] is True
        answer: dict[str, Any] = response["response"]
        return answer


@pytest.fixture
async def running(
    server: ApiServer, api: Api, monkeypatch: pytest.MonkeyPatch
) -> AsyncIterator[Running]:
    monkeypatch.setattr(serving, "RESTART_PAUSES_S", (0.05,))
    monkeypatch.setattr(serving, "_RETRY_PAUSES_S", (0.05,))
    serving.quiet_library_logs()
    started = Running(server, api)
    started.serving.start()
    await until_alive(started)
    yield started
    await in_thread(started.serving.stop)
    assert "kopf" not in {thread.name for thread in threading.enumerate()}


async def until_alive(running: Running) -> None:
    """Wait until liveness and the webhook are served."""
    while True:
        for port in (running.liveness, running.webhook):
            try:
                _, writer = await asyncio.open_connection("127.0.0.1", port)
            except OSError:
                await asyncio.sleep(0.02)
                break
            writer.close()
        else:
            return


def get(url: str) -> tuple[int, str]:
    try:
        with urllib.request.urlopen(url, timeout=30) as reply:
            return reply.status, reply.read().decode()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read().decode()


def post(port: int, path: str, body: Any) -> Any:
    context = ssl.create_default_context(cadata=PAIR.ca.decode())
    request = urllib.request.Request(
        f"https://localhost:{port}{path}",
        json.dumps(body).encode(),
        {"Content-Type": "application/json"},
    )
    with urllib.request.urlopen(request, timeout=30, context=context) as reply:
        return json.loads(reply.read())


async def test_when_kopf_ends_it_is_started_again(
    running: Running, caplog: pytest.LogCaptureFixture
) -> None:
    asked = len(running.server.asked("GET", "apis"))
    running.serving.restart()
    await until(lambda: len(running.server.asked("GET", "apis")) > asked)
    await until_alive(running)
    put_rosproxy(running.server)
    assert "patch" in await running.admit(pod_obj("talker", INJECT))


async def test_while_kopf_fails_the_operator_stays_alive(
    running: Running, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Otherwise the kubelet would restart an operator of which only the webhook fails."""

    async def fail(**_: Any) -> None:
        monkeypatch.setattr(serving, "RESTART_PAUSES_S", (3600.0,))
        raise RuntimeError("no webhook")

    monkeypatch.setattr(kopf, "operator", fail)
    running.serving.restart()
    await until(lambda: "webhook server ended" in caplog.text)
    assert await running.health() == (200, "ok\n")


async def test_it_watches_nothing(running: Running) -> None:
    await until_alive(running)
    assert not [query for _, _, query in running.server.requests if query.get("watch")]


async def test_liveness_is_the_controllers(running: Running) -> None:
    await until_alive(running)
    assert await running.health() == (200, "ok\n")


async def test_a_hung_controller_is_not_alive(running: Running) -> None:
    await until_alive(running)
    running.controller.reason = "the event loop has not run for 30 s"
    assert await running.health() == (503, "the event loop has not run for 30 s\n")


async def test_an_address_has_a_few_connections_to_liveness(running: Running) -> None:
    """Any pod could take all memory and all files of the operator by connections."""
    wires = [
        await asyncio.open_connection("127.0.0.1", running.liveness)
        for _ in range(MOST_CONNECTIONS + 1)
    ]
    await until(wires[0][0].at_eof)
    assert (await running.health())[0] == 200
    for _, writer in wires:
        writer.transport.abort()


def put_rosproxy(server: ApiServer) -> None:
    server.put("rosproxies", rosproxy_obj(), NAMESPACE)
    server.put("services", service_obj(), NAMESPACE)


async def test_a_pod_is_wired(running: Running) -> None:
    put_rosproxy(running.server)
    pod = pod_obj("talker", INJECT)
    answer = await running.admit(pod)
    assert "warnings" not in answer
    patch = json.loads(base64.b64decode(answer["patch"]))
    wired = jsonpatch.apply_patch(pod, patch)
    (service,) = running.server.all("services")
    uri = f"http://{service['spec']['clusterIP']}:11311"
    env = {variable["name"]: variable for variable in wired["spec"]["containers"][0]["env"]}
    assert env["ROS_MASTER_URI"]["value"] == uri
    assert env["ROS_IP"]["valueFrom"]["fieldRef"]["fieldPath"] == "status.podIP"
    assert wired["metadata"]["annotations"]["rosproxy.io/master-uri"] == uri
    assert running.metrics.admissions.labels("wired")._value.get() == 1


async def test_a_pod_that_comes_before_its_service_waits_for_the_controller(
    running: Running,
) -> None:
    server = running.server
    server.put("rosproxies", rosproxy_obj(), NAMESPACE)
    running.controller.makes = lambda: server.put("services", service_obj(), NAMESPACE)
    assert "patch" in await running.admit(pod_obj("talker", INJECT))
    assert {method for method, _, _ in server.requests} == {"GET"}


async def test_a_pod_whose_service_does_not_come_is_admitted(
    running: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rosproxy_operator.kubernetes.webhook.injector.ADMISSION_TIMEOUT_S", 0.5)
    running.server.put("rosproxies", rosproxy_obj(), NAMESPACE)
    answer = await running.admit(pod_obj("talker", INJECT))
    assert (
        "has no cluster IP yet. Read kubectl -n robots describe rosproxy arm"
        in (answer["warnings"][0])
    )
    assert running.controller.times > 0


@pytest.mark.parametrize(
    "change", [{"ownerReferences": [OTHER]}, {"deletionTimestamp": "2026-01-01T00:00:00Z"}]
)
async def test_a_service_that_is_about_to_go_is_waited_for(
    running: Running, monkeypatch: pytest.MonkeyPatch, change: dict[str, Any]
) -> None:
    monkeypatch.setattr("rosproxy_operator.kubernetes.webhook.injector.ADMISSION_TIMEOUT_S", 0.3)
    running.server.put("rosproxies", rosproxy_obj(), NAMESPACE)
    running.server.put("services", service_obj(**change), NAMESPACE)
    answer = await running.admit(pod_obj("talker", INJECT))
    assert "has no cluster IP yet" in answer["warnings"][0]


async def test_a_service_that_is_somebody_elses_is_told(running: Running) -> None:
    running.server.put("rosproxies", rosproxy_obj(), NAMESPACE)
    running.server.put("services", service_obj(labels={}), NAMESPACE)
    answer = await running.admit(pod_obj("talker", INJECT))
    assert "exists already that the operator did not create. Delete that" in answer["warnings"][0]


@pytest.mark.parametrize(
    ("spec", "said"),
    [
        ({"ports": 65}, "RosProxy arm: spec.ports: the operator does not allow 65"),
        (
            {"master": {"service": {"name": "m", "namespace": "other"}}},
            "does not allow RosProxies of namespace 'robots'",
        ),
    ],
)
async def test_a_pod_of_a_rosproxy_that_asks_for_too_much_does_not_wait(
    running: Running, monkeypatch: pytest.MonkeyPatch, spec: dict[str, Any], said: str
) -> None:
    """The operator makes no Service for such a RosProxy. Once allowed, the pod waits for the
    Service.
    """
    monkeypatch.setattr("rosproxy_operator.kubernetes.webhook.injector.ADMISSION_TIMEOUT_S", 60.0)
    server = running.server
    server.put("rosproxies", rosproxy_obj(spec), NAMESPACE)
    answer = await running.admit(pod_obj("talker", INJECT))
    assert said in answer["warnings"][0]
    agreed = {"metadata": {"name": "m", "annotations": {"rosproxy.io/allow-from": NAMESPACE}}}
    server.put("services", agreed, "other")
    server.put("rosproxies", rosproxy_obj(spec | {"ports": 64}), NAMESPACE)
    running.controller.makes = lambda: server.put("services", service_obj(), NAMESPACE)
    assert "patch" in await running.admit(pod_obj("talker", INJECT))


async def test_a_dry_run_waits_for_no_service(
    running: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rosproxy_operator.kubernetes.webhook.injector.ADMISSION_TIMEOUT_S", 60.0)
    running.server.put("rosproxies", rosproxy_obj(), NAMESPACE)
    answer = await running.admit(pod_obj("talker", INJECT), dryRun=True)
    assert "has no cluster IP yet" in answer["warnings"][0]
    assert not running.server.all("services")


@pytest.mark.parametrize("status", [403, 500])
async def test_a_pod_is_admitted_whatever_the_api_server_says(
    running: Running, status: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rosproxy_operator.kubernetes.webhook.injector.ADMISSION_TIMEOUT_S", 0.3)
    running.server.refuse("GET", "rosproxies", status, "no")
    answer = await running.admit(pod_obj("talker", INJECT))
    assert answer["warnings"][0].startswith("rosproxy: this pod was not wired to a proxy: ")
    patch = json.loads(base64.b64decode(answer["patch"]))
    assert {step["path"].split("/")[1] for step in patch} == {"metadata"}


async def test_an_api_server_that_is_just_starting_is_asked_again(running: Running) -> None:
    put_rosproxy(running.server)
    running.server.refuse("GET", "rosproxies", 429, "storage is (re)initializing")
    asyncio.get_running_loop().call_later(0.4, running.server.refusals.clear)
    assert "patch" in await running.admit(pod_obj("talker", INJECT))


async def test_a_pod_waits_for_a_service_that_is_just_made(
    running: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before kube-proxy knows the Service, a connection attempt would hang for two minutes."""
    monkeypatch.setattr("rosproxy_operator.kubernetes.webhook.injector.YOUNG_SERVICE_S", 0.5)
    put_rosproxy(running.server)
    (service,) = running.server.all("services")
    made = datetime.now(UTC) + timedelta(seconds=3600)
    service["metadata"]["creationTimestamp"] = made.isoformat()
    started = time.monotonic()
    assert "patch" in await running.admit(pod_obj("second", INJECT))
    assert time.monotonic() - started > 0.4  # and not for an hour, if a clock is wrong
    service["metadata"]["creationTimestamp"] = "2026-01-01T00:00:00Z"
    monkeypatch.setattr("rosproxy_operator.kubernetes.webhook.injector.YOUNG_SERVICE_S", 3600.0)
    assert "patch" in await running.admit(pod_obj("third", INJECT))


async def test_a_pod_that_nobody_takes_is_told(running: Running) -> None:
    answer = await running.admit(pod_obj("talker", INJECT))
    assert "namespace robots has no RosProxy" in answer["warnings"][0]
    answer = await running.admit(pod_obj("talker", {"rosproxy.io/inject": "false"}))
    assert "warnings" not in answer


async def test_for_a_pod_without_a_namespace_nothing_is_listed(running: Running) -> None:
    """A caller had the operator list the RosProxies of all namespaces, for each request."""
    pod = pod_obj("talker", INJECT)
    del pod["metadata"]["namespace"]
    answer = await running.admit(pod)
    assert "has no RosProxy" in answer["warnings"][0]
    assert not running.server.asked("GET", "rosproxies")


async def test_a_mistake_of_ours_admits_the_pod(
    running: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: Any) -> Any:
        raise RuntimeError("oops")

    monkeypatch.setattr("rosproxy_operator.kubernetes.webhook.injector.objects.pod", broken)
    answer = await running.admit(pod_obj("talker", INJECT))
    assert "the operator failed: RuntimeError('oops')" in answer["warnings"][0]


async def test_what_kopf_cannot_serve_is_admitted_too(running: Running) -> None:
    answer = await running.admit(pod_obj("talker", INJECT), userInfo=None)
    assert "the operator failed" in answer["warnings"][0]


async def test_nonsense_is_refused(running: Running) -> None:
    bodies: list[Any] = [[], "x", {"request": 3}]
    for nonsense in bodies:
        with pytest.raises(urllib.error.HTTPError, match="400") as caught:
            await in_thread(post, running.webhook, "/wire", nonsense)
        caught.value.close()


async def test_everything_that_would_surprise_is_off() -> None:
    settings = kopf.OperatorSettings()
    controller = cast(Any, Woken())
    cluster_serving = ClusterServing(KubernetesSettings(), controller, None)
    await cluster_serving.configure(settings)
    assert not settings.posting.enabled
    assert settings.scanning.disabled
    assert settings.peering.standalone
    assert settings.admission.managed is None
    assert settings.process.ultimate_exiting_timeout is None
