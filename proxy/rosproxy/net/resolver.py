"""Host names to addresses, without ever waiting long for a name server that does not answer.

``getaddrinfo`` can't be stopped and may take 40 s. It runs in daemon threads, one per name at most,
so that look-ups that hang block neither other names nor the end of the process.
"""

import asyncio
import socket
import threading
from concurrent.futures import Future

from rosproxy.net.addresses import is_address, plain_address

RESOLVE_TIMEOUT = 1.0
"""Seconds after which a name counts as unresolvable."""
MOST_LOOKUPS = 64
"""Look-ups that may be under way at once; beyond that names count as unresolvable."""

_running: dict[str, Future[list[str]]] = {}


async def resolve(host: str) -> list[str]:
    """The addresses of a host name, IPv4 first; empty if it can't be resolved in time."""
    if is_address(host):
        return [plain_address(host)]
    lookup = _running.get(host) or _start(host)
    try:
        async with asyncio.timeout(RESOLVE_TIMEOUT):
            return await asyncio.shield(asyncio.wrap_future(lookup))
    except TimeoutError:
        return []


def _start(host: str) -> Future[list[str]]:
    lookup: Future[list[str]] = Future()
    if len(_running) >= MOST_LOOKUPS:
        lookup.set_result([])
        return lookup
    _running[host] = lookup
    threading.Thread(target=_look_up, args=(host, lookup), daemon=True).start()
    return lookup


def _look_up(host: str, lookup: "Future[list[str]]") -> None:
    try:
        found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
        addresses = dict.fromkeys(plain_address(str(info[4][0])) for info in found)
    except (OSError, UnicodeError):
        addresses = {}
    del _running[host]
    lookup.set_result(sorted(addresses, key=lambda address: ":" in address))
