"""What a node counts of its topic connections: the reply to ``getBusStats``.

It has a list of publications and one of subscriptions, each with rows of a topic and its
connections. A subscription's connection is ``[id, bytes, messages, drops, ...]``. A publication's
is ``[id, bytes, messages, connected]`` in rospy, and in roscpp ``[id, bytes, bytes of messages,
messages, connected]`` (``Publication::getStats``).

The numbers have 32 bits, with a sign. roscpp counts with 64 and cuts them off, so that beyond 2 GiB
they go on below zero; rospy, which has to tell a greater one, answers with an error.
"""

from collections.abc import Mapping
from itertools import islice
from typing import Any

OUT = "o"
IN = "i"
"""Directions, as in ``getBusInfo``: of a publisher's connections, and of a subscriber's."""
MOST_CONNECTIONS = 256
"""Connections of a topic that are read; `/rosout` of a large system has 200."""
LEAST = -(2**31)
GREATEST = 2**31 - 1
"""Bounds of a number of XML-RPC."""
Count = tuple[int, int]
"""Bytes and messages."""
BusStats = Mapping[tuple[str, str], Mapping[int, Count]]
"""What is counted, by direction and topic, then by the number of the connection."""


def read_bus_stats(stats: Any) -> BusStats:
    """The counts in a reply's value; rows that can't be read are left out.

    roscpp's first connection has the number 0, and so has each that is being made: the counts of
    one number are added up.
    """
    by_topic: dict[tuple[str, str], dict[int, Count]] = {}
    for direction, rows in zip((OUT, IN), _items(stats)[:2], strict=False):
        for row in _items(rows):
            match row:
                case [str(topic), *_, list(connections)]:
                    counts = by_topic.setdefault((direction, topic), {})
                    for connection in islice(connections, MOST_CONNECTIONS):
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
    if all(LEAST <= value <= GREATEST for value in (number, size, messages)):
        former_size, former_messages = counts.get(number, (0, 0))
        counts[number] = former_size + size, former_messages + messages


def _items(value: Any) -> list[Any]:
    return value if isinstance(value, list) else []
