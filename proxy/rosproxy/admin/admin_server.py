"""The admin endpoint: health, readiness, metrics, status, live page, and the calls of an operator.

The endpoint listens on loopback by default. Which callers it serves:

- GET only reads, and serves every caller that reaches the endpoint. The live page has a rule of its
  own (`rosproxy.page`).
- POST changes the proxy. A caller without the token must call from loopback, and not from a web
  page. The same rule holds for ``GET /status/changes`` (`status_changes`). The proxy holds only the
  hash of the token.
- All paths refuse a ``Host`` that a stranger may have registered (`host_rule`). Exceptions:
  requests with the token, and the live page if the proxy has a token.

Callers are few and friendly, so the bounds are tight, and no options change the bounds. A source
with too many connections loses the oldest connection. The endpoint ends the connection of a caller
that sends half a request or reads no reply. Status and metrics are costly: callers share the
documents (`shared_document`) and need slots. /healthz and /readyz need no slots.
"""

import asyncio
import hashlib
import hmac
import json
import logging
from collections.abc import Awaitable, Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

from aiohttp import web
from prometheus_client import CollectorRegistry
from prometheus_client.exposition import CONTENT_TYPE_LATEST, generate_latest

from rosproxy.admin.status_changes import StatusChanges, StatusSnapshot
from rosproxy.net.fair_slots import FairSlots, NoSlot
from rosproxy.net.http_client import CallFailed
from rosproxy.shared.addresses import HostPort, is_loopback, plain_address
from rosproxy.shared.connections.sockets import MOST_BACKLOG
from rosproxy.shared.documents.requests import BodyError
from rosproxy.shared.documents.status_document import ProxyStatus
from rosproxy.shared.http.bodies import TooLong, read_bounded
from rosproxy.shared.http.bounded_server import BoundedServer
from rosproxy.shared.http.host_rule import is_own_host, refusal
from rosproxy.shared.http.replies import send_shared, unavailable
from rosproxy.shared.http.shared_document import SharedDocument

log = logging.getLogger(__name__)

CHANGES_PATH = "/status/changes"
MAX_BODY_BYTES = 1024 * 1024
"""Largest body of a POST, in bytes."""
MOST_CONNECTIONS = 32
"""Connections from one address: an operator, a health check and Prometheus have one or two each."""
MOST_REPLIES = 16
"""Replies with the status or the metrics that may be under way at the same time."""
MOST_REPLIES_EACH = 4
"""Replies with status or metrics to one address: operator, Prometheus and a user have one each."""
JSON = {"Content-Type": "application/json; charset=utf-8"}
BODY_TIMEOUT = 10.0
"""Seconds in which the whole body of a POST must arrive."""
FORBIDDEN = (
    "rosproxy: {} is for callers on this host's loopback, and for those that send "
    "'Authorization: Bearer TOKEN' with the proxy's --admin-token (ROSPROXY_ADMIN_TOKEN){}\n"
)

Handler = Callable[[web.BaseRequest], Awaitable[web.StreamResponse]]
Action = Callable[[Any], Awaitable[dict[str, Any]]]
"""Carries out a POST, given the decoded JSON body, and returns the JSON of the reply.

Raises BodyError, CallFailed.
"""


@dataclass(slots=True, eq=False)
class AdminServer:
    """Serves users, orchestrators and the operator.

    ``status`` returns the state of the proxy. ``unready`` returns why the proxy is not ready; None
    if ready. ``actions`` carry out POST calls, by path. ``token_hash`` is the SHA-256, in hex
    digits, of the token; None: only callers on loopback may post. ``routes`` are the handlers of
    the live page, by method and path. ``own_names`` are the host names of the proxy, in lower case.
    """

    _metrics: CollectorRegistry
    _status: Callable[[], ProxyStatus]
    _unready: Callable[[], str | None]
    _actions: Mapping[str, Action]
    _token_hash: str | None
    _routes: Mapping[tuple[str, str], Handler]
    _own_names: Collection[str] = ()
    _runner: web.ServerRunner | None = None
    _snapshots: SharedDocument[StatusSnapshot] = field(init=False)
    _exposition: SharedDocument[bytes] = field(init=False)
    _changes: StatusChanges = field(init=False)
    _replies: FairSlots = field(init=False)

    def __post_init__(self) -> None:
        """Create the shared documents and the slots."""
        self._snapshots = SharedDocument(lambda: StatusSnapshot.take(self._status))
        self._exposition = SharedDocument(lambda: generate_latest(self._metrics))
        self._changes = StatusChanges(self._snapshots.newest)
        work = "replies with the status or the metrics are under way"
        advice = "read one to its end before you ask again"
        self._replies = FairSlots(work, MOST_REPLIES, MOST_REPLIES_EACH, advice)

    async def start(self, listener: HostPort) -> None:
        """Listen. Raises OSError."""
        self._runner = web.ServerRunner(BoundedServer(self._answer, MOST_CONNECTIONS))
        await self._runner.setup()
        # With a full queue, TCP tries to connect again after 1 s: too late for a health check.
        await web.TCPSite(self._runner, listener.host, listener.port, backlog=MOST_BACKLOG).start()

    async def stop(self) -> None:
        """Stop listening, and end all replies."""
        # aiohttp waits up to a minute for open handlers (web_runner.py, shutdown_timeout), so the
        # handlers that wait for a change or a document have to end first.
        self._changes.end()
        self._snapshots.close()
        self._exposition.close()
        if self._runner is not None:
            await self._runner.cleanup()

    async def _answer(self, request: web.BaseRequest) -> web.StreamResponse:
        method = "GET" if request.method == "HEAD" else request.method
        read_handler = self._read_handlers().get(request.path)
        route = self._routes.get((method, request.path))
        if not self._answers_to_host(request, route):
            return web.Response(status=403, text=refusal(request.headers.get("Host", "")))
        if read_handler is not None and method == "GET":
            return await read_handler(request)
        if route is not None:
            return await route(request)
        has_action = request.path in self._actions
        if has_action and method == "POST":
            return await self._post(request)
        allowed = {verb for verb, path in self._routes if path == request.path}
        allowed |= ({"GET"} if read_handler else set()) | ({"POST"} if has_action else set())
        if not allowed:
            return web.Response(status=404, text="404: Not Found")
        methods = ",".join(sorted(allowed | ({"HEAD"} if "GET" in allowed else set())))
        text = "405: Method Not Allowed"
        return web.Response(status=405, text=text, headers={"Allow": methods})

    def _answers_to_host(self, request: web.BaseRequest, route: Handler | None) -> bool:
        """Whether the endpoint answers a request with this ``Host`` header; see `host_rule`.

        If a token is set, the live page answers to any name: the page asks for the token itself.
        """
        page_asks_for_token = route is not None and self._token_hash is not None
        is_own = is_own_host(request.headers.get("Host", ""), self._own_names)
        return is_own or page_asks_for_token or self._knows_token(request)

    def _read_handlers(self) -> dict[str, Handler]:
        return {
            "/healthz": _tell_health,
            "/readyz": self._tell_readiness,
            "/metrics": self._tell_metrics,
            "/status": self._tell_status,
            CHANGES_PATH: self._wait,
        }

    async def _tell_metrics(self, request: web.BaseRequest) -> web.StreamResponse:
        try:
            with self._replies.slot(_address(request)):
                body = await self._exposition.newest()
                return await send_shared(request, [body], {"Content-Type": CONTENT_TYPE_LATEST})
        except NoSlot as error:
            return unavailable(error)

    async def _tell_status(self, request: web.BaseRequest) -> web.StreamResponse:
        try:
            with self._replies.slot(_address(request)):
                snapshot = await self._snapshots.newest()
                return await send_shared(request, [snapshot.body], JSON)
        except NoSlot as error:
            return unavailable(error)

    async def _tell_readiness(self, _request: web.BaseRequest) -> web.Response:
        reason = self._unready()
        return web.Response(status=503 if reason else 200, text=f"{reason or 'ok'}\n")

    async def _wait(self, request: web.BaseRequest) -> web.StreamResponse:
        """Answer once the version of the state differs from ``since``, or after ``within`` s."""
        if not self._may_post(request):
            return self._forbidden(f"GET {CHANGES_PATH}")
        since = request.query.get("since", "")
        transport = request.transport
        try:
            within = float(request.query.get("within", "0"))
        except ValueError:
            return web.Response(status=400, text="rosproxy: within: must be seconds\n")
        try:
            with self._changes.slots.slot(_address(request)):
                snapshot = await self._changes.after(
                    since, within, lambda: transport is not None and not transport.is_closing()
                )
                head = f'{{"version":"{snapshot.version}","status":'.encode()
                return await send_shared(request, [head, snapshot.body, b"}"], JSON)
        except NoSlot as error:
            return unavailable(error)

    def _forbidden(self, operation: str) -> web.Response:
        hint = "" if self._token_hash else "; this proxy has no token"
        return web.Response(status=403, text=FORBIDDEN.format(operation, hint))

    async def _post(self, request: web.BaseRequest) -> web.Response:
        if not self._may_post(request):
            return self._forbidden("POST")
        try:
            async with asyncio.timeout(BODY_TIMEOUT):
                raw_body = await read_bounded(request.content, MAX_BODY_BYTES)
        except TimeoutError:
            return web.Response(status=408, text=f"the body took over {BODY_TIMEOUT:g} s\n")
        except TooLong as error:
            return web.Response(status=413, text=f"{error}\n")
        try:
            body = _read_json(raw_body)
            return web.json_response(await self._actions[request.path](body))
        except BodyError as error:
            return web.Response(status=400, text=f"rosproxy: {error}\n")
        except CallFailed as error:
            log.warning("POST %s could not be carried out: %s", request.path, error)
            return web.Response(status=503, text=f"rosproxy: {error}; try again\n")

    def _may_post(self, request: web.BaseRequest) -> bool:
        """Whether a caller may post: with the token, or from loopback and not from a web page.

        A browser on this host calls from loopback, too, for any web page. The headers show that the
        caller is a browser: a request of a page has ``Origin``, and a request for an image or
        script has at least ``Sec-Fetch-Site``.
        """
        is_page = bool({"Origin", "Sec-Fetch-Site"} & request.headers.keys())
        return self._knows_token(request) or (is_loopback(request.remote or "") and not is_page)

    def _knows_token(self, request: web.BaseRequest) -> bool:
        scheme, _, token = request.headers.get("Authorization", "").partition(" ")
        if not self._token_hash or scheme != "Bearer":
            return False
        # aiohttp decodes bytes that are not UTF-8 as surrogates.
        token_hash = hashlib.sha256(token.encode("utf-8", "surrogateescape")).hexdigest()
        return hmac.compare_digest(token_hash, self._token_hash)


async def _tell_health(_request: web.BaseRequest) -> web.Response:
    return web.Response(text="ok\n")


def _address(request: web.BaseRequest) -> str:
    """The source address of a request."""
    return plain_address(request.remote or "")


def _read_json(body: bytes) -> Any:
    """The decoded JSON of a body; an empty object for an empty body. Raises BodyError."""
    try:
        return json.loads(body) if body.strip() else {}
    except (ValueError, RecursionError) as error:
        raise BodyError(f"the body: must be JSON: {error}") from None
