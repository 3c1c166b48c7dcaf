"""What the live table shows: rows from the nodes' reports, a phase, and what happened so far."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass, field
from typing import Any

from rosproxy.demo.processes import Worker

RATE_SECONDS = 1.0


@dataclass(frozen=True)
class Row:
    """One node as the table shows it; empty cells are ones that don't apply."""

    side: str
    node: str
    own: str
    seen: str
    sent: str
    received: str
    rate: str
    state: str


HEADINGS = Row(
    "SIDE",
    "NODE",
    "CALLS ITSELF",
    "OTHER SIDE USES",
    "SENT",
    "RECV",
    "RATE",
    "STATE",
)


@dataclass
class Entry:
    """One node on the board; `seen` is its address as the other side gets it."""

    side: str
    node: str
    worker: Worker
    seen: str = ""
    calls: int = 0
    history: deque[tuple[float, int]] = field(default_factory=deque)

    def rate(self, now: float) -> str:
        """Return how often its count went up in the last second."""
        count = _progress(self.worker.state)
        if count is None or not self.worker.running:
            return ""
        self.history.append((now, count))
        while self.history[0][0] < now - RATE_SECONDS:
            self.history.popleft()
        began, first = self.history[0]
        # A node that was started anew counts from the start again.
        return f"{max(0, count - first) / max(now - began, RATE_SECONDS / 2):.0f}/s"

    def row(self, now: float) -> Row:
        """Return the node's row."""
        state = self.worker.state
        subscription = state.get("subscription") or {}
        return Row(
            self.side,
            self.node,
            _address(state.get("uri", "")),
            self.seen,
            _text(_sent(state)),
            _text(subscription.get("count")),
            self.rate(now),
            self._condition(),
        )

    def _condition(self) -> str:
        state = self.worker.state
        if not self.worker.running:
            return "stopped"
        if not state.get("registered"):
            return "waiting for its master"
        if state["publisher"]:
            return self._talking(state["publisher"])
        if state["subscription"]:
            return self._listening(state["subscription"])
        return _plural(state["answered"] or 0, "call")

    def _talking(self, publisher: dict[str, Any]) -> str:
        condition = "connected" if publisher["connected"] else "nobody listens"
        unheard = publisher["unheard"]
        return f"{condition}, {unheard} unheard" if unheard else condition

    def _listening(self, subscription: dict[str, Any]) -> str:
        if subscription["connected"]:
            return "connected"
        # The number of the error says nothing that its text doesn't.
        return subscription["problem"].rpartition("] ")[2] or "no publisher"


@dataclass
class Board:
    """The state of the whole demo for the screen."""

    began: float = field(default_factory=time.monotonic)
    phase: str = "start"
    proxy: str = "not started"
    entries: dict[str, Entry] = field(default_factory=dict)
    events: list[tuple[float, str]] = field(default_factory=list)

    def clock(self) -> float:
        """Return the seconds since the demo began."""
        return time.monotonic() - self.began

    def enter(self, phase: str) -> None:
        """Begin a phase."""
        self.phase = phase

    def tell(self, text: str) -> None:
        """Note that something happened now."""
        self.events.append((self.clock(), text))

    def rows(self) -> list[Row]:
        """Return one row for each node, inside first."""
        now = time.monotonic()
        entries = sorted(self.entries.values(), key=lambda entry: entry.side)
        return [entry.row(now) for entry in entries]


def _sent(state: dict[str, Any]) -> int | None:
    """Return how many messages went to a subscriber; None for a node that doesn't publish."""
    publisher = state.get("publisher")
    return publisher["published"] - publisher["unheard"] if publisher else None


def _progress(state: dict[str, Any]) -> int | None:
    if state.get("publisher"):
        return int(state["publisher"]["published"])
    if state.get("subscription"):
        return int(state["subscription"]["count"])
    return None


def _address(uri: str) -> str:
    """Return the `host:port` of a URI."""
    return uri.partition("//")[2].partition("/")[0]


def _text(value: object) -> str:
    return "" if value is None else str(value)


def _plural(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"
