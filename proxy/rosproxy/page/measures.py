"""The counters of each link, and the rates, times and stalls that follow from the counters.

A link has up to three counters:

- The subscriber counts messages and bytes that have arrived (``getBusStats``).
- The publisher counts messages and bytes to send (``getBusStats``).
- The proxy counts bytes that a relay has passed on. If nothing arrives at the subscriber, this
  counter still grows until the buffers are full.

The proxy reads the relays each second. A round of questions to a thousand nodes takes a minute. So
the relay decides whether messages flow, unless the counts of the nodes show a stall.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from rosproxy.doctor.facts import DoctorFacts, SlaveReport
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.uris import parse_slave_uri

STALLED_AFTER_S = 5.0
"""Seconds without a message at the subscriber after which a link counts as stalled."""
MISSED_MESSAGES = 2
"""Messages of the publisher that must be missing in a stalled link. One may be under way."""
LATE_ROUNDS = 2
"""Rounds of questions without a new count after which a link no longer flows."""
FLOW_PERIOD_S = 3.0
"""Seconds after a message for which a link flows."""
Key = tuple[str, str, str]
"""Topic, publisher, subscriber."""


@dataclass(slots=True)
class Counter:
    """A counter of messages or bytes, at the latest two reads.

    ``value``: the count at the latest read. ``at``: the time of this read. ``grew_at``: the time of
    the latest read with a larger count than before. ``interval_s``: seconds between the latest two
    reads. ``rate``: growth a second between these reads. Times are monotonic seconds.
    """

    value: int
    at: float
    rate: float | None = None
    grew_at: float | None = None
    interval_s: float = 0.0

    def read(self, value: int, at: float) -> None:
        """Record a later value. A smaller value belongs to a new connection and has no rate."""
        if at <= self.at:
            return
        self.rate = (value - self.value) / (at - self.at) if value >= self.value else None
        if value > self.value:
            self.grew_at = at
        self.interval_s = at - self.at
        self.value = value
        self.at = at

    def is_outdated(self, now: float) -> bool:
        """Whether the next reads are overdue: the node no longer answers."""
        return now - self.at > LATE_ROUNDS * self.interval_s + FLOW_PERIOD_S


@dataclass(slots=True)
class Link:
    """The counters of a link by name.

    ``given`` and ``given bytes``: the publisher's counts. ``taken`` and ``taken bytes``: the
    subscriber's counts. ``relayed``: bytes of the relay. ``mark``: the publisher's count, and the
    time, when the subscriber's count last grew.
    """

    counters: dict[str, Counter] = field(default_factory=dict)
    mark: tuple[int, float] | None = None

    def read(self, name: str, value: int, at: float) -> None:
        """Record a value of a counter."""
        counter = self.counters.get(name)
        if counter is None:
            self.counters[name] = Counter(value, at)
        else:
            counter.read(value, at)

    def message_rate(self, now: float) -> float | None:
        """Messages a second by the subscriber's count, else by the publisher's count.

        Leaves out the counts of a node that no longer answers. None if unknown.
        """
        return self._rate(now, "taken", "given")

    def byte_rate(self, now: float) -> float | None:
        """Bytes a second by the relay, else by the subscriber, else by the publisher.

        Leaves out the counts of a node that no longer answers. None if unknown.
        """
        return self._rate(now, "relayed", "taken bytes", "given bytes")

    def last(self, now: float) -> float | None:
        """The time of the last message, in monotonic seconds; None if unknown."""
        names = ("taken",) if self.is_stalled(now) else ("taken", "relayed")
        counters = [self.counters[name] for name in names if name in self.counters]
        if not counters:
            given = self.counters.get("given")
            return given.grew_at if given else None
        return max((c.grew_at for c in counters if c.grew_at is not None), default=None)

    def flows(self, now: float) -> bool:
        """Whether messages flow at ``now``: the last message is less than FLOW_PERIOD_S old.

        No messages flow over a stalled link. Without a relay, messages also flow if the latest
        count of a node has grown by at least one message per FLOW_PERIOD_S.
        """
        last = self.last(now)
        if last is None or self.is_stalled(now):
            return False
        counter = self.counters.get("taken") or self.counters.get("given")
        if now - last < FLOW_PERIOD_S or counter is None or "relayed" in self.counters:
            return now - last < FLOW_PERIOD_S
        if counter.is_outdated(now):
            return False
        return counter.grew_at == counter.at and (counter.rate or 0.0) * FLOW_PERIOD_S >= 1.0

    def note_progress(self) -> None:
        """Set ``mark`` if the subscriber's count has grown, for `is_stalled`."""
        sent = self.counters.get("given")
        arrived = self.counters.get("taken")
        if sent is None or arrived is None:
            self.mark = None
        # A smaller count of the publisher belongs to a new connection, and needs a new mark.
        elif (
            self.mark is None
            or (arrived.grew_at or 0.0) > self.mark[1]
            or sent.value < self.mark[0]
        ):
            # The nodes answer at different times. The time of a stall starts at the later answer.
            self.mark = sent.value, max(sent.at, arrived.at)

    def is_stalled(self, now: float) -> bool:
        """Whether no message arrived for STALLED_AFTER_S, although MISSED_MESSAGES were sent."""
        if self.mark is None:
            return False
        sent, since = self.mark
        missed = self.counters["given"].value - sent
        return missed >= MISSED_MESSAGES and now - since >= STALLED_AFTER_S

    def _rate(self, now: float, *names: str) -> float | None:
        counters = (self.counters[name] for name in names if name in self.counters)
        return next((c.rate for c in counters if not c.is_outdated(now)), None)


class Measures:
    """The counters of all links while there is a watcher."""

    def __init__(self) -> None:
        self._links: dict[Key, Link] = {}
        self._participants: dict[str, Counter] = {}

    def get(self, key: Key) -> Link:
        """The counters of a link, perhaps empty. Do not change the result."""
        return self._links.get(key, _EMPTY_LINK)

    def participant_last(self, key: str) -> float | None:
        """The time when user data last passed to a participant, in monotonic seconds, or None."""
        counter = self._participants.get(key)
        return counter.grew_at if counter else None

    def read_participants(self, datagrams: Mapping[str, int], now: float) -> None:
        """Record the number of user data datagrams that passed to each participant, by its key."""
        former = self._participants
        self._participants = {}
        for key, count in datagrams.items():
            counter = self._participants[key] = former.get(key) or Counter(count, now)
            counter.read(count, now)

    def read_relays(self, relayed: Mapping[Key, int], now: float) -> None:
        """Record the bytes that the proxy has relayed, by link. Other links lose ``relayed``."""
        for key in self._links.keys() - relayed.keys():
            self._links[key].counters.pop("relayed", None)
        for key, size in relayed.items():
            self._links.setdefault(key, Link()).read("relayed", size, now)

    def read_nodes(self, facts: DoctorFacts, pairs: Iterable[Key]) -> None:
        """Record the counts of nodes for the links ``pairs``, and drop all other links."""
        former = self._links
        uris = dict[str, Mapping[tuple[str, HostPort], str]]()
        self._links = {}
        for key in pairs:
            topic, publisher, subscriber = key
            link = self._links[key] = former.get(key, Link())
            source = facts.nodes.get(publisher)
            target = facts.nodes.get(subscriber)
            if source and source.report and target:
                _read(link, "given", source.report, ("o", topic, target.name))
            if target and target.report and source:
                if subscriber not in uris:
                    uris[subscriber] = _publishers(target.report)
                uri = source.uri
                if source.slave is not None:
                    uri = uris[subscriber].get((topic, source.slave), uri)
                _read(link, "taken", target.report, ("i", topic, uri))
            link.note_progress()


def _read(link: Link, side: str, report: SlaveReport, connection: tuple[str, str, str]) -> None:
    counts = report.counts.get(connection)
    if counts is None:
        for name in (side, f"{side} bytes"):
            link.counters.pop(name, None)
        return
    link.read(side, counts[1], report.at)
    link.read(f"{side} bytes", counts[0], report.at)


def _publishers(report: SlaveReport) -> Mapping[tuple[str, HostPort], str]:
    """The URIs that a subscriber reports for publishers, by topic and slave API.

    roscpp reports URIs without a path, so these URIs can differ from the URIs at the master.
    """
    uris: dict[tuple[str, HostPort], str] = {}
    for direction, topic, peer in report.counts:
        slave = parse_slave_uri(peer) if direction == "i" else None
        if slave is not None:
            uris.setdefault((topic, slave), peer)
    return uris


_EMPTY_LINK = Link()
