"""Serves the live page over HTTP: files, the document, and changes as server-sent events.

The page can change nothing at the proxy. Every caller may read the scripts and the style sheet. The
document and the changes are only for requests that `Visitors` allows.

Nodes choose their names, so a name may contain a script. The Content-Security-Policy of the page
allows only files of the proxy, so a browser does not run such a script.
"""

import asyncio
import contextlib
import hashlib
import time
from collections.abc import Awaitable, Callable, Mapping
from functools import cache
from importlib.resources import files
from urllib.parse import parse_qs

from aiohttp import web

from rosproxy.net.fair_slots import NoSlot
from rosproxy.page.changes import changes
from rosproxy.page.feed import Ended, Feed
from rosproxy.page.page_document import Json
from rosproxy.page.visitors import SESSION_S, Visitors, cookie_name
from rosproxy.shared.addresses import plain_address
from rosproxy.shared.documents.status_bounds import encode
from rosproxy.shared.http.bodies import TooLong, read_bounded
from rosproxy.shared.http.replies import send_shared, unavailable, write_pieces

Handler = Callable[[web.BaseRequest], Awaitable[web.StreamResponse]]
HEARTBEAT_S = 15.0
"""Seconds without a change after which the proxy sends the time.

If sending fails, the browser has gone. If no event arrives, the page opens a new connection.
"""
FIRST_DOCUMENT_TIMEOUT_S = 10.0
"""Seconds within which the first document must be ready."""
MOST_FORM_BYTES = 4096
"""Most bytes of the login form."""
FORM_TIMEOUT_S = 10.0
"""Seconds within which the login form must arrive."""
_HEADERS = {
    "Content-Security-Policy": (
        # data: is for the empty icon in the pages' heads. Otherwise browsers request /favicon.ico.
        "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
        "img-src 'self' data:; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}
_JSON_HEADERS = {**_HEADERS, "Content-Type": "application/json; charset=utf-8"}
_FILES = {
    "/page.js": ("page.js", "text/javascript"),
    "/view.js": ("view.js", "text/javascript"),
    "/picture.js": ("picture.js", "text/javascript"),
    "/findings.js": ("findings.js", "text/javascript"),
    "/history.js": ("history.js", "text/javascript"),
    "/zoom.js": ("zoom.js", "text/javascript"),
    "/page.css": ("page.css", "text/css"),
}
_REFUSED_HTML = '<p role="alert">Wrong token. Enter the token of --admin-token.</p>'


class Page:
    """The routes of the page. ``feed`` makes the documents."""

    def __init__(self, feed: Feed, visitors: Visitors) -> None:
        self.feed = feed
        self.visitors = visitors
        self._encoded: tuple[Json, Json, bytes] | None = None
        self._whole: tuple[Json, bytes] | None = None

    @property
    def routes(self) -> Mapping[tuple[str, str], Handler]:
        """The handlers by method and path."""
        handlers: dict[tuple[str, str], Handler] = {
            ("GET", "/"): self._show,
            ("POST", "/login"): self._log_in,
            ("GET", "/graph"): self._send_document,
            ("GET", "/events"): self._stream,
        }
        return handlers | {("GET", path): _send_file for path in _FILES}

    async def close(self) -> None:
        """End all streams."""
        await self.feed.close()

    async def _show(self, request: web.BaseRequest) -> web.StreamResponse:
        key = request.query.get("key", "")
        if key and self.visitors.use_key(key):
            return self._let_in(request)
        if self.visitors.may_look(request):
            return _html("index.html")
        return self._turn_away()

    def _turn_away(self, remark: str = "") -> web.Response:
        if not self.visitors.needs_token:
            return web.Response(status=403, text=self.visitors.refusal, headers=_HEADERS)
        return _html("login.html", 403 if remark else 401, remark)

    async def _log_in(self, request: web.BaseRequest) -> web.StreamResponse:
        try:
            async with asyncio.timeout(FORM_TIMEOUT_S):
                body = await read_bounded(request.content, MOST_FORM_BYTES)
            fields = parse_qs(body.decode("utf-8", "surrogateescape"), max_num_fields=4)
        except (TimeoutError, TooLong, ValueError):
            return web.Response(
                status=400, text="rosproxy: unreadable form. Open / again\n", headers=_HEADERS
            )
        if self.visitors.knows_token(fields.get("token", [""])[0]):
            return self._let_in(request)
        return self._turn_away(_REFUSED_HTML)

    def _let_in(self, request: web.BaseRequest) -> web.Response:
        response = web.Response(status=303, headers={**_HEADERS, "Location": "./"})
        # Without the attribute Secure, because the endpoint has no TLS (docs/guide/live-page.md).
        response.set_cookie(
            cookie_name(request),
            self.visitors.new_session(),
            max_age=int(SESSION_S),
            httponly=True,
            samesite="Strict",
        )
        return response

    async def _send_document(self, request: web.BaseRequest) -> web.StreamResponse:
        """Reply with the whole document, for programs."""
        if not self.visitors.may_look(request):
            return _refusal()
        try:
            with self.feed.watching(_source(request)):
                document = await self.feed.after(None, FIRST_DOCUMENT_TIMEOUT_S)
                if document is None:
                    return _not_now()
                return await send_shared(request, [self._encode(document)], _JSON_HEADERS)
        except (NoSlot, Ended) as error:
            return _not_now(error)

    async def _stream(self, request: web.BaseRequest) -> web.StreamResponse:
        """Send the document, and then the changes until the browser closes the connection."""
        if not self.visitors.may_look(request):
            return _refusal()
        # A reply to HEAD has no body, so the stream would never end.
        if request.method == "HEAD":
            return web.Response(headers=_HEADERS)
        response = web.StreamResponse(headers={**_HEADERS, "Cache-Control": "no-store"})
        response.content_type = "text/event-stream"
        try:
            with self.feed.watching(_source(request)):
                await response.prepare(request)
                await self._send(response)
        except NoSlot as error:
            return _not_now(error)
        except (Ended, ConnectionError):
            pass
        with contextlib.suppress(ConnectionError):
            await response.write_eof()
        return response

    async def _send(self, response: web.StreamResponse) -> None:
        """Send events without an end. Raises Ended; ConnectionError if the browser has gone."""
        await response.write(_clock_event())
        former: Json | None = None
        while True:
            newest = await self.feed.after(former, HEARTBEAT_S)
            # Not a comment, which would be shorter: browsers do not pass comments to the page.
            event = _clock_event() if newest is None else self._event(former, newest)
            await write_pieces(response, event)
            former = newest or former

    def _encode(self, document: Json) -> bytes:
        """A document as JSON, encoded only once for all programs and all new watchers."""
        if self._whole is None or self._whole[0] is not document:
            self._whole = document, encode(document)
        return self._whole[1]

    def _event(self, former: Json | None, newest: Json) -> bytes:
        """The event that turns ``former`` into ``newest``.

        Encoded only once for all watchers with the same ``former``, as most have.
        """
        if former is None:
            return b"event: all\ndata: %b\n\n" % self._encode(newest)
        cached = self._encoded
        if cached is None or cached[0] is not former or cached[1] is not newest:
            data = encode(changes(former, newest))
            self._encoded = cached = (former, newest, b"event: change\ndata: %b\n\n" % data)
        return cached[2]


def _clock_event() -> bytes:
    """The event with the proxy's time. The browser's clock may differ, and the page shows ages."""
    return f"event: clock\ndata: {time.time():.3f}\n\n".encode()


async def _send_file(request: web.BaseRequest) -> web.StreamResponse:
    name, kind = _FILES[request.path]
    body, tag = _read(name)
    headers = {**_HEADERS, "ETag": tag, "Cache-Control": "no-cache"}
    if request.headers.get("If-None-Match") == tag:
        return web.Response(status=304, headers=headers)
    return web.Response(body=body, content_type=kind, charset="utf-8", headers=headers)


@cache
def _read(name: str) -> tuple[bytes, str]:
    """The content of a file of the page, and the ETag, which is a hash of the content."""
    body = files("rosproxy.page").joinpath("files", name).read_bytes()
    return body, f'"{hashlib.sha256(body).hexdigest()[:32]}"'


def _html(name: str, status: int = 200, remark: str = "") -> web.Response:
    text = _read(name)[0].decode().replace("<!-- remark -->", remark)
    headers = {**_HEADERS, "Cache-Control": "no-store"}
    return web.Response(status=status, text=text, content_type="text/html", headers=headers)


def _refusal() -> web.Response:
    text = "rosproxy: no token or cookie. Send 'Authorization: Bearer TOKEN', or log in at /\n"
    return web.Response(status=403, text=text, headers=_HEADERS)


def _not_now(reason: object = "") -> web.Response:
    return unavailable(reason or "no document is ready yet. Try again", _HEADERS)


def _source(request: web.BaseRequest) -> str:
    """The IP address from which a request comes."""
    return plain_address(request.remote or "")
