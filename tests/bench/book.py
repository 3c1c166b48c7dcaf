"""The numbers of a run, kept by row, path and size, and the arithmetic on them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any, TypeVar

_Way = TypeVar("_Way")

DIRECT = "direct"
"""The path that the others are compared with: without anything in between."""


def ratio(values: list[float], base: list[float]) -> float | None:
    """The median of the rounds' own ratios: a busy moment of the machine hits both of a pair.

    Where a round is missing on one side, nothing can be paired: then the ratio of the medians.
    None without a base, or with one that is nothing.
    """
    if not values or not base or not all(base):
        return None
    if len(values) == len(base):
        return median(a / b for a, b in zip(values, base, strict=True))
    return median(values) / median(base)


def percentile(values: list[float], percent: float) -> float:
    """The smallest value that is not below `percent` of a hundred of them (nearest rank)."""
    ordered = sorted(values)
    rank = -(-len(ordered) * percent // 100)
    return ordered[max(0, int(rank) - 1)]


def smallest_share(amounts: list[float]) -> float:
    """How much of the mean the one that got least has got: 1 is fair, 0 is starved."""
    mean = sum(amounts) / len(amounts)
    return min(amounts) / mean if mean else 0.0


def loss(sent: float, arrived: float) -> float:
    """The part of what was sent that has not arrived: 0 is none, 1 is all."""
    return max(0.0, 1 - arrived / sent) if sent else 0.0


@dataclass(frozen=True)
class Line:
    """The values of all rounds of one row, path and size, and what they come to."""

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
    """What has been measured.

    ``section`` is what `add` belongs to now, ``axes`` what the sizes of each section count.
    ``machine`` describes where it was measured; ``notes`` are for readers of the tables.
    """

    machine: dict[str, str] = field(default_factory=dict)
    section: str = ""
    axes: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    _values: dict[tuple[str, str, str, int], list[float]] = field(default_factory=dict)

    def begin(self, section: str, axis: str = "connections") -> None:
        """What is added from now on belongs to this section; ``axis`` says what sizes count."""
        self.section = section
        self.axes[section] = axis

    def add(self, row: str, path: str, value: float, size: int = 1) -> None:
        """One number of one round: ``row`` ends with its unit, as in ``rate, MB/s``."""
        self._values.setdefault((self.section, row, path, size), []).append(float(value))

    def note(self, text: str) -> None:
        """A sentence that the tables need, once however often it is said."""
        if (line := f"{self.section}: {text}") not in self.notes:
            self.notes.append(line)

    def lines(self) -> list[Line]:
        """All of them, in the order in which they were first added."""
        return [Line(*key, values, self._to_direct(key)) for key, values in self._values.items()]

    def _to_direct(self, key: tuple[str, str, str, int]) -> float | None:
        section, row, path, size = key
        base = self._values.get((section, row, DIRECT, size), [])
        return None if path == DIRECT else ratio(self._values[key], base)

    def save(self, path: Path) -> None:
        """Write all of it as JSON."""
        rows = [line.as_json() for line in self.lines()]
        document = {"machine": self.machine, "axes": self.axes, "notes": self.notes, "rows": rows}
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(document, indent=1) + "\n")

    @classmethod
    def load(cls, path: Path) -> Book:
        """What `save` wrote."""
        document = json.loads(path.read_text())
        book = cls(document["machine"], "", document["axes"], document["notes"])
        for row in document["rows"]:
            key = row["section"], row["row"], row["path"], row["size"]
            book._values[key] = row["values"]
        return book


def in_turn(ways: Sequence[_Way], number: int) -> list[_Way]:
    """The ways in the order of a round: each begins once, as whoever follows a busy one suffers."""
    first = number % len(ways)
    return [*ways[first:], *ways[:first]]
