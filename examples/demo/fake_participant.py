"""A small DDS participant, as a ROS 2 node has: discovery, and a reliable topic.

The participant announces itself each second to given addresses (SPDP), and answers a new
participant with an announcement. Then both describe their writers and readers to each other (SEDP).
If topic and type match, the writer sends samples to the reader. Datagrams go to the locators in the
announcements of the receiver. This participant has two locators, with a socket for each: one for
discovery, one for user data.

The participant works with any DDS. It lacks liveliness, fragments, type descriptions and node
names, and never forgets another participant.
"""

from __future__ import annotations

import asyncio
import os
import struct
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from math import inf
from time import monotonic

from examples.demo.reliable_topics import ReliableReader, ReliableWriter
from examples.demo.rtps_messages import VENDOR, Told, data, message, parameter_list, string, told
from rosproxy.ros2.protocol.addressing import destination
from rosproxy.ros2.protocol.locators import pack_locator
from rosproxy.ros2.protocol.parameters import Pid
from rosproxy.ros2.protocol.rtps import VERSION, RtpsError, SubmessageId, samples, source_prefix
from rosproxy.ros2.registry.participants import EndpointKind
from rosproxy.ros2.rewriting.discovery import Announcement, BuiltinWriter, read_discovery
from rosproxy.shared.addresses import HostPort

ANNOUNCE_INTERVAL = 1.0
"""Seconds between announcements. Fast DDS waits three."""
HEARTBEAT_INTERVAL = 0.1
LEASE = 100
"""Lease duration in seconds: the default of DDS (9.6.3.2)."""
ALL_PARTICIPANTS = bytes(12)
PARTICIPANT = 0x000001C1
SPDP_READER = 0x000100C7
WRITER = 0x00000103
READER = 0x00000104
"""Entity ids of the writer and the reader. Their topic has no key (9.3.1.2)."""
TO_READER = 5
"""Difference between the entity ids of an SEDP writer and its reader."""
BUILT_IN = {BuiltinWriter.PUBLICATIONS: (0x04, 0x08), BuiltinWriter.SUBSCRIPTIONS: (0x10, 0x20)}
"""Bits for the writer and the reader of each kind of SEDP (9.3.2.12)."""
RELIABILITY = 0x1A
RELIABLE = struct.pack("<IiI", 2, 0, 0)
"""The only QoS policy that differs from the default of DDS."""
STRING_TYPE = "std_msgs::msg::dds_::String_"


@dataclass
class DdsPeer:
    """Another participant: locators for discovery and user data, time of the last announcement."""

    discovery: HostPort
    user: HostPort
    heard: float


class FakeParticipant(asyncio.DatagramProtocol):
    """A participant at an address; see the module. `start` needs a running event loop.

    `admits` decides by the source whether the participant accepts a datagram. `turned_away` counts
    the rejected datagrams. `peers` are the discovered participants by prefix. `locators` are for
    discovery and for user data, in this order.
    """

    def __init__(self, name: str, address: str, topic: str) -> None:
        self.name = name
        self.address = address
        self.prefix = VENDOR + os.urandom(10)
        self.dds_topic = f"rt{topic}"
        self.admits: Callable[[str], bool] = lambda _peer: True
        self.turned_away = 0
        self.peers: dict[bytes, DdsPeer] = {}
        self.writers = {writer.value: ReliableWriter(writer, durable=True) for writer in BUILT_IN}
        self.readers = {
            writer + TO_READER: ReliableReader(writer + TO_READER) for writer in BUILT_IN
        }
        self.locators: list[HostPort] = []
        self._announced_to: list[HostPort] = []
        self._own_locators: dict[bytes, HostPort] = {}
        self._sockets: list[asyncio.DatagramTransport] = []
        self._ticking: asyncio.Task[None] | None = None

    @property
    def listening(self) -> bool:
        """Whether the participant runs."""
        return bool(self._sockets)

    async def start(self) -> None:
        """Open both sockets."""
        loop = asyncio.get_running_loop()
        for _ in range(2):
            local_address = (self.address, 0)
            transport, _ = await loop.create_datagram_endpoint(lambda: self, local_address)
            self._sockets.append(transport)
            self.locators.append(HostPort(*transport.get_extra_info("sockname")))
        self._ticking = asyncio.create_task(self._tick())

    async def stop(self) -> None:
        """End without a dispose message."""
        if self._ticking:
            self._ticking.cancel()
            await asyncio.gather(self._ticking, return_exceptions=True)
        for transport in self._sockets:
            transport.close()
        self._sockets.clear()

    def announce_to(self, to: list[HostPort]) -> None:
        """Announce this participant at these addresses only, now and each second."""
        self._announced_to = to
        self._announce(to)

    def describe(self, entity: int, by: BuiltinWriter) -> None:
        """Describe the writer or reader to all participants."""
        parameters = [
            (Pid.ENDPOINT_GUID, self._guid(entity)),
            (Pid.TOPIC_NAME, string(self.dds_topic)),
            (Pid.TYPE_NAME, string(STRING_TYPE)),
            (RELIABILITY, RELIABLE),
        ]
        self.writers[by].write(parameter_list(parameters))

    def publish(self, payload: bytes) -> None:
        """Write a sample, and send it to all readers."""
        writer = self.writers[WRITER]
        writer.write(payload)
        for reader in writer.acknowledged:
            parts = writer.sample(reader, writer.last), writer.heartbeat(reader)
            self._send_to(reader, *parts)

    def hear(self, payload: bytes) -> None:
        """Process a sample of the topic."""

    def datagram_received(self, datagram: bytes, sender: tuple[str, int]) -> None:
        """Process a datagram of either socket."""
        if not self.admits(sender[0]):
            self.turned_away += 1
            return
        with suppress(RtpsError, struct.error, UnicodeDecodeError):
            if destination(datagram) in (None, self.prefix):
                self._take(datagram, source_prefix(datagram))

    def _announce(self, to: list[HostPort], meant: bytes = ALL_PARTICIPANTS) -> None:
        discovery, user = (pack_locator(locator, "<") for locator in self.locators)
        payload = parameter_list(
            [
                (Pid.PROTOCOL_VERSION, VERSION),
                (Pid.VENDOR_ID, VENDOR),
                (Pid.PARTICIPANT_GUID, self._guid(PARTICIPANT)),
                (Pid.METATRAFFIC_UNICAST_LOCATOR, discovery),
                (Pid.DEFAULT_UNICAST_LOCATOR, user),
                (Pid.PARTICIPANT_LEASE_DURATION, struct.pack("<iI", LEASE, 0)),
                (Pid.BUILTIN_ENDPOINT_SET, struct.pack("<I", 0x3F)),
            ]
        )
        spdp = data(SPDP_READER, BuiltinWriter.PARTICIPANTS, 1, payload)
        for locator in to:
            self._send(locator, meant, spdp)

    def _take(self, datagram: bytes, prefix: bytes) -> None:
        for announced in read_discovery(datagram).announcements:
            if announced.writer is BuiltinWriter.PARTICIPANTS:
                self._meet(prefix, announced, datagram)
            elif prefix in self.peers:
                self._match(prefix, announced, datagram)
        for sample in samples(datagram):
            writer = prefix + sample.writer.to_bytes(4, "big")
            for reader in self.readers.values():
                taken = reader.take(writer, sample.sequence)
                if taken and sample.payload and reader.entity == READER:
                    self.hear(datagram[sample.payload.start : sample.payload.end])
        for submessage in told(datagram):
            self._heed(prefix, submessage)

    def _meet(self, prefix: bytes, announced: Announcement, datagram: bytes) -> None:
        """Process a participant's announcement. Answer a new participant."""
        locators = dict(reversed([*announced.reached_at(datagram)]))
        discovery = locators.get(Pid.METATRAFFIC_UNICAST_LOCATOR)
        if discovery is None:
            return
        if prefix not in self.peers:
            self._announce([discovery], prefix)
        user = locators.get(Pid.DEFAULT_UNICAST_LOCATOR, discovery)
        self.peers[prefix] = DdsPeer(discovery, user, monotonic())
        has = announced.parameters.number(datagram, Pid.BUILTIN_ENDPOINT_SET) or 0
        for writer, (has_writer, has_reader) in BUILT_IN.items():
            if has & has_writer:
                self.readers[writer + TO_READER].match(prefix + writer.to_bytes(4, "big"))
            if has & has_reader:
                self.writers[writer].match(prefix + (writer + TO_READER).to_bytes(4, "big"))

    def _match(self, prefix: bytes, announced: Announcement, datagram: bytes) -> None:
        """Process the description of a reader or writer."""
        entity = announced.endpoint(datagram)
        type_name = announced.parameters.text(datagram, Pid.TYPE_NAME)
        if not entity or (announced.topic(datagram), type_name) != (self.dds_topic, STRING_TYPE):
            return
        guid = prefix + entity
        for _, locator in reversed([*announced.reached_at(datagram)]):
            self._own_locators[guid] = locator
        if announced.kind is EndpointKind.READER and WRITER in self.writers:
            self.writers[WRITER].match(guid)
        if announced.kind is EndpointKind.WRITER and READER in self.readers:
            self.readers[READER].match(guid)

    def _heed(self, prefix: bytes, submessage: Told) -> None:
        """Process a heartbeat or a gap for a reader, or an ACKNACK for a writer."""
        if submessage.kind == SubmessageId.ACKNACK:
            guid = prefix + submessage.reader.to_bytes(4, "big")
            if submessage.writer in self.writers and (
                again := self.writers[submessage.writer].heed(guid, submessage)
            ):
                self._send_to(guid, *again)
            return
        guid = prefix + submessage.writer.to_bytes(4, "big")
        for reader in self.readers.values():
            if guid in reader.expected:
                is_gap = submessage.kind == SubmessageId.GAP
                reader.skip(
                    guid,
                    *((submessage.first, submessage.last) if is_gap else (1, submessage.first - 1)),
                )
                if submessage.asks:
                    self._send_to(guid, reader.answer(guid, submessage.last))

    async def _tick(self) -> None:
        announced = -inf
        while True:
            if monotonic() - announced >= ANNOUNCE_INTERVAL:
                announced = monotonic()
                self._announce(self._announced_to)
            for writer in self.writers.values():
                for reader, got in writer.acknowledged.items():
                    if got < writer.last:
                        self._send_to(reader, writer.heartbeat(reader))
            await asyncio.sleep(HEARTBEAT_INTERVAL)

    def _guid(self, entity: int) -> bytes:
        return self.prefix + entity.to_bytes(4, "big")

    def _send_to(self, guid: bytes, *parts: bytes) -> None:
        """Send to the own locator of a reader or writer, otherwise to the participant's locator."""
        peer = self.peers[guid[:12]]
        is_built_in = guid[15] & 0xC0 == 0xC0
        usual = peer.discovery if is_built_in else peer.user
        self._send(self._own_locators.get(guid, usual), guid[:12], *parts)

    def _send(self, to: HostPort, meant: bytes, *parts: bytes) -> None:
        self._sockets[0].sendto(message(self.prefix, meant, *parts), (to.host, to.port))
