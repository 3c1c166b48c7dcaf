"""DDS discovery: who says what of itself, and its locators led elsewhere.

Participants find each other by SPDP and tell each other of their readers and writers by SEDP. Both
are samples of built-in writers, known by their entity ids (DDSI-RTPS 2.5, 8.5 and 9.3.1.2), whose
payload is a parameter list. What an *announcement* says goes on as it is but for its locators:
each that a participant can be reached at is led elsewhere, and all others are taken out. These are
multicast ones, which end at the next router, and those of transports that can't be passed on
(shared memory). One that is to be hidden goes on as a GAP, so that its reader does not ask for it
again and again.
"""

from collections.abc import Callable, Iterator
from enum import IntEnum

import msgspec

from rosproxy.net.addresses import HostPort
from rosproxy.ros2.protocol.locators import read_locator, replaced
from rosproxy.ros2.protocol.parameters import (
    Parameter,
    ParameterList,
    Pid,
    inline_parameters,
    payload_parameters,
)
from rosproxy.ros2.protocol.reliable import withheld
from rosproxy.ros2.protocol.rtps import (
    Fragments,
    Overwrite,
    RtpsError,
    Sample,
    apply,
    samples,
    source_prefix,
)
from rosproxy.ros2.registry.participants import EndpointKind

UNICAST = (
    Pid.UNICAST_LOCATOR,
    Pid.DEFAULT_UNICAST_LOCATOR,
    Pid.METATRAFFIC_UNICAST_LOCATOR,
)
MULTICAST = (
    Pid.MULTICAST_LOCATOR,
    Pid.DEFAULT_MULTICAST_LOCATOR,
    Pid.METATRAFFIC_MULTICAST_LOCATOR,
)
_DISPOSED_OR_UNREGISTERED = 0x03
LONGEST_OF_PARTICIPANT = 8192
"""Bytes of a datagram in which a participant announces itself, which is kept; some have 1,500."""
LONGEST_TOPIC = 1024
"""Bytes of a topic's name; those of ROS 2 have 255."""


class BuiltinWriter(IntEnum):
    """The writers of discovery."""

    PARTICIPANTS = 0x000100C2
    PUBLICATIONS = 0x000003C2
    SUBSCRIPTIONS = 0x000004C2


_BUILTIN_WRITERS = frozenset(writer.value for writer in BuiltinWriter)

_KINDS = {
    BuiltinWriter.PUBLICATIONS: EndpointKind.WRITER,
    BuiltinWriter.SUBSCRIPTIONS: EndpointKind.READER,
}

Lead = Callable[[int, HostPort], HostPort | None]
"""Where a locator is to lead, given its parameter's id and where it leads; None: take it out."""


class Announcement(msgspec.Struct, frozen=True):
    """What a participant says of itself, or of one of its readers or writers.

    ``held`` are the parameters; none if it only tells an end. ``in_front`` are those of the inline
    QoS. ``ended``: it is disposed of, or unregistered.
    """

    writer: BuiltinWriter
    sample: Sample
    held: ParameterList
    in_front: ParameterList | None
    ended: bool

    @property
    def kind(self) -> EndpointKind | None:
        """What it is about, a reader or a writer; None if about the participant."""
        return _KINDS.get(self.writer)

    def topic(self, datagram: bytes) -> str:
        """The topic of DDS that its reader or writer is of; empty if it does not say."""
        return self.held.text(datagram, Pid.TOPIC_NAME) or ""

    def endpoint(self, datagram: bytes) -> bytes | None:
        """The entity id of the reader or writer that it is about; None if it does not say.

        What has ended is told by its key, in the payload or in front of it (9.6.3.8).
        """
        for held in (self.held, self.in_front):
            for one in held.all(Pid.ENDPOINT_GUID, Pid.KEY_HASH) if held else ():
                if one.value.end - one.value.start >= 16:
                    return datagram[one.value.start + 12 : one.value.start + 16]
        return None

    def reached_at(self, datagram: bytes) -> Iterator[tuple[int, HostPort]]:
        """The unicast locators of UDP, each with its parameter's id."""
        for parameter in self.held.all(*UNICAST):
            locator = read_locator(datagram, self.held, parameter)
            where = locator.where if locator else None
            if where:
                yield parameter.pid, where


class DiscoveryMessage(msgspec.Struct, frozen=True):
    """A message of a participant's, and what it announces of itself there.

    ``fragments`` are parts of announcements, which are read once these are whole.
    """

    datagram: bytes
    prefix: bytes
    announcements: tuple[Announcement, ...]
    fragments: tuple[tuple[Sample, Fragments], ...]

    @property
    def of_participant(self) -> Announcement | None:
        """What the participant says of itself, the last of it; None if nothing (SPDP)."""
        told = (
            one for one in reversed(self.announcements) if one.writer is BuiltinWriter.PARTICIPANTS
        )
        return next(told, None)


def read_discovery(datagram: bytes) -> DiscoveryMessage:
    """What a datagram announces.

    Raises RtpsError if it or an announcement is malformed, or is another participant's than the one
    that sends it.
    """
    prefix = source_prefix(datagram)
    found = [sample for sample in samples(datagram) if sample.writer in _BUILTIN_WRITERS]
    if any(sample.prefix != prefix for sample in found):
        raise RtpsError("it announces another participant than the one that sends it")
    message = DiscoveryMessage(
        datagram,
        prefix,
        tuple(_announcement(datagram, sample) for sample in found if sample.fragments is None),
        tuple((sample, sample.fragments) for sample in found if sample.fragments is not None),
    )
    if len(datagram) > LONGEST_OF_PARTICIPANT and message.of_participant is not None:
        raise RtpsError(f"a participant's announcement in {len(datagram)} bytes")
    return message


def rewritten(
    message: DiscoveryMessage, lead: Lead, is_hidden: Callable[[Announcement], bool]
) -> bytes:
    """The message with the locators in its announcements led elsewhere, and some of these hidden.

    Raises ValueError if ``lead`` gives a host that is no address.
    """
    edits = list[Overwrite]()
    for one in message.announcements:
        if is_hidden(one):
            edits.append(withheld(one.sample))
        else:
            edits += _edits(message.datagram, one.held, lead)
    return apply(message.datagram, edits)


def _announcement(datagram: bytes, sample: Sample) -> Announcement:
    held, in_front = payload_parameters(datagram, sample), inline_parameters(datagram, sample)
    ended = sample.key or _tells_an_end(datagram, in_front)
    if held is None and not ended:
        raise RtpsError("an announcement that is no parameter list")
    held = held or ParameterList(sample.little, ())
    topics = held.all(Pid.TOPIC_NAME)
    if len(topics) > 1:  # who reads which of them?
        raise RtpsError("an announcement that names more than one topic")
    if topics and topics[0].value.end - topics[0].value.start > LONGEST_TOPIC:
        raise RtpsError(f"a topic with a name of more than {LONGEST_TOPIC} bytes")
    return Announcement(BuiltinWriter(sample.writer), sample, held, in_front, ended)


def _tells_an_end(datagram: bytes, found: ParameterList | None) -> bool:
    """Whether the status in front of a sample says that what it is about has ended (9.6.3.9)."""
    for one in found.all(Pid.STATUS_INFO) if found else ():
        if one.value.end - one.value.start >= 4:
            status = int.from_bytes(datagram[one.value.start : one.value.start + 4], "big")
            return bool(status & _DISPOSED_OR_UNREGISTERED)
    return False


def _edits(datagram: bytes, held: ParameterList, lead: Lead) -> Iterator[Overwrite]:
    for parameter in held.all(*UNICAST, *MULTICAST):
        after = _after(datagram, held, parameter, lead)
        yield replaced(held, parameter, after) if after else held.removed(parameter)


def _after(
    datagram: bytes, held: ParameterList, parameter: Parameter, lead: Lead
) -> HostPort | None:
    """Where a locator leads afterwards; None if it is taken out."""
    locator = read_locator(datagram, held, parameter)
    if locator is None or locator.where is None or parameter.pid in MULTICAST:
        return None
    return lead(parameter.pid, locator.where)
