"""Refusals above a bound: counted, logged, and shown in the status.

A metric counts each refusal by reason (docs/reference/limits.md has the reasons). The log gets at
most one line for a reason and source in QUIET seconds. In the same time the log gets at most
MOST_LINES lines for a reason. `rosproxy status` shows the last refusal of each reason until
there was no refusal for OVER_AFTER seconds.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache

from rosproxy.shared.output.problems import Problems, refusal_subject
from rosproxy.telemetry.metrics import Metrics

log = logging.getLogger(__name__)

QUIET = 60.0
"""Seconds after a line in the log without another line for the same source and reason."""
OVER_AFTER = 300.0
"""Seconds without a refusal after which the status no longer shows the last refusal."""
START_REASONS = frozenset(
    {"not_a_peer", "hidden_source", "unproven", "unknown_participant", "no_locator"}
)
"""Reasons that occur at each start of a ROS 2 node, for a second or two: datagrams of a participant
overtake the announcement of this participant."""
RATE = "rate"
"""The reason if a source sends more discovery of ROS 2 than the proxy reads. Fast DDS sends a
thousand heartbeats a second while participants discover each other. A busy proxy drops some, and
participants send these again."""
PATIENCE = 10.0
"""Seconds of a span after which the log and the status report a refusal, for `RATE` and for the
reasons in `START_REASONS`. Refusals for other reasons are reported at once."""
PAUSE = 15.0
"""Seconds without a refusal after which a new span begins. Cyclone DDS announces every 8 s."""
MOST_LINES = 20
"""Lines in the log for a reason in QUIET seconds: sources of datagrams may be forged."""
MOST_REMEMBERED_LINES = 1000
"""Pairs of reason and source whose last line is remembered."""
MOST_SOURCES = 256
"""Sources of a span that are remembered. Only a pause ends a span with this many sources."""


@dataclass(slots=True)
class _Span:
    """A series of refusals for one reason. ``first`` and ``last`` are times in seconds.

    ``sources``: the refused sources. A source leaves when the proxy has met its participant.
    """

    first: float
    last: float
    sources: set[str] = field(default_factory=set)

    def extend(self, source: str, now: float) -> None:
        """Add a refusal. A new span begins after a pause, or when all sources have settled."""
        if now - self.last > PAUSE:
            self.sources.clear()
        if not self.sources:
            self.first = now
        self.last = now
        if len(self.sources) < MOST_SOURCES:
            self.sources.add(source)

    def settle(self, source: str) -> bool:
        """Note that the proxy has met the participant of a source.

        Return whether this was the last source of the span.
        """
        if len(self.sources) >= MOST_SOURCES or source not in self.sources:
            return False
        self.sources.discard(source)
        return not self.sources

    @property
    def length(self) -> float:
        """Seconds from the first refusal to the last."""
        return self.last - self.first


class Refusals:
    """Reports refusals. ``now`` returns seconds of a monotonic clock."""

    def __init__(self, metrics: Metrics, problems: Problems, now: Callable[[], float]) -> None:
        self._of_reason = cache(metrics.refused.labels)
        self._problems = problems
        self._now = now
        self._logged_at: dict[tuple[str, str], float] = {}
        self._lines: dict[str, tuple[float, int]] = {}
        self._spans: dict[str, _Span] = {}

    def note(self, reason: str, source: str, text: str) -> None:
        """Report a refusal; ``text`` says what was refused, and why."""
        self._of_reason(reason).inc()
        now = self._now()
        key = reason, source
        span = self._spans.setdefault(reason, _Span(now, now))
        span.extend(source, now)
        if (reason in START_REASONS or reason == RATE) and span.length < PATIENCE:
            return
        if now - self._logged_at.get(key, -QUIET) < QUIET:
            return
        since, lines = self._lines.get(reason, (now, 0))
        if now - since >= QUIET:
            since = now
            lines = 0
        if lines >= MOST_LINES:
            return
        self._lines[reason] = since, lines + 1
        self._logged_at.pop(key, None)
        if len(self._logged_at) >= MOST_REMEMBERED_LINES:
            del self._logged_at[next(iter(self._logged_at))]
        self._logged_at[key] = now
        subject = refusal_subject(reason)
        log.warning("%s, from %s: %s", subject, source, text)
        self._problems.solved(subject)
        self._problems.add(subject, f"from {source}: {text}")

    def settle(self, source: str) -> None:
        """Note that the proxy has met the participant of a source, so that its start is over.

        Refusals of starts may last longer than `PATIENCE`: a node may crash and start repeatedly,
        and after a start of the proxy a running robot announces itself late. So the status drops
        such a refusal once the proxy has met the participants of all sources.
        """
        for reason in START_REASONS & self._spans.keys():
            if self._spans[reason].settle(source):
                self._problems.solved(refusal_subject(reason))

    def end_old(self) -> None:
        """Remove the problems of reasons without a refusal for OVER_AFTER seconds."""
        now = self._now()
        for reason in [r for r, span in self._spans.items() if now - span.last >= OVER_AFTER]:
            del self._spans[reason]
            self._problems.solved(refusal_subject(reason))
