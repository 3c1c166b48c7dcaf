"""The operator's own endpoint: /healthz, /readyz, /metrics."""

from collections.abc import Callable

from aiohttp import web
from prometheus_client import CollectorRegistry
from prometheus_client.exposition import CONTENT_TYPE_LATEST, generate_latest

from rosproxy.net.addresses import HostPort
from rosproxy.settings import SettingError

GREETING = "rosproxy-operator: /healthz /readyz /metrics\n"
Check = Callable[[], str | None]


class HealthServer:
    """Serves what orchestrators ask. ``alive`` and ``ready`` give None or the reason why not."""

    def __init__(self, metrics: CollectorRegistry, alive: Check, ready: Check) -> None:
        self._metrics, self._alive, self._ready = metrics, alive, ready
        self._runner: web.AppRunner | None = None

    async def start(self, where: HostPort) -> None:
        """Listen. Raises SettingError if the address can't be bound."""
        app = web.Application()
        app.router.add_get("/", self._greet)
        app.router.add_get("/healthz", self._healthz)
        app.router.add_get("/readyz", self._readyz)
        app.router.add_get("/metrics", self._get_metrics)
        self._runner = web.AppRunner(app, access_log=None)
        await self._runner.setup()
        try:
            await web.TCPSite(self._runner, where.host, where.port).start()
        except OSError as error:
            text = f"{where} can't be bound: {error.strerror}"
            raise SettingError("--admin-bind", text) from None

    async def stop(self) -> None:
        """Stop listening."""
        if self._runner is not None:
            await self._runner.cleanup()

    async def _greet(self, request: web.Request) -> web.Response:
        return web.Response(text=GREETING)

    async def _healthz(self, request: web.Request) -> web.Response:
        return _answer(self._alive())

    async def _readyz(self, request: web.Request) -> web.Response:
        return _answer(self._ready())

    async def _get_metrics(self, request: web.Request) -> web.Response:
        body = generate_latest(self._metrics)
        return web.Response(body=body, headers={"Content-Type": CONTENT_TYPE_LATEST})


def _answer(reason: str | None) -> web.Response:
    return web.Response(status=503 if reason else 200, text=f"{reason or 'ok'}\n")
