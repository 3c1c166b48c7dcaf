"""DDS discovery: read announcements, and replace the locators in them.

Participants discover each other by SPDP, and each other's readers and writers by SEDP. Both consist
of samples of builtin writers, which have fixed entity ids (DDSI-RTPS 2.5, 8.5 and 9.3.1.2). The
payload of such a sample is a parameter list.

In an *announcement* the proxy replaces, keeps or removes each unicast locator of UDP
(`LocatorRedirect`), and removes all other locators. Multicast locators end at the next router. The
proxy can't pass on data of other transports, such as shared memory. The proxy also removes the
parameters by which Fast DDS recognises programs on the same machine. All other bytes stay.

The proxy turns a hidden announcement into a GAP. Otherwise the reader would request the
announcement again and again.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from enum import IntEnum

import msgspec

from rosproxy.ros2.protocol.locators import read_locator, replaced
from rosproxy.ros2.protocol.parameters import (
    OLD_LOCATORS,
    FastDdsPid,
    Parameter,
    ParameterList,
    Pid,
    inline_parameters,
    payload_parameters,
)
from rosproxy.ros2.protocol.reliable import withheld
from rosproxy.ros2.protocol.rtps import (
    FAST_DDS,
    HEADER_BYTES,
    NO_VENDOR,
    PREFIX_BYTES,
    Fragments,
    Overwrite,
    RtpsError,
    Sample,
    SubmessageId,
    apply,
    by_source,
    has_checksum,
    samples,
    source_prefix,
    source_vendor,
    submessages,
)
from rosproxy.ros2.registry.participants import EndpointKind
from rosproxy.shared.addresses import HostPort

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
_IDENTITIES = (Pid.PARTICIPANT_GUID, Pid.ENDPOINT_GUID, Pid.KEY_HASH)
"""Parameters that name the participant, reader or writer of an announcement. Each value begins with
a GUID prefix. Receivers act on these values, whatever the source of the message is (Fast DDS:
EDPSimplePUBListener)."""
FAST_DDS_PARAMETER_VENDORS = (FAST_DDS, NO_VENDOR)
"""Vendors whose vendor-specific parameters Fast DDS interprets."""
_DISPOSED_OR_UNREGISTERED = 0x03
LONGEST_SPDP_DATAGRAM_BYTES = 8192
"""Bytes of a datagram in which a participant announces itself. The proxy keeps this datagram. Some
participants send 1,500 bytes."""
_FOREIGN_ANNOUNCEMENT = "the datagram announces another participant than its sender"
LONGEST_TOPIC_BYTES = 255
"""Bytes of a topic's name, without the zero byte at its end. Fast DDS cuts longer names, or refuses
these (CDRMessage.hpp, readString). Names of ROS 2 are not longer."""
MOST_PARAMETERS_OF_ALL = 4096
"""Parameters of all announcements in a datagram. The announcement of a reader or writer has 25
parameters in 600 bytes, so a datagram of 64 KiB has 2,700."""
MOST_LOCATORS_OF_ALL = 1024
"""Locators of all announcements in a datagram. Fast DDS announces five for a reader or writer."""


class BuiltinWriter(IntEnum):
    """The builtin writers that discovery uses."""

    PARTICIPANTS = 0x000100C2
    PUBLICATIONS = 0x000003C2
    SUBSCRIPTIONS = 0x000004C2


_BUILTIN_WRITERS = frozenset(writer.value for writer in BuiltinWriter)

_KINDS = {
    BuiltinWriter.PUBLICATIONS: EndpointKind.WRITER,
    BuiltinWriter.SUBSCRIPTIONS: EndpointKind.READER,
}

LocatorRedirect = Callable[[int, HostPort], HostPort | None]
"""Returns the target for a locator, from the parameter's id and the present target. None removes
the locator."""


class Announcement(msgspec.Struct, frozen=True):
    """The announcement of a participant, or of one of its readers or writers.

    ``parameters`` are the parameters of the payload; none if the announcement only reports an end.
    ``inline_parameters`` are those of the inline QoS. ``ended`` means that the participant, reader
    or writer is disposed or unregistered.
    """

    writer: BuiltinWriter
    sample: Sample
    parameters: ParameterList
    inline_parameters: ParameterList | None
    ended: bool

    @property
    def kind(self) -> EndpointKind | None:
        """Whether a reader or a writer is announced; None for a participant."""
        return _KINDS.get(self.writer)

    def topic(self, datagram: bytes) -> str:
        """The DDS topic of the reader or writer; empty if the announcement names none."""
        return self.parameters.text(datagram, Pid.TOPIC_NAME) or ""

    def endpoint(self, datagram: bytes) -> bytes | None:
        """The entity id of the reader or writer; None if the announcement names none.

        If the reader or writer has ended, its key is in the payload or in the inline QoS (9.6.3.8).
        """
        for parameters in (self.parameters, self.inline_parameters):
            for parameter in parameters.all(Pid.ENDPOINT_GUID, Pid.KEY_HASH) if parameters else ():
                if parameter.value.end - parameter.value.start >= 16:
                    return datagram[parameter.value.start + 12 : parameter.value.start + 16]
        return None

    @property
    def locator_count(self) -> int:
        """The number of locators of all kinds."""
        return len(self.parameters.all(*UNICAST, *MULTICAST))

    def reached_at(self, datagram: bytes) -> Iterator[tuple[int, HostPort]]:
        """Yield the unicast locators of UDP, each after the id of its parameter."""
        for parameter in self.parameters.all(*UNICAST):
            locator = read_locator(datagram, self.parameters, parameter)
            host_port = locator.host_port if locator else None
            if host_port:
                yield parameter.pid, host_port


@dataclass(slots=True)
class ContentCounts:
    """The numbers of parameters and locators in all announcements that a datagram leads to."""

    parameters: int = 0
    locators: int = 0

    def add(self, announcement: Announcement) -> None:
        """Count an announcement. Raises RtpsError if there are too many parameters or locators."""
        self.parameters += len(announcement.parameters.parameters)
        self.locators += announcement.locator_count
        if self.parameters > MOST_PARAMETERS_OF_ALL:
            raise RtpsError(f"the datagram has more than {MOST_PARAMETERS_OF_ALL} parameters")
        if self.locators > MOST_LOCATORS_OF_ALL:
            raise RtpsError(f"the datagram has more than {MOST_LOCATORS_OF_ALL} locators")


class DiscoveryMessage(msgspec.Struct, frozen=True):
    """A message of a participant, with the announcements in the message.

    ``fragments`` are parts of announcements. The proxy reads an announcement when all its parts
    have come.
    """

    datagram: bytes
    prefix: bytes
    announcements: tuple[Announcement, ...]
    fragments: tuple[tuple[Sample, Fragments], ...]

    @property
    def of_participant(self) -> Announcement | None:
        """The last announcement of the participant itself (SPDP); None if the message has none."""
        spdp = (a for a in reversed(self.announcements) if a.writer is BuiltinWriter.PARTICIPANTS)
        return next(spdp, None)


def read_discovery(datagram: bytes) -> DiscoveryMessage:
    """Read the announcements in a datagram.

    Raises RtpsError if the datagram or an announcement is malformed, or if an announcement is from
    or about another participant than the sender. Raises RtpsError also for a checksum, and for a
    message with SPDP of more than LONGEST_SPDP_DATAGRAM_BYTES.
    """
    prefix = source_prefix(datagram)
    builtin_samples = [sample for sample in samples(datagram) if sample.writer in _BUILTIN_WRITERS]
    if any(sample.prefix != prefix for sample in builtin_samples):
        raise RtpsError(_FOREIGN_ANNOUNCEMENT)
    if builtin_samples and has_checksum(datagram):
        raise RtpsError("the discovery has a checksum, so the proxy can't rewrite the discovery")
    for sample in builtin_samples:  # fragments have inline QoS as well
        _require_own(datagram, sample, inline_parameters(datagram, sample))
    message = DiscoveryMessage(
        datagram,
        prefix,
        _announcements(datagram, [s for s in builtin_samples if s.fragments is None]),
        tuple((s, s.fragments) for s in builtin_samples if s.fragments is not None),
    )
    if len(datagram) > LONGEST_SPDP_DATAGRAM_BYTES and message.of_participant is not None:
        text = f"the announcement of a participant has {len(datagram)} bytes"
        raise RtpsError(f"{text}, at most {LONGEST_SPDP_DATAGRAM_BYTES} are accepted")
    return message


def read_messages(datagram: bytes) -> Iterator[DiscoveryMessage]:
    """Yield the message of each participant in a datagram. Raises RtpsError."""
    yield from map(read_discovery, by_source(datagram))


def credited_messages(datagram: bytes, received: int) -> Iterator[tuple[DiscoveryMessage, int]]:
    """Yield the message of each participant, and the count of received bytes for the message.

    The messages together may be longer than the datagram (`by_source`). The sum of the counts is at
    most ``received``. So a datagram of several messages earns no additional credit. Raises
    RtpsError.
    """
    for message in read_messages(datagram):
        credited = min(len(message.datagram), received)
        received -= credited
        yield message, credited


def rewritten(
    message: DiscoveryMessage, redirect: LocatorRedirect, is_hidden: Callable[[Announcement], bool]
) -> bytes:
    """The message with replaced locators, and with a GAP for each hidden announcement.

    Raises ValueError if ``redirect`` returns a host that is no address.
    """
    edits = list[Overwrite]()
    for announcement in message.announcements:
        if is_hidden(announcement):
            edits.append(withheld(announcement.sample))
        else:
            edits += _edits(message.datagram, announcement.parameters, redirect)
    return apply(message.datagram, edits)


def participant_alone(message: DiscoveryMessage) -> bytes:
    """The SPDP announcement in a message, without other submessages and without a destination.

    If the message has no SPDP announcement, the result is the header alone.

    Cyclone DDS answers the discovery participant with an announcement for this participant alone
    (ddsi_discovery_spdp.c, respond_to_spdp). Without the destination, all participants accept the
    announcement. The message may also announce readers and writers. The participants then request
    these announcements again (DDSI-RTPS 2.5, 8.4.9).
    """
    datagram = message.datagram
    spdp = message.of_participant
    kept = datagram[:HEADER_BYTES]
    if spdp is None:
        return kept
    stamp = b""
    for kind, _, body in submessages(datagram):
        if kind == SubmessageId.INFO_TS:
            stamp = datagram[body.start - 4 : body.end]
        if body == spdp.sample.body:
            return kept + stamp + datagram[body.start - 4 : body.end]
    return kept


def require_rewritable(message: DiscoveryMessage) -> None:
    """Raise RtpsError unless the proxy can rewrite and hide all announcements in a message.

    Call this before the proxy keeps the message, because the proxy rewrites a kept message again
    and again. Fragments count as not rewritable: the proxy reads fragments only when all have come,
    and the announcement of a participant does not wait for that.
    """
    if message.fragments:
        raise RtpsError("the message by which a participant announces itself has fragments")
    rewritten(message, lambda *_: None, lambda a: bool(a.topic(message.datagram)))


def _announcements(datagram: bytes, builtin_samples: Iterable[Sample]) -> tuple[Announcement, ...]:
    """The announcements in samples.

    Raises RtpsError if an announcement is malformed, or if all together have too many parameters.
    """
    announcements = list[Announcement]()
    contents = ContentCounts()
    for sample in builtin_samples:
        announcement = _announcement(datagram, sample)
        contents.add(announcement)
        announcements.append(announcement)
    return tuple(announcements)


def _announcement(datagram: bytes, sample: Sample) -> Announcement:
    parameters = payload_parameters(datagram, sample)
    inline = inline_parameters(datagram, sample)
    ended = sample.is_key_only or _reports_end(datagram, inline)
    # An end may have no payload. A payload has to be a parameter list, because the list may name
    # another participant (`_require_own`).
    if parameters is None and (sample.payload or not ended):
        raise RtpsError("an announcement is not a parameter list")
    parameters = parameters or ParameterList(sample.is_little_endian, ())
    _require_own(datagram, sample, parameters)
    _require_clear_topic(datagram, parameters)
    is_endpoint = sample.writer in _KINDS
    if is_endpoint and not ended and not parameters.text(datagram, Pid.TOPIC_NAME):
        raise RtpsError("a reader or writer has no topic")
    return Announcement(BuiltinWriter(sample.writer), sample, parameters, inline, ended)


def _require_clear_topic(datagram: bytes, parameters: ParameterList) -> None:
    """Raise RtpsError if receivers may read another topic than the one that the policy judges.

    Fast DDS reads a topic up to the first zero byte, also beyond the length of the string and of
    the parameter (CDRMessage.hpp, readString).
    """
    topics = parameters.all(Pid.TOPIC_NAME)
    if len(topics) > 1:
        raise RtpsError("an announcement names more than one topic")
    for topic in topics:
        size = parameters.number(datagram, Pid.TOPIC_NAME) or 0
        end = topic.value.start + 4 + size
        if not 0 < size <= LONGEST_TOPIC_BYTES + 1:
            text = f"the name of a topic has {size} bytes with its zero byte, not 1 to "
            raise RtpsError(f"{text}{LONGEST_TOPIC_BYTES + 1}")
        if end > topic.value.end or datagram[end - 1]:
            raise RtpsError("the name of a topic does not end with a zero byte")


def _require_own(datagram: bytes, sample: Sample, parameters: ParameterList | None) -> None:
    """Raise RtpsError if an announcement names another participant than the sample's source."""
    for parameter in parameters.all(*_IDENTITIES) if parameters else ():
        start = parameter.value.start
        end = parameter.value.end
        if datagram[start : min(start + PREFIX_BYTES, end)] != sample.prefix:
            raise RtpsError(_FOREIGN_ANNOUNCEMENT)


def _reports_end(datagram: bytes, inline_qos: ParameterList | None) -> bool:
    """Whether the inline QoS reports the end of a participant, reader or writer (9.6.3.9)."""
    for param in inline_qos.all(Pid.STATUS_INFO) if inline_qos else ():
        if param.value.end - param.value.start >= 4:
            # Four octets without a byte order. The last octet has the flags.
            status = int.from_bytes(datagram[param.value.start : param.value.start + 4], "big")
            return bool(status & _DISPOSED_OR_UNREGISTERED)
    return False


def _edits(
    datagram: bytes, parameters: ParameterList, redirect: LocatorRedirect
) -> Iterator[Overwrite]:
    for parameter in parameters.all(*UNICAST, *MULTICAST):
        target = _target(datagram, parameters, parameter, redirect)
        yield replaced(parameters, parameter, target) if target else parameters.removed(parameter)
    yield from (parameters.removed(parameter) for parameter in parameters.all(*OLD_LOCATORS))
    if source_vendor(datagram) in FAST_DDS_PARAMETER_VENDORS:
        yield from _edits_of_machine(parameters)


def _edits_of_machine(parameters: ParameterList) -> Iterator[Overwrite]:
    """Yield the edits that stop Fast DDS from assuming that two participants share a machine.

    Two containers may have the same machine id and the same MAC addresses, from which the id for
    data sharing follows. The participants would use shared memory, and no message would leave the
    machine. A participant on the proxy's machine would replace the locators by loopback
    (UDPv4Transport.cpp, transform_remote_locator).
    """
    yield from map(parameters.removed, parameters.all(FastDdsPid.MACHINE_ID))
    yield from map(parameters.removed, parameters.all(FastDdsPid.DATA_SHARING))
    yield from map(parameters.zeroed, parameters.all(FastDdsPid.NETWORK_CONFIGURATION))


def _target(
    datagram: bytes, parameters: ParameterList, parameter: Parameter, redirect: LocatorRedirect
) -> HostPort | None:
    """The target for a locator; None if the edit removes the locator."""
    locator = read_locator(datagram, parameters, parameter)
    if locator is None or locator.host_port is None or parameter.pid in MULTICAST:
        return None
    return redirect(parameter.pid, locator.host_port)
