"""Decides which requests may see the live page.

Without a token, every caller may see the page, as ``/status``. With a token, callers on loopback
and callers with the token may. A web page of another site may not
(`rosproxy.shared.http.host_rule`).

A browser can't send the token with each request. A cookie with the token would be a risk, because
browsers send a cookie to all ports of the host. So the user enters the token once, in a form, and
the browser gets a session cookie. With this cookie, the browser can only see the page.

``rosproxy status --open`` gets a key by ``POST /page-key``, so the address in the browser contains
no token. The key gives the browser a cookie, works once, and expires after a minute. Cookies and
keys are random, and the proxy stores only hashes.
"""

import hashlib
import hmac
import secrets
from collections.abc import Callable, Collection
from typing import Any

from aiohttp import web

from rosproxy.shared.addresses import is_loopback
from rosproxy.shared.documents.requests import EmptyBody, read_body
from rosproxy.shared.http.host_rule import is_own_host

SESSION_S = 12 * 3600.0
"""Seconds until a cookie expires."""
KEY_LIFETIME_S = 60.0
"""Seconds until a key expires."""
MOST_TOKENS = 64
"""Most valid cookies, and most valid keys. A further cookie or key replaces the oldest."""


class ExpiringTokens:
    """Issues random texts that are valid for ``seconds``, and keeps only hashes."""

    def __init__(self, seconds: float, now: Callable[[], float]) -> None:
        self._seconds = seconds
        self._now = now
        self._until: dict[str, float] = {}

    def issue(self) -> str:
        """Issue a text. If there are MOST_TOKENS valid texts, the oldest expires."""
        self._forget()
        while len(self._until) >= MOST_TOKENS:
            del self._until[next(iter(self._until))]
        text = secrets.token_urlsafe(32)
        self._until[_hash(text)] = self._now() + self._seconds
        return text

    def is_valid(self, text: str) -> bool:
        """Whether a text was issued here and has not expired.

        The comparison uses hashes, so the time of the comparison reveals nothing about a text.
        """
        self._forget()
        return _hash(text) in self._until

    def use_up(self, text: str) -> bool:
        """Return the same as `is_valid`. The text then expires."""
        self._forget()
        return self._until.pop(_hash(text), None) is not None

    def _forget(self) -> None:
        for text in [text for text, until in self._until.items() if until < self._now()]:
            del self._until[text]


class Visitors:
    """Decides which requests may see the page.

    ``token_hash``: the SHA-256 of the token in hex digits, None without a token. ``local``: only
    callers on loopback may see the page, as on an operator's endpoint. ``own_names``: the names of
    the endpoint, in lower case.
    """

    def __init__(
        self,
        token_hash: str | None,
        now: Callable[[], float],
        local: bool = False,
        own_names: Collection[str] = (),
    ) -> None:
        self._token_hash = token_hash
        self._local = local
        self._own_names = own_names
        self._sessions = ExpiringTokens(SESSION_S, now)
        self._keys = ExpiringTokens(KEY_LIFETIME_S, now)

    def may_look(self, request: web.BaseRequest) -> bool:
        """Whether a request may see the page."""
        if self._sessions.is_valid(request.cookies.get(cookie_name(request), "")):
            return True
        scheme, _, token = request.headers.get("Authorization", "").partition(" ")
        if scheme == "Bearer" and self.knows_token(token):
            return True
        open_to_all = self._token_hash is None and not self._local
        return (open_to_all or is_loopback(request.remote or "")) and is_own_host(
            request.headers.get("Host", ""), self._own_names
        )

    @property
    def refusal(self) -> str:
        """The text of the reply to a refused request at an endpoint without a token."""
        if self._local:
            return (
                "rosproxy: only callers on loopback may see the page. "
                "Open http://localhost:PORT/ on this machine\n"
            )
        return (
            "rosproxy: without a token the page does not open by this name. Open the page by the "
            "address of this host or as localhost, or set --admin-token\n"
        )

    @property
    def needs_token(self) -> bool:
        """Whether the endpoint has a token."""
        return self._token_hash is not None

    def knows_token(self, token: str) -> bool:
        """Whether a text is the token. The comparison takes the same time for all texts."""
        return self._token_hash is not None and hmac.compare_digest(_hash(token), self._token_hash)

    def new_session(self) -> str:
        """The value of a new session cookie."""
        return self._sessions.issue()

    def use_key(self, key: str) -> bool:
        """Return whether a text is a valid key. The key then expires."""
        return self._keys.use_up(key)

    async def issue_key(self, body: Any) -> dict[str, Any]:
        """``POST /page-key``: return a new key for a browser. Raises BodyError."""
        read_body(body, EmptyBody)
        return {"key": self._keys.issue()}


def cookie_name(request: web.BaseRequest) -> str:
    """The name of the cookie, with the port: browsers send a cookie to all ports of a host."""
    _, _, port = request.headers.get("Host", "").rpartition(":")
    # The caller chooses the Host header, so only digits may get into the name.
    return f"rosproxy-{port}" if port.isascii() and port.isdecimal() else "rosproxy"


def _hash(text: str) -> str:
    # aiohttp decodes bytes that are not UTF-8 to surrogates.
    return hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()
