"""The client of the admin endpoints of running proxies."""

import asyncio
import errno
import socket
from collections.abc import Collection, Mapping, Sequence
from typing import Any
from urllib.parse import quote

import aiohttp
import msgspec

from rosproxy.page.page_document import Document
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.documents.status_bounds import MOST_BYTES
from rosproxy.shared.documents.status_document import (
    NotAStatus,
    ProxyStatus,
    parse_status,
    read_status,
)
from rosproxy.shared.http.bodies import TooLong, read_bounded
from rosproxy.shared.policy.layers import PolicyLayer, layers_as_json
from rosproxy_operator.common.merged_page import read_document

Json = dict[str, Any]
ANSWER_TIMEOUT_S = 3.0
"""Seconds in which a proxy must answer."""
MOST_PAGE_REQUESTS = 8
"""The highest number of requests for page documents at the same time."""
MOST_ANSWER_BYTES = 64 * 1024
"""Bytes of an answer at most.

An attacker may control a proxy. So answers have limits, and the client follows no redirects and
decompresses no answers.
"""
MOST_STATUS_BYTES = MOST_BYTES + MOST_ANSWER_BYTES
"""Bytes of a status at most. Parsing blocks the event loop, and so delays all proxies."""
MOST_PAGE_BYTES = 8 * 1024 * 1024
"""Bytes of a page document at most. The nodes and links of the document have up to 5 MiB."""
PAGE_TIMEOUT_S = 12.0
"""Seconds for a page document. A proxy takes up to 10 s for the first document (`page.routes`)."""
LONGEST_VERSION = 64
"""Characters of the version of a status at most. The client sends the version back in a URL."""
MASTER_CALL_TIMEOUT_S = 40.0
"""Seconds for a call for which the proxy first calls the master, which may take 30 s."""
_KEEP_ALIVE = {socket.TCP_KEEPIDLE: 10, socket.TCP_KEEPINTVL: 3, socket.TCP_KEEPCNT: 3}
"""Keep-alive, see tcp(7): seconds until the first probe and between probes, and lost probes."""


class ProxyError(Exception):
    """A proxy did not carry out a request.

    ``is_unreachable``: no answer in time, or an error of the operating system, such as no route. A
    refused connection does not count as unreachable. ``status`` is the HTTP status; 0 without an
    HTTP answer. ``lacks_master``: HTTP 503. The proxy answers, but its master does not, or all
    places for callers are taken.

    ``is_unreadable``: the answer has more bytes than the operator reads. This is no sign of a
    restart. After all other errors the proxy may have restarted, so the operator for Kubernetes
    sends everything again.
    """

    def __init__(
        self,
        message: str,
        is_unreachable: bool = False,
        status: int = 0,
        is_unreadable: bool = False,
    ) -> None:
        super().__init__(message)
        self.is_unreachable = is_unreachable
        self.status = status
        self.is_unreadable = is_unreadable
        self.lacks_master = status == 503


class PolicyRefused(ProxyError):
    """A proxy refuses its policy, or supports none. The message says what to do."""


class ProxyClient:
    """Calls the admin endpoints of proxies. All calls except `documents` raise ProxyError."""

    def __init__(self) -> None:
        self._session: aiohttp.ClientSession | None = None

    async def status(self, admin: HostPort) -> ProxyStatus:
        """Request the ``/status`` of a proxy."""
        text = await self._request("GET", admin, "/status", most_bytes=MOST_STATUS_BYTES)
        try:
            return parse_status(text)
        except NotAStatus:
            raise _no_rosproxy(admin) from None

    async def changes(
        self, admin: HostPort, token: str, since: str, within: float
    ) -> tuple[str, ProxyStatus]:
        """Wait until the status has another version than ``since``. Return version and status.

        The proxy answers after ``within`` seconds at the latest, even without a change. If a proxy
        can't report changes, the error has the HTTP status 403, 404, 405 or 503.
        """
        path = f"/status/changes?since={quote(since)}&within={within:g}"
        within += ANSWER_TIMEOUT_S
        text = await self._request(
            "GET", admin, path, token, within=within, most_bytes=MOST_STATUS_BYTES
        )
        answer = _read(text, admin)
        version = answer.get("version")
        status = answer.get("status")
        if not isinstance(version, str) or len(version) > LONGEST_VERSION:
            raise _no_rosproxy(admin)
        try:
            return version, read_status(status)
        except NotAStatus:
            raise _no_rosproxy(admin) from None

    async def document(self, admin: HostPort, token: str) -> Document:
        """Request the document of a proxy's live page."""
        try:
            text = await self._request(
                "GET", admin, "/graph", token, within=PAGE_TIMEOUT_S, most_bytes=MOST_PAGE_BYTES
            )
        except ProxyError as error:
            if error.status == 404:
                text = "the proxy has no live page: its image is of a former release"
                raise ProxyError(text, status=404) from None
            raise
        try:
            return read_document(text)
        except ValueError:
            raise _no_rosproxy(admin) from None

    async def documents(
        self, proxies: Mapping[str, tuple[HostPort, str]]
    ) -> dict[str, Document | str]:
        """Request the page document of each proxy, by name. A failed request gives a text."""
        room = asyncio.Semaphore(MOST_PAGE_REQUESTS)

        async def ask(admin: HostPort, token: str) -> Document | str:
            async with room:
                try:
                    return await self.document(admin, token)
                except ProxyError as error:
                    return str(error)

        answers = await asyncio.gather(*(ask(*access) for access in proxies.values()))
        return dict(zip(proxies, answers, strict=True))

    async def send_master_address(self, admin: HostPort, token: str, address: str) -> None:
        """Send the current address of the master's host."""
        await self._request("POST", admin, "/master-address", token, {"address": address})

    async def send_containers(self, admin: HostPort, token: str, body: Mapping[str, Any]) -> Json:
        """Send the addresses of containers that have gone, moved or arrived.

        Return the answer, with counts of affected nodes.
        """
        text = await self._request("POST", admin, "/containers", token, body, MASTER_CALL_TIMEOUT_S)
        return _read(text, admin)

    async def send_policy(self, admin: HostPort, token: str, layers: Sequence[PolicyLayer]) -> None:
        """Send the policy's layers, which replace all earlier layers. Raises PolicyRefused, too.

        The layers are in force at once. HTTP 503 is no error: the master does not answer now, and
        the proxy repeats the changes of registrations until the master answers. HTTP 404 comes from
        a proxy of a former release, which has no policy; without layers, this is no error.
        """
        try:
            body = {"layers": layers_as_json(layers)}
            await self._request("POST", admin, "/policy", token, body, MASTER_CALL_TIMEOUT_S)
        except ProxyError as error:
            if error.status == 404 and layers:
                text = (
                    "does not support policies, since its image is of a former release. So no new "
                    "container or pod may use the proxy. Give the proxy the image of this release"
                )
                raise PolicyRefused(text, status=404) from None
            if error.status == 400:
                text = (
                    f"refuses its policy: {error}. Until the proxy accepts a policy, no new "
                    "container or pod may use the proxy"
                )
                raise PolicyRefused(text, status=400) from None
            if error.status not in (404, 503):
                raise

    async def send_selected(
        self,
        admin: HostPort,
        token: str,
        addresses: Collection[str],
        peers: Collection[str] | None = None,
        former: Mapping[str, Sequence[int]] | None = None,
    ) -> None:
        """Send the addresses that may use the proxy as their master.

        ``peers`` are the peers of ROS 2; None: the proxy keeps its peers. ``former`` has the ports
        of participants at the previous proxy, by GUID prefix.
        """
        body: dict[str, Any] = {"selected": sorted(addresses)}
        if peers is not None:
            body["peers"] = sorted(peers)
        if former:
            body["former"] = {prefix: list(ports) for prefix, ports in former.items()}
        await self._request("POST", admin, "/containers", token, body)

    async def retire(self, admin: HostPort, token: str) -> Json:
        """Let the proxy unregister all nodes and end all participants.

        Return the answer; ``unregistered`` is the number of nodes and participants.
        """
        return _read(
            await self._request("POST", admin, "/retire", token, {}, MASTER_CALL_TIMEOUT_S), admin
        )

    async def close(self) -> None:
        """Close all connections."""
        if self._session is not None:
            await self._session.close()

    async def _request(
        self,
        method: str,
        admin: HostPort,
        path: str,
        token: str = "",
        body: Mapping[str, Any] | None = None,
        within: float = ANSWER_TIMEOUT_S,
        most_bytes: int = MOST_ANSWER_BYTES,
    ) -> str:
        """Send a request. Return the body of the answer, with ``most_bytes`` bytes at most."""
        if self._session is None:
            # No limit: each waiting call of `changes` takes a connection, and the callers bound the
            # other calls.
            connector = aiohttp.TCPConnector(limit=0, socket_factory=_kept_alive)
            self._session = aiohttp.ClientSession(connector=connector, auto_decompress=False)
        # A call to a proxy that does not exist should fail soon, even if an answer may take long.
        limits = aiohttp.ClientTimeout(total=within, sock_connect=ANSWER_TIMEOUT_S)
        headers = {"Accept-Encoding": "identity"}
        if token:
            headers["Authorization"] = f"Bearer {token}"
        url = f"http://{admin}{path}"
        try:
            async with self._session.request(
                method, url, json=body, headers=headers, timeout=limits, allow_redirects=False
            ) as reply:
                text = (await read_bounded(reply.content, most_bytes)).decode(errors="replace")
                if reply.status == 200:
                    return text
                request = f"{method} {path.partition('?')[0]}"
                message = f"{admin} answers HTTP {reply.status} to {request}: {text.strip()[:200]}"
                raise ProxyError(message, status=reply.status)
        except TimeoutError:
            raise ProxyError(f"{admin} does not answer", is_unreachable=True) from None
        except TooLong:
            request = f"{method} {path.partition('?')[0]}"
            text = f"{admin} answers more than {most_bytes} bytes to {request}"
            text = f"{text}: the proxy is of another release, or compromised"
            raise ProxyError(text, is_unreadable=True) from None
        except (OSError, aiohttp.ClientError) as error:
            raise _no_answer(admin, error) from None


def _kept_alive(info: aiohttp.AddrInfoType) -> socket.socket:
    """Return a socket with TCP keep-alive, which notices a dead machine on an idle connection."""
    sock = socket.socket(family=info[0], type=info[1], proto=info[2])
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in _KEEP_ALIVE.items():
        sock.setsockopt(socket.IPPROTO_TCP, option, value)
    return sock


def _read(text: str, admin: HostPort) -> Json:
    try:
        return msgspec.json.decode(text, type=Json)
    except (msgspec.DecodeError, RecursionError):
        raise _no_rosproxy(admin) from None


def _no_rosproxy(admin: HostPort) -> ProxyError:
    return ProxyError(f"{admin} gives an answer that is not from a rosproxy")


def _no_answer(admin: HostPort, error: Exception) -> ProxyError:
    number = error.errno if isinstance(error, OSError) else None
    if number == errno.ECONNREFUSED:
        return ProxyError(f"{admin} refuses connections")
    reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return ProxyError(f"{admin} can't be reached ({reason})", is_unreachable=number is not None)
