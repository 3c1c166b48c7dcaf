"""What the proxy has refused because it was over a bound: counted, logged, and shown in the status.

A metric counts every refusal by its reason, a word of those in docs/reference/limits.md. The log
gets one line for each reason and source, then none for a while, and so many for each reason;
`rosproxy status` shows the last one of each reason, until the proxy has refused nothing more for
that reason for some minutes.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache

from rosproxy.telemetry.metrics import Metrics
from rosproxy.telemetry.problems import Problems

log = logging.getLogger(__name__)

DENIED = "policy"
WOULD_BE_DENIED = "policy_audit"
"""The reasons of what a policy denies, or only tells of."""
QUIET = 60.0
"""Seconds in which a source is not logged again for the same reason."""
OVER_AFTER = 300.0
"""Seconds without a refusal after which the status shows the last one no longer."""
OF_STARTS = frozenset(
    {"not_a_peer", "hidden_source", "unproven", "unknown_participant", "no_locator"}
)
"""Reasons that nodes of ROS 2 give at each start, for a second or two: a datagram of a participant
overtakes the announcement of that participant."""
RATE = "rate"
"""The reason that a source sends more discovery of ROS 2 than the proxy reads. Fast DDS sends a
thousand heartbeats a second while participants meet, and a proxy without a free processor reads
them a little later; participants repeat what is lost."""
PATIENCE = 10.0
"""Seconds that refusals for a reason of `OF_STARTS`, or for `RATE`, go on before the log and the
status tell it."""
PAUSE = 15.0
"""Seconds without a refusal after which these begin anew. Cyclone DDS announces itself each 8 s."""
LINES = 20
"""Sources that are logged in that time for one reason: sources of datagrams may be forged."""
MOST = 1000
"""Sources and reasons that are remembered for that."""
MOST_SOURCES = 256
"""Sources of a span that are remembered. A span with more sources ends by a pause alone."""


@dataclass(slots=True)
class _Span:
    """A time in which something was refused for one reason again and again, in seconds.

    ``sources`` are those of the refusals that have not settled.
    """

    first: float
    last: float
    sources: set[str] = field(default_factory=set)

    def extend(self, source: str, now: float) -> None:
        """Take in a refusal; after a pause, or when all sources have settled, a span begins."""
        if now - self.last > PAUSE:
            self.sources.clear()
        if not self.sources:
            self.first = now
        self.last = now
        if len(self.sources) < MOST_SOURCES:
            self.sources.add(source)

    def settle(self, source: str) -> bool:
        """Note that the participant of a source has been met; whether it was the last such one."""
        if len(self.sources) >= MOST_SOURCES or source not in self.sources:
            return False
        self.sources.discard(source)
        return not self.sources

    @property
    def length(self) -> float:
        """Seconds from the first refusal to the last."""
        return self.last - self.first


def problem_subject(reason: str) -> str:
    """The subject of the problem that tells the last refusal for a reason."""
    return f"refused: {reason.replace('_', ' ')}"


class Refusals:
    """Tells of refusals; ``now`` is the monotonic clock."""

    def __init__(self, metrics: Metrics, problems: Problems, now: Callable[[], float]) -> None:
        self._of_reason = cache(metrics.refused.labels)
        self._problems = problems
        self._now = now
        self._logged_at: dict[tuple[str, str], float] = {}
        self._lines: dict[str, tuple[float, int]] = {}
        self._spans: dict[str, _Span] = {}

    def note(self, reason: str, source: str, text: str) -> None:
        """Tell that something from a source was refused, and why."""
        self._of_reason(reason).inc()
        now = self._now()
        key = reason, source
        span = self._spans.setdefault(reason, _Span(now, now))
        span.extend(source, now)
        if (reason in OF_STARTS or reason == RATE) and span.length < PATIENCE:
            return
        if now - self._logged_at.get(key, -QUIET) < QUIET:
            return
        since, lines = self._lines.get(reason, (now, 0))
        if now - since >= QUIET:
            since = now
            lines = 0
        if lines >= LINES:
            return
        self._lines[reason] = since, lines + 1
        self._logged_at.pop(key, None)
        if len(self._logged_at) >= MOST:
            del self._logged_at[next(iter(self._logged_at))]
        self._logged_at[key] = now
        subject = problem_subject(reason)
        log.warning("%s, from %s: %s", subject, source, text)
        self._problems.solved(subject)
        self._problems.add(subject, f"from {source}: {text}")

    def settle(self, source: str) -> None:
        """Note that a participant has been met: what its start has brought is over.

        A node that crashes again and again starts each time. Beside a running robot a proxy may
        refuse datagrams for longer than `PATIENCE`, until the robot announces itself again. So the
        status does not tell a refusal any more once all its sources have been met.
        """
        for reason in OF_STARTS & self._spans.keys():
            if self._spans[reason].settle(source):
                self._problems.solved(problem_subject(reason))

    def end_old(self) -> None:
        """End the problems that tell refusals which are over."""
        now = self._now()
        for reason in [r for r, span in self._spans.items() if now - span.last >= OVER_AFTER]:
            del self._spans[reason]
            self._problems.solved(problem_subject(reason))
