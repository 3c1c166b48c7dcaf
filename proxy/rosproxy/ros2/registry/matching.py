"""Which writer and reader of a topic match, by the rule of DDS.

A writer *offers* and a reader *requests* (DDS 1.4, 2.2.3): they match where the topic and the type
are the same, both have a partition in common, and of each policy no less is offered than requested.
Both sides decide it by themselves, and neither tells the other, so that a mismatch looks like
silence. Only pairs of one inside and one outside are looked at: no others pass the proxy.

Types are compared by their names, as ROS 2 has them: another definition has the same name.

One participant may have thousands of readers and writers, and so millions of pairs. So addresses
take turns, and what is left out is counted: no address keeps a pair of another one from being
compared.
"""

from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Iterator
from itertools import islice, product, repeat
from typing import TypeVar

import msgspec

from rosproxy.ros2.protocol.qos import Liveliness
from rosproxy.ros2.protocol.ros_names import ros_name, ros_type
from rosproxy.ros2.registry.participants import DdsEndpoint, EndpointKind, Participant

MOST_LOOKED_AT = 10_000
"""Readers and writers of a side that are looked at, in 0.1 s at most. A participant of ROS 2 has
some tens. The addresses of the side take turns."""
MOST_COMPARED = 20_000
"""Pairs that are compared at a time. The addresses inside take turns, and in the turns of each of
them its readers and writers; each meets those outside in the order of their addresses' turns."""
_OPPOSITE = {
    EndpointKind.READER: EndpointKind.WRITER,
    EndpointKind.WRITER: EndpointKind.READER,
}
_WILDCARDS = {"*", "?", "["}
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
    return next((reason for rule in _RULES if (reason := rule(writer, reader))), None)


class Comparison(msgspec.Struct, frozen=True):
    """The pairs that don't match, and how many pairs are not compared.

    A reader or writer that is not looked at counts as one pair.
    """

    mismatched: list[MismatchedPair] = []
    left_out: int = 0


def compare(inside: Iterable[Participant], outside: Iterable[Participant]) -> Comparison:
    """Compare the readers and writers of a topic, of which one is inside and one outside.

    Each mismatch of the same two participants is there once for each topic or service.
    """
    insiders, not_looked_at_inside = _endpoints(inside)
    outsiders, not_looked_at_outside = _endpoints(outside)
    by_partner: defaultdict[tuple[str, EndpointKind], list[_Owned]] = defaultdict(list)
    for owned in outsiders:
        _, endpoint = owned
        by_partner[endpoint.topic, _OPPOSITE[endpoint.kind]].append(owned)
    by_address: defaultdict[str, list[Iterator[tuple[_Owned, _Owned]]]] = defaultdict(list)
    count = 0
    for owned in insiders:
        participant, endpoint = owned
        partners = by_partner.get((endpoint.topic, endpoint.kind), [])
        by_address[participant.address].append(zip(repeat(owned), partners))
        count += len(partners)
    pairs = _in_turn(map(_in_turn, by_address.values()))
    mismatched: dict[tuple[str, bytes, bytes, str], MismatchedPair] = {}
    for insider, outsider in islice(pairs, MOST_COMPARED):
        is_written_inside = insider[1].kind is EndpointKind.WRITER
        (source, writer), (sink, reader) = (
            (insider, outsider) if is_written_inside else (outsider, insider)
        )
        if reason := mismatch(writer, reader):
            key = ros_name(writer.topic), insider[0].prefix, outsider[0].prefix, reason.policy
            mismatched.setdefault(key, MismatchedPair(reason, writer.topic, source, sink))
    left_out = max(count - MOST_COMPARED, 0) + not_looked_at_inside + not_looked_at_outside
    return Comparison(list(mismatched.values()), left_out)


_Owned = tuple[Participant, DdsEndpoint]
_Item = TypeVar("_Item")


def _endpoints(side: Iterable[Participant]) -> tuple[list[_Owned], int]:
    """Return the readers and writers of a side in turn, and how many are not looked at.

    Equal ones of a participant count as one.
    """
    by_address: defaultdict[str, list[Iterator[_Owned]]] = defaultdict(list)
    count = 0
    for participant in side:
        owned = zip(repeat(participant), participant.endpoints.values())
        by_address[participant.address].append(owned)
        count += len(participant.endpoints)
    in_turn = islice(_in_turn(map(_in_turn, by_address.values())), MOST_LOOKED_AT)
    different = {
        (participant.prefix, endpoint): (participant, endpoint) for participant, endpoint in in_turn
    }
    return list(different.values()), max(count - MOST_LOOKED_AT, 0)


def _in_turn(sequences: Iterable[Iterable[_Item]]) -> Iterator[_Item]:
    """Yield the first item of each, then the second item of each, and so on."""
    waiting = deque(map(iter, sequences))
    while waiting:
        items = waiting.popleft()
        for item in items:
            yield item
            waiting.append(items)
            break


def _type(writer: DdsEndpoint, reader: DdsEndpoint) -> Mismatch | None:
    if writer.type_name == reader.type_name:
        return None
    return Mismatch("type", ros_type(writer.type_name), ros_type(reader.type_name))


def _partition(writer: DdsEndpoint, reader: DdsEndpoint) -> Mismatch | None:
    """Whether they have no partition in common; the default is the partition with an empty name."""
    offered = writer.qos.partitions
    requested = reader.qos.partitions
    if offered is None or requested is None:
        return None
    if any(_may_be_same_partition(*pair) for pair in product(offered or ("",), requested or ("",))):
        return None
    return Mismatch("partition", " ".join(offered) or "none", " ".join(requested) or "none")


def _may_be_same_partition(offered: str, requested: str) -> bool:
    """Whether two names of partitions match, or may: one may be a pattern, as of file names.

    Implementations differ in what patterns mean. If both are some, they match only if they are the
    same (DDS 1.4, 2.2.3.13).
    """
    wild = [bool(_WILDCARDS & {*name}) for name in (offered, requested)]
    return offered == requested or wild[0] != wild[1]


def _reliability(writer: DdsEndpoint, reader: DdsEndpoint) -> Mismatch | None:
    if writer.qos.reliable or not reader.qos.reliable:
        return None
    return Mismatch("reliability", "BEST_EFFORT", "RELIABLE")


def _durability(writer: DdsEndpoint, reader: DdsEndpoint) -> Mismatch | None:
    offered = writer.qos.durability
    requested = reader.qos.durability
    return Mismatch("durability", offered.name, requested.name) if offered < requested else None


def _deadline(writer: DdsEndpoint, reader: DdsEndpoint) -> Mismatch | None:
    return _longer("deadline", writer.qos.deadline, reader.qos.deadline)


def _liveliness(writer: DdsEndpoint, reader: DdsEndpoint) -> Mismatch | None:
    offered: Liveliness = writer.qos.liveliness
    requested: Liveliness = reader.qos.liveliness
    return Mismatch("liveliness", offered.name, requested.name) if offered < requested else None


def _liveliness_lease(writer: DdsEndpoint, reader: DdsEndpoint) -> Mismatch | None:
    name = "liveliness lease duration"
    return _longer(name, writer.qos.liveliness_lease, reader.qos.liveliness_lease)


def _ownership(writer: DdsEndpoint, reader: DdsEndpoint) -> Mismatch | None:
    if writer.qos.exclusive == reader.qos.exclusive:
        return None
    names = "SHARED", "EXCLUSIVE"
    return Mismatch("ownership", names[writer.qos.exclusive], names[reader.qos.exclusive])


def _representation(writer: DdsEndpoint, reader: DdsEndpoint) -> Mismatch | None:
    """Whether a reader does not take what a writer writes: its first kind (XTypes 1.3)."""
    offered = writer.qos.representations or (_XCDR,)
    requested = reader.qos.representations or (_XCDR,)
    if offered[0] in requested:
        return None
    names = [_REPRESENTATIONS.get(kind, str(kind)) for kind in (offered[0], *requested)]
    return Mismatch("data representation", names[0], " ".join(names[1:]))


def _longer(policy: str, offered: float, requested: float) -> Mismatch | None:
    """Whether the period that a writer offers is longer than the one that a reader requests."""
    if offered <= requested:
        return None
    return Mismatch(policy, *(_seconds_text(seconds) for seconds in (offered, requested)))


def _seconds_text(seconds: float) -> str:
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
