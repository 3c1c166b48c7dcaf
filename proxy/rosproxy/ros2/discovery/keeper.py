"""Which ports a participant has, kept where it outlasts the proxy: in the participant itself.

A reliable reader remembers, of each writer, the number of the next sample that it expects, and says
so when it is asked by a heartbeat (DDSI-RTPS 2.5, 8.3.8.6 and 8.4.9). So the proxy has a
participant, the *keeper*, with a writer of SEDP that never writes: it tells each participant inside
by a heartbeat that all samples before a number are gone, and the number holds its ports. The keeper
has the same GUID prefix in each process of the proxy, so that the next one asks, and is told.

The number is 1 for nothing; else, of the ports less the range's first, the first port's is in the
lowest bits, and a port that is added makes it greater, as it has to be. A range that is made longer
keeps its first port, and a port has as many bits in it, up to a length: so the keeper stays who it
is.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from hashlib import blake2b

from rosproxy.leases.ports import PortRange
from rosproxy.net.addresses import HostPort
from rosproxy.ros2.protocol.announcement import WRITES, announcement
from rosproxy.ros2.protocol.reliable import acknowledged, heartbeat
from rosproxy.ros2.protocol.rtps import NO_VENDOR, PREFIX
from rosproxy.ros2.rewriting.discovery import BuiltinWriter

COUNTS_EACH_SECOND = 4
LEASE = 24 * 3600.0
"""Seconds for which participants remember the keeper without hearing it."""
_BITS = 62
"""Bits of a number that are used."""
_WIDTHS = (7, 10, 16)
"""Bits that a port may have, by how long the range is: 8, 6 or 3 ports are kept."""


@dataclass(slots=True)
class Keeper:
    """Keeps ports of a range in participants; ``prefix`` is its own.

    ``kept`` is what each has answered last, by GUID prefix.
    """

    prefix: bytes
    ports: PortRange
    kept: dict[bytes, int] = field(default_factory=dict)
    _first_count: int = 0
    _counts: dict[bytes, int] = field(default_factory=dict)

    @classmethod
    def of(cls, host: str, ports: PortRange, domain: int, started: float) -> "Keeper":
        """That of a proxy, known by its advertised host, its range's first port and its domain.

        ``started`` is Unix time: heartbeats to a participant are counted up from there, since it
        heeds only those that count more than the last, which another process may have sent. None
        sends one participant more than `COUNTS_EACH_SECOND`.
        """
        known = f"{host} {ports.first} {_width(ports)} {domain}"
        own = blake2b(known.encode(), digest_size=PREFIX - 2).digest()
        return cls(NO_VENDOR + own, ports, _first_count=int(started * COUNTS_EACH_SECOND))

    def questions(self, of: bytes, reached_at: HostPort) -> list[bytes]:
        """What asks a participant for its ports; ``reached_at`` is where it answers."""
        told = announcement(self.prefix, [reached_at], LEASE, WRITES)
        return [told, self._heartbeat(of, 1)]

    def reminders(self, of: bytes, ports: Sequence[int], reached_at: HostPort) -> list[bytes]:
        """What has a participant keep its ports; nothing if it does."""
        if self.keeps(of, ports):
            return []
        told = announcement(self.prefix, [reached_at], LEASE, WRITES)
        return [told, self._heartbeat(of, self.number(ports))]

    def keeps(self, of: bytes, ports: Sequence[int]) -> bool:
        """Whether a participant keeps all these ports, which it has."""
        return self.kept.get(of, 0) >= self.number(ports)

    def take(self, of: bytes, datagram: bytes) -> bool:
        """Take in what a participant answers; whether it does. Raises RtpsError."""
        numbers = acknowledged(datagram, self.prefix, BuiltinWriter.PUBLICATIONS)
        for number in numbers:
            self.kept[of] = number
        return bool(numbers)

    def had(self, of: bytes) -> list[int]:
        """The ports that a participant has kept, in the order of its locators."""
        return list(self._ports(self.kept.get(of, 1)))

    def forget(self, of: bytes) -> None:
        """Forget a participant that has gone."""
        self.kept.pop(of, None)
        self._first_count = max(self._first_count, self._counts.pop(of, 0))  # it may come again

    def number(self, ports: Iterable[int]) -> int:
        """What holds these ports, as many of them as fit."""
        number, width = 0, _width(self.ports)
        for index, port in enumerate(ports):
            if (index + 1) * width <= _BITS:
                number |= (port - self.ports.first + 1) << index * width
        return number + 1

    def _ports(self, number: int) -> Iterator[int]:
        """The ports that a number holds; none if it can't be one of `number`."""
        left, width = number - 1, _width(self.ports)
        while left > 0:
            port = self.ports.first + (left & (1 << width) - 1) - 1
            if port not in self.ports:
                return
            yield port
            left >>= width

    def _heartbeat(self, of: bytes, first: int) -> bytes:
        count = self._counts[of] = self._counts.get(of, self._first_count) + 1
        return heartbeat(self.prefix, of, BuiltinWriter.PUBLICATIONS, first, count & 0x7FFFFFFF)


def _width(ports: PortRange) -> int:
    return next(width for width in _WIDTHS if len(ports) < 1 << width)
