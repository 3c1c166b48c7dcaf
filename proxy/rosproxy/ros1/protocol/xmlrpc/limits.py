"""How large a document may be, by its sender.

A single thread serves all connections, and reads each document as a whole. Each value takes some
400 bytes until the call is answered. So the bounds limit the time and the memory for a document.
The proxy does not read long documents without addresses, and these limits do not apply to them
(`passing`). How far real systems stay below the limits: docs/reference/limits.md.
"""

import msgspec


class Limits(msgspec.Struct, frozen=True):
    """The highest number of bytes, elements and nested levels of a document."""

    size: int
    elements: int
    depth: int = 64


def lease_call(mebibytes: int) -> Limits:
    """The limits of a call from outside to a node.

    The largest real call, publisherUpdate, has two elements and some 60 bytes for each publisher of
    a topic.
    """
    return Limits(mebibytes * 1024 * 1024, mebibytes * 10_000)


def master_call(mebibytes: int) -> Limits:
    """The limits of a call from inside to the master. Registrations have twenty elements."""
    return Limits(mebibytes * 1024 * 1024, mebibytes * 5_000)


REPLY = Limits(4 * 1024 * 1024, 20_000)
"""A reply with addresses to replace: the publishers of a topic, the connections of a node."""
BUS_STATS = Limits(4 * 1024 * 1024, 10_000)
"""The counts of a node: twelve elements for each topic with two connections."""
SHORT_REPLY = Limits(64 * 1024, 100)
"""The pid of a node, for which the proxy asks again and again, or a name, a port, or a refusal: up
to ten elements."""
LEASES = Limits(4 * 1024 * 1024, 100)
"""The value of the parameter with the leases: a text with 40 bytes for each node, or whatever
another program has written to the parameter."""
ALL_LEASES = Limits(4 * 1024 * 1024, 10_000)
"""The values of these parameters of all proxies, with four elements for each proxy."""
FLAG = Limits(16 * 1024, 100)
"""A parameter that is true or false, or whatever a program has written to the parameter."""
OWN_REPLY = Limits(32 * 1024 * 1024, 500_000)
"""The master's reply to a call of the proxy itself: the graph of all nodes, with ten elements for
each topic and for each service."""
