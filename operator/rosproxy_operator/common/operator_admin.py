"""The admin endpoint of an operator: /healthz, /readyz, /metrics, /status, and the live page.

The same rules hold as at the admin endpoint of a proxy. The server answers only requests whose
``Host`` no stranger can register, such as an IP address or the server's own host name
(`rosproxy.shared.http.host_rule`, DNS rebinding). Each client address may have `MOST_CONNECTIONS`
connections. Callers that request the metrics at the same time share a reply.
"""

import socket
import time
from collections.abc import Awaitable, Callable, Mapping
from functools import partial

from aiohttp import web
from prometheus_client import CollectorRegistry
from prometheus_client.exposition import CONTENT_TYPE_LATEST, generate_latest

from rosproxy.page.routes import Page
from rosproxy.page.visitors import Visitors
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.connections.sockets import MOST_BACKLOG
from rosproxy.shared.http.bounded_server import BoundedServer
from rosproxy.shared.http.host_rule import is_own_host, refusal
from rosproxy.shared.http.replies import send_shared
from rosproxy.shared.http.shared_document import SharedDocument
from rosproxy.shared.setting_kinds import SettingError
from rosproxy_operator.common.control_loop import LookFailed
from rosproxy_operator.common.proxy_client import Json

MOST_CONNECTIONS = 32
"""The highest number of connections from one address.

The kubelet, Prometheus and a browser need a few each.
"""

Check = Callable[[], str | None]
"""Returns None if all is well, else the reason for HTTP 503."""
Handler = Callable[[web.BaseRequest], Awaitable[web.StreamResponse]]
"""Returns the reply to a request."""
GetStatus = Callable[[], Awaitable[Json]]
"""Returns the document at ``/status``. Raises LookFailed."""


class OperatorAdminServer:
    """The HTTP server of the admin endpoint.

    ``alive`` and ``ready`` are the checks at ``/healthz`` and ``/readyz``. ``status`` and the
    ``page`` answer only callers on loopback. Without ``status`` there is no ``/status``.
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
        self._exposition = SharedDocument(lambda: generate_latest(metrics))
        routes: dict[tuple[str, str], Handler] = {
            **page.routes,
            ("GET", "/healthz"): partial(_reply_check, alive),
            ("GET", "/readyz"): partial(_reply_check, ready),
            ("GET", "/metrics"): partial(_reply_metrics, self._exposition),
        }
        if status is not None:
            visitors = Visitors(None, time.monotonic, local=True)
            routes["GET", "/status"] = partial(_reply_status, status, visitors)
        self._runner = web.ServerRunner(BoundedServer(partial(_answer, routes), MOST_CONNECTIONS))

    async def start(self, listener: HostPort) -> None:
        """Start to listen. Raises SettingError if the address can't be bound."""
        await self._runner.setup()
        try:
            site = web.TCPSite(self._runner, listener.host, listener.port, backlog=MOST_BACKLOG)
            await site.start()
        except OSError as error:
            text = f"{listener} can't be bound: {error.strerror}"
            raise SettingError("--admin-bind", text) from None

    async def stop(self) -> None:
        """Stop listening, and close all connections."""
        await self._page.close()
        self._exposition.close()
        await self._runner.cleanup()


async def _answer(
    routes: Mapping[tuple[str, str], Handler], request: web.BaseRequest
) -> web.StreamResponse:
    host = request.headers.get("Host", "")
    # A stranger may have registered any other name: DNS rebinding
    # (`rosproxy.shared.http.host_rule`).
    if not is_own_host(host, {socket.gethostname().lower()}):
        return web.Response(status=403, text=refusal(host))
    method = "GET" if request.method == "HEAD" else request.method
    handler = routes.get((method, request.path))
    if handler is not None:
        return await handler(request)
    allowed = {verb for verb, path in routes if path == request.path}
    if not allowed:
        return web.Response(status=404, text="404: Not Found")
    headers = {"Allow": ",".join(sorted(allowed))}
    return web.Response(status=405, text="405: Method Not Allowed", headers=headers)


async def _reply_check(check: Check, _request: web.BaseRequest) -> web.Response:
    reason = check()
    return web.Response(status=503 if reason else 200, text=f"{reason or 'ok'}\n")


async def _reply_metrics(
    exposition: SharedDocument[bytes], request: web.BaseRequest
) -> web.StreamResponse:
    headers = {"Content-Type": CONTENT_TYPE_LATEST}
    return await send_shared(request, [await exposition.newest()], headers)


async def _reply_status(
    status: GetStatus, visitors: Visitors, request: web.BaseRequest
) -> web.Response:
    if not visitors.may_look(request):
        return web.Response(
            status=403, text="/status answers only callers on loopback of this machine\n"
        )
    try:
        return web.json_response(await status())
    except LookFailed as error:
        return web.Response(status=503, text=f"{error}\n")
