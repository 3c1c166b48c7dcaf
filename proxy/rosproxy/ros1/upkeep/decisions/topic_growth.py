"""How many messages and bytes topics have carried, by the counts of the nodes."""

from collections.abc import Iterator, Mapping

from rosproxy.ros1.protocol.bus_stats import IN, OUT, BusStats, Count
from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.registry.endpoint import Endpoint

SIDES = {OUT: "published", IN: "received"}
"""What a node does with a topic, by the direction of the connection."""
MOST_NAMES = 1000
"""The highest number of separate sums, each of a topic and a side. On each side, all further topics
share a sum."""
OTHERS = "other"
"""The topic name of these shared sums."""
OVERFLOW_DIFFERENCE = 2**32
"""The difference after an overflow: roscpp's numbers are signed 32-bit integers."""


def registered_stats(endpoint: Endpoint, stats: BusStats) -> BusStats:
    """The counts of topics that the node has registered. A node may answer with any name."""
    kinds = {OUT: Kind.PUBLISHER, IN: Kind.SUBSCRIBER}
    registered = {(way, name) for way, kind in kinds.items() for name in endpoint.names(kind)}
    return {key: connections for key, connections in stats.items() if key in registered}


def growth(former: BusStats, newest: BusStats) -> Mapping[tuple[str, str], Count]:
    """The bytes and messages added between two answers, by direction and topic.

    A publisher sends a message over each of its connections, but the message counts once. So the
    number of its messages is that of the connection with the most messages. The bytes are the sum
    of all connections, as on the network.
    """
    return {
        key: _sum_up(key[0], list(_grown(key[0], former.get(key, {}), connections)))
        for key, connections in newest.items()
    }


class TopicSums:
    """The bytes and messages of all nodes, by topic and side (`SIDES`). Sums never shrink."""

    def __init__(self) -> None:
        self.by_topic: dict[tuple[str, str], Count] = {}

    def add(self, topic: str, side: str, count: Count) -> None:
        """Add the counts of a node."""
        key = topic, side
        if key not in self.by_topic and len(self.by_topic) >= MOST_NAMES:
            key = OTHERS, side
        size, messages = self.by_topic.get(key, (0, 0))
        self.by_topic[key] = size + count[0], messages + count[1]


def _grown(
    direction: str, former: Mapping[int, Count], newest: Mapping[int, Count]
) -> Iterator[Count]:
    """The bytes and messages that each connection has added.

    When a subscriber of roscpp connects again, its counts go on under another connection number
    (``PublisherLink::setHeader``). So a new connection continues the ended connection with the
    most bytes whose counts do not exceed the new counts. A new connection of a publisher belongs to
    another subscriber, and starts at zero.
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
    """The growth of a count. A count that is smaller than before overflowed or began again at zero.

    Only an overflow makes a count negative.
    """
    if newest >= former:
        return newest - former
    return newest - former + OVERFLOW_DIFFERENCE if newest < 0 <= former else max(newest, 0)


def _sum_up(direction: str, counts: list[Count]) -> Count:
    messages = [messages for _, messages in counts]
    total = max(messages, default=0) if direction == OUT else sum(messages)
    return sum(size for size, _ in counts), total
