"""The counts of a node for its topic connections: the reply to ``getBusStats``.

The reply has a list of publications and a list of subscriptions. Each list has rows of a topic and
its connections. A connection of a subscription is ``[id, bytes, messages, drops, ...]``. A
connection of a publication is ``[id, bytes, messages, connected]`` in rospy, and in roscpp ``[id,
bytes, bytes of messages, messages, connected]`` (``Publication::getStats``).

The numbers are signed and have 32 bits. roscpp counts with 64 bits and drops the upper 32, so
numbers beyond 2 GiB continue below zero. rospy answers with an error if a number is too large.
"""

from collections.abc import Mapping
from itertools import islice
from typing import Any

OUT = "o"
IN = "i"
"""Directions, as in ``getBusInfo``: of a publisher's connections, and of a subscriber's."""
MOST_CONNECTIONS = 256
"""The highest number of connections to read for a topic, of all its rows together; `/rosout` of a
large system has 200."""
LEAST_INTEGER = -(2**31)
GREATEST_INTEGER = 2**31 - 1
"""The bounds of an integer of XML-RPC."""
Count = tuple[int, int]
"""Bytes and messages."""
BusStats = Mapping[tuple[str, str], Mapping[int, Count]]
"""The counts, by direction and topic, then by the number of the connection."""


def read_bus_stats(stats: Any) -> BusStats:
    """Read the counts from the value of a reply; rows of another form are left out.

    roscpp gives the number 0 to its first connection, and to each connection that is not
    established yet. So the counts of connections with the same number are added up.
    """
    by_topic: dict[tuple[str, str], dict[int, Count]] = {}
    for direction, rows in zip((OUT, IN), _items(stats)[:2], strict=False):
        for row in _items(rows):
            match row:
                case [str(topic), *_, list(connections)]:
                    counts = by_topic.setdefault((direction, topic), {})
                    for connection in islice(connections, MOST_CONNECTIONS - len(counts)):
                        _add(counts, connection, direction)
    return by_topic


def _add(counts: dict[int, Count], row: Any, direction: str) -> None:
    match row:
        case [int(number), int(size), _, int(messages), _] if direction == OUT:
            pass
        case [int(number), int(size), int(messages), *_]:
            pass
        case _:
            return
    if all(LEAST_INTEGER <= value <= GREATEST_INTEGER for value in (number, size, messages)):
        former_size, former_messages = counts.get(number, (0, 0))
        counts[number] = former_size + size, former_messages + messages


def _items(value: Any) -> list[Any]:
    return value if isinstance(value, list) else []
