"""Which writers and readers of a topic match, by the rules of DDS.

A writer *offers* and a reader *requests* QoS (DDS 1.4, 2.2.3). A writer and a reader match under
three conditions: topic and type are the same, both have a partition in common, and the writer
offers no less of each policy than the reader requests. Each side decides alone, and reports nothing
to the other. So a mismatch looks like silence. This module looks only at pairs of one endpoint
inside and one outside, because no other pairs pass the proxy.

Types are compared by name, as ROS 2 does. Two definitions of a type may have the same name.

A participant may have thousands of readers and writers, and so there may be millions of pairs. So
the addresses take turns, and the result counts what is left out. No address can prevent the
comparison of another address's pairs.
"""

from collections import defaultdict, deque
from collections.abc import Callable, Generator, Iterable, Iterator
from itertools import islice, repeat
from typing import TypeVar

import msgspec

from rosproxy.ros2.protocol.qos import Liveliness
from rosproxy.ros2.protocol.ros_names import ros_name, ros_type
from rosproxy.ros2.registry.participants import DdsEndpoint, EndpointKind, Participant

MOST_COMPARED_ENDPOINTS = 10_000
"""Readers and writers of a side that one comparison reads, in at most 0.1 s. A participant of ROS 2
has some tens. The addresses of the side take turns."""
MOST_COMPARED_PAIRS = 20_000
"""Pairs in one comparison. The addresses inside take turns, and so do the readers and writers of an
address. The endpoints outside of each pair follow in the order of the turns outside."""
ITEMS_PER_STEP = 500
"""Endpoints or pairs in a step of a comparison: some milliseconds."""
_OPPOSITE = {
    EndpointKind.READER: EndpointKind.WRITER,
    EndpointKind.WRITER: EndpointKind.READER,
}
_XCDR = 0
_REPRESENTATIONS = {0: "XCDR", 1: "XML", 2: "XCDR2"}


class Mismatch(msgspec.Struct, frozen=True):
    """Why a writer and a reader do not match: the policy, the offer, and the request."""

    policy: str
    offered: str
    requested: str


class MismatchedPair(msgspec.Struct, frozen=True):
    """A writer and a reader that do not match, with their participants, of which one is inside."""

    mismatch: Mismatch
    topic: str
    writer: Participant
    reader: Participant


def mismatch(writer: DdsEndpoint, reader: DdsEndpoint) -> Mismatch | None:
    """The first mismatch of a writer and a reader of the same topic; None if they match."""
    return next((reason for rule in _RULES if (reason := rule(writer, reader))), None)


class Comparison(msgspec.Struct, frozen=True):
    """The pairs that do not match, and how many pairs are not compared.

    A reader or writer that is left out counts as one pair.
    """

    mismatched: list[MismatchedPair] = []
    left_out: int = 0


def compare(inside: Iterable[Participant], outside: Iterable[Participant]) -> Comparison:
    """Compare the readers and writers inside with those outside, topic by topic.

    Two participants may have several pairs of the same topic or service that do not match by the
    same policy. Then the result has only the first of these pairs.
    """
    steps = comparison_steps(inside, outside)
    while True:
        try:
            next(steps)
        except StopIteration as end:
            comparison: Comparison = end.value
            return comparison


def comparison_steps(
    inside: Iterable[Participant], outside: Iterable[Participant]
) -> Generator[None, None, Comparison]:
    """The comparison of `compare` in steps of some milliseconds.

    The first step reads the two sides, so these may change between the steps.
    """
    looks = [_Endpoints(inside), _Endpoints(outside)]
    insiders = yield from _in_steps(looks[0].owned)
    outsiders = yield from _in_steps(looks[1].owned)
    by_partner: defaultdict[tuple[str, EndpointKind], list[_Owned]] = defaultdict(list)
    for number, owned in enumerate(outsiders, start=1):
        _, endpoint = owned
        by_partner[endpoint.topic, _OPPOSITE[endpoint.kind]].append(owned)
        if number % ITEMS_PER_STEP == 0:
            yield
    by_address: defaultdict[str, list[Iterator[tuple[_Owned, _Owned]]]] = defaultdict(list)
    count = 0
    for number, owned in enumerate(insiders, start=1):
        participant, endpoint = owned
        partners = by_partner.get((endpoint.topic, endpoint.kind), [])
        by_address[participant.address].append(zip(repeat(owned), partners))
        count += len(partners)
        if number % ITEMS_PER_STEP == 0:
            yield
    pairs = in_turn(map(in_turn, by_address.values()))
    mismatched: dict[tuple[str, bytes, bytes, str], MismatchedPair] = {}
    for number, pair in enumerate(islice(pairs, MOST_COMPARED_PAIRS), start=1):
        _note_mismatch(*pair, mismatched)
        if number % ITEMS_PER_STEP == 0:
            yield
    left_out = max(count - MOST_COMPARED_PAIRS, 0) + sum(look.left_out for look in looks)
    return Comparison(list(mismatched.values()), left_out)


_Owned = tuple[Participant, DdsEndpoint]
_Item = TypeVar("_Item")


def _note_mismatch(
    insider: _Owned,
    outsider: _Owned,
    mismatched: dict[tuple[str, bytes, bytes, str], MismatchedPair],
) -> None:
    """Add a pair to ``mismatched`` if it does not match, and if no such pair is there yet."""
    is_written_inside = insider[1].kind is EndpointKind.WRITER
    (source, writer), (sink, reader) = (
        (insider, outsider) if is_written_inside else (outsider, insider)
    )
    if reason := mismatch(writer, reader):
        key = ros_name(writer.topic), insider[0].prefix, outsider[0].prefix, reason.policy
        mismatched.setdefault(key, MismatchedPair(reason, writer.topic, source, sink))


class _Endpoints:
    """The readers and writers of a side in turn (``owned``), and how many are left out."""

    def __init__(self, side: Iterable[Participant]) -> None:
        by_address: defaultdict[str, list[Iterator[_Owned]]] = defaultdict(list)
        count = 0
        for participant in side:
            # A copy: the participant may have others in the next step.
            owned = zip(repeat(participant), list(participant.endpoints.values()))
            by_address[participant.address].append(owned)
            count += len(participant.endpoints)
        every = in_turn(map(in_turn, by_address.values()))
        self.owned = islice(every, MOST_COMPARED_ENDPOINTS)
        self.left_out = max(count - MOST_COMPARED_ENDPOINTS, 0)


def _in_steps(every: Iterable[_Owned]) -> Generator[None, None, list[_Owned]]:
    """The readers and writers in steps. Equal endpoints of a participant count as one."""
    different: dict[tuple[bytes, DdsEndpoint], _Owned] = {}
    for number, (participant, endpoint) in enumerate(every, start=1):
        different[participant.prefix, endpoint] = participant, endpoint
        if number % ITEMS_PER_STEP == 0:
            yield
    return list(different.values())


def in_turn(sequences: Iterable[Iterable[_Item]]) -> Iterator[_Item]:
    """Yield the first item of each sequence, then the second item of each sequence, and so on."""
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
    """The mismatch if there is no common partition. The default partition has an empty name.

    Some names are patterns, and implementations interpret patterns differently. So a pattern and a
    name that is none may match. Two patterns match only if both are the same (DDS 1.4, 2.2.3.13).
    """
    offered = writer.qos.partitions
    requested = reader.qos.partitions
    if offered is None or requested is None:
        return None
    offered = offered or ("",)
    requested = requested or ("",)
    kinds = {_is_pattern(name) for name in (*offered, *requested)}
    if len(kinds) > 1 or not set(offered).isdisjoint(requested):
        return None
    return Mismatch("partition", " ".join(offered) or "none", " ".join(requested) or "none")


def _is_pattern(partition: str) -> bool:
    """Whether the name of a partition may be a pattern."""
    return "*" in partition or "?" in partition or "[" in partition


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
    """The mismatch if the reader does not accept the writer's first representation (XTypes 1.3)."""
    offered = writer.qos.representations or (_XCDR,)
    requested = reader.qos.representations or (_XCDR,)
    if offered[0] in requested:
        return None
    names = [_REPRESENTATIONS.get(kind, str(kind)) for kind in (offered[0], *requested)]
    return Mismatch("data representation", names[0], " ".join(names[1:]))


def _longer(policy: str, offered: float, requested: float) -> Mismatch | None:
    """The mismatch if the offered period is longer than the requested period."""
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
