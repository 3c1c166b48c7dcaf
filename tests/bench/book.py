"""The numbers of a run by row, path and size, and the arithmetic."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any, TypeVar

_Way = TypeVar("_Way")

DIRECT = "direct"
"""The path for comparison: without anything in between."""


def ratio(values: list[float], base: list[float]) -> float | None:
    """The median of the ratios of all rounds: a busy moment hits both values of a pair.

    If a side misses a round, the ratio of the medians. None without a base, or with a zero in the
    base.
    """
    if not values or not base or not all(base):
        return None
    if len(values) == len(base):
        return median(a / b for a, b in zip(values, base, strict=True))
    return median(values) / median(base)


def percentile(values: list[float], percent: float) -> float:
    """The smallest value that is not below `percent` percent of the values (nearest rank)."""
    ordered = sorted(values)
    rank = -(-len(ordered) * percent // 100)
    return ordered[max(0, int(rank) - 1)]


def smallest_share(amounts: list[float]) -> float:
    """The smallest amount as a share of the mean: 1 is fair, 0 is starved."""
    mean = sum(amounts) / len(amounts)
    return min(amounts) / mean if mean else 0.0


def loss(sent: float, arrived: float) -> float:
    """The part of what was sent that has not arrived: 0 is none, 1 is all."""
    return max(0.0, 1 - arrived / sent) if sent else 0.0


@dataclass(frozen=True)
class Line:
    """The values of all rounds for a row, path and size, and derived numbers."""

    section: str
    row: str
    path: str
    size: int
    values: list[float]
    to_direct: float | None

    @property
    def middle(self) -> float:
        return median(self.values)

    def as_json(self) -> dict[str, Any]:
        spread = {"median": self.middle, "lowest": min(self.values), "highest": max(self.values)}
        return {**vars(self), **spread}


@dataclass
class Book:
    """All results.

    `add` adds to ``section``. ``axes`` has the meaning of the sizes in each section. ``machine``
    describes the machine. ``notes`` are for readers of the tables.
    """

    machine: dict[str, str] = field(default_factory=dict)
    section: str = ""
    axes: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    _values: dict[tuple[str, str, str, int], list[float]] = field(default_factory=dict)

    def begin(self, section: str, axis: str = "connections") -> None:
        """Start a section for all later numbers. ``axis`` is the meaning of the sizes."""
        self.section = section
        self.axes[section] = axis

    def add(self, row: str, path: str, value: float, size: int = 1) -> None:
        """Add a number of a round. ``row`` ends with the unit, as in ``rate, MB/s``."""
        self._values.setdefault((self.section, row, path, size), []).append(float(value))

    def note(self, text: str) -> None:
        """Add a sentence for the tables, without repetition."""
        if (line := f"{self.section}: {text}") not in self.notes:
            self.notes.append(line)

    def lines(self) -> list[Line]:
        """All lines, in the order of their first numbers."""
        return [Line(*key, values, self._to_direct(key)) for key, values in self._values.items()]

    def _to_direct(self, key: tuple[str, str, str, int]) -> float | None:
        section, row, path, size = key
        base = self._values.get((section, row, DIRECT, size), [])
        return None if path == DIRECT else ratio(self._values[key], base)

    def save(self, path: Path) -> None:
        """Write the whole book as JSON."""
        rows = [line.as_json() for line in self.lines()]
        document = {"machine": self.machine, "axes": self.axes, "notes": self.notes, "rows": rows}
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(document, indent=1) + "\n")

    @classmethod
    def load(cls, path: Path) -> Book:
        """The book that `save` wrote."""
        document = json.loads(path.read_text())
        book = cls(document["machine"], "", document["axes"], document["notes"])
        for row in document["rows"]:
            key = row["section"], row["row"], row["path"], row["size"]
            book._values[key] = row["values"]
        return book


def in_turn(ways: Sequence[_Way], number: int) -> list[_Way]:
    """The ways in the order of a round. Each way is first once, because a way after a busy way
    suffers.
    """
    first = number % len(ways)
    return [*ways[first:], *ways[:first]]
