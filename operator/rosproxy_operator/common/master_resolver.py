"""Resolves the host names of the masters to addresses, on the operator's host."""

import asyncio
import time
from collections.abc import Callable, Iterable, Mapping

from rosproxy.shared.addresses import is_address, is_loopback, plain_address
from rosproxy.shared.machine.resolver import resolve

RESOLVE_INTERVAL_S = 15.0
"""Seconds after which the resolver resolves a name again."""
UNRESOLVED_RETRY_S = 3.0
"""Seconds after which the resolver retries a name without an address."""


class MasterResolver:
    """The addresses of the masters' hosts. If a name no longer resolves, its last address stays.

    `refresh` calls ``changed`` after a change of an address. In all methods, a host is a name or
    an address, in lower case.
    """

    def __init__(self, changed: Callable[[], None]) -> None:
        self._changed = changed
        self._resolved: dict[str, str] = {}
        self._asked_at: dict[str, float] = {}
        self._fallback: Mapping[str, str] = {}
        self._excluded: frozenset[str] = frozenset()

    def address(self, host: str) -> str:
        """Return the address of a host: resolved, else the fallback of `learn`, else empty."""
        if is_address(host):
            return plain_address(host)
        return self._resolved.get(host) or self._fallback.get(host, "")

    async def learn(
        self, hosts: Iterable[str], fallback: Mapping[str, str], excluded: Iterable[str]
    ) -> None:
        """Resolve the new hosts among ``hosts``, and forget hosts that are no longer there.

        ``fallback`` has addresses for hosts that do not resolve. ``excluded`` are the addresses of
        the proxies: a proxy answers to the name of its master, so this name may resolve to it.
        """
        self._fallback = fallback
        self._excluded = frozenset(excluded)
        wanted = {host for host in hosts if not is_address(host)}
        self._asked_at = {host: self._asked_at.get(host, 0.0) for host in wanted}
        self._resolved = {host: self._resolved[host] for host in wanted if host in self._resolved}
        await self._ask([host for host, at in self._asked_at.items() if not at])

    async def refresh(self) -> None:
        """Resolve the names that are due, and call ``changed`` if an address changes."""
        now = time.monotonic()
        previous = dict(self._resolved)
        await self._ask(
            [host for host, at in self._asked_at.items() if now >= at + self._interval(host)]
        )
        if self._resolved != previous:
            self._changed()

    def _interval(self, host: str) -> float:
        return RESOLVE_INTERVAL_S if host in self._resolved else UNRESOLVED_RETRY_S

    async def _ask(self, hosts: list[str]) -> None:
        answers = await asyncio.gather(*map(resolve, hosts))
        for host, addresses in zip(hosts, answers, strict=True):
            if host not in self._asked_at:  # forgotten meanwhile
                continue
            self._asked_at[host] = time.monotonic()
            usable = [a for a in addresses if not is_loopback(a) and a not in self._excluded]
            # A name with several addresses keeps the chosen address. Name servers change the order
            # of addresses, and the operator would send each change to the proxy.
            if usable and self._resolved.get(host) not in usable:
                self._resolved[host] = usable[0]
