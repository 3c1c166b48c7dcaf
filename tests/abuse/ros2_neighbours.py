"""Neighbours of a ROS 2 proxy, made of sockets: honest participants, and floods.

A `Participant` announces itself like DDS, and receives. A `Flood` sends from a thread as fast as
allowed, from own addresses, or from any address in packets made by hand.
"""

import itertools
import socket
import struct
import threading
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from time import monotonic
from types import TracebackType

from rosproxy.ros2.protocol.reliable import heartbeats
from rosproxy.ros2.protocol.rtps import FAST_DDS, NO_VENDOR, source_prefix, source_vendor
from rosproxy.ros2.rewriting.discovery import read_discovery
from rosproxy.shared.addresses import HostPort
from tests.unit.ros2.discovery.domains import of_vendor, spdp
from tests.unit.ros2.protocol.messages import message, submessage

WELL_KNOWN = 7410
AGAIN = 0.1
"""Seconds after which an announcement is repeated that may be lost."""
PATIENCE = 60.0
SHORTEST_PAUSE = 0.005
"""Seconds that a flood may be ahead of its rate."""
PADDING = 200
"""Bytes that make an announcement as long as a real announcement: an answer is never longer."""
_SO_RCVBUFFORCE = 33
"""Socket option for more bytes than rmem_max allows (socket(7)), missing in Python's module."""

Address = tuple[str, int]


def udp(address: str, port: int = 0) -> socket.socket:
    """A socket at an address of this machine, with room for all that a busy test reads late."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, 8 * 1024 * 1024)
    sock.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(address))
    sock.bind((address, port))
    return sock


class Participant:
    """A participant at an address, with sockets for metatraffic and for data.

    ``vendor`` is the id of the implementation.
    """

    def __init__(self, prefix: bytes, address: str, port: int, vendor: bytes = FAST_DDS) -> None:
        self.prefix = prefix
        self.address = address
        self.port = port
        self.vendor = vendor
        self.meta = udp(address, port)
        self.data = udp(address, port + 1)

    def close(self) -> None:
        """End, without a word."""
        self.meta.close()
        self.data.close()

    def announce(self, *to: Address) -> None:
        """Announce itself."""
        for target in to:
            announcement = spdp(self.prefix, self.address, self.port, padding=PADDING)
            self.meta.sendto(of_vendor(announcement, self.vendor), target)

    def proves_to_receive(self, asked: Callable[[], object]) -> None:
        """Answer the question that the proxy sends to this address; ``asked`` is done meanwhile."""
        self._answer(self.is_asked(asked))

    def answers_all(self) -> None:
        """Answer each question that has come, as a real participant does: an answer may be lost."""
        self.meta.setblocking(False)
        with suppress(BlockingIOError):
            while True:
                datagram = self.meta.recv(65536)
                if _is_question(datagram):
                    self._answer(datagram)

    def _answer(self, question: bytes) -> None:
        told = read_discovery(question).of_participant
        assert told is not None
        (meta, _) = (locator for _, locator in told.reached_at(question))
        info_dst = submessage(0x0E, 0, source_prefix(question))
        body = bytes([0, 0, 3, 0xC7, 0, 0, 3, 0xC2]) + bytes(20)
        answer = message(info_dst, submessage(0x06, 0, body), prefix=self.prefix)
        self.meta.sendto(answer, (meta.host, meta.port))

    def is_asked(self, asked: Callable[[], object]) -> bytes:
        """The question that the proxy sends to this address; ``asked`` is done meanwhile."""
        return self._wait(self.meta, asked, _is_question)

    def hears(self, prefix: bytes, asked: Callable[[], object]) -> list[HostPort]:
        """The locators in another's announcement, once that comes; ``asked`` is done meanwhile."""
        datagram = self._wait(self.meta, asked, lambda received: _announces(received, prefix))
        (told,) = read_discovery(datagram).announcements
        return [locator for _, locator in told.reached_at(datagram)]

    def gets(self, content: bytes, asked: Callable[[], object]) -> None:
        """Wait for user's data; ``asked`` is done meanwhile."""
        self._wait(self.data, asked, lambda received: received == content)

    def _wait(
        self, sock: socket.socket, asked: Callable[[], object], wanted: Callable[[bytes], bool]
    ) -> bytes:
        sock.settimeout(AGAIN)
        end = monotonic() + PATIENCE
        while monotonic() < end:
            asked()
            again = monotonic() + AGAIN
            while monotonic() < again:
                try:
                    datagram = sock.recv(65536)
                except TimeoutError:
                    break
                if wanted(datagram):
                    return datagram
        raise AssertionError(f"{self.address} did not get the expected datagram")


def _announces(datagram: bytes, prefix: bytes) -> bool:
    told = read_discovery(datagram).of_participant
    return source_prefix(datagram) == prefix and told is not None and not told.ended


def _is_question(datagram: bytes) -> bool:
    told = read_discovery(datagram).of_participant
    return told is not None and source_vendor(datagram) == NO_VENDOR and any(heartbeats(datagram))


def packet(source: str, to: Address, datagram: bytes) -> bytes:
    """An IPv4 packet with a datagram from any address; the kernel adds what is zero here."""
    length = 8 + len(datagram)
    head = struct.pack(">BBHHHBBH", 0x45, 0, 20 + length, 0, 0, 64, socket.IPPROTO_UDP, 0)
    head += socket.inet_aton(source) + socket.inet_aton(to[0])
    return head + struct.pack(">HHHH", WELL_KNOWN, to[1], length, 0) + datagram


def forge(source: str, to: Address, datagram: bytes) -> None:
    """Send a datagram from an address that is another's."""
    with socket.socket(socket.AF_INET, socket.SOCK_RAW, socket.IPPROTO_RAW) as raw:
        raw.sendto(packet(source, to, datagram), (to[0], 0))


class Flood:
    """Sends datagrams over and over while the context lasts. ``sent`` counts the datagrams.

    Each datagram has a source, which is an address of this machine, and a target. ``via`` is the
    address on the network for forged datagrams to a group. ``per_second`` is the rate.
    ``make_packet`` makes a forged packet from source, target and datagram.
    """

    def __init__(
        self,
        datagrams: Iterable[tuple[str, Address, bytes]],
        is_forged: bool,
        via: str = "0.0.0.0",
        per_second: float = float("inf"),
        make_packet: Callable[[str, Address, bytes], bytes] = packet,
    ) -> None:
        self._datagrams = list(datagrams)
        self._is_forged = is_forged
        self._via = via
        self._per_second = per_second
        self._make_packet = make_packet
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self.sent = 0

    def __enter__(self) -> "Flood":
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._ended.set()
        self._thread.join()

    def wait(self, count: int) -> None:
        """Wait until so many have been sent."""
        end = monotonic() + PATIENCE
        while self.sent < count and self._thread.is_alive():
            assert monotonic() < end, f"only {self.sent} of {count} datagrams were sent"
            self._ended.wait(0.05)
        assert self.sent >= count

    def _run(self) -> None:
        sources = {source for source, _, _ in self._datagrams}
        raw = socket.socket(socket.AF_INET, socket.SOCK_RAW, socket.IPPROTO_RAW)
        raw.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(self._via))
        own = {} if self._is_forged else {source: udp(source) for source in sources}
        began = monotonic()
        for source, to, datagram in itertools.cycle(self._datagrams):
            if self._ended.is_set():
                break
            if self._is_forged:
                raw.sendto(self._make_packet(source, to, datagram), (to[0], 0))
            else:
                own[source].sendto(datagram, to)
            self.sent += 1
            ahead = self.sent / self._per_second - (monotonic() - began)
            if ahead > SHORTEST_PAUSE:
                self._ended.wait(ahead)
        for sock in (raw, *own.values()):
            sock.close()


class Counted:
    """All bytes of datagrams that come to an address of this machine, at whatever port."""

    def __init__(self, address: str) -> None:
        self._sock = socket.socket(socket.AF_INET, socket.SOCK_RAW, socket.IPPROTO_UDP)
        self._sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 * 1024 * 1024)
        self._sock.bind((address, 0))
        self._sock.setblocking(False)

    def bytes_from(self, sources: Sequence[str]) -> int:
        """The bytes from these addresses since the last call."""
        total = 0
        while True:
            try:
                data, (source, _) = self._sock.recvfrom(65536)
            except BlockingIOError:
                return total
            total += len(data) - 28 if source in sources else 0

    def close(self) -> None:
        """End."""
        self._sock.close()
