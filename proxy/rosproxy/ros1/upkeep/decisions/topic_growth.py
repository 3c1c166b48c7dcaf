"""How many messages and bytes topics have carried, from what nodes count of their connections."""

from collections.abc import Iterator, Mapping

from rosproxy.ros1.protocol.bus_stats import IN, OUT, BusStats, Count
from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.registry.endpoint import Endpoint

SIDES = {OUT: "published", IN: "received"}
"""What a node does with a topic, by the direction of its connections."""
MOST_NAMES = 1000
"""Topics with sums of their own; those of all others are one."""
OTHERS = "other"
WRAP = 2**32
"""What roscpp's numbers have lost where they go on below zero."""


def registered_stats(endpoint: Endpoint, stats: BusStats) -> BusStats:
    """What a node counts of the topics that it has registered; it may answer with any name."""
    kinds = {OUT: Kind.PUBLISHER, IN: Kind.SUBSCRIBER}
    registered = {(way, name) for way, kind in kinds.items() for name in endpoint.names(kind)}
    return {key: connections for key, connections in stats.items() if key in registered}


def growth(former: BusStats, newest: BusStats) -> Mapping[tuple[str, str], Count]:
    """Bytes and messages that have been added between two answers, by direction and topic.

    A message of a publisher goes to each of its connections. It counts once: as many messages as
    the connection got that got most. Bytes are those of all connections, as they use the network.
    """
    return {
        key: _sum_up(key[0], list(_grown(key[0], former.get(key, {}), connections)))
        for key, connections in newest.items()
    }


class TopicSums:
    """The sums of all nodes by topic and side; they only grow."""

    def __init__(self) -> None:
        self.by_topic: dict[tuple[str, str], Count] = {}

    def add(self, topic: str, side: str, count: Count) -> None:
        """Add what a node has counted."""
        key = topic, side
        if key not in self.by_topic and len(self.by_topic) >= MOST_NAMES:
            key = OTHERS, side
        size, messages = self.by_topic.get(key, (0, 0))
        self.by_topic[key] = size + count[0], messages + count[1]


def _grown(
    direction: str, former: Mapping[int, Count], newest: Mapping[int, Count]
) -> Iterator[Count]:
    """How far each connection has got.

    A subscriber of roscpp that connects again goes on counting, under another number
    (``PublisherLink::setHeader``): it is taken for the connection that is gone and had most of what
    it has. One of a publisher is another subscriber's, and begins with nothing.
    """
    gone = [count for number, count in former.items() if number not in newest]
    gone = sorted(gone, reverse=True) if direction == IN else []
    for number, (size, messages) in newest.items():
        since = former.get(number)
        if since is None:
            since = next((c for c in gone if c[0] <= size and c[1] <= messages), (0, 0))
            gone = [count for count in gone if count is not since]
        yield _difference(since[0], size), _difference(since[1], messages)


def _difference(former: int, newest: int) -> int:
    """How far a number has grown; a smaller one has begun anew, unless it goes on below zero."""
    if newest >= former:
        return newest - former
    return newest - former + WRAP if newest < 0 <= former else max(newest, 0)


def _sum_up(direction: str, counts: list[Count]) -> Count:
    messages = [messages for _, messages in counts]
    total = max(messages, default=0) if direction == OUT else sum(messages)
    return sum(size for size, _ in counts), total
