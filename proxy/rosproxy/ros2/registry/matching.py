"""Who matches whom: the rule of DDS by which a writer and a reader of a topic find together.

A writer *offers* and a reader *requests* (DDS 1.4, 2.2.3): they match where the topic and the type
are the same, both have a partition in common, and of each policy no less is offered than requested.
Both sides decide it by themselves, and none is told by the other, so that a mismatch looks like
silence. What is looked at here are pairs of one inside and one outside: all others don't pass the
proxy.

Types are compared by their names, as ROS 2 has them: one of another definition has the same name.
"""

from collections.abc import Callable, Iterable, Iterator
from fnmatch import fnmatchcase
from itertools import islice, product

import msgspec

from rosproxy.ros2.protocol.names import ros_name, ros_type
from rosproxy.ros2.protocol.qos import Liveliness
from rosproxy.ros2.registry.participants import DdsEndpoint, EndpointKind, Participant

MOST_LOOKED_AT = 20_000
"""Readers and writers of a side that are looked at; a participant of ROS 2 has some tens."""
MOST_COMPARED = 20_000
"""Pairs that are compared at a time."""
_WILDCARDS = {"*", "?"}
_XCDR = 0
_REPRESENTATIONS = {0: "XCDR", 1: "XML", 2: "XCDR2"}


class Mismatch(msgspec.Struct, frozen=True):
    """Why a writer and a reader don't match: the policy, what is offered, and what is requested."""

    policy: str
    offered: str
    requested: str


class MismatchedPair(msgspec.Struct, frozen=True):
    """A writer and a reader that don't match, whose they are, and why; one is inside."""

    mismatch: Mismatch
    topic: str
    writer: Participant
    reader: Participant


def mismatch(writer: DdsEndpoint, reader: DdsEndpoint) -> Mismatch | None:
    """The first reason for which a writer and a reader of a topic don't match; None if they do."""
    return next((found for rule in _RULES if (found := rule(writer, reader))), None)


def mismatched_pairs(
    inside: Iterable[Participant], outside: Iterable[Participant]
) -> list[MismatchedPair]:
    """All that have a topic in common across the boundary, and don't match.

    The same reason between the same two is there once for each topic or service.
    """
    there: dict[str, list[tuple[Participant, DdsEndpoint]]] = {}
    for participant, end in _endpoints(outside):
        there.setdefault(end.topic, []).append((participant, end))
    pairs = (
        (here, end, other, far)
        for here, end in _endpoints(inside)
        for other, far in there.get(end.topic, ())
    )
    found: dict[tuple[str, bytes, bytes, str], MismatchedPair] = {}
    for here, end, other, far in islice(pairs, MOST_COMPARED):
        if end.kind is far.kind:
            continue
        sides = (here, end), (other, far)
        (source, writer), (sink, reader) = sides if end.kind is EndpointKind.WRITER else sides[::-1]
        why = mismatch(writer, reader)
        if why:
            name = ros_name(end.topic)
            key = name, here.prefix, other.prefix, why.policy
            found.setdefault(key, MismatchedPair(why, end.topic, source, sink))
    return list(found.values())


def _endpoints(side: Iterable[Participant]) -> Iterator[tuple[Participant, DdsEndpoint]]:
    """The readers and writers of a side, those of a kind once."""
    found = ((one, end) for one in side for end in dict.fromkeys(one.endpoints.values()))
    return islice(found, MOST_LOOKED_AT)


def _type(writer: DdsEndpoint, reader: DdsEndpoint) -> Mismatch | None:
    if writer.type_name == reader.type_name:
        return None
    return Mismatch("type", ros_type(writer.type_name), ros_type(reader.type_name))


def _partition(writer: DdsEndpoint, reader: DdsEndpoint) -> Mismatch | None:
    """Whether they have no partition in common; without any they are in the one without a name."""
    mine, theirs = writer.qos.partitions, reader.qos.partitions
    if mine is None or theirs is None:
        return None
    if any(_same_partition(*pair) for pair in product(mine or ("",), theirs or ("",))):
        return None
    return Mismatch("partition", " ".join(mine) or "none", " ".join(theirs) or "none")


def _same_partition(one: str, other: str) -> bool:
    """Whether two names of partitions mean the same; either may have wildcards, as file names have.

    Two that both have match only if they are the same (2.2.3.13).
    """
    wild = [bool(_WILDCARDS & {*name}) for name in (one, other)]
    if wild[0] == wild[1]:
        return one == other
    name, pattern = (other, one) if wild[0] else (one, other)
    return fnmatchcase(name, pattern)


def _reliability(writer: DdsEndpoint, reader: DdsEndpoint) -> Mismatch | None:
    if writer.qos.reliable or not reader.qos.reliable:
        return None
    return Mismatch("reliability", "BEST_EFFORT", "RELIABLE")


def _durability(writer: DdsEndpoint, reader: DdsEndpoint) -> Mismatch | None:
    mine, theirs = writer.qos.durability, reader.qos.durability
    return Mismatch("durability", mine.name, theirs.name) if mine < theirs else None


def _deadline(writer: DdsEndpoint, reader: DdsEndpoint) -> Mismatch | None:
    return _longer("deadline", writer.qos.deadline, reader.qos.deadline)


def _liveliness(writer: DdsEndpoint, reader: DdsEndpoint) -> Mismatch | None:
    mine: Liveliness = writer.qos.liveliness
    theirs: Liveliness = reader.qos.liveliness
    return Mismatch("liveliness", mine.name, theirs.name) if mine < theirs else None


def _liveliness_lease(writer: DdsEndpoint, reader: DdsEndpoint) -> Mismatch | None:
    name = "liveliness lease duration"
    return _longer(name, writer.qos.liveliness_lease, reader.qos.liveliness_lease)


def _ownership(writer: DdsEndpoint, reader: DdsEndpoint) -> Mismatch | None:
    if writer.qos.exclusive == reader.qos.exclusive:
        return None
    words = "SHARED", "EXCLUSIVE"
    return Mismatch("ownership", words[writer.qos.exclusive], words[reader.qos.exclusive])


def _representation(writer: DdsEndpoint, reader: DdsEndpoint) -> Mismatch | None:
    """Whether a reader does not take what a writer writes: the first that it tells (XTypes 1.3)."""
    mine, theirs = writer.qos.representations or (_XCDR,), reader.qos.representations or (_XCDR,)
    if mine[0] in theirs:
        return None
    shown = [_REPRESENTATIONS.get(one, str(one)) for one in (mine[0], *theirs)]
    return Mismatch("data representation", shown[0], " ".join(shown[1:]))


def _longer(policy: str, offered: float, requested: float) -> Mismatch | None:
    """Whether a writer promises something less often than a reader wants it."""
    if offered <= requested:
        return None
    return Mismatch(policy, *(_shown(one) for one in (offered, requested)))


def _shown(seconds: float) -> str:
    return "infinite" if seconds == float("inf") else f"{seconds:g} s"


_RULES: tuple[Callable[[DdsEndpoint, DdsEndpoint], Mismatch | None], ...] = (
    _type,
    _partition,
    _reliability,
    _durability,
    _deadline,
    _liveliness,
    _liveliness_lease,
    _ownership,
    _representation,
)
