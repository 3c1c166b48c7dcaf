"""Records datagrams of each implementation: ``python -m tests.ros2.record`` as root.

A publisher and a subscriber run on machines of a container network, without the proxy. Their
datagrams from start to end go to ``tests/unit/ros2/recordings``, in a file for each implementation.
Of datagrams with the same form only the first two are kept.
"""

import select
import socket
import struct
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event, Thread

import msgspec

from rosproxy.ros2.protocol.rtps import RtpsError, by_source, source_prefix, submessages
from rosproxy.ros2.rewriting.discovery import read_discovery
from tests.ros.topology import Place, remove_leftovers, run_command
from tests.ros2.lab import PROGRAMS, Lab
from tests.ros2.machines import PLAN, built
from tests.unit.ros2.recorded import FOLDER, Datagram

PORT = "c1-1"
"""The port of the bridge where the publisher is: all passes there that the two send each other."""
ROLES = "c1", "c2"
EACH = 2
ETH_P_ALL = 0x0003
ETHERNET = 14
IPV4 = b"\x08\x00"
UDP = 17
LONG = {"cyclone": {"user_data": 2000}}
"""Options for an announcement that is sent in fragments. Fast DDS fragments only from 64 KB."""
HEARD = 20
"""Messages after which the two have met for certain."""


@dataclass
class Recorder:
    """Records the datagrams at a network device of a machine, in a separate thread."""

    place: Place
    datagrams: list[Datagram] = field(default_factory=list)
    _ended: Event = field(default_factory=Event)
    _thread: Thread | None = None

    def start(self) -> None:
        with self.place.entered():
            sock = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ETH_P_ALL))
        sock.bind((PORT, ETH_P_ALL))
        self._thread = Thread(target=self._record, args=(sock,))
        self._thread.start()

    def stop(self) -> None:
        self._ended.set()
        assert self._thread is not None
        self._thread.join()

    def _record(self, sock: socket.socket) -> None:
        with sock:
            while not self._ended.is_set():
                if select.select([sock], [], [], 0.2)[0]:
                    self.datagrams += datagrams_in(sock.recv(65536))


def datagrams_in(frame: bytes) -> Iterator[Datagram]:
    """The RTPS datagram in an Ethernet frame, if complete."""
    if frame[ETHERNET - 2 : ETHERNET] != IPV4:
        return
    packet = frame[ETHERNET:]
    header = 4 * (packet[0] & 0x0F)
    (fragment,) = struct.unpack_from(">H", packet, 6)
    if packet[9] != UDP or fragment & 0x3FFF:
        return
    source, target = (socket.inet_ntoa(packet[at : at + 4]) for at in (12, 16))
    source_port, target_port, size = struct.unpack_from(">HHH", packet, header)
    payload = packet[header + 8 : header + size]
    with suppress(RtpsError):
        source_prefix(payload)
        yield Datagram(f"{source}:{source_port}", f"{target}:{target_port}", payload.hex())


def form(datagram: Datagram) -> tuple[object, ...]:
    """The form of a datagram, equal for datagrams that are made alike.

    Source and target, kinds and entities of submessages, announced topics, and numbers of
    fragments.
    """
    payload = datagram.content
    ends = [payload[body.start + 4 : body.start + 12] for _, _, body in submessages(payload)]
    kinds = [kind for kind, _, _ in submessages(payload)]
    target, _, _ = datagram.target.partition(":")
    told = [read_discovery(message) for message in by_source(payload)]
    topics = [a.topic(message.datagram) for message in told for a in message.announcements]
    parts = [part.first for message in told for _, part in message.fragments]
    return datagram.host, target, *kinds, *ends, *topics, *parts


def selected(datagrams: list[Datagram]) -> Iterator[Datagram]:
    counts = Counter[tuple[object, ...]]()
    for datagram in datagrams:
        counts[form(datagram)] += 1
        if counts[form(datagram)] <= EACH:
            yield datagram


def make_look_alike(place: Place) -> None:
    """Give a machine the same machine id as all others, like containers of the same image."""
    (Path("/etc/netns") / place.namespace / "machine-id").write_text(f"{1:032}\n")


def avoid_fragments(lab: Lab) -> None:
    """Raise the MTU, so that each datagram is a single packet."""
    host = lab.place("host").namespace
    links = [(host, "c1-1"), (host, "c2-1"), *((lab.place(r).namespace, "eth0") for r in ROLES)]
    for namespace, device in links:
        run_command("ip", "-n", namespace, "link", "set", device, "mtu", "65535")


def record(vendor: str, lab: Lab) -> list[Datagram]:
    avoid_fragments(lab)
    for role in ROLES:
        make_look_alike(lab.place(role))
    recorder = Recorder(lab.place("host"))
    recorder.start()
    try:
        lab.node(vendor, "c1", "pub", topic="/chatter", name="talker", **LONG.get(vendor, {}))
        lab.node(vendor, "c2", "sub", topic="/chatter", name="listener").wait_for_count(
            "^got hello ", HEARD
        )
        lab.stop_nodes()
    finally:
        recorder.stop()
    return list(selected(recorder.datagrams))


def main() -> None:
    remove_leftovers()
    FOLDER.mkdir(exist_ok=True)
    for vendor in sys.argv[1:] or PROGRAMS:
        with tempfile.TemporaryDirectory() as folder, built(PLAN, Path(folder)) as topology:
            recorded = record(vendor, Lab(topology, Path(folder)))
        lines = msgspec.json.Encoder().encode_lines(recorded)
        (FOLDER / f"{vendor}.jsonl").write_bytes(lines)
        print(f"{vendor}: {len(recorded)} datagrams")


if __name__ == "__main__":
    main()
