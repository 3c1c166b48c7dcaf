"""Running the Kubernetes operator."""

import asyncio
import logging
import signal
from collections.abc import Coroutine
from typing import Any

from rosproxy import __version__
from rosproxy_operator.common.health import HealthServer
from rosproxy_operator.common.metrics import ClusterMetrics
from rosproxy_operator.kubernetes.api import Api
from rosproxy_operator.kubernetes.controller import KubernetesController
from rosproxy_operator.kubernetes.settings import KubernetesSettings
from rosproxy_operator.kubernetes.watch import ClusterWatch
from rosproxy_operator.kubernetes.webhook.injector import Injector
from rosproxy_operator.kubernetes.webhook.rotation import CertificateRotation, source
from rosproxy_operator.kubernetes.webhook.server import WebhookServer

log = logging.getLogger(__name__)


def run(settings: KubernetesSettings) -> None:
    """Run the operator until a signal ends it; its proxies go on.

    Raises SettingError if it can't listen where it is told to, ApiError if no cluster is known.
    """
    asyncio.run(_run(settings, Api(settings.namespaces)))


async def _run(settings: KubernetesSettings, api: Api) -> None:
    stopped = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stopped.set)
    metrics = ClusterMetrics()
    controller = KubernetesController(settings, api, metrics)
    health = HealthServer(metrics.registry, controller.dead, controller.unready)
    await health.start(settings.admin)
    log.info(
        "rosproxy-operator %s: looking after %s at %s; health and metrics at http://%s",
        __version__,
        ", ".join(settings.namespaces) or "all namespaces",
        api.server,
        settings.admin,
    )
    running: list[Coroutine[Any, Any, object]] = [controller.run(), stopped.wait()]
    webhook = None
    if settings.webhook:
        rotation = CertificateRotation(source(api, settings.webhook), metrics)
        running.append(rotation.run())
        server = WebhookServer(settings.webhook.bind, rotation)
        webhook = Injector(api, settings.plan, metrics, controller.wake), server
    watch = ClusterWatch(settings, controller, webhook, metrics)
    controller.appeared = watch.restart
    tasks = [asyncio.ensure_future(work) for work in running]
    watch.start()
    done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, health.stop(), return_exceptions=True)
    watch.stop()
    for task in done:
        task.result()  # raises what it died of
