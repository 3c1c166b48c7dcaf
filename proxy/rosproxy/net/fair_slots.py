"""Slots for work that is under way, with a bound in all and a bound for each source address."""

from collections.abc import Iterator
from contextlib import contextmanager

from rosproxy.shared.connections.source_shares import SourceShares


class NoSlot(Exception):
    """All slots are taken; the message says how many slots there are, and what to do."""


class FairSlots:
    """Counts slots: at most ``most`` in all, and ``each`` for each source.

    For messages, ``work`` names the work in the plural, and ``advice`` says what to do instead.
    """

    def __init__(self, work: str, most: int, each: int, advice: str = "try again later") -> None:
        self.most = most
        self.each = each
        self._work = work
        self._advice = advice
        self._by_source = SourceShares()
        self.taken = 0
        """How many slots are taken."""

    @contextmanager
    def slot(self, source: str) -> Iterator[None]:
        """Take a slot for as long as the context lasts. Raises NoSlot."""
        if not self._by_source.has_room(source, self.each):
            raise NoSlot(f"{source}: {self.each} {self._work} already; {self._advice}")
        if self.taken >= self.most:
            raise NoSlot(f"{self.most} {self._work} already; {self._advice}")
        self._by_source.add(source)
        self.taken += 1
        try:
            yield
        finally:
            self._by_source.add(source, -1)
            self.taken -= 1
