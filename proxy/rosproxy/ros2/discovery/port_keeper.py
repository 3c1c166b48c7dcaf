"""Which ports a participant has, kept where that outlasts the proxy: in the participant itself.

A reliable reader remembers, of each writer, the number of the next sample that it expects, and says
so when it is asked by a heartbeat (DDSI-RTPS 2.5, 8.3.8.6 and 8.4.9). So the proxy has a
participant, the *keeper*, with a writer of SEDP that never writes: it tells each participant inside
by a heartbeat that all samples before a number are gone, and the number holds its ports. The keeper
has the same GUID prefix in each process of the proxy, so that the next one asks, and is told.

The number is 1 for no ports; else it holds each port less the range's first, that of the first port
in the lowest bits, and a port that is added makes it greater, as it has to be. A range that is made
longer keeps its first port, and a port its bits, up to a length: so the keeper stays the same.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from hashlib import blake2b

from rosproxy.leases.ports import PortRange
from rosproxy.net.addresses import HostPort
from rosproxy.ros2.protocol.announcement import WRITER_ENDPOINTS, announcement
from rosproxy.ros2.protocol.reliable import acknowledged, heartbeat
from rosproxy.ros2.protocol.rtps import NO_VENDOR, PREFIX
from rosproxy.ros2.rewriting.discovery import BuiltinWriter

COUNTS_EACH_SECOND = 4
LEASE = 24 * 3600.0
"""Seconds for which participants remember the keeper without hearing it."""
_BITS = 62
"""Bits of a number that are used."""
_WIDTHS = (7, 10, 16)
"""Bits that a port may take, by how long the range is: 8, 6 or 3 ports are kept."""


@dataclass(slots=True)
class Keeper:
    """Keeps ports of a range in participants; ``prefix`` is its own.

    ``number_by_prefix`` is what each has answered last, by GUID prefix.
    """

    prefix: bytes
    ports: PortRange
    number_by_prefix: dict[bytes, int] = field(default_factory=dict)
    _first_count: int = 0
    _counts: dict[bytes, int] = field(default_factory=dict)

    @classmethod
    def of(cls, host: str, ports: PortRange, domain: int, started: float) -> "Keeper":
        """The keeper of a proxy, from its advertised host, its range's first port and its domain.

        ``started`` is Unix time: heartbeats to a participant are counted up from there, since it
        heeds only those with a greater count than the last, which another process may have sent.
        No process sends a participant more than `COUNTS_EACH_SECOND`.
        """
        identity = f"{host} {ports.first} {_width(ports)} {domain}"
        digest = blake2b(identity.encode(), digest_size=PREFIX - 2).digest()
        # A GUID prefix begins with the vendor's id (DDSI 2.2; so in Cyclone DDS, ddsi_init.c).
        return cls(NO_VENDOR + digest, ports, _first_count=int(started * COUNTS_EACH_SECOND))

    def questions(self, prefix: bytes, reached_at: HostPort) -> list[bytes]:
        """What asks a participant for its ports; ``reached_at`` is where it answers."""
        spdp = announcement(self.prefix, [reached_at], LEASE, WRITER_ENDPOINTS)
        return [spdp, self._heartbeat(prefix, 1)]

    def reminders(self, prefix: bytes, ports: Sequence[int], reached_at: HostPort) -> list[bytes]:
        """What makes a participant keep its ports; nothing if it does already."""
        if self.keeps(prefix, ports):
            return []
        spdp = announcement(self.prefix, [reached_at], LEASE, WRITER_ENDPOINTS)
        return [spdp, self._heartbeat(prefix, self.number(ports))]

    def keeps(self, prefix: bytes, ports: Sequence[int]) -> bool:
        """Whether a participant keeps all these ports."""
        return self.number_by_prefix.get(prefix, 0) >= self.number(ports)

    def take(self, prefix: bytes, datagram: bytes) -> bool:
        """Note what a participant answers; whether it is an answer. Raises RtpsError."""
        numbers = acknowledged(datagram, self.prefix, BuiltinWriter.PUBLICATIONS)
        for number in numbers:
            self.number_by_prefix[prefix] = number
        return bool(numbers)

    def former_ports(self, prefix: bytes) -> list[int]:
        """The ports that a participant has kept, in the order of its locators."""
        return list(self._ports(self.number_by_prefix.get(prefix, 1)))

    def forget(self, prefix: bytes) -> None:
        """Forget a participant that has gone."""
        self.number_by_prefix.pop(prefix, None)
        self._first_count = max(self._first_count, self._counts.pop(prefix, 0))  # it may come again

    def number(self, ports: Iterable[int]) -> int:
        """The number that holds these ports, as many of them as fit."""
        number, width = 0, _width(self.ports)
        for index, port in enumerate(ports):
            if (index + 1) * width <= _BITS:
                # The first port is 1: zero means that no port follows (`_ports`).
                number |= (port - self.ports.first + 1) << index * width
        return number + 1

    def _ports(self, number: int) -> Iterator[int]:
        """The ports that a number holds; none if it can't be one of `number`."""
        bits, width = number - 1, _width(self.ports)
        while bits > 0:
            port = self.ports.first + (bits & (1 << width) - 1) - 1
            if port not in self.ports:
                return
            yield port
            bits >>= width

    def _heartbeat(self, prefix: bytes, first: int) -> bytes:
        count = self._counts[prefix] = self._counts.get(prefix, self._first_count) + 1
        # A count is a signed number of 32 bits.
        return heartbeat(self.prefix, prefix, BuiltinWriter.PUBLICATIONS, first, count & 0x7FFFFFFF)


def _width(ports: PortRange) -> int:
    return next(width for width in _WIDTHS if len(ports) < 1 << width)
