"""What the proxy has refused because it was over a bound: counted, logged, and shown in the status.

A metric counts every refusal by its reason, a word of those in docs/reference/limits.md. The log
gets one line for each reason and source, then none for a while, and so many for each reason;
`rosproxy status` shows the last one of each reason.
"""

import logging
from collections.abc import Callable

from rosproxy.telemetry.metrics import Metrics
from rosproxy.telemetry.problems import Problems

log = logging.getLogger(__name__)

DENIED, WOULD_BE_DENIED = "policy", "policy_audit"
"""The reasons of what a policy denies, or only tells of."""
QUIET = 60.0
"""Seconds in which a source is not logged again for the same reason."""
LINES = 20
"""Sources that are logged in that time for one reason: sources of datagrams may be forged."""
MOST = 1000
"""Sources and reasons that are remembered for that."""


def problem_subject(reason: str) -> str:
    """The subject of the problem that tells the last refusal for a reason."""
    return f"refused: {reason.replace('_', ' ')}"


class Refusals:
    """Tells of refusals; ``now`` is the monotonic clock."""

    def __init__(self, metrics: Metrics, problems: Problems, now: Callable[[], float]) -> None:
        self._metrics, self._problems, self._now = metrics, problems, now
        self._logged_at: dict[tuple[str, str], float] = {}
        self._lines: dict[str, tuple[float, int]] = {}

    def note(self, reason: str, source: str, text: str) -> None:
        """Tell that something from a source was refused, and why."""
        self._metrics.refused.labels(reason).inc()
        now, key = self._now(), (reason, source)
        if now - self._logged_at.get(key, -QUIET) < QUIET:
            return
        since, lines = self._lines.get(reason, (now, 0))
        if now - since >= QUIET:
            since, lines = now, 0
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
