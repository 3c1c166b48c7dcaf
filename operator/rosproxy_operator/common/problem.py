"""Problems that the operators of all engines report and log."""

import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

log = logging.getLogger(__name__)

# Reasons of problems (`Problem.reason`) that both engines have.
CONFLICT = "PortConflict"
EXHAUSTED = "PortsExhausted"
FAILED = "OperatorFailed"
INVALID = "Invalid"
LAN_RELAY_STUCK = "LanRelayStuck"
MASTER_UNKNOWN = "MasterUnknown"
NO_ADVERTISE_HOST = "NoAdvertiseHost"
NO_LAN_ADDRESS = "NoLanAddress"
NOT_ADMITTED = "ProxyNotAdmitted"
NOT_ALLOWED = "NotAllowed"
NOT_WIRED = "NotWired"
OPTION_IGNORED = "OptionIgnored"
REFUSES = "PolicyRefused"
SILENT = "ProxyUnreachable"
STUCK = "ProxyStuck"
TOO_MANY = "TooMany"
UNKNOWN_NAME = "UnknownName"


def bounded(text: str, most: int) -> str:
    """Return the text, cut to ``most`` characters at most. A cut text ends in an ellipsis."""
    return text if len(text) <= most else f"{text[: most - 1]}…"


class Fault(NamedTuple):
    """What is wrong, and the fix: an imperative, empty if there is nothing to do.

    Both are without a full stop at the end.
    """

    text: str
    fix: str = ""

    def __str__(self) -> str:
        """Return both as one text, for outputs that have room for a single text."""
        return with_fix(*self)

    def shortened(self, most: int, cut: Callable[[str, int], str] = bounded) -> "Fault":
        """Return the fault with ``most`` characters at most, both together.

        What is wrong is cut, and the fix stays whole up to three quarters of the room. ``cut``
        shortens a text. It may count bytes, so the fix counts by its bytes.
        """
        fix = cut(self.fix, most * 3 // 4)
        room = most - len(f". {fix}".encode()) if fix else most
        return Fault(cut(self.text, room), fix)


@dataclass(frozen=True, slots=True)
class Problem:
    """A problem of an object: ``text`` and ``fix`` are those of a `Fault`.

    ``subject`` names the object: ``container talker``, ``network app``, ``proxy rosproxy-…``.
    ``fatal``: the object does not get what its user wants. Otherwise the problem is a warning.
    ``reason`` is a CamelCase word for the kind of the problem, for programs: the word stays the
    same in later releases.
    """

    subject: str
    text: str
    fix: str = ""
    fatal: bool = True
    reason: str = field(kw_only=True)

    @property
    def message(self) -> str:
        """What is wrong and the fix as one text."""
        return with_fix(self.text, self.fix)

    def __str__(self) -> str:
        """Return the subject and the message as a line."""
        return f"{self.subject}: {self.message}"

    @property
    def log_fields(self) -> dict[str, str]:
        """The fields of a log entry about the problem, for ``extra``."""
        kind, _, name = self.subject.partition(" ")
        own = {kind: name} if kind in ("container", "pod", "proxy") else {}
        return {**own, "reason": self.reason}


def ends_again(error: str, command: str) -> Fault:
    """Say that the container of a proxy ends again and again. ``command`` prints the log."""
    return Fault(f"the container ends again and again ({error})", f"Read {command}")


def silent(error: str, fix: str) -> Fault:
    """Say that a proxy does not answer the operator."""
    return Fault(f"does not answer the operator ({error})", fix)


def with_fix(text: str, fix: str) -> str:
    """Return what is wrong and the fix as one text."""
    end = " " if text.endswith(("?", "…")) else ". "
    return f"{text}{end}{fix}" if fix else text


class ProblemLog:
    """Logs each problem once, and logs when an object has no more problems.

    ``since``: the time of the update that first had the problem, of each current problem.
    """

    def __init__(self) -> None:
        self.since: dict[Problem, float] = {}

    def update(self, problems: Iterable[Problem], now: float) -> None:
        """Log new problems, and subjects whose problems are solved.

        ``problems`` are all current problems. ``now``: monotonic seconds.
        """
        current = {problem: self.since.get(problem, now) for problem in problems}
        for problem in current:
            if problem not in self.since:
                level = logging.ERROR if problem.fatal else logging.WARNING
                log.log(level, "%s", problem, extra=problem.log_fields)
        for subject in sorted({p.subject for p in self.since} - {p.subject for p in current}):
            log.info("%s: solved", subject)
        self.since = current
