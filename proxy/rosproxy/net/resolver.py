"""Resolves host names, with a short time-out for name servers that do not answer.

``getaddrinfo`` can't be stopped and may take 40 s. So look-ups run in daemon threads, one for each
name. A look-up that hangs blocks neither other names nor the end of the process.

The number of threads is bounded, and nodes choose names. A node could use all threads by names
whose name server hangs. So each look-up counts for the ``source`` that gave the name, and each
source has a few look-ups at a time. Some look-ups are reserved for the proxy's own names, such as
the master's host name.
"""

import asyncio
import logging
import socket
import threading
from concurrent.futures import Future

from rosproxy.net.addresses import is_address, plain_address

log = logging.getLogger(__name__)

RESOLVE_TIMEOUT_S = 1.0
"""Seconds after which a name counts as unresolvable."""
MOST_LOOKUPS = 64
"""Look-ups that may be under way at once; above the bound a name counts as unresolvable."""
MOST_FOR_OTHERS = 56
"""Look-ups at once for all sources except the proxy itself."""
MOST_PER_SOURCE = 8
"""Look-ups at once for one source. Nodes usually give the name of their machine."""
NODES = "nodes"
"""The source of the names of nodes in the master's graph, which does not say who gave a name."""
MOST_FOR_NODES = 32
"""Look-ups at once for NODES. These names come all at once, a name for each machine."""

_running: dict[str, tuple[str, Future[list[str]]]] = {}
"""The look-ups under way by host name, with the source. The end of a thread removes the entry."""


async def resolve(host: str, source: str = "") -> list[str]:
    """The addresses of a host name, IPv4 first; empty if unresolvable in RESOLVE_TIMEOUT_S.

    ``source``: the address of the node that gave the name, or NODES; empty for the proxy's names.
    """
    if is_address(host):
        return [plain_address(host)]
    _, lookup = _running.get(host) or ("", _start(host, source))
    try:
        async with asyncio.timeout(RESOLVE_TIMEOUT_S):
            # Shielded: other callers may wait for the same look-up.
            return await asyncio.shield(asyncio.wrap_future(lookup))
    except TimeoutError:
        return []


def _start(host: str, source: str) -> Future[list[str]]:
    lookup: Future[list[str]] = Future()
    if not _may_start(source):
        label = source or "the proxy"
        log.warning(
            "%s: too many name look-ups at once; host name %s counts as unresolvable", label, host
        )
        lookup.set_result([])
        return lookup
    _running[host] = source, lookup
    try:
        threading.Thread(target=_look_up, args=(host, lookup), daemon=True).start()
    except RuntimeError as error:  # the process or the machine has no thread left
        log.warning("%s: host name %s can't be looked up: %s", source or "the proxy", host, error)
        _end(host, lookup, [])
    return lookup


def _may_start(source: str) -> bool:
    """Whether a source may start another look-up."""
    sources = [source for source, _ in list(_running.values())]  # threads end at any time
    if not source:
        return len(sources) < MOST_LOOKUPS
    limit = MOST_FOR_NODES if source == NODES else MOST_PER_SOURCE
    return sum(map(bool, sources)) < MOST_FOR_OTHERS and sources.count(source) < limit


def _look_up(host: str, lookup: "Future[list[str]]") -> None:
    addresses: list[str] = []
    try:
        infos = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
        addresses = list(dict.fromkeys(plain_address(str(info[4][0])) for info in infos))
    except (OSError, ValueError):  # not found, or not a host name (UnicodeError is a ValueError)
        pass
    finally:
        _end(host, lookup, addresses)


def _end(host: str, lookup: "Future[list[str]]", addresses: list[str]) -> None:
    del _running[host]
    lookup.set_result(sorted(addresses, key=lambda address: ":" in address))
