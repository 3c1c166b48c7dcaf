"""Budgets: how much all sources together may hold at once, and how much each source.

Pure bookkeeping, in bytes or in numbers of objects. A caller takes an amount from a budget before
using memory, and gives the amount back at the end. The budget refuses too large an amount at once:
a caller that waits would hold memory, too. Each source has a share, so that no source can use the
budget of all others.
"""

from types import TracebackType

from rosproxy.shared.connections.source_shares import SourceShares


class OverBudget(Exception):
    """The budget refuses an amount; the message names the bound."""


class Budget:
    """At most ``most`` at once, and at most ``share`` for each source; ``unit`` is for messages."""

    def __init__(self, most: int, share: int, unit: str) -> None:
        self.most = most
        self._share = share
        self._unit = unit
        self._used_by_source = SourceShares()
        self.used = 0

    def take(self, source: str, size: int) -> None:
        """Take an amount for a source. Raises OverBudget, and then takes nothing."""
        if self.used + size > self.most:
            raise OverBudget(f"at most {self.most} {self._unit} are accepted at once; try again")
        if not self._used_by_source.has_room(source, self._share, size):
            text = f"at most {self._share} {self._unit} are accepted at once from {source}"
            raise OverBudget(text)
        self.used += size
        self._used_by_source.add(source, size)

    def give(self, source: str, size: int) -> None:
        """Give back an amount that was taken for a source."""
        self.used -= size
        self._used_by_source.add(source, -size)


class Charge:
    """The amount that a piece of work holds. The end of the context gives all back."""

    __slots__ = ("_budget", "_source", "taken")

    def __init__(self, budget: Budget, source: str) -> None:
        self._budget = budget
        self._source = source
        self.taken = 0

    def add(self, size: int) -> None:
        """Take more of the budget. Raises OverBudget."""
        self._budget.take(self._source, size)
        self.taken += size

    def __enter__(self) -> "Charge":
        """Enter the context, without taking anything yet."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Give the whole amount back."""
        self._budget.give(self._source, self.taken)
        self.taken = 0
