"""Running kopf in a thread of its own, again whenever it ends: it serves webhook and liveness.

kopf watches nothing here: it would keep a task and the whole object for each, and ends as a whole
when one of its watches does (`reflector` watches instead). Only the admission of pods depends on
kopf.
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

from rosproxy.net.bounded_server import BoundedServer
from rosproxy.net.sockets import BACKLOG
from rosproxy_operator.common.health_server import MOST_CONNECTIONS
from rosproxy_operator.kubernetes.controller import KubernetesController
from rosproxy_operator.kubernetes.resources.names import INJECT
from rosproxy_operator.kubernetes.settings import KubernetesSettings
from rosproxy_operator.kubernetes.webhook.injector import Injector
from rosproxy_operator.kubernetes.webhook.webhook_server import WebhookServer

log = logging.getLogger(__name__)

WIRE = "wire"
"""The id of the handler that wires pods, and so the path of the webhook."""
BACK_OFF = (1.0, 2.0, 5.0, 10.0)
"""Seconds until kopf is started again; the last is repeated."""
WELL = 60.0
"""Seconds after which a run counts as a good one."""
STOPPING = 3.0
"""Seconds that kopf has to end."""
_BETWEEN_TRIES = (1.0, 1.0, 2.0, 3.0, 5.0)


class EndlessBackoff:
    """Seconds between the tries of a request, without end: kopf would give up and end otherwise."""

    def __iter__(self) -> Iterator[float]:
        """Give them one after the other, the last for ever."""
        yield from _BETWEEN_TRIES
        while True:
            yield _BETWEEN_TRIES[-1]


def quiet_library_logs() -> None:
    """Keep kopf and its libraries from logging each request; looks report what is wrong."""
    debug = logging.getLogger().isEnabledFor(logging.DEBUG)
    for name in ("kopf", "kubernetes", "urllib3"):
        logging.getLogger(name).setLevel(logging.INFO if debug else logging.CRITICAL)
    logging.getLogger("asyncio").setLevel(logging.INFO)
    logging.getLogger("aiohttp.access").setLevel(logging.WARNING)


class ClusterServing:
    """Serves liveness and, if it is given, the webhook, in a thread."""

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
        """Begin to serve."""
        self._thread.start()

    def restart(self) -> None:
        """Let kopf begin anew."""
        if self._running is not None:
            loop, task = self._running
            with contextlib.suppress(RuntimeError):  # it has just ended by itself
                loop.call_soon_threadsafe(task.cancel)

    def stop(self) -> None:
        """End serving; waits for it, but not long."""
        self._ending.set()
        self.restart()
        self._thread.join(STOPPING)

    async def configure(self, settings: kopf.OperatorSettings, **_: Any) -> None:
        """Set kopf up."""
        settings.posting.enabled = False  # the operator makes its own Events
        # To watch namespaces and definitions takes rights that the operator has not.
        settings.scanning.disabled = True
        settings.peering.standalone = True  # `leader` says who acts
        # It would kill this thread some minutes after kopf was only started again.
        settings.process.ultimate_exiting_timeout = None
        settings.networking.error_backoffs = EndlessBackoff()
        settings.networking.request_timeout = 30.0
        settings.networking.connect_timeout = 5.0
        # The chart makes the webhook's configuration; kopf would write it anew, and take it away.
        settings.admission.managed = None
        settings.admission.server = self._webhook[1] if self._webhook else None

    def _run(self) -> None:
        failures = 0
        while not self._ending.is_set():
            started = time.monotonic()
            self._run_once()
            failures = 1 if time.monotonic() - started > WELL else failures + 1
            self._ending.wait(BACK_OFF[min(failures, len(BACK_OFF)) - 1])

    def _run_once(self) -> None:
        try:
            with warnings.catch_warnings(action="ignore"):
                asyncio.run(self._operate())
        except asyncio.CancelledError:
            pass  # by `restart`
        except Exception as error:
            reason = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
            log.warning("webhook server ended, the operator starts it again: %s", reason)
        finally:
            self._running = None

    async def _operate(self) -> None:
        loop = asyncio.get_running_loop()
        task = asyncio.current_task()
        loop.set_exception_handler(_log_exception)
        if task is not None:
            self._running = loop, task
        if self._ending.is_set():
            return
        namespaces = self._settings.namespaces
        liveness = web.ServerRunner(BoundedServer(self._tell_liveness, MOST_CONNECTIONS))
        await liveness.setup()
        try:
            bind = self._settings.liveness
            await web.TCPSite(liveness, bind.host, bind.port, backlog=BACKLOG).start()
            # kopf's own stop flag would hold it up for seconds when it ends for another reason.
            await kopf.operator(
                registry=self._handlers(),
                standalone=True,
                # kopf would ask for the user's name otherwise, and an image's user has none.
                identity=cast(Any, "rosproxy-operator"),
                clusterwide=not namespaces,
                namespaces=namespaces,
            )
        finally:
            await liveness.cleanup()

    async def _tell_liveness(self, _request: web.BaseRequest) -> web.Response:
        """Answer the kubelet. kopf's own liveness endpoint has no bound of connections."""
        reason = self._controller.dead()
        return web.Response(status=503 if reason else 200, text=f"{reason or 'ok'}\n")

    def _handlers(self) -> kopf.OperatorRegistry:
        handlers = kopf.OperatorRegistry()
        kopf.on.startup(registry=handlers, id="startup")(self.configure)
        # As long as there are no credentials, kopf is not to end for it.
        kopf.on.login(registry=handlers, backoff=5.0)(kopf.login_via_client)

        if self._webhook:
            _register_webhook(handlers, self._webhook[0])
        return handlers


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
        # As it was sent: kopf's own is a view whose parts are no dictionaries.
        wiring = await injector.wiring(dict(body), dryrun)
        warnings.extend(wiring.warnings)
        if wiring.spec is not None:
            patch["spec"] = dict(wiring.spec)
        if wiring.annotations:
            patch.metadata["annotations"] = dict(wiring.annotations)


def _log_exception(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Log errors of tasks that kopf leaves behind when it ends; why it ends `_run_once` logs."""
    log.debug("kopf: %s: %r", context.get("message"), context.get("exception"))
