"""The operator's own endpoint: /healthz, /readyz, /metrics, /status, and its proxies' live page.

As at a proxy's endpoint, no path answers by a name that a stranger may have registered.
"""

import socket
import time
from collections.abc import Awaitable, Callable
from functools import partial

from aiohttp import web
from prometheus_client import CollectorRegistry
from prometheus_client.exposition import CONTENT_TYPE_LATEST, generate_latest

from rosproxy.admin.host_rule import is_own_host, refusal
from rosproxy.net.addresses import HostPort
from rosproxy.page.routes import Page
from rosproxy.page.visitors import Visitors
from rosproxy.setting_kinds import SettingError
from rosproxy_operator.common.control_loop import LookFailed
from rosproxy_operator.common.proxy_client import Json

Check = Callable[[], str | None]
Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]
GetStatus = Callable[[], Awaitable[Json]]
"""Makes the document at ``/status``; raises LookFailed."""


class HealthServer:
    """Serves what orchestrators ask. ``alive`` and ``ready`` give None or the reason why not.

    ``status`` is for callers on loopback, as the page is.
    """

    def __init__(
        self,
        metrics: CollectorRegistry,
        alive: Check,
        ready: Check,
        page: Page,
        status: GetStatus | None = None,
    ) -> None:
        self._page = page
        app = web.Application(middlewares=[_refuse_strangers_names])
        for (method, path), handler in page.routes.items():
            app.router.add_route(method, path, handler)
        app.router.add_get("/healthz", partial(_check, alive))
        app.router.add_get("/readyz", partial(_check, ready))
        app.router.add_get("/metrics", partial(_show, metrics))
        if status is not None:
            visitors = Visitors(None, time.monotonic, local=True)
            app.router.add_get("/status", partial(_tell, status, visitors))
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


@web.middleware
async def _refuse_strangers_names(request: web.Request, handler: Handler) -> web.StreamResponse:
    """Answer no request by a name that a stranger may have registered; see `host_rule`."""
    host = request.headers.get("Host", "")
    if is_own_host(host, {socket.gethostname().lower()}):
        return await handler(request)
    return web.Response(status=403, text=refusal(host))


async def _check(check: Check, request: web.Request) -> web.Response:
    reason = check()
    return web.Response(status=503 if reason else 200, text=f"{reason or 'ok'}\n")


async def _show(metrics: CollectorRegistry, request: web.Request) -> web.Response:
    body = generate_latest(metrics)
    return web.Response(body=body, headers={"Content-Type": CONTENT_TYPE_LATEST})


async def _tell(status: GetStatus, visitors: Visitors, request: web.Request) -> web.Response:
    if not visitors.may_look(request):
        return web.Response(status=403, text="the status is for this machine's own loopback\n")
    try:
        return web.json_response(await status())
    except LookFailed as error:
        return web.Response(status=503, text=f"{error}\n")
