"""What was counted of each link, and what follows from it.

That are rates, the age of the last message, and whether a connection that seems well carries
nothing. There are three counters: the publisher's and the subscriber's own of messages and bytes,
which they are asked for now and then (``getBusStats``), and the proxy's of bytes, where it relays.
What the subscriber has counted has arrived. The proxy's counter stops only once buffers are full;
the publisher's tells what was to be sent.

The proxy's counter is read each second, the nodes' as seldom as a thousand of them need. So what
the proxy relays counts, as long as nothing shows that it does not arrive.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from rosproxy.doctor.facts import DoctorFacts, SlaveReport
from rosproxy.net.addresses import HostPort
from rosproxy.ros1.protocol.uris import parse_slave_uri

STALLED = 5.0
"""Seconds in which a subscriber has got nothing that was sent to it, until that is told."""
MISSED = 2
"""Messages that must have been sent meanwhile: one may be under way."""
LATE_ROUNDS = 2
"""Rounds of questions after which the counts of a node that answers no more are not shown."""
FLOWS = 3.0
"""Seconds after a message in which one is said to come just now."""
Key = tuple[str, str, str]
"""Topic, publisher, subscriber."""


@dataclass(slots=True)
class Counter:
    """Something that only grows: its ``value`` ``at`` a time, ``rate``, and when it last grew.

    ``every``: seconds between the last two times.
    """

    value: int
    at: float
    rate: float | None = None
    grew: float | None = None
    every: float = 0.0

    def read(self, value: int, at: float) -> None:
        """Take in another value; a smaller one is that of a new connection."""
        if at <= self.at:
            return
        self.rate = (value - self.value) / (at - self.at) if value >= self.value else None
        if value > self.value:
            self.grew = at
        self.every = at - self.at
        self.value = value
        self.at = at


@dataclass(slots=True)
class Link:
    """The counters of a link, by ``messages``, ``bytes`` and side, and ``relayed`` bytes.

    ``mark``: what the publisher had sent, and when, as the subscriber last got something.
    """

    counters: dict[str, Counter] = field(default_factory=dict)
    mark: tuple[int, float] | None = None

    def read(self, name: str, value: int, at: float) -> None:
        """Take in what was counted."""
        counter = self.counters.get(name)
        if counter is None:
            self.counters[name] = Counter(value, at)
        else:
            counter.read(value, at)

    @property
    def hz(self) -> float | None:
        """Messages per second that arrive or, where that is not told, that are sent."""
        return self._first("rate", "taken", "given")

    @property
    def rate(self) -> float | None:
        """Bytes per second: those of the proxy, else those that a node has counted."""
        return self._first("rate", "relayed", "taken bytes", "given bytes")

    def last(self, now: float) -> float | None:
        """When something was last seen to have come; None: that is not known."""
        names = ("taken",) if self.is_stalled(now) else ("taken", "relayed")
        counters = [self.counters[name] for name in names if name in self.counters]
        if not counters:
            return self._first("grew", "given")
        return max((c.grew for c in counters if c.grew is not None), default=None)

    def flows(self, now: float) -> bool:
        """Whether messages come just now, or came so often when they were counted last."""
        last = self.last(now)
        if last is None or self.is_stalled(now):
            return False
        counter = self.counters.get("taken") or self.counters.get("given")
        if now - last < FLOWS or counter is None or "relayed" in self.counters:
            return now - last < FLOWS
        if now - counter.at > LATE_ROUNDS * counter.every + FLOWS:
            return False
        return counter.grew == counter.at and (counter.rate or 0.0) * FLOWS >= 1.0

    def note_progress(self) -> None:
        """Remember how far the publisher was whenever the subscriber got something."""
        sent = self.counters.get("given")
        arrived = self.counters.get("taken")
        if sent is None or arrived is None:
            self.mark = None
        # Anew also when the publisher counts from the beginning: that is another connection.
        elif self.mark is None or (arrived.grew or 0.0) > self.mark[1] or sent.value < self.mark[0]:
            # The two nodes are asked one after the other: nothing is late before the later answer.
            self.mark = sent.value, max(sent.at, arrived.at)

    def is_stalled(self, now: float) -> bool:
        """Whether messages are sent, and none arrives."""
        if self.mark is None:
            return False
        sent, since = self.mark
        missed = self.counters["given"].value - sent
        return missed >= MISSED and now - since >= STALLED

    def _first(self, attribute: str, *names: str) -> float | None:
        counters = [self.counters[name] for name in names if name in self.counters]
        number: float | None = getattr(counters[0], attribute) if counters else None
        return number


class Measures:
    """The counters of all links, for as long as anybody looks."""

    def __init__(self) -> None:
        self._links: dict[Key, Link] = {}

    def get(self, key: Key) -> Link:
        """What is known of a link."""
        return self._links.get(key, _EMPTY_LINK)

    def read_relays(self, relayed: Mapping[Key, int], now: float) -> None:
        """Take in the bytes that the proxy has relayed, by those links that it relays now."""
        for key in self._links.keys() - relayed.keys():
            self._links[key].counters.pop("relayed", None)
        for key, size in relayed.items():
            self._links.setdefault(key, Link()).read("relayed", size, now)

    def read_nodes(self, facts: DoctorFacts, pairs: Iterable[Key]) -> None:
        """Take in what nodes have counted of these links; what is known of others is dropped."""
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
    """The URIs that a subscriber knows publishers by, which roscpp has without their paths."""
    uris: dict[tuple[str, HostPort], str] = {}
    for direction, topic, peer in report.counts:
        slave = parse_slave_uri(peer) if direction == "i" else None
        if slave is not None:
            uris.setdefault((topic, slave), peer)
    return uris


_EMPTY_LINK = Link()
