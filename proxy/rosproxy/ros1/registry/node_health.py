"""When a node counts as failing, dead or back: a state machine over probe results."""

from dataclasses import dataclass
from enum import Enum

UNKNOWN_PID = (None, -1)
"""What stands for a pid that is not known, or not relied on."""

FAILURES_TO_CLOSE = 2
"""Failed probes in a row after which a node's port refuses."""


RETRY = 1.0
"""Seconds between probes of a node that is down."""


class ProbeResult(Enum):
    """How a call to a node's slave API ended."""

    ANSWERED = "answered"
    REFUSED = "refused"
    SILENT = "silent"


@dataclass(slots=True)
class Health:
    """What is known of a node's health; times are seconds of a monotonic clock.

    ``refused`` tells whether the last failure was a refused connection, which only a node that
    has ended gives; one that hangs or is cut off is silent. ``cleaned``: its registrations were
    taken back at the master, at ``cleaned_at``, and are kept only for the case that it answers
    again. ``has_ended``: it is known to have ended for good, even if its address is just silent.
    ``hung_up_pid`` is the process that ended the last connection that was to be kept.
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
        """Whether the node is known not to answer, so that its port refuses."""
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

    def probe_soon(self) -> None:
        """Have the node probed at once."""
        self.checked_at = None

    def note_hung_up(self) -> None:
        """Have the node probed at once: it has ended a connection that was to be kept."""
        self.checked_at = None
        self.hung_up_pid = self.pid

    @property
    def steady(self) -> bool:
        """Whether it has answered whenever it was asked of late, always as the same process."""
        is_well = self.answered_at is not None and not (
            self.failures or self.cleaned or self.has_ended
        )
        return is_well and self.checked_at is not None and self.pid not in UNKNOWN_PID

    @property
    def hangs_up(self) -> bool:
        """Whether the process that answers has ended a connection that was to be kept."""
        return self.hung_up_pid is not None and self.hung_up_pid == self.pid

    def note_cleaned(self, at: float) -> None:
        """Note that its registrations were taken back at the master, as they were at a time."""
        self.cleaned = True
        self.cleaned_at = at

    def note_back(self, pid: int | None) -> None:
        """Note that it answers after all, as process ``pid``, and that it is registered again."""
        self.pid = pid
        self.cleaned = False

    def suspect(self) -> None:
        """Have the node probed at once, as if another process could be there by now."""
        self.checked_at = None
        self.pid = -1

    def note(self, probe: ProbeResult, now: float) -> bool:
        """Take in a probe result; whether the node went down by it."""
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
        """Note that the node has ended, whatever it is that its address answers."""
        self.failures = max(self.failures, FAILURES_TO_CLOSE)
        # Failing since ever, so that `clean_up` waits for nothing.
        self.checked_at = now
        self.failing_since = float("-inf")
        self.has_ended = True

    def due(self, now: float, interval: float) -> bool:
        """Whether to probe: idle for ``interval`` seconds, or under suspicion."""
        if self.checked_at is None or 0 < self.failures < FAILURES_TO_CLOSE:
            return True
        if self.down:
            return now - self.checked_at >= min(RETRY, interval)
        return now - self.checked_at >= interval

    def clean_up(self, now: float, after: float) -> bool:
        """Whether to unregister the node at the master: down for ``after`` seconds (0: never)."""
        if not after or self.cleaned or self.failing_since is None or not self.down:
            return False
        return now - self.failing_since >= after
