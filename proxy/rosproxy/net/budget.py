"""How much may be held at once, and how much of that by one source.

Pure bookkeeping, in bytes or in numbers of things. Whoever wants to hold something takes it from a
budget first and gives it back in the end; what is over budget is refused at once, since whoever
waits holds something as well. No source gets more than its share, so that none shuts out the rest.
"""

from types import TracebackType


class OverBudget(Exception):
    """A refusal: what is too much, in words."""


class Budget:
    """At most ``most`` at once, of which a source has at most ``share``; ``unit`` names them."""

    def __init__(self, most: int, share: int, unit: str) -> None:
        self.most = most
        self._share = share
        self._unit = unit
        self._used_by_source: dict[str, int] = {}
        self.used = 0

    def take(self, source: str, size: int) -> None:
        """Take so much for a source. Raises OverBudget, and takes nothing."""
        if self.used + size > self.most:
            raise OverBudget(f"at most {self.most} {self._unit} are accepted at once; try again")
        total = self._used_by_source.get(source, 0) + size
        if total > self._share:
            text = f"at most {self._share} {self._unit} are accepted at once from {source}"
            raise OverBudget(text)
        self.used += size
        self._used_by_source[source] = total

    def give(self, source: str, size: int) -> None:
        """Give back what was taken."""
        self.used -= size
        remaining = self._used_by_source.get(source, 0) - size
        if remaining:
            self._used_by_source[source] = remaining
        else:
            self._used_by_source.pop(source, None)


class Charge:
    """What one piece of work holds of a budget; all of it is given back when the context ends."""

    __slots__ = ("_budget", "_source", "taken")

    def __init__(self, budget: Budget, source: str) -> None:
        self._budget = budget
        self._source = source
        self.taken = 0

    def add(self, size: int) -> None:
        """Hold more. Raises OverBudget."""
        self._budget.take(self._source, size)
        self.taken += size

    def __enter__(self) -> "Charge":
        """Begin to hold something."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Give all of it back."""
        self._budget.give(self._source, self.taken)
        self.taken = 0
