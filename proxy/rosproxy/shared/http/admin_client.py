"""A client for the admin endpoint, for the commands ``status``, ``health``, ``doctor``.

The client uses http.client, which imports fast. Unlike urllib, http.client ignores the variable
``http_proxy``: a container has to reach its own proxy directly.
"""

import http.client
import json
import os
from typing import TYPE_CHECKING, Any

from rosproxy.shared.addresses import HostPort, parse_host_port
from rosproxy.shared.fixes import how_to_in_a_sentence

if TYPE_CHECKING:
    from rosproxy.shared.documents.requests import RangeProbe
    from rosproxy.shared.documents.status_document import ProxyStatus

DEFAULT_URL = "http://127.0.0.1:11312"
MAX_REPLY_BYTES = 64 * 1024 * 1024
"""Bytes of a reply that the client reads; the client drops further bytes."""
_WILDCARD_TO_LOOPBACK = {"0.0.0.0": "127.0.0.1", "::": "::1"}


class AdminError(Exception):
    """The admin endpoint gave no usable answer; the message says why."""


class AdminClient:
    """Calls the admin endpoint at ``url``, ``http://host:port`` or ``host:port``.

    Raises ValueError for a ``url`` of another form.
    """

    def __init__(self, url: str) -> None:
        authority = url.removeprefix("http://").rstrip("/")
        server = parse_host_port(authority)
        if server is None:
            raise ValueError(f"{url!r} is not of the form {DEFAULT_URL}")
        self.server = server
        self.url = f"http://{server}"

    def get(self, path: str, within: float = 5.0) -> str:
        """The text at a path; ``within`` bounds each wait in seconds. Raises AdminError."""
        return self._ask("GET", path, within)

    def status_json(self) -> dict[str, Any]:
        """The decoded JSON of ``/status``. Raises AdminError."""
        return self._json(self.get("/status"), "settings")

    def status(self) -> "ProxyStatus":
        """The status of the proxy. Raises AdminError."""
        from rosproxy.shared.documents import status_document  # noqa: PLC0415 - health starts fast

        try:
            return status_document.read_status(self.status_json())
        except status_document.NotAStatus as error:
            raise AdminError(f"{self.url}/status can't be read: {error}") from None

    def probe(self) -> "RangeProbe":
        """Have the proxy test whether outside reaches the range. Raises AdminError."""
        from rosproxy.shared.documents.requests import read_probe  # noqa: PLC0415

        # If the master answers, the test takes 15 s at most: twice two time-outs of 3 s
        # (`range_probe`), and 3 s by UDP (`udp_probe`).
        return read_probe(self._json(self._ask("POST", "/probe", 20.0), "probes"))

    def page(self) -> str:
        """The URL of the live page, with a key if a token is set. Raises AdminError."""
        if not _authorization():
            # The page needs no key without a token: the call only tests whether the proxy answers.
            self.get("/healthz")
            return f"{self.url}/"
        return f"{self.url}/?key={self._json(self._ask('POST', '/page-key', 5.0), 'key')['key']}"

    def _ask(self, method: str, path: str, within: float) -> str:
        connection = http.client.HTTPConnection(self.server.host, self.server.port, timeout=within)
        try:
            connection.connect()
            # The address, not the name: the endpoint refuses unknown names
            # (`rosproxy.shared.http.host_rule`).
            address, port = connection.sock.getpeername()[:2]
            headers = {"Host": str(HostPort(address, port)), **_authorization()}
            connection.request(method, path, headers=headers)
            reply = connection.getresponse()
            text = reply.read(MAX_REPLY_BYTES).decode("utf-8", "replace")
        except (OSError, http.client.HTTPException) as error:
            reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
            raise AdminError(
                f"no rosproxy answers at {self.url} ({reason.lower()}). "
                + how_to_in_a_sentence("ask the proxy")
            ) from None
        finally:
            connection.close()
        if reply.status != 200:
            raise AdminError(f"{self.url}{path} answers HTTP {reply.status}: {text.strip()[:200]}")
        return text

    def _json(self, text: str, key: str) -> dict[str, Any]:
        try:
            answer = json.loads(text)
        except (ValueError, RecursionError):
            answer = None
        if not isinstance(answer, dict) or key not in answer:
            raise AdminError(f"the program at {self.url} is not the admin endpoint of a rosproxy")
        return answer


def _authorization() -> dict[str, str]:
    """The header with the token of this environment; empty without a usable token.

    A caller that is not on loopback needs the token for changes.
    """
    token = os.environ.get("ROSPROXY_ADMIN_TOKEN", "")
    # http.client raises ValueError for a header with other characters (putheader). Without the
    # header the proxy answers 403 and names the missing token.
    fits = token and token.isascii() and token.isprintable()
    return {"Authorization": f"Bearer {token}"} if fits else {}


def default_url(admin_bind: str | None = None) -> str:
    """The URL of the admin endpoint of the proxy in this container or shell.

    The address is ``admin_bind``, else the address in ROSPROXY_ADMIN_BIND, with loopback for a
    wildcard address. Without both, or if the address is malformed: DEFAULT_URL.
    """
    bound = parse_host_port(admin_bind or os.environ.get("ROSPROXY_ADMIN_BIND", ""))
    if bound is None:
        return DEFAULT_URL
    return f"http://{HostPort(_WILDCARD_TO_LOOPBACK.get(bound.host, bound.host), bound.port)}"
