"""A thread that serves the webhook (by kopf) and the liveness check.

When kopf ends, the thread starts kopf again after a pause. The liveness server serves during the
pause, too. Only the admission of pods and the liveness check depend on this thread.

kopf watches nothing here; `watch.reflector` watches instead. kopf would keep a task and the whole
object in memory for each object, and all of kopf ends when a single watch ends.
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
from aiohttp import web

from rosproxy.shared.connections.sockets import MOST_BACKLOG
from rosproxy.shared.http.bounded_server import BoundedServer
from rosproxy_operator.common.operator_admin import MOST_CONNECTIONS
from rosproxy_operator.kubernetes.controller import KubernetesController
from rosproxy_operator.kubernetes.resources.names import INJECT
from rosproxy_operator.kubernetes.settings import KubernetesSettings
from rosproxy_operator.kubernetes.webhook.injector import Injector
from rosproxy_operator.kubernetes.webhook.webhook_server import WebhookServer

log = logging.getLogger(__name__)

WIRE = "wire"
"""Id of the handler that wires pods. kopf uses the id as the path of the webhook."""
RESTART_PAUSES_S = (1.0, 2.0, 5.0, 10.0)
"""Seconds until the thread starts kopf again, after each failure in a row. The last repeats."""
STABLE_AFTER_S = 60.0
"""A run of kopf that lasted longer resets the count of failures."""
STOP_TIMEOUT_S = 3.0
"""Seconds that the thread has to end."""
_RETRY_PAUSES_S = (1.0, 1.0, 2.0, 3.0, 5.0)
"""Seconds between tries of a request. The last repeats."""


class EndlessBackoff:
    """Seconds between tries of a request, without an end. After a last value, kopf would end."""

    def __iter__(self) -> Iterator[float]:
        """Yield the seconds in order, and then the last value for ever."""
        yield from _RETRY_PAUSES_S
        while True:
            yield _RETRY_PAUSES_S[-1]


def quiet_library_logs() -> None:
    """Keep kopf and its libraries from logging each request. Looks report problems."""
    debug = logging.getLogger().isEnabledFor(logging.DEBUG)
    for name in ("kopf", "kubernetes", "urllib3"):
        logging.getLogger(name).setLevel(logging.INFO if debug else logging.CRITICAL)
    logging.getLogger("asyncio").setLevel(logging.INFO)
    logging.getLogger("aiohttp.access").setLevel(logging.WARNING)


class ClusterServing:
    """Serves the liveness check in a thread, and the webhook unless ``webhook`` is None."""

    def __init__(
        self,
        settings: KubernetesSettings,
        controller: KubernetesController,
        webhook: tuple[Injector, WebhookServer] | None,
    ) -> None:
        self._settings = settings
        self._controller = controller
        self._webhook = webhook
        self._ending = threading.Event()
        self._running: tuple[asyncio.AbstractEventLoop, asyncio.Task[None]] | None = None
        self._thread = threading.Thread(target=self._run, daemon=True, name="kopf")

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def restart(self) -> None:
        """End the current run of kopf. The thread then starts the next run."""
        if self._running is not None:
            loop, task = self._running
            with contextlib.suppress(RuntimeError):  # the run has just ended
                loop.call_soon_threadsafe(task.cancel)

    def stop(self) -> None:
        """Stop serving, and wait up to `STOP_TIMEOUT_S` seconds for the thread."""
        self._ending.set()
        self.restart()
        self._thread.join(STOP_TIMEOUT_S)

    async def configure(self, settings: kopf.OperatorSettings, **_: Any) -> None:
        """Configure kopf (startup handler)."""
        settings.posting.enabled = False  # the operator creates its own Events
        # kopf would watch namespaces and definitions, but the operator has no right to do so.
        settings.scanning.disabled = True
        settings.peering.standalone = True  # `leader_election` decides which operator acts
        # With a timeout, each cancelled run schedules SIGKILL for this thread, and SIGKILL ends the
        # whole process (ultimate_termination in kopf, _core/reactor/running.py).
        settings.process.ultimate_exiting_timeout = None
        settings.networking.error_backoffs = EndlessBackoff()
        settings.networking.request_timeout = 30.0
        settings.networking.connect_timeout = 5.0
        # The chart creates the webhook's configuration. kopf would overwrite and later delete this
        # configuration.
        settings.admission.managed = None
        settings.admission.server = self._webhook[1] if self._webhook else None

    def _run(self) -> None:
        failures = 0
        while not self._ending.is_set():
            try:
                with warnings.catch_warnings(action="ignore"):
                    failures = asyncio.run(self._operate(failures))
            except asyncio.CancelledError:
                pass  # `stop` or `restart` has cancelled the pause
            except Exception as error:
                failures += 1
                text = "liveness server ended, the operator starts it again: %s"
                log.warning(text, _reason(error))
                self._ending.wait(_pause(failures))
            finally:
                self._running = None

    async def _operate(self, failures: int) -> int:
        """Run kopf once, and pause. Return the failures in a row.

        The liveness server serves during the pause, too. Otherwise the kubelet would restart the
        operator after three failed checks, although only kopf fails.
        """
        loop = asyncio.get_running_loop()
        task = asyncio.current_task()
        loop.set_exception_handler(_log_exception)
        if task is not None:
            self._running = loop, task
        if self._ending.is_set():
            return failures
        liveness = web.ServerRunner(BoundedServer(self._tell_liveness, MOST_CONNECTIONS))
        await liveness.setup()
        try:
            bind = self._settings.liveness
            await web.TCPSite(liveness, bind.host, bind.port, backlog=MOST_BACKLOG).start()
            started = time.monotonic()
            await self._run_kopf()
            failures = 1 if time.monotonic() - started > STABLE_AFTER_S else failures + 1
            await asyncio.sleep(_pause(failures))
        finally:
            await liveness.cleanup()
        return failures

    async def _run_kopf(self) -> None:
        """Run kopf until kopf ends. Raise CancelledError if `stop` has cancelled the run."""
        namespaces = self._settings.namespaces
        try:
            # No stop flag: with a flag, kopf takes seconds longer to end for another reason.
            await kopf.operator(
                registry=self._handlers(),
                standalone=True,
                # By default kopf asks for the Unix user's name. The user of the image has no name.
                identity=cast(Any, "rosproxy-operator"),
                clusterwide=not namespaces,
                namespaces=namespaces,
            )
        except asyncio.CancelledError:
            if self._ending.is_set():
                raise  # else `restart` has cancelled the run
        except Exception as error:
            log.warning("webhook server ended, the operator starts it again: %s", _reason(error))

    async def _tell_liveness(self, _request: web.BaseRequest) -> web.Response:
        """Answer the kubelet. kopf's own liveness endpoint does not limit connections."""
        reason = self._controller.dead()
        return web.Response(status=503 if reason else 200, text=f"{reason or 'ok'}\n")

    def _handlers(self) -> kopf.OperatorRegistry:
        handlers = kopf.OperatorRegistry()
        kopf.on.startup(registry=handlers, id="startup")(self.configure)
        # Without credentials kopf would end. With a back-off, kopf tries again.
        kopf.on.login(registry=handlers, backoff=5.0)(kopf.login_via_client)

        if self._webhook:
            _register_webhook(handlers, self._webhook[0])
        return handlers


def _pause(failures: int) -> float:
    """Return the seconds until the next run, after so many failures in a row."""
    return RESTART_PAUSES_S[min(failures, len(RESTART_PAUSES_S)) - 1]


def _reason(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"


def _register_webhook(handlers: kopf.OperatorRegistry, injector: Injector) -> None:
    @kopf.on.mutate(
        "",
        "v1",
        "pods",
        id=WIRE,
        registry=handlers,
        operations=["CREATE"],
        labels={INJECT: kopf.PRESENT},
        ignore_failures=True,
    )
    async def wire(
        body: kopf.Body, patch: kopf.Patch, warnings: list[str], dryrun: bool, **_: Any
    ) -> None:
        # kopf's body is a view, and its parts are no dictionaries. So the pod is copied.
        wiring = await injector.wiring(dict(body), dryrun)
        warnings.extend(wiring.warnings)
        if wiring.spec is not None:
            patch["spec"] = dict(wiring.spec)
        if wiring.annotations:
            patch.metadata["annotations"] = dict(wiring.annotations)


def _log_exception(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Log errors of tasks that kopf leaves behind. `_run_kopf` logs why kopf ends."""
    log.debug("kopf: %s: %r", context.get("message"), context.get("exception"))
