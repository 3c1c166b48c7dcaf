"""Participants: what the proxy knows about the participants inside and outside.

A GUID prefix and an address identify a participant together. A GUID prefix alone identifies
nothing, because each sender may write any prefix into a datagram.
"""

from collections import Counter
from dataclasses import dataclass, field
from enum import StrEnum
from sys import getsizeof
from typing import Generic, TypeVar

import msgspec

from rosproxy.ros2.protocol.addressing import is_destination
from rosproxy.ros2.protocol.qos import EndpointQos
from rosproxy.ros2.protocol.ros_names import GRAPH_TOPIC
from rosproxy.ros2.protocol.rtps import CYCLONE_DDS, FAST_DDS, NO_VENDOR, RTI
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.policy.rules import RuleKind

VENDORS = {
    NO_VENDOR: "rosproxy",
    RTI: "RTI Connext",
    b"\x01\x02": "OpenSplice",
    b"\x01\x03": "OpenDDS",
    FAST_DDS: "Fast DDS",
    CYCLONE_DDS: "Cyclone DDS",
    b"\x01\x12": "RustDDS",
    b"\x01\x14": "Dust DDS",
}
"""Names of implementations, by the vendor id in the header of each message (list of the OMG). The
proxy's own participants have the id zero, which means "unknown"."""
PROCESS_PREFIX_BYTES = {FAST_DDS: 8, CYCLONE_DDS: 4}
"""Bytes at the start of a GUID prefix that all participants of a process have in common.

Sources: Fast DDS: GuidUtils.hpp; Cyclone DDS: ddsi_generate_participant_guid (ddsi_participant.c).

With these implementations, no other process can bind the port of a process's metatraffic locator.
Only sockets for multicast have SO_REUSEADDR (Fast DDS: UDPv4Transport.cpp, UDPv6Transport.cpp;
Cyclone DDS: ddsi_udp.c)."""
MOST_ENDPOINTS = 2048
"""Readers and writers of a participant that the proxy remembers, only for status and findings."""
MOST_ENDPOINT_BYTES_PER_ADDRESS = 4 * 1024 * 1024
"""Bytes for the readers and writers of all participants at an address."""
MOST_ENDPOINT_BYTES = 32 * 1024 * 1024
"""Bytes for the readers and writers of a side."""
ENDPOINT_OVERHEAD = 500
"""Bytes that a reader or writer takes besides its texts."""


class TrafficKind(StrEnum):
    """The purpose of a locator: discovery or user data.

    The proxy also reads discovery at a port for user data, unless the participant ignores discovery
    there (`Participant.reads_discovery_at`).
    """

    METATRAFFIC = "metatraffic"
    USER_DATA = "data"


class EndpointKind(StrEnum):
    """Whether an endpoint is a reader or a writer."""

    READER = "reader"
    WRITER = "writer"


class ShortageKind(StrEnum):
    """Why a locator inside got no port.

    ``RANGE``: no port of the range is left for the locator. ``BOUND``: the participant has as many
    ports as one participant may have.
    """

    NONE = ""
    RANGE = "range"
    BOUND = "bound"


class PortShortage(msgspec.Struct, frozen=True):
    """The shortage of a participant with a locator that got no port; ``text`` is for the status."""

    kind: ShortageKind = ShortageKind.NONE
    text: str = ""


class DdsEndpoint(msgspec.Struct, frozen=True):
    """A reader or writer of a participant, as announced by SEDP.

    ``nodes``: the names of the participant's nodes, if the writer has told them (GRAPH_TOPIC).
    """

    kind: EndpointKind
    topic: str
    type_name: str
    qos: EndpointQos = EndpointQos()
    nodes: tuple[str, ...] = ()

    @property
    def size(self) -> int:
        """The bytes that the endpoint takes.

        A single wide character makes all characters of a text take four bytes each.
        """
        texts = (self.topic, self.type_name, *(self.qos.partitions or ()), *self.nodes)
        return ENDPOINT_OVERHEAD + sum(map(getsizeof, texts))


class DdsSecurity(StrEnum):
    """Whether a participant uses DDS Security. ``PROTECTED``: discovery is protected, too."""

    NONE = ""
    AUTHENTICATED = "authenticated"
    PROTECTED = "protected"


class LocatorFault(StrEnum):
    """Why the proxy can't pass datagrams to a participant, judging by its locators.

    ``TCP``: the locators are of TCP, and none is of UDP. ``LOOPBACK``: all UDP addresses are
    loopback addresses. ``ELSEWHERE``: the source of the announcement is not among the UDP
    addresses. ``MISSING``: there is no locator of UDP or TCP.
    """

    NO = ""
    TCP = "tcp"
    LOOPBACK = "loopback"
    ELSEWHERE = "elsewhere"
    MISSING = "missing"


class ParticipantTraits(msgspec.Struct, frozen=True):
    """The properties of a participant that may prevent its discovery by others.

    ``domain`` is the announced domain; None if the participant announces none.
    """

    domain: int | None = None
    security: DdsSecurity = DdsSecurity.NONE
    locator_fault: LocatorFault = LocatorFault.NO


UNKNOWN_TRAITS = ParticipantTraits()
"""The traits of a participant that has announced nothing yet."""


@dataclass(slots=True)
class PortMapping:
    """A port of the proxy that leads to one locator of a participant.

    A locator inside has a port of the range. A locator outside has a *stand-in*, a port that inside
    reaches. ``is_read`` (only inside) means that a participant at the locator may act on discovery.

    ``bytes`` and ``datagrams`` count all datagrams that the proxy has passed on. ``user_bytes`` and
    ``user_datagrams`` count only the datagrams with samples of user data. ``rate`` and
    ``user_rate`` are in bytes per second, ``user_datagram_rate`` in datagrams per second, as of the
    last `update_rates`.
    """

    port: int
    target: HostPort
    kind: TrafficKind
    is_read: bool = False
    datagrams: int = 0
    bytes: int = 0
    user_datagrams: int = 0
    user_bytes: int = 0
    rate: float = 0.0
    user_rate: float = 0.0
    user_datagram_rate: float = 0.0
    _rates_at: float = 0.0
    _counts_at_rates: tuple[int, int, int] = (0, 0, 0)

    def update_rates(self, now: float) -> None:
        """Compute the rates since the last call; the first call has none. ``now`` is in seconds."""
        counts = self.bytes, self.user_bytes, self.user_datagrams
        elapsed = now - self._rates_at
        if self._rates_at and elapsed > 0:
            self.rate, self.user_rate, self.user_datagram_rate = (
                round((count - last) / elapsed, 1)
                for count, last in zip(counts, self._counts_at_rates, strict=True)
            )
        self._rates_at = now
        self._counts_at_rates = counts

    def note_passed(self, size: int, has_samples: bool) -> None:
        """Count a datagram of ``size`` bytes that the proxy passes on.

        ``has_samples``: whether the datagram has samples of user data.
        """
        self.datagrams += 1
        self.bytes += size
        if has_samples:
            self.user_datagrams += 1
            self.user_bytes += size


@dataclass(slots=True)
class Participant:
    """A participant on either side.

    ``address`` is the source of its announcements. ``until`` is the time at which the participant
    counts as gone, unless it announces itself again. ``announcement`` is its last SPDP datagram,
    without other submessages (`participant_alone`). For a participant inside, this is the rewritten
    datagram for outside. For a participant outside, this is the received datagram. ``next_number``
    is the sequence number after that of the announcement. ``endpoints`` are by entity id, and
    ``mappings`` by locator. ``graph_writer`` is the entity id of the writer of GRAPH_TOPIC.
    """

    prefix: bytes
    address: str
    vendor: bytes
    until: float
    announcement: bytes = b""
    next_number: int = 1
    metatraffic: HostPort | None = None
    traits: ParticipantTraits = UNKNOWN_TRAITS
    endpoints: dict[bytes, DdsEndpoint] = field(default_factory=dict)
    graph_writer: bytes = b""
    mappings: dict[HostPort, PortMapping] = field(default_factory=dict)

    @property
    def guid_prefix(self) -> str:
        """The GUID prefix in the notation of DDS tools."""
        return ".".join(f"{byte:02x}" for byte in self.prefix)

    @property
    def vendor_name(self) -> str:
        """The name of the implementation, or the vendor id in hexadecimal."""
        return VENDORS.get(self.vendor, self.vendor.hex())

    def reads_discovery_at(self, mapping: PortMapping) -> bool:
        """Whether the participant may act on discovery that arrives at the target of a mapping.

        Fast DDS gives a datagram only to the readers that have the port among their locators. The
        builtin readers have only the ports for metatraffic (RTPSParticipantImpl.cpp,
        assignEndpoint2LocatorList; MessageReceiver.cpp, associated_readers_; from 1.8 to 3.2).
        Cyclone DDS finds the writer of a datagram in one table for all sockets (ddsi_receive.c,
        handle_submsg_sequence). Other implementations count as Cyclone DDS.
        """
        return mapping.kind is TrafficKind.METATRAFFIC or self.vendor != FAST_DDS

    def note_vendor(self, vendor: bytes) -> bool:
        """Note the vendor in a later announcement. Return whether the vendor has changed.

        Another vendor outweighs Fast DDS, and the first other vendor stays. So if a forger
        announces the participant first, as a participant of Fast DDS, the next true announcement
        corrects the vendor.
        """
        if self.vendor != FAST_DDS or vendor == FAST_DDS:
            return False
        self.vendor = vendor
        return True


@dataclass(slots=True)
class EndpointNotes:
    """The remembered readers and writers of participants, within bounds for each address and side.

    ``size_by_address`` and ``size`` are in bytes.
    """

    size_by_address: Counter[str] = field(default_factory=Counter)
    size: int = 0

    def note(self, participant: Participant, entity: bytes, endpoint: DdsEndpoint | None) -> None:
        """Remember a reader or writer; with None, forget a reader or writer that has ended.

        Without room, the reader or writer is not remembered, and a former entry is forgotten.
        """
        former = participant.endpoints.pop(entity, None)
        if former is not None:
            self._count(participant.address, -former.size)
        if endpoint is None:
            return
        if (endpoint.kind, endpoint.topic) == (EndpointKind.WRITER, GRAPH_TOPIC):
            participant.graph_writer = entity
            nodes = former.nodes if former is not None else endpoint.nodes
            endpoint = msgspec.structs.replace(endpoint, nodes=nodes)
        if self._has_room(participant, endpoint.size):
            participant.endpoints[entity] = endpoint
            self._count(participant.address, endpoint.size)

    def note_nodes(self, participant: Participant, nodes: tuple[str, ...]) -> None:
        """Remember the nodes that the ``graph_writer`` of a participant has told, if known."""
        endpoint = participant.endpoints.get(participant.graph_writer)
        if endpoint is not None and endpoint.nodes != nodes:
            self.note(participant, participant.graph_writer, None)
            named = msgspec.structs.replace(endpoint, nodes=nodes)
            self.note(participant, participant.graph_writer, named)

    def forget(self, participant: Participant) -> None:
        """Forget the readers and writers of a participant that has gone."""
        size = sum(endpoint.size for endpoint in participant.endpoints.values())
        self._count(participant.address, -size)
        participant.endpoints.clear()

    def _has_room(self, participant: Participant, size: int) -> bool:
        at_address = self.size_by_address[participant.address] + size
        return (
            len(participant.endpoints) < MOST_ENDPOINTS
            and at_address <= MOST_ENDPOINT_BYTES_PER_ADDRESS
            and self.size + size <= MOST_ENDPOINT_BYTES
        )

    def _count(self, address: str, change: int) -> None:
        self.size += change
        self.size_by_address[address] += change
        if not self.size_by_address[address]:
            del self.size_by_address[address]


@dataclass(slots=True)
class InsideParticipant(Participant):
    """A participant inside, with a port of the range for each of its locators.

    ``verdicts`` say whether the policy allows a topic or service, by kind of rule and name. There
    is a verdict for each endpoint of the participant, and for each endpoint outside that the proxy
    was to announce to the participant. ``has_more_verdicts`` means that the proxy does not remember
    all verdicts. ``proxy_address`` is the proxy's address on the network of the
    participant. ``is_in_group`` means that the participant was heard on this network by multicast.
    ``was_inside`` means that a former process of the proxy served the participant, by better
    evidence than the participant's own claim. ``announced_at`` is the time of the last announcement
    to outside.

    The other attributes belong to `Rediscovery`, and are None outside of a rediscovery.
    ``separation_due_from`` is the time from which the participant waits for its separation.
    ``separated_until`` is the end of the separation. ``dispose_message_times`` has the time of the
    last dispose message for each participant outside, by prefix.
    """

    verdicts: dict[tuple[RuleKind, str], bool] = field(default_factory=dict)
    has_more_verdicts: bool = False
    proxy_address: str = ""
    is_in_group: bool = False
    was_inside: bool = False
    announced_at: float = 0.0
    separation_due_from: float | None = None
    separated_until: float | None = None
    dispose_message_times: dict[bytes, float] | None = None

    @property
    def is_separated(self) -> bool:
        """Whether no discovery passes between the participant and outside."""
        return self.separation_due_from is not None or self.separated_until is not None

    @property
    def ports(self) -> list[int]:
        """The ports of the participant, in the order of their mapping."""
        return [mapping.port for mapping in self.mappings.values()]


COMES_IN_WITHIN_S = 2.0
"""Seconds in which discovery of a participant outside arrives at the range, if it arrives at all.
The time begins with the first announcement."""
ANSWERED_FACTOR = 3
"""Bytes that the proxy may send for each received byte, to a participant that has answered but
whose address is not proven. With authentication by DDS Security, participants do not answer the
question that proves the address."""


@dataclass(slots=True)
class OutsideParticipant(Participant):
    """A participant outside, with a stand-in for each locator that inside can't reach directly.

    The proxy may send any number of bytes to a participant that is ``trusted`` (at the address of a
    peer) or ``proven`` (at a proven address). To all others, the proxy sends no more bytes than
    came from the participant; ``credit`` is the number of bytes left. ``has_answered`` means that
    the participant has named the discovery participant, or a participant inside. The factor
    `ANSWERED_FACTOR` then applies to received bytes. ``has_come_in`` means that discovery of the
    participant has arrived at a port of the range. ``is_announced`` means that the proxy announces
    the participant inside. ``announcements_inside`` are the rewritten announcements, by the proxy's
    address for which each was rewritten. ``met_at`` and ``heard_at`` are the times of the first and
    the last announcement.
    """

    trusted: bool = False
    proven: bool = False
    has_answered: bool = False
    has_come_in: bool = False
    is_announced: bool = False
    announcements_inside: dict[str, bytes] = field(default_factory=dict)
    credit: int = 0
    met_at: float = 0.0
    heard_at: float = 0.0

    @property
    def is_known(self) -> bool:
        """Whether the address of the participant is that of a peer, or proven."""
        return self.trusted or self.proven

    @property
    def comes_in(self) -> bool:
        """Whether discovery of the participant arrives at ports of the range, or still may arrive.

        If the participant does not announce itself again, it counts as coming in: it may have
        crashed at once.
        """
        return self.has_come_in or self.heard_at - self.met_at < COMES_IN_WITHIN_S

    def note_received(self, datagram: bytes, size: int, addressee: bytes) -> None:
        """Note a message of the participant, for which ``size`` bytes have come.

        If the destination is ``addressee``, the message answers a participant of the proxy or
        inside. A forger on the LAN could send this message, too, because the forger hears the same
        announcements. Raises RtpsError.
        """
        if not self.has_answered and is_destination(datagram, addressee):
            self.has_answered = True
        self.credit += size * (ANSWERED_FACTOR if self.has_answered else 1)

    def take_credit(self, size: int) -> bool:
        """Return whether the proxy may send ``size`` bytes to the participant.

        If so, charge the credit, except for a participant that is trusted or proven.
        """
        if self.is_known:
            return True
        if self.credit < size:
            return False
        self.credit -= size
        return True


AnyParticipant = TypeVar("AnyParticipant", bound=Participant)


@dataclass(slots=True, kw_only=True)
class ParticipantTable(Generic[AnyParticipant]):
    """The participants of a side by GUID prefix, and their number at each address.

    ``notes`` bounds the remembered readers and writers of these participants.
    """

    by_prefix: dict[bytes, AnyParticipant] = field(default_factory=dict)
    count_by_address: Counter[str] = field(default_factory=Counter)
    notes: EndpointNotes = field(default_factory=EndpointNotes)
    _by_address: dict[str, dict[bytes, AnyParticipant]] = field(default_factory=dict)

    def find(self, prefix: bytes, source: str) -> AnyParticipant | None:
        """The participant with a prefix; None if there is none at this source address."""
        participant = self.by_prefix.get(prefix)
        return participant if participant is not None and participant.address == source else None

    def at(self, address: str) -> list[AnyParticipant]:
        """The participants at an address."""
        return list(self._by_address.get(address, {}).values())

    def former_processes(self, prefix: bytes, address: str) -> list[AnyParticipant]:
        """The participants of former processes at the port that a participant has now.

        Empty if the participant or its port is unknown, or if several processes may use the port.
        """
        holder = self.find(prefix, address)
        if holder is None or holder.metatraffic is None:
            return []
        length = PROCESS_PREFIX_BYTES.get(holder.vendor)
        return [
            participant
            for participant in self.at(address)
            if length is not None
            and participant.vendor in PROCESS_PREFIX_BYTES
            and participant.metatraffic == holder.metatraffic
            and participant.prefix[:length] != prefix[:length]
        ]

    def add(self, participant: AnyParticipant) -> None:
        """Add a participant."""
        self.by_prefix[participant.prefix] = participant
        self.count_by_address[participant.address] += 1
        self._by_address.setdefault(participant.address, {})[participant.prefix] = participant

    def remove(self, participant: AnyParticipant) -> None:
        """Remove a participant, with its readers and writers."""
        del self.by_prefix[participant.prefix]
        del self._by_address[participant.address][participant.prefix]
        self.notes.forget(participant)
        self.count_by_address[participant.address] -= 1
        if not self.count_by_address[participant.address]:
            del self.count_by_address[participant.address]
            del self._by_address[participant.address]
