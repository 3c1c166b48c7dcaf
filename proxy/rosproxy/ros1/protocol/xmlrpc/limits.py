"""How large a document may be, by who sends it.

A document is read as a whole, by the one thread that serves everybody, and each value that is
found takes some 400 bytes until the call is answered. So the bounds hold the time and the memory
that one document can take. What has no addresses in it is not read at all and has no bound here
(`passing`). How far real systems stay below: docs/reference/limits.md.
"""

import msgspec


class Limits(msgspec.Struct, frozen=True):
    """The most bytes and elements of a document, and how deep they may be nested."""

    size: int
    elements: int
    depth: int = 64


def lease_call(mebibytes: int) -> Limits:
    """Of a call from outside to a node.

    The largest real one, publisherUpdate, has two elements and some 60 bytes for each publisher of
    a topic.
    """
    return Limits(mebibytes * 1024 * 1024, mebibytes * 10_000)


def master_call(mebibytes: int) -> Limits:
    """Of a call of a node inside to the master. Registrations have twenty elements."""
    return Limits(mebibytes * 1024 * 1024, mebibytes * 5_000)


REPLY = Limits(4 * 1024 * 1024, 20_000)
"""A reply in which addresses are replaced: the publishers of a topic, a node's connections."""
BUS_STATS = Limits(4 * 1024 * 1024, 10_000)
"""What a node has counted: twelve elements for each topic with two connections."""
PID_REPLY = Limits(4 * 1024 * 1024, 100)
"""A node's pid, which it is asked for over and over, or its refusal: five elements."""
OWN_REPLY = Limits(64 * 1024 * 1024, 500_000)
"""The master's reply to a call of the proxy's own: the graph of all nodes, of ten elements for each
topic and as many for each service."""
