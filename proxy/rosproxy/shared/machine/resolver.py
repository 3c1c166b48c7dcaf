"""Resolves host names, with a short time-out for name servers that do not answer.

``getaddrinfo`` can't be stopped and may take 40 s. So look-ups run in daemon threads, one for each
name. A look-up that hangs blocks neither other names nor the end of the process.

The number of threads is bounded, and nodes choose names. A node could use all threads by names
whose name server hangs. So each look-up counts for the ``source`` that gave the name, and each
source has a few look-ups at a time. Some look-ups are reserved for the proxy's own names, such as
the master's host name.

The names in the master's graph have no source (`NODES`). Of these, names that have resolved before
have look-ups of their own, until a look-up hangs. In each of the two parts, a domain gets no more
look-ups than it leaves to other domains: a name server answers for all names of its domain.
"""

import asyncio
import logging
import socket
import threading
from collections import OrderedDict
from concurrent.futures import Future
from typing import NamedTuple

from rosproxy.shared.addresses import is_address, plain_address
from rosproxy.shared.connections.source_shares import SourceShares

log = logging.getLogger(__name__)

RESOLVE_TIMEOUT_S = 1.0
"""Seconds after which a name counts as unresolvable."""
MOST_PER_SOURCE = 8
"""Look-ups at once for one source. Nodes usually give the name of their machine."""
MOST_FOR_SOURCES = 32
"""Look-ups at once for all sources except NODES and the proxy itself."""
NODES = "nodes"
"""The source of the names of nodes in the master's graph, which does not say who gave a name."""
MOST_FOR_NODES = 64
"""Look-ups at once for NODES, of names that have resolved before, and as many of other names. These
names come all at once, a name for each machine: a single domain gets half of the look-ups."""
MOST_FOR_OTHERS = 2 * MOST_FOR_NODES + MOST_FOR_SOURCES
"""Look-ups at once for all sources except the proxy itself."""
MOST_LOOKUPS = MOST_FOR_OTHERS + 8
"""Look-ups that may be under way at once; above the bound a name counts as unresolvable."""
MOST_RESOLVED = 4096
"""The highest number of names that the proxy remembers as resolved. Each has 255 characters at
most: a longer name does not resolve (RFC 1035, 2.3.4)."""


class _Lookup(NamedTuple):
    """A look-up under way. ``resolved``: the name has resolved before."""

    source: str
    domain: str
    resolved: bool
    addresses: Future[list[str]]


_running: dict[str, _Lookup] = {}
"""The look-ups under way by host name. The end of a thread removes the entry."""
_resolved: OrderedDict[str, None] = OrderedDict()
"""The names whose last look-up has found addresses, oldest first."""


async def resolve(host: str, source: str = "") -> list[str]:
    """The addresses of a host name, IPv4 first; empty if unresolvable in RESOLVE_TIMEOUT_S.

    ``source``: the address of the node that gave the name, or NODES; empty for the proxy's names.
    """
    if is_address(host):
        return [plain_address(host)]
    lookup = _running.get(host)
    pending = lookup.addresses if lookup else _start(host, source)
    try:
        async with asyncio.timeout(RESOLVE_TIMEOUT_S):
            # Shielded: other callers may wait for the same look-up.
            addresses = await asyncio.shield(asyncio.wrap_future(pending))
    except TimeoutError:
        _resolved.pop(host, None)
        return []
    if addresses:
        _note_resolved(host)
    return addresses


def _note_resolved(host: str) -> None:
    _resolved[host] = None
    _resolved.move_to_end(host)
    if len(_resolved) > MOST_RESOLVED:
        _resolved.popitem(last=False)


def _start(host: str, source: str) -> Future[list[str]]:
    addresses: Future[list[str]] = Future()
    lookup = _Lookup(source, _domain(host), host in _resolved, addresses)
    if not _may_start(lookup):
        label = source or "the proxy"
        log.warning(
            "%s: too many name look-ups at once; host name %s counts as unresolvable", label, host
        )
        addresses.set_result([])
        return addresses
    _running[host] = lookup
    try:
        threading.Thread(target=_look_up, args=(host, addresses), daemon=True).start()
    except RuntimeError as error:  # the process or the machine has no thread left
        log.warning("%s: host name %s can't be looked up: %s", source or "the proxy", host, error)
        _end(host, addresses, [])
    return addresses


def _may_start(lookup: _Lookup) -> bool:
    """Whether the bounds allow another look-up."""
    running = list(_running.values())  # threads end at any time
    if not lookup.source:
        return len(running) < MOST_LOOKUPS
    if lookup.source == NODES:
        part = [r for r in running if r.source == NODES and r.resolved is lookup.resolved]
        return MOST_FOR_NODES - len(part) > sum(r.domain == lookup.domain for r in part)
    shares = SourceShares()
    of_sources = [r.source for r in running if r.source not in ("", NODES)]
    for source in of_sources:
        shares.add(source)
    has_room = shares.has_room(lookup.source, MOST_PER_SOURCE)
    return has_room and len(of_sources) < MOST_FOR_SOURCES


def _domain(host: str) -> str:
    """The last two labels of a host name, without the first label of the name."""
    return ".".join(host.lower().rstrip(".").split(".")[1:][-2:])


def _look_up(host: str, pending: "Future[list[str]]") -> None:
    addresses: list[str] = []
    try:
        infos = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
        addresses = list(dict.fromkeys(plain_address(str(info[4][0])) for info in infos))
    except (OSError, ValueError):  # not found, or not a host name (UnicodeError is a ValueError)
        pass
    finally:
        _end(host, pending, addresses)


def _end(host: str, pending: "Future[list[str]]", addresses: list[str]) -> None:
    del _running[host]
    pending.set_result(sorted(addresses, key=lambda address: ":" in address))
