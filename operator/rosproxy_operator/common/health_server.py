"""The operator's own endpoint: /healthz, /readyz, /metrics, and the live page of its proxies."""

from collections.abc import Callable
from functools import partial

from aiohttp import web
from prometheus_client import CollectorRegistry
from prometheus_client.exposition import CONTENT_TYPE_LATEST, generate_latest

from rosproxy.net.addresses import HostPort
from rosproxy.page.routes import Page
from rosproxy.setting_kinds import SettingError

Check = Callable[[], str | None]


class HealthServer:
    """Serves what orchestrators ask. ``alive`` and ``ready`` give None or the reason why not."""

    def __init__(self, metrics: CollectorRegistry, alive: Check, ready: Check, page: Page) -> None:
        self._page = page
        app = web.Application()
        for (method, path), handler in page.routes.items():
            app.router.add_route(method, path, handler)
        app.router.add_get("/healthz", partial(_check, alive))
        app.router.add_get("/readyz", partial(_check, ready))
        app.router.add_get("/metrics", partial(_show, metrics))
        self._runner = web.AppRunner(app, access_log=None)

    async def start(self, listener: HostPort) -> None:
        """Listen. Raises SettingError if the address can't be bound."""
        await self._runner.setup()
        try:
            await web.TCPSite(self._runner, listener.host, listener.port).start()
        except OSError as error:
            text = f"{listener} can't be bound: {error.strerror}"
            raise SettingError("--admin-bind", text) from None

    async def stop(self) -> None:
        """Stop listening."""
        await self._page.close()
        await self._runner.cleanup()


async def _check(check: Check, request: web.Request) -> web.Response:
    reason = check()
    return web.Response(status=503 if reason else 200, text=f"{reason or 'ok'}\n")


async def _show(metrics: CollectorRegistry, request: web.Request) -> web.Response:
    body = generate_latest(metrics)
    return web.Response(body=body, headers={"Content-Type": CONTENT_TYPE_LATEST})
