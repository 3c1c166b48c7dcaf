"""Does every count fit? Pure functions from what the nodes reported to a list of verdicts."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

RECOVERY_LIMIT = 2.0
"""Seconds that a restarted proxy may take until messages and service calls pass again."""
IN_FLIGHT_SECONDS = 0.1
"""A message written this shortly before the proxy was killed may still have been inside of it."""


@dataclass(frozen=True)
class Verdict:
    """One expectation of the demo and whether it was met."""

    expectation: str
    met: bool
    detail: str


@dataclass(frozen=True)
class StreamCount:
    """One direction's messages. published = sent + unheard; sent = received + cut_off + lost."""

    direction: str
    published: int
    unheard_before: int
    unheard_during_outage: int
    sent: int
    received: int
    cut_off: int
    lost: int
    duplicates: int
    strangers: int

    @property
    def fits(self) -> bool:
        """Whether everything sent while connected arrived exactly once, and nothing else did."""
        return self.received > 0 and not (self.lost or self.duplicates or self.strangers)

    def describe(self) -> str:
        """Say it in one line."""
        text = f"sent {self.sent}, received {self.received}"
        if self.cut_off:
            text += f", {self.cut_off} on the way when the proxy was killed"
        if self.unheard_during_outage:
            text += f", {self.unheard_during_outage} published during the outage (nobody connected)"
        return f"{text}; lost {self.lost}, duplicated {self.duplicates}"


def _numbers(runs: Iterable[tuple[int | None, int | None]]) -> set[int]:
    return {
        number
        for first, last in runs
        if first is not None and last is not None
        for number in range(first, last + 1)
    }


def _in_flight(session: dict[str, Any], killed: float) -> set[int]:
    """The numbers that a session which the kill ended wrote around or after the kill."""
    if session["closed"] is None or session["closed"] < killed:
        return set()
    return {number for number, sent in session["tail"] if sent >= killed - IN_FLIGHT_SECONDS}


def count_stream(
    direction: str, publisher: dict[str, Any], subscription: dict[str, Any], killed: float
) -> StreamCount:
    """Compare what a publisher wrote to its subscriber's connections with what arrived.

    `killed` is when the proxy was killed, on the same monotonic clock as the reports.
    """
    sessions = publisher["sessions"]
    sent = _numbers((session["first"], session["last"]) for session in sessions)
    received = _numbers((run[0], run[1]) for run in subscription["runs"])
    cut = set().union(*(_in_flight(session, killed) for session in sessions)) - received
    before = min(sent, default=publisher["published"] + 1) - 1
    return StreamCount(
        direction=direction,
        published=publisher["published"],
        unheard_before=before,
        unheard_during_outage=publisher["published"] - len(sent) - before,
        sent=len(sent),
        received=len(received & sent),
        cut_off=len(cut),
        lost=len(sent - received - cut),
        duplicates=subscription["count"] - len(received),
        strangers=len(received - sent),
    )


def first_message_after(subscription: dict[str, Any], moment: float) -> float | None:
    """Return when the first message came over a connection made after `moment`."""
    times = [
        link["first_message"]
        for link in subscription["links"]
        if link["connected"] > moment and link["first_message"] is not None
    ]
    return min(times, default=None)


@dataclass
class Evidence:
    """What the course of the demo has gathered; times are seconds of the monotonic clock."""

    direct_received: int | None = None
    direct_problem: str = ""
    streams: tuple[StreamCount, ...] = ()
    service_before: tuple[str, ...] = ()
    service_after: tuple[str, ...] = ()
    addresses_before: dict[str, str] | None = None
    addresses_after: dict[str, str] | None = None
    message_recovery: float | None = None
    service_recovery: float | None = None

    def to_json(self) -> dict[str, Any]:
        """Return everything as plain data."""
        return asdict(self)


def judge(evidence: Evidence) -> list[Verdict]:
    """Hold the evidence against everything that the demo promises."""
    return [
        _direct(evidence),
        *(_stream(count) for count in evidence.streams),
        _services("service calls before the kill", evidence.service_before),
        _services("service calls after the restart", evidence.service_after),
        _addresses(evidence),
        _recovery(evidence),
    ]


def _direct(evidence: Evidence) -> Verdict:
    failed = evidence.direct_received == 0 and bool(evidence.direct_problem)
    detail = f"outside received {evidence.direct_received} messages: {evidence.direct_problem}"
    if evidence.direct_received is None:
        detail = "not tried"
    return Verdict("without the proxy nothing crosses", failed, detail)


def _stream(count: StreamCount) -> Verdict:
    return Verdict(f"every message {count.direction} arrived once", count.fits, count.describe())


def _services(expectation: str, problems: tuple[str, ...]) -> Verdict:
    failures = [problem for problem in problems if problem]
    answered = f"{len(problems)} answered" if problems else "none was made"
    detail = "; ".join(failures) or answered
    return Verdict(expectation, bool(problems) and not failures, detail)


def _addresses(evidence: Evidence) -> Verdict:
    before, after = _listed(evidence.addresses_before), _listed(evidence.addresses_after)
    same = bool(evidence.addresses_before) and before == after
    detail = after if same else f"before the kill: {before}; after the restart: {after}"
    return Verdict("the same ports serve the same nodes", same, detail)


def _listed(addresses: dict[str, str] | None) -> str:
    if addresses is None:
        return "not looked up"
    return ", ".join(f"{name} {address}" for name, address in addresses.items())


def _recovery(evidence: Evidence) -> Verdict:
    times = {"messages": evidence.message_recovery, "service": evidence.service_recovery}
    met = all(time is not None and time < RECOVERY_LIMIT for time in times.values())
    shown = [f"{what} {_seconds(time)} after the restart" for what, time in times.items()]
    return Verdict(f"recovered in less than {RECOVERY_LIMIT:g} s", met, ", ".join(shown))


def _seconds(time: float | None) -> str:
    return "never" if time is None else f"{time:.2f} s"
