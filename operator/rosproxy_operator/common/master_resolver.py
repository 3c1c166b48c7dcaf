"""Where the masters are: their hosts' addresses, as this host resolves them."""

import asyncio
import time
from collections.abc import Callable, Iterable, Mapping

from rosproxy.net.addresses import is_address, is_loopback, plain_address
from rosproxy.net.resolver import resolve

AGAIN = 15.0
"""Seconds after which a name is resolved anew."""
AGAIN_UNRESOLVED = 3.0
"""The same for a name that could not be resolved."""


class MasterResolver:
    """The addresses of masters' hosts. The last good one is kept while a name server fails.

    ``changed`` is called when an address has changed. The host of every method is a name or an
    address, in lower case.
    """

    def __init__(self, changed: Callable[[], None]) -> None:
        self._changed = changed
        self._resolved: dict[str, str] = {}
        self._asked_at: dict[str, float] = {}
        self._fallback: Mapping[str, str] = {}
        self._excluded: frozenset[str] = frozenset()

    def address(self, host: str) -> str:
        """The address of a host; empty if it could not be resolved yet."""
        if is_address(host):
            return plain_address(host)
        return self._resolved.get(host) or self._fallback.get(host, "")

    async def learn(
        self, hosts: Iterable[str], fallback: Mapping[str, str], excluded: Iterable[str]
    ) -> None:
        """Resolve those hosts that are new and forget those that are not named any more.

        ``fallback`` are addresses for hosts that can't be resolved. ``excluded`` are no master's:
        they are the proxies' own, which answer to their masters' names.
        """
        self._fallback = fallback
        self._excluded = frozenset(excluded)
        wanted = {host for host in hosts if not is_address(host)}
        self._asked_at = {host: self._asked_at.get(host, 0.0) for host in wanted}
        self._resolved = {host: self._resolved[host] for host in wanted if host in self._resolved}
        await self._ask([host for host, when in self._asked_at.items() if not when])

    async def refresh(self) -> None:
        """Resolve anew what is due."""
        now = time.monotonic()
        previous = dict(self._resolved)
        await self._ask(
            [host for host, when in self._asked_at.items() if now >= when + self._age(host)]
        )
        if self._resolved != previous:
            self._changed()

    def _age(self, host: str) -> float:
        return AGAIN if host in self._resolved else AGAIN_UNRESOLVED

    async def _ask(self, hosts: list[str]) -> None:
        answers = await asyncio.gather(*map(resolve, hosts))
        for host, addresses in zip(hosts, answers, strict=True):
            if host not in self._asked_at:  # forgotten meanwhile
                continue
            self._asked_at[host] = time.monotonic()
            usable = [a for a in addresses if not is_loopback(a) and a not in self._excluded]
            # A name with several addresses keeps the one that was chosen: name servers change the
            # order of their answers, and each change would be told to the proxy.
            if usable and self._resolved.get(host) not in usable:
                self._resolved[host] = usable[0]
