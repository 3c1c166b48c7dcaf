"""When a node counts as failing, dead or back: a state machine over probe results."""

from dataclasses import dataclass
from enum import Enum

UNKNOWN_PIDS = (None, -1)
"""The values of a pid that is unknown (None) or not trusted any more (-1)."""

FAILURES_TO_CLOSE = 2
"""Failed probes in a row after which the port of a node refuses connections."""
RETRY_INTERVAL_S = 1.0
"""Seconds between probes of a node that is down."""


class ProbeResult(Enum):
    """How a call to the slave API of a node ended."""

    ANSWERED = "answered"
    REFUSED = "refused"
    SILENT = "silent"


@dataclass(slots=True)
class Health:
    """The health of a node; times are seconds of a monotonic clock.

    - ``refused``: the last failure was a refused connection, so the node has ended. A node that
      hangs or is cut off is silent instead.
    - ``cleaned``: the registrations were taken back at the master, at ``cleaned_at``. The registry
      keeps them for the case that the node answers again.
    - ``has_ended``: the node has ended for good, even if its address is only silent.
    - ``checked_at``: the time of the last probe; None if a probe is due at once.
    - ``hung_up_pid``: the process that ended the last kept connection.
    """

    answered_at: float | None = None
    failing_since: float | None = None
    failures: int = 0
    refused: bool = False
    cleaned: bool = False
    cleaned_at: float = 0.0
    has_ended: bool = False
    pid: int | None = None
    checked_at: float | None = None
    hung_up_pid: int | None = None

    @property
    def down(self) -> bool:
        """Whether the node counts as dead, so that its port refuses connections."""
        return self.failures >= FAILURES_TO_CLOSE

    @property
    def state(self) -> str:
        """One word for status: ok, new, failing, refused, silent, cleaned or ended."""
        if self.has_ended:
            return "ended"
        if self.cleaned:
            return "cleaned"
        if self.down:
            return "refused" if self.refused else "silent"
        if self.failures:
            return "failing"
        return "new" if self.answered_at is None else "ok"

    def unanswered(self, now: float) -> float:
        """The seconds since the first of the last failed probes; 0 if the node answers."""
        if self.failing_since is None or self.has_ended:
            return 0.0
        return now - self.failing_since

    def probe_soon(self) -> None:
        """Make the next look probe the node."""
        self.checked_at = None

    def note_hung_up(self) -> None:
        """Make the next look probe the node, which has ended a kept connection."""
        self.checked_at = None
        self.hung_up_pid = self.pid

    @property
    def steady(self) -> bool:
        """Whether the latest calls were all answered, by the same process."""
        is_well = self.answered_at is not None and not (
            self.failures or self.cleaned or self.has_ended
        )
        return is_well and self.checked_at is not None and self.pid not in UNKNOWN_PIDS

    @property
    def hangs_up(self) -> bool:
        """Whether the process that answers now has ended a kept connection."""
        return self.hung_up_pid is not None and self.hung_up_pid == self.pid

    def note_cleaned(self, at: float) -> None:
        """Record that the registrations were taken back at the master; this began at ``at``."""
        self.cleaned = True
        self.cleaned_at = at

    def note_back(self, pid: int | None) -> None:
        """Record that the node answers again as process ``pid``, and is registered again."""
        self.pid = pid
        self.cleaned = False

    def suspect(self) -> None:
        """Make the next look probe the node, as if another process had taken its address."""
        self.checked_at = None
        self.pid = -1

    def note(self, probe: ProbeResult, now: float) -> bool:
        """Record a probe result; return whether the node went down with this result."""
        was_down = self.down
        self.checked_at = now
        if probe is ProbeResult.ANSWERED:
            self.answered_at = now
            self.failing_since = None
            self.failures = 0
            self.refused = self.has_ended = False
            return False
        self.failures += 1
        self.refused = probe is ProbeResult.REFUSED
        self.failing_since = now if self.failing_since is None else self.failing_since
        return self.down and not was_down

    def end(self, now: float) -> None:
        """Record that the node has ended, regardless of answers at its address."""
        self.failures = max(self.failures, FAILURES_TO_CLOSE)
        # An infinitely old failure: `cleanup_due` then does not wait.
        self.checked_at = now
        self.failing_since = float("-inf")
        self.has_ended = True

    def probe_due(self, now: float, interval: float) -> bool:
        """Whether to probe the node now: ``interval`` seconds after the last probe, or at once.

        At once means under suspicion, or after a first failure. A node that is down gets a probe at
        least every RETRY_INTERVAL_S.
        """
        if self.checked_at is None or 0 < self.failures < FAILURES_TO_CLOSE:
            return True
        if self.down:
            return now - self.checked_at >= min(RETRY_INTERVAL_S, interval)
        return now - self.checked_at >= interval

    def cleanup_due(self, now: float, after: float) -> bool:
        """Whether to unregister the node at the master: down for ``after`` seconds (0: never)."""
        if not after or self.cleaned or self.failing_since is None or not self.down:
            return False
        return now - self.failing_since >= after
