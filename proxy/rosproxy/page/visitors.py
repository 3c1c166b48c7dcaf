"""Who may look at the page: whoever may read the status and, where there is a token, knows it.

A browser can't send the token with each request, and a cookie that holds it would go to every other
port of the host. So it is given once, in a form, for a cookie that lets look and nothing else. And
``rosproxy status --open`` gets a key by ``POST /page-key``, which is good for one cookie within a
minute, so that no token stands in an address. All of them are random, and kept here as hashes.

Without a token the page is for whoever reaches the endpoint, as ``/status`` is; but not for pages
of strangers (`rosproxy.admin.host_rule`).
"""

import hashlib
import hmac
import secrets
from collections.abc import Callable, Collection
from typing import Any

from aiohttp import web

from rosproxy.admin.host_rule import is_own_host
from rosproxy.admin.requests import EmptyBody, read_body
from rosproxy.net.addresses import is_loopback

SESSION = 12 * 3600.0
"""Seconds for which a cookie is good."""
KEY = 60.0
"""Seconds in which a key must be used."""
MOST = 64
"""Cookies, and keys, that are good at the same time; the oldest goes first."""


class ExpiringTokens:
    """Random texts that are good for some seconds, of which only hashes are kept."""

    def __init__(self, seconds: float, now: Callable[[], float]) -> None:
        self._seconds = seconds
        self._now = now
        self._until: dict[str, float] = {}

    def issue(self) -> str:
        """Make one."""
        self._forget()
        while len(self._until) >= MOST:
            del self._until[next(iter(self._until))]
        text = secrets.token_urlsafe(32)
        self._until[_hash(text)] = self._now() + self._seconds
        return text

    def is_good(self, text: str) -> bool:
        """Whether it was issued here and is not too old.

        Hashes are compared, so that the time it takes tells nothing of the text.
        """
        self._forget()
        return _hash(text) in self._until

    def use_up(self, text: str) -> bool:
        """The same, and it is good no more."""
        self._forget()
        return self._until.pop(_hash(text), None) is not None

    def _forget(self) -> None:
        for text in [text for text, until in self._until.items() if until < self._now()]:
            del self._until[text]


class Visitors:
    """Decides who may look. ``token_hash``: the SHA-256 of the token, in hex digits.

    ``local``: without one only callers on loopback may. ``own_names`` are those that the endpoint
    is known by, in lower case.
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
        self._sessions = ExpiringTokens(SESSION, now)
        self._keys = ExpiringTokens(KEY, now)

    def may_look(self, request: web.BaseRequest) -> bool:
        """Whether a request is of somebody who may."""
        if self._sessions.is_good(request.cookies.get(cookie_name(request), "")):
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
        """What to tell somebody who may not look where there is no token."""
        if self._local:
            return (
                "rosproxy: the page is for this machine's own loopback (http://localhost:PORT/)\n"
            )
        return (
            "rosproxy: by this name the page is shown only with the token (--admin-token); without "
            "one ask for it by the address of this host, or as localhost\n"
        )

    @property
    def needs_token(self) -> bool:
        """Whether there is a token to be known."""
        return self._token_hash is not None

    def knows_token(self, token: str) -> bool:
        """Whether this is the token."""
        return self._token_hash is not None and hmac.compare_digest(_hash(token), self._token_hash)

    def new_session(self) -> str:
        """What a cookie is to hold."""
        return self._sessions.issue()

    def uses_key(self, key: str) -> bool:
        """Whether this is a key; it is none afterwards."""
        return self._keys.use_up(key)

    async def issue_key(self, body: Any) -> dict[str, Any]:
        """``POST /page-key``: a key with which a browser gets in. Raises BodyError."""
        read_body(body, EmptyBody)
        return {"key": self._keys.issue()}


def cookie_name(request: web.BaseRequest) -> str:
    """Cookies are for all ports of a host: the name tells which one is meant."""
    _, _, port = request.headers.get("Host", "").rpartition(":")
    # The header is the caller's: only digits of it may get into a cookie's name.
    return f"rosproxy-{port}" if port.isascii() and port.isdecimal() else "rosproxy"


def _hash(text: str) -> str:
    # aiohttp keeps bytes that are no UTF-8 as surrogates.
    return hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()
