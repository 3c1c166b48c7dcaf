"""XML-RPC calls to the master and to inside nodes."""

import asyncio
import time
from collections.abc import Sequence
from typing import Any
from urllib.parse import urlsplit

import aiohttp

from rosproxy.core import xmlrpc
from rosproxy.core.liveness import Probe
from rosproxy.core.uris import HostPort, slave_uri
from rosproxy.metrics import Metrics
from rosproxy.names import Resolver

CALLER_ID = "/rosproxy"
"""The node name under which the proxy itself calls."""
LOOP_HEADER = "X-Rosproxy"
"""Carries the proxy's own id, so that it notices when a call of its own comes back to it."""
MAX_BODY = 64 * 1024 * 1024
"""Longest XML-RPC body in bytes, either way."""
MULTICALL_SIZE = 100
CONNECT_TIMEOUT = 2.0
MASTER_TIMEOUT = 30.0
MASTER_KEEPALIVE = 8.0
"""Seconds that an unused connection to the master is kept; rosmaster spends a thread on each."""
NODE_TIMEOUT = 15.0


class Unreachable(Exception):
    """A call that got no answer; ``refused`` if the connection was refused."""

    def __init__(self, message: str, refused: bool = False) -> None:
        super().__init__(message)
        self.refused = refused

    @property
    def probe(self) -> Probe:
        """What this means for a node's health."""
        return Probe.REFUSED if self.refused else Probe.SILENT


class MasterError(Exception):
    """The master answered, but not with status 1."""


class Upstream:
    """HTTP sessions towards the master and the nodes.

    The master's connections are kept alive. A node's are not: roscpp's server and a node's end
    make reuse unsafe, and calls to nodes are rare.
    """

    def __init__(self, master_uri: str, instance: str, metrics: Metrics) -> None:
        self.master_uri = master_uri
        self._metrics = metrics
        parts = urlsplit(master_uri)
        self._master_url = f"http://{parts.netloc}{parts.path or '/'}"
        self._master = _session(
            aiohttp.TCPConnector(resolver=Resolver(), limit=64, keepalive_timeout=MASTER_KEEPALIVE),
            {LOOP_HEADER: instance},
        )
        self._nodes = _session(
            aiohttp.TCPConnector(limit=0, force_close=True), {LOOP_HEADER: f"{instance} node"}
        )

    async def close(self) -> None:
        """Close all connections."""
        await asyncio.gather(self._master.close(), self._nodes.close())

    async def master(self, body: bytes) -> bytes:
        """The master's reply to a call. Raises Unreachable.

        Calls to the master can be repeated without harm, so a kept connection that the master
        had closed costs one more try.
        """
        try:
            return await _post(self._master, self._master_url, body, MASTER_TIMEOUT)
        except aiohttp.ServerDisconnectedError:
            return await self._again(body)
        except _FAILURES as error:
            raise self._master_gone(error) from error

    async def ask_master(self, method: str, *params: Any) -> Any:
        """The value of the proxy's own call to the master. Raises Unreachable, MasterError."""
        started = time.monotonic()
        reply = await self.master(xmlrpc.dump_call(method, CALLER_ID, *params))
        self._metrics.master_round_trip.observe(time.monotonic() - started)
        return _value(method, _parsed(reply))

    async def batch(self, calls: Sequence[tuple[str, list[Any]]]) -> list[Any]:
        """The values of many calls ``(method, params)``, as ``system.multicall``.

        ``params`` include the caller_id. A call that failed gives None. Raises Unreachable.
        """
        values: list[Any] = []
        for start in range(0, len(calls), MULTICALL_SIZE):
            part = calls[start : start + MULTICALL_SIZE]
            body = [{"methodName": method, "params": params} for method, params in part]
            results = _parsed(await self.master(xmlrpc.dump_call("system.multicall", body)))
            if not isinstance(results, list) or len(results) != len(part):
                raise Unreachable(f"master {self.master_uri}: no answer to system.multicall")
            values += [_batched(result) for result in results]
        return values

    async def node(self, where: HostPort, body: bytes, within: float = NODE_TIMEOUT) -> bytes:
        """A node's reply to a call; ``within`` is in seconds. Raises Unreachable."""
        try:
            return await _post(self._nodes, slave_uri(where), body, within)
        except _FAILURES as error:
            raise _unreachable(f"node at {where}", error) from error

    async def ask_node(self, where: HostPort, within: float, method: str, *params: Any) -> Any:
        """The value of the proxy's own call to a node. Raises Unreachable, MasterError."""
        body = xmlrpc.dump_call(method, CALLER_ID, *params)
        return _value(method, _parsed(await self.node(where, body, within)))

    async def _again(self, body: bytes) -> bytes:
        try:
            return await _post(self._master, self._master_url, body, MASTER_TIMEOUT)
        except _FAILURES as error:
            raise self._master_gone(error) from error

    def _master_gone(self, error: BaseException) -> Unreachable:
        return _unreachable(f"master {self.master_uri}", error)


_FAILURES = (aiohttp.ClientError, OSError, TimeoutError, ValueError)


def _session(connector: aiohttp.TCPConnector, headers: dict[str, str]) -> aiohttp.ClientSession:
    return aiohttp.ClientSession(
        connector=connector,
        headers={"Content-Type": "text/xml", "User-Agent": "rosproxy", **headers},
        cookie_jar=aiohttp.DummyCookieJar(),
        skip_auto_headers=["Accept-Encoding", "Accept"],
        auto_decompress=True,
    )


async def _post(session: aiohttp.ClientSession, url: str, body: bytes, within: float) -> bytes:
    timeout = aiohttp.ClientTimeout(total=within, sock_connect=min(CONNECT_TIMEOUT, within))
    # A peer that could redirect the proxy would make it fetch from any host that it reaches.
    async with session.post(url, data=body, timeout=timeout, allow_redirects=False) as reply:
        if reply.status != 200:
            raise ValueError(f"HTTP status {reply.status}")
        return await read_bounded(reply.content)


async def read_bounded(stream: aiohttp.StreamReader) -> bytes:
    """All of a body. Raises ValueError if it is longer than MAX_BODY."""
    parts, size = [], 0
    async for part in stream.iter_any():
        size += len(part)
        if size > MAX_BODY:
            raise ValueError(f"a body of more than {MAX_BODY} bytes")
        parts.append(part)
    return b"".join(parts)


def _unreachable(who: str, error: BaseException) -> Unreachable:
    cause = error.os_error if isinstance(error, aiohttp.ClientConnectorError) else error
    refused = isinstance(cause, ConnectionRefusedError)
    if isinstance(error, TimeoutError):
        reason = "no answer in time"
    elif isinstance(cause, OSError) and cause.strerror:
        reason = cause.strerror.lower()
    else:
        reason = str(cause) or type(cause).__name__
    return Unreachable(f"{who}: {reason}", refused)


def _parsed(reply: bytes) -> Any:
    """A reply's value, a fault's too."""
    try:
        return xmlrpc.python_value(xmlrpc.parse_response(reply)[0])
    except xmlrpc.XmlRpcError as error:
        raise Unreachable(f"no XML-RPC reply: {error}") from None


def _value(method: str, reply: Any) -> Any:
    match reply:
        case [1, _, value]:
            return value
        case [_, str(message), _]:
            raise MasterError(f"{method}: {message}")
        case {"faultString": str(message)}:
            raise MasterError(f"{method}: {message}")
    raise MasterError(f"{method}: not a ROS status triple")


def _batched(result: Any) -> Any:
    triple = result[0] if isinstance(result, list) and len(result) == 1 else None
    if not isinstance(triple, list) or len(triple) != 3 or triple[0] != 1:
        return None
    return triple[2]
