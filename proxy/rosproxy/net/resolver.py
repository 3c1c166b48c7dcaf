"""Host names to addresses, without ever waiting long for a name server that does not answer.

``getaddrinfo`` can't be stopped and may take 40 s. It runs in daemon threads, one per name at most,
so that look-ups that hang block neither other names nor the end of the process.

Threads are bounded, and nodes choose names: who gives names whose name server hangs, one after the
other, would use up all threads. So a look-up is counted for whoever gave the name, its ``source``,
who has a few at a time; and some are left for names of the proxy's own, as the master's.
"""

import asyncio
import logging
import socket
import threading
from concurrent.futures import Future

from rosproxy.net.addresses import is_address, plain_address

log = logging.getLogger(__name__)

RESOLVE_TIMEOUT = 1.0
"""Seconds after which a name counts as unresolvable."""
MOST_LOOKUPS = 64
"""Look-ups that may be under way at once; beyond that names count as unresolvable."""
MOST_FOR_OTHERS = 56
MOST_FOR_ONE = 8
"""Of these, how many for names that others gave, and that one other gave: the nodes of one machine
give its name."""
NODES = "nodes"
MOST_FOR_NODES = 32
"""The source of names that the master has of nodes, since it does not say who gave them; and how
many: they are as many as there are machines, and come all at once."""

_running: dict[str, tuple[str, Future[list[str]]]] = {}
"""The look-ups under way, each with its source; an entry ends when its thread does."""


async def resolve(host: str, source: str = "") -> list[str]:
    """The addresses of a host name, IPv4 first; empty if it can't be resolved in time.

    ``source`` is who gave the name: an address, or NODES; empty for the proxy's own names.
    """
    if is_address(host):
        return [plain_address(host)]
    _, lookup = _running.get(host) or ("", _start(host, source))
    try:
        async with asyncio.timeout(RESOLVE_TIMEOUT):
            # Shielded, since others may wait for the same look-up.
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
    """Whether there is a thread for one more look-up of a source's."""
    sources = [source for source, _ in list(_running.values())]  # threads end at any time
    if not source:
        return len(sources) < MOST_LOOKUPS
    limit = MOST_FOR_NODES if source == NODES else MOST_FOR_ONE
    return sum(map(bool, sources)) < MOST_FOR_OTHERS and sources.count(source) < limit


def _look_up(host: str, lookup: "Future[list[str]]") -> None:
    addresses: list[str] = []
    try:
        infos = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
        addresses = list(dict.fromkeys(plain_address(str(info[4][0])) for info in infos))
    except (OSError, ValueError):  # not to be found; nothing that could be (UnicodeError is one)
        pass
    finally:
        _end(host, lookup, addresses)


def _end(host: str, lookup: "Future[list[str]]", addresses: list[str]) -> None:
    del _running[host]
    lookup.set_result(sorted(addresses, key=lambda address: ":" in address))
