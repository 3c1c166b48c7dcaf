"""Running kopf in a thread of its own, again whenever it ends.

kopf ends as a whole when one of its watches does, and then cancels every task of its event loop.
Nothing depends on it but how soon something is seen: looks go on by the clock.
"""

import asyncio
import contextlib
import logging
import threading
import time
import warnings
from collections.abc import Iterator
from typing import Any, cast

import kopf

from rosproxy_operator.common.metrics import ClusterMetrics
from rosproxy_operator.kubernetes.handlers import Wakeable, registry
from rosproxy_operator.kubernetes.settings import KubernetesSettings
from rosproxy_operator.kubernetes.webhook.injector import Injector
from rosproxy_operator.kubernetes.webhook.server import WebhookServer

log = logging.getLogger(__name__)

BACK_OFF = (1.0, 2.0, 5.0, 10.0)
"""Seconds until kopf is started again; the last is repeated."""
WELL = 60.0
"""Seconds after which a run counts as a good one."""
STOPPING = 3.0
"""Seconds that kopf has to end."""
_BETWEEN_TRIES = (1.0, 1.0, 2.0, 3.0, 5.0)
_PERIOD = 300
"""Seconds after which the API server is to end a watch: whatever was lost comes again then."""


class Endless:
    """Seconds between the tries of a request, without end: kopf would give up and end otherwise."""

    def __iter__(self) -> Iterator[float]:
        """Give them one after the other, the last for ever."""
        yield from _BETWEEN_TRIES
        while True:
            yield _BETWEEN_TRIES[-1]


class ClusterWatch:
    """Watches the cluster and serves liveness and webhook, in a thread."""

    def __init__(
        self,
        settings: KubernetesSettings,
        controller: Wakeable,
        injector: Injector | None,
        server: WebhookServer | None,
        metrics: ClusterMetrics,
    ) -> None:
        self._settings, self._controller, self._metrics = settings, controller, metrics
        self._injector, self._server = injector, server
        self._ending = threading.Event()
        self._running: tuple[asyncio.AbstractEventLoop, asyncio.Task[None]] | None = None
        self._thread = threading.Thread(target=self._run, daemon=True, name="kopf")

    def start(self) -> None:
        """Begin to watch."""
        self._thread.start()

    def restart(self) -> None:
        """Let kopf find out anew which kinds of objects the cluster has."""
        if self._running is not None:
            loop, task = self._running
            with contextlib.suppress(RuntimeError):  # it has just ended by itself
                loop.call_soon_threadsafe(task.cancel)

    def stop(self) -> None:
        """End watching; waits for it, but not long."""
        self._ending.set()
        self.restart()
        self._thread.join(STOPPING)

    def configure(self, settings: kopf.OperatorSettings) -> None:
        """Set kopf up."""
        settings.posting.enabled = False
        settings.scanning.disabled = True
        settings.peering.standalone = True
        # It would kill this thread some minutes after kopf was only started again.
        settings.process.ultimate_exiting_timeout = None
        settings.networking.error_backoffs = Endless()
        settings.networking.request_timeout = 30.0
        settings.networking.connect_timeout = 5.0
        settings.watching.server_timeout = _PERIOD
        settings.watching.reconnect_backoff = 1.0
        settings.admission.managed = None
        settings.admission.server = self._server

    def _run(self) -> None:
        failures = 0
        while not self._ending.is_set():
            started = time.monotonic()
            self._once()
            failures = 0 if time.monotonic() - started > WELL else failures + 1
            if not self._ending.is_set():
                self._metrics.watch_restarts.inc()
                self._controller.wake()
                self._ending.wait(BACK_OFF[min(failures, len(BACK_OFF)) - 1])

    def _once(self) -> None:
        try:
            with _quiet():
                asyncio.run(self._operate())
        except asyncio.CancelledError:
            pass
        except Exception as error:
            log.warning("watching has ended (%s); starting it again", _reason(error))
        finally:
            self._running = None

    async def _operate(self) -> None:
        loop, task = asyncio.get_running_loop(), asyncio.current_task()
        loop.set_exception_handler(_forgotten)
        if task is not None:
            self._running = loop, task
        if self._ending.is_set():
            return
        namespaces = self._settings.namespaces
        # kopf's own stop flag would hold it up for seconds when it ends for another reason.
        await kopf.operator(
            registry=registry(self._controller, self._injector, self.configure),
            standalone=True,
            # kopf would ask for the user's name otherwise, and an image's user has none.
            identity=cast(Any, "rosproxy-operator"),
            liveness_endpoint=f"http://{self._settings.liveness}/healthz",
            clusterwide=not namespaces,
            namespaces=namespaces,
        )


def _forgotten(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Tasks that kopf leaves behind when it ends; why it does is told where it is started anew."""
    log.debug("kopf: %s: %r", context.get("message"), context.get("exception"))


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def _reason(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
