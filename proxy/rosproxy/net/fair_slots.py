"""Slots for work that is under way, with a bound in all and a bound for each source address."""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager


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
        self._taken: Counter[str] = Counter()

    @property
    def taken(self) -> int:
        """How many slots are taken."""
        return self._taken.total()

    @contextmanager
    def slot(self, source: str) -> Iterator[None]:
        """Take a slot for as long as the context lasts. Raises NoSlot."""
        if self._taken[source] >= self.each:
            raise NoSlot(f"{source}: {self.each} {self._work} already; {self._advice}")
        if self.taken >= self.most:
            raise NoSlot(f"{self.most} {self._work} already; {self._advice}")
        self._taken[source] += 1
        try:
            yield
        finally:
            self._taken[source] -= 1
            if not self._taken[source]:
                del self._taken[source]
