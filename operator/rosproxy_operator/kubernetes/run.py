"""Start and end of the Kubernetes operator.

After a signal, an operator with a Lease object first stops acting and releases the Lease object.
Then the operator still serves the webhook for `WEBHOOK_DRAIN_S` seconds. After this time, no
kube-proxy sends requests to this pod.
"""

import asyncio
import contextlib
import logging
import resource
import signal
from collections.abc import Callable, Coroutine
from typing import Any

from rosproxy import __version__
from rosproxy.page.routes import Page
from rosproxy_operator.common.operator_admin import OperatorAdminServer
from rosproxy_operator.common.operator_metrics import ClusterMetrics
from rosproxy_operator.common.operator_page import operator_page
from rosproxy_operator.common.threads import in_thread
from rosproxy_operator.kubernetes.api.api_client import Api
from rosproxy_operator.kubernetes.controller import KubernetesController
from rosproxy_operator.kubernetes.leader_election import LeaderElection
from rosproxy_operator.kubernetes.serving import ClusterServing
from rosproxy_operator.kubernetes.settings import KubernetesSettings
from rosproxy_operator.kubernetes.webhook.injector import Injector
from rosproxy_operator.kubernetes.webhook.rotation import CertificateRotation, certificate_source
from rosproxy_operator.kubernetes.webhook.webhook_server import WebhookServer

log = logging.getLogger(__name__)

REQUESTS_END_TIMEOUT_S = 5.0
"""Seconds for requests to end before the operator releases the Lease object.

If a request takes longer, the operator does not release the Lease object, which then expires.
"""
WEBHOOK_DRAIN_S = 6.0
"""Seconds for which the operator serves the webhook after the release of the Lease object.

Meanwhile each kube-proxy notices that this pod ends.
"""


def run(settings: KubernetesSettings) -> None:
    """Run the operator until a signal ends the operator. The proxies keep running.

    Raises SettingError if ``settings.admin`` can't be bound, ApiError if no cluster is configured.
    """
    _raise_limit()
    asyncio.run(_run(settings, Api(settings.namespaces)))


def logs_command(proxy: str) -> str:
    """Return the command that shows the log of a proxy, given NAMESPACE/NAME of the proxy's pod."""
    namespace, _, pod = proxy.partition("/")
    return f"kubectl -n {namespace} logs {pod}"


def _raise_limit() -> None:
    """Allow as many open files as possible, because each proxy takes a waiting connection."""
    _, hard_limit = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard_limit, hard_limit))


async def _run(settings: KubernetesSettings, api: Api) -> None:
    stopped = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stopped.set)
    metrics = ClusterMetrics()
    election = LeaderElection(api, settings.lease, metrics)
    api.gate.open = election.leads
    rotation = server = None
    if settings.webhook:
        source = certificate_source(api, settings.webhook, election.leads)
        rotation = CertificateRotation(source, metrics)
        server = WebhookServer(settings.webhook.bind, rotation)
    webhook_since = server.serving_since if server else lambda: ""
    controller = KubernetesController(settings, api, metrics, election.term, webhook_since)
    webhook = (Injector(api, settings.plan, metrics, controller.wake), server) if server else None
    page = _page(controller)
    unready = _first_reason(controller.unready, *([server.unready] if server else []))
    admin_server = OperatorAdminServer(metrics.registry, controller.dead, unready, page)
    await admin_server.start(settings.admin)
    log.info(
        "rosproxy-operator %s: manages %s at %s, health and metrics at http://%s",
        __version__,
        ", ".join(settings.namespaces) or "all namespaces",
        api.server,
        settings.admin,
    )
    serving = ClusterServing(settings, controller, webhook)
    running: list[Coroutine[Any, Any, object]] = [
        stopped.wait(), controller.run(), election.run(controller.retry),
        *([rotation.run()] if rotation else []),
    ]  # fmt: skip
    tasks = [asyncio.ensure_future(work) for work in running]
    serving.start()
    done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    # Without a Lease object, there is no other operator that could lead.
    if settings.lease and stopped.is_set():
        await hand_over(api, controller, election)
        if server:
            await _drain(server, stopped)
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, admin_server.stop(), return_exceptions=True)
    serving.stop()
    for task in done:
        task.result()  # raises the error of a failed task


def _page(controller: KubernetesController) -> Page:
    return operator_page(controller.documents, logs_command, controller.places, controller.problems)


async def hand_over(api: Api, controller: KubernetesController, election: LeaderElection) -> None:
    """Stop acting, and release the Lease object once no request is under way."""
    election.resign()
    await controller.stop_acting()
    if await in_thread(api.gate.close, REQUESTS_END_TIMEOUT_S):
        await election.release()


async def _drain(server: WebhookServer, stopped: asyncio.Event) -> None:
    """Serve the webhook for `WEBHOOK_DRAIN_S` seconds. A second signal ends the wait."""
    stopped.clear()
    server.drain()
    with contextlib.suppress(TimeoutError):
        await asyncio.wait_for(stopped.wait(), WEBHOOK_DRAIN_S)


def _first_reason(*checks: Callable[[], str | None]) -> Callable[[], str | None]:
    """Return a check that gives the first reason of several checks, None without a reason."""
    return lambda: next(filter(None, (check() for check in checks)), None)
