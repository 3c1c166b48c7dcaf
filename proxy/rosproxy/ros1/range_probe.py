"""Try whether outside reaches the advertised ports, over free ports of the range, from two places.

The proxy connects to its own advertised address. If NAT does not lead such a connection back (no
hairpin), the attempt fails although outside reaches the port. So the master tries as well. It calls
paramUpdate at a subscriber of a parameter, and the proxy subscribes the port under test. The probe
leaves no trace in the graph or among the parameters.
"""

import asyncio
import logging
import secrets
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field

from rosproxy.ros1.clients.master_client import CALLER_ID, Unreachable
from rosproxy.ros1.context import Context
from rosproxy.ros1.leases import Leases
from rosproxy.ros1.protocol.xmlrpc import document as xmlrpc
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.documents.requests import PortProbe
from rosproxy.shared.machine.resolver import resolve
from rosproxy.shared.uris import slave_uri

log = logging.getLogger(__name__)

PROBE_TIMEOUT_S = 3.0
"""Seconds for a connection to the port under test, and again for the exchange there."""
MASTER_TIMEOUT_S = 4.0
"""Seconds within which the master must call back. rosmaster calls back from three threads."""
MOST_REQUEST_BYTES = 65536


@dataclass(slots=True, eq=False)
class _PortTrial:
    """A port under test, and the secrets by which its two callers identify themselves."""

    proxy_secret: str = field(default_factory=lambda: secrets.token_hex(16))
    master_secret: str = field(default_factory=lambda: secrets.token_hex(16))
    reached: asyncio.Event = field(default_factory=asyncio.Event)

    async def greet(self, conn: socket.socket, peer: str) -> None:
        """Answer a caller that knows one of the secrets, in the way of a node."""
        loop = asyncio.get_running_loop()
        request = b""
        async with asyncio.timeout(PROBE_TIMEOUT_S):
            while not self._recognize(request) and len(request) < MOST_REQUEST_BYTES:
                chunk = await loop.sock_recv(conn, 4096)
                if not chunk:
                    break
                request += chunk
            if self._recognize(request):
                # rosmaster unpacks a triple (master_api.py, param_update_task). The triple has the
                # secret by which the proxy recognizes its own answer.
                body = xmlrpc.dump_reply([1, self.proxy_secret, 0])
                head = "HTTP/1.0 200 OK\r\nContent-Type: text/xml\r\nContent-Length:"
                await loop.sock_sendall(conn, f"{head} {len(body)}\r\n\r\n".encode() + body)
        conn.close()

    def _recognize(self, request: bytes) -> bool:
        if self.master_secret.encode() in request:
            self.reached.set()
        return self.master_secret.encode() in request or self.proxy_secret.encode() in request


async def probe_range(
    context: Context, leases: Leases, or_fast: bool = True
) -> tuple[PortProbe, ...]:
    """Try the lowest and the highest free port of the range; without a free port, one fast port.

    The result is empty if no port was tried.

    After the probe, the proxy relays the topics of the fast port's node for a while. So without
    ``or_fast`` nothing is tried if no port is free.

    If the master misses the first port, the probe leaves out the second. The reason: rosmaster
    calls back from three threads, and a call without an answer holds a thread as long as TCP tries,
    two minutes.
    """
    pool = context.registry.pool
    ports = context.settings.ports.listen.ports()
    probes: list[PortProbe] = []
    for order in (ports, reversed(ports)):
        trial = _PortTrial()
        async with leases.lend(order, trial.greet, or_fast) as port:
            if port is None:
                break
            target = context.addressing.outside(port)
            from_proxy, from_master = await asyncio.gather(
                _dial(context, trial, target), _ask_master(context, trial, target)
            )
            if not leases.is_lent(port):
                break  # a node has got the port meanwhile, so the result is unknown
        probes.append(PortProbe(port, str(target), from_proxy, from_master))
        if probes[0].from_master == "missed" or pool.free == 1:
            break
    return tuple(probes)


async def _dial(context: Context, trial: _PortTrial, target: HostPort) -> str:
    """Connect to the advertised address, and check the answer; return a word for `PortProbe`."""
    addresses = await resolve(context.upstream.reach(target).host)
    if not addresses:
        return "unresolvable"
    try:
        async with asyncio.timeout(PROBE_TIMEOUT_S):
            reader, writer = await asyncio.open_connection(addresses[0], target.port)
    except TimeoutError:
        return "silent"
    except ConnectionRefusedError:
        return "refused"
    except OSError:
        return "unreachable"
    return await _await_greeting(trial, reader, writer)


async def _await_greeting(
    trial: _PortTrial, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
) -> str:
    answer = b""
    try:
        async with asyncio.timeout(PROBE_TIMEOUT_S):
            writer.write(f"GET /{trial.proxy_secret} HTTP/1.0\r\n\r\n".encode())
            while len(answer) < MOST_REQUEST_BYTES and (chunk := await reader.read(4096)):
                answer += chunk
    except TimeoutError:
        return "stranger"
    except OSError as error:
        log.debug("the port under test ended the connection: %s", error)
    finally:
        writer.close()
    if trial.proxy_secret.encode() in answer:
        return "ok"
    return "stranger" if answer else "closed"


async def _ask_master(context: Context, trial: _PortTrial, target: HostPort) -> str:
    """Make the master call the port, as if a parameter of a node there had changed.

    Returns a word for `PortProbe`: "ok", "missed", or "unknown" if the master could not be asked.
    """
    try:
        async with _subscribed(context, trial, target), asyncio.timeout(MASTER_TIMEOUT_S):
            await trial.reached.wait()
    except TimeoutError:
        return "missed"
    except Unreachable as error:
        log.debug("the master can't call the port under test, %s: %s", target, error)
        return "unknown"
    return "ok"


@asynccontextmanager
async def _subscribed(context: Context, trial: _PortTrial, target: HostPort) -> AsyncIterator[None]:
    """Subscribe the port under test to a parameter while the block runs."""
    # No other node has this subscriber name: rosmaster calls shutdown at the former URI of a name
    # that registers with another URI (registrations.py, _register_node_api).
    name = f"{CALLER_ID}_probe_{trial.master_secret}"
    uri = slave_uri(target)
    multicall = context.upstream.multicall
    try:
        replies = await multicall(
            [("subscribeParam", [name, uri, name]), ("setParam", [CALLER_ID, name, True])]
        )
        if None in replies:
            raise Unreachable("the master refused a call")
        yield
    finally:
        try:
            await multicall(
                [("unsubscribeParam", [name, uri, name]), ("deleteParam", [CALLER_ID, name])]
            )
        except Unreachable as error:  # the result of the block counts
            log.debug("the probe leaves its parameter at the master: %s", error)
