"""Participants: what the proxy knows of those inside and of those outside.

A participant is known by its GUID prefix, and only together with the address that it was found at:
each sender may write any prefix into a datagram.
"""

from collections import Counter
from dataclasses import dataclass, field
from enum import StrEnum
from sys import getsizeof
from typing import Generic, TypeVar

import msgspec

from rosproxy.access.rules import RuleKind
from rosproxy.net.addresses import HostPort
from rosproxy.ros2.protocol.addressing import is_destination
from rosproxy.ros2.protocol.qos import EndpointQos
from rosproxy.ros2.protocol.rtps import CYCLONE_DDS, FAST_DDS, NO_VENDOR, RTI

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
"""Names of implementations, by the vendor id in each message's header (OMG's list). Zero stands for
none; a proxy's own participants have it."""
PROCESS_LENGTHS = {FAST_DDS: 8, CYCLONE_DDS: 4}
"""Bytes that the GUID prefixes of all participants of a process begin with.

Fast DDS: GuidUtils.hpp; Cyclone DDS: ddsi_generate_participant_guid (ddsi_participant.c).

A process of these implementations has the port of its metatraffic locator for itself. Only sockets
for multicast have SO_REUSEADDR (Fast DDS: UDPv4Transport.cpp, UDPv6Transport.cpp; Cyclone DDS:
ddsi_udp.c).
"""
MOST_ENDPOINTS = 2048
MOST_ENDPOINT_BYTES_PER_ADDRESS = 4 * 1024 * 1024
MOST_ENDPOINT_BYTES = 32 * 1024 * 1024
"""Readers and writers of a participant that are remembered, which is for the status alone, and the
bytes that those at an address and on a side take."""
ENDPOINT_OVERHEAD = 500
"""Bytes that a reader or writer takes beside its texts."""


class TrafficKind(StrEnum):
    """What a participant announces a locator for: discovery, or user data.

    The proxy reads discovery at a port for user data as well, unless the participant ignores
    discovery there (`Participant.reads_discovery_at`).
    """

    METATRAFFIC = "metatraffic"
    USER_DATA = "data"


class EndpointKind(StrEnum):
    """What a participant has announced."""

    READER = "reader"
    WRITER = "writer"


class ShortageKind(StrEnum):
    """What there is too little of for a locator: ``RANGE``, or ``BOUND``, ports for one alone."""

    NONE = ""
    RANGE = "range"
    BOUND = "bound"


class PortShortage(msgspec.Struct, frozen=True):
    """Why a locator inside got no port."""

    kind: ShortageKind = ShortageKind.NONE
    text: str = ""


class DdsEndpoint(msgspec.Struct, frozen=True):
    """A reader or writer of a participant, as its SEDP tells."""

    kind: EndpointKind
    topic: str
    type_name: str
    qos: EndpointQos = EndpointQos()

    @property
    def size(self) -> int:
        """The bytes that it takes: one character may make all of a text take four bytes each."""
        texts = (self.topic, self.type_name, *(self.qos.partitions or ()))
        return ENDPOINT_OVERHEAD + sum(map(getsizeof, texts))


class DdsSecurity(StrEnum):
    """What a participant says of DDS Security. ``PROTECTED``: its discovery is, too."""

    NONE = ""
    AUTHENTICATED = "authenticated"
    PROTECTED = "protected"


class LocatorFault(StrEnum):
    """Why the proxy can't pass anything on to a participant, as its locators tell.

    ``TCP``: it has no UDP; ``LOOPBACK``: only addresses that mean its own machine; ``ELSEWHERE``:
    addresses, but not the one that it sends from; ``MISSING``: none at all.
    """

    NO = ""
    TCP = "tcp"
    LOOPBACK = "loopback"
    ELSEWHERE = "elsewhere"
    MISSING = "missing"


class ParticipantTraits(msgspec.Struct, frozen=True):
    """What a participant says of itself that may keep others from meeting it.

    ``domain`` is its domain's id, None if it does not say.
    """

    domain: int | None = None
    security: DdsSecurity = DdsSecurity.NONE
    locator_fault: LocatorFault = LocatorFault.NO


UNKNOWN_TRAITS = ParticipantTraits()
"""Of a participant that has said nothing yet."""


@dataclass(slots=True)
class PortMapping:
    """A port of the proxy that leads to one locator of a participant.

    A locator inside has a port of the range. A locator outside has a *stand-in*, a port that inside
    reaches. ``is_read`` (inside alone): a participant there may act on discovery. ``bytes`` and
    ``datagrams`` are those that were passed on; ``rate`` is in bytes per second, as of the last
    `sample`.
    """

    port: int
    target: HostPort
    kind: TrafficKind
    is_read: bool = False
    datagrams: int = 0
    bytes: int = 0
    rate: float = 0.0
    _sampled: tuple[float, int] = (0.0, 0)

    def sample(self, now: float) -> None:
        """Compute the rate since the last sample; ``now`` is in seconds."""
        last_time, last_bytes = self._sampled
        self._sampled = now, self.bytes
        if last_time and now > last_time:
            self.rate = round((self.bytes - last_bytes) / (now - last_time), 1)

    def note_passed(self, size: int) -> None:
        """Count a datagram of so many bytes that is passed on."""
        self.datagrams += 1
        self.bytes += size


@dataclass(slots=True)
class Participant:
    """What is known of a participant on either side.

    ``address`` is where it was found, ``until`` when it counts as gone unless it is heard again.
    ``announcement`` is its last SPDP datagram: of one inside as outside gets it, of one outside as
    it came, without what else the datagram held (`participant_alone`). ``next_number`` is the
    sequence number after that of the announcement. ``endpoints`` are by their entity ids,
    ``mappings`` by its locators.
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
    mappings: dict[HostPort, PortMapping] = field(default_factory=dict)

    @property
    def guid_prefix(self) -> str:
        """The GUID prefix as tools of DDS print it."""
        return ".".join(f"{byte:02x}" for byte in self.prefix)

    @property
    def vendor_name(self) -> str:
        """The implementation's name, or its id."""
        return VENDORS.get(self.vendor, self.vendor.hex())

    def reads_discovery_at(self, mapping: PortMapping) -> bool:
        """Whether the participant may act on discovery that arrives where a mapping leads.

        Fast DDS gives a datagram only to the readers that have the port among their own locators.
        The built-in readers have the ports for metatraffic alone (RTPSParticipantImpl.cpp,
        assignEndpoint2LocatorList; MessageReceiver.cpp, associated_readers_; from 1.8 to 3.2).
        Cyclone DDS finds the writer of a datagram in one table for all sockets (ddsi_receive.c,
        handle_submsg_sequence). Other implementations count as Cyclone DDS does.
        """
        return mapping.kind is TrafficKind.METATRAFFIC or self.vendor != FAST_DDS

    def note_vendor(self, vendor: bytes) -> bool:
        """Note the vendor in a later announcement. Return whether the vendor has changed.

        Another vendor outweighs Fast DDS, and the first other vendor stays. So a forger that
        announces the participant first, as one of Fast DDS, gains nothing for long.
        """
        if self.vendor != FAST_DDS or vendor == FAST_DDS:
            return False
        self.vendor = vendor
        return True


@dataclass(slots=True)
class EndpointNotes:
    """Notes the readers and writers of participants, within bounds for each address and in all.

    ``size_by_address`` and ``size`` are in bytes.
    """

    size_by_address: Counter[str] = field(default_factory=Counter)
    size: int = 0

    def note(self, participant: Participant, entity: bytes, endpoint: DdsEndpoint | None) -> None:
        """Remember a reader or writer; with None, that it has ended."""
        former = participant.endpoints.pop(entity, None)
        if former is not None:
            self._count(participant.address, -former.size)
        if endpoint is not None and self._has_room(participant, endpoint.size):
            participant.endpoints[entity] = endpoint
            self._count(participant.address, endpoint.size)

    def forget(self, participant: Participant) -> None:
        """Forget those of a participant that has gone."""
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

    ``verdicts``: whether the policy allows a topic or service, by rule; of its own endpoints and of
    those outside that it was to be told of; ``has_more_verdicts``: some are not remembered.
    ``proxy_address`` is the proxy's address on its network; ``is_in_group``: it was heard there by
    multicast. ``was_inside``: a former process served it, as more than its own word says.
    ``announced_at`` is when outside was last told of it.
    The rest is None if it does not apply (`Rediscovery`). ``separation_due_from``: since when it
    waits to be separated from outside. ``separated_until``: when the separation ends.
    ``dispose_message_times``: when it was last told to forget each participant outside, by prefix.
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
        """Whether nothing of discovery passes between it and outside."""
        return self.separation_due_from is not None or self.separated_until is not None

    @property
    def ports(self) -> list[int]:
        """The ports that it has, in the order in which they were given."""
        return [mapping.port for mapping in self.mappings.values()]


COMES_IN_WITHIN_S = 2.0
"""Seconds after which a participant that announces itself has sent discovery to the range."""
ANSWERED_FACTOR = 3
"""Bytes for each byte that has come, to a participant that has answered but not proved to receive.
Where DDS Security authenticates participants, they don't answer the question that proves it."""


@dataclass(slots=True)
class OutsideParticipant(Participant):
    """A participant outside, with a stand-in for each locator that inside does not reach by itself.

    A participant may be sent anything if it is ``trusted``, at a peer's address, or its address is
    ``proven`` to receive. All others are sent no more bytes than came from there; ``credit`` is how
    many are left. ``has_answered``: it has named the proxy's participant, or one inside, and may be
    sent `ANSWERED_FACTOR` times as much. ``has_come_in``: discovery from it has arrived at a port
    of the range. ``is_announced``: participants inside are told of it. ``announcement_inside`` is
    the announcement as inside gets it, with the proxy's address inside for which it is made.
    ``met_at`` and ``heard_at`` are when it announced itself for the first and for the last time.
    """

    trusted: bool = False
    proven: bool = False
    has_answered: bool = False
    has_come_in: bool = False
    is_announced: bool = False
    announcement_inside: tuple[str, bytes] | None = None
    credit: int = 0
    met_at: float = 0.0
    heard_at: float = 0.0

    @property
    def is_known(self) -> bool:
        """Whether its address is a peer's, or has proved to receive."""
        return self.trusted or self.proven

    @property
    def comes_in(self) -> bool:
        """Whether discovery from it arrives at ports of the range, or still may.

        A participant that does not announce itself again may have crashed at once.
        """
        return self.has_come_in or self.heard_at - self.met_at < COMES_IN_WITHIN_S

    def note_received(self, datagram: bytes, size: int, addressee: bytes) -> None:
        """Note a message of the participant's, for which ``size`` bytes have come.

        A message to ``addressee`` answers one of the proxy's. A forger on the LAN can send it too,
        where it hears the same announcements. Raises RtpsError.
        """
        if not self.has_answered and is_destination(datagram, addressee):
            self.has_answered = True
        self.credit += size * (ANSWERED_FACTOR if self.has_answered else 1)

    def may_be_sent(self, size: int) -> bool:
        """Whether so many bytes may go to it; if so, they are taken off its credit."""
        if self.is_known:
            return True
        if self.credit < size:
            return False
        self.credit -= size
        return True


AnyParticipant = TypeVar("AnyParticipant", bound=Participant)


@dataclass(slots=True, kw_only=True)
class ParticipantTable(Generic[AnyParticipant]):
    """The participants of one side by GUID prefix, and how many there are at each address.

    ``notes`` holds how many readers and writers of theirs are remembered.
    """

    by_prefix: dict[bytes, AnyParticipant] = field(default_factory=dict)
    count_by_address: Counter[str] = field(default_factory=Counter)
    notes: EndpointNotes = field(default_factory=EndpointNotes)

    def find(self, prefix: bytes, source: str) -> AnyParticipant | None:
        """The participant with a prefix, if it is at the address that a datagram came from."""
        participant = self.by_prefix.get(prefix)
        return participant if participant is not None and participant.address == source else None

    def at(self, address: str) -> list[AnyParticipant]:
        """The participants at an address."""
        if address not in self.count_by_address:
            return []
        return [p for p in self.by_prefix.values() if p.address == address]

    def former_processes(self, prefix: bytes, address: str) -> list[AnyParticipant]:
        """The participants of processes that had the port which a participant has now.

        Empty if the participant is unknown, or if other processes may have the port as well.
        """
        holder = self.find(prefix, address)
        if holder is None or holder.metatraffic is None:
            return []
        length = PROCESS_LENGTHS.get(holder.vendor)
        return [
            participant
            for participant in self.at(address)
            if length is not None
            and participant.vendor in PROCESS_LENGTHS
            and participant.metatraffic == holder.metatraffic
            and participant.prefix[:length] != prefix[:length]
        ]

    def add(self, participant: AnyParticipant) -> None:
        """Add a participant that has come."""
        self.by_prefix[participant.prefix] = participant
        self.count_by_address[participant.address] += 1

    def remove(self, participant: AnyParticipant) -> None:
        """Forget a participant that has gone."""
        del self.by_prefix[participant.prefix]
        self.notes.forget(participant)
        self.count_by_address[participant.address] -= 1
        if not self.count_by_address[participant.address]:
            del self.count_by_address[participant.address]
