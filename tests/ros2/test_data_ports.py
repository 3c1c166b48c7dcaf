"""Real Cyclone DDS with a separate port for user data, where Cyclone DDS reads discovery as well.

Outside announces readers at that port by hand, as no implementation of DDS does.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from socket import AF_INET, SOCK_DGRAM, socket

import pytest

from rosproxy.ros2.protocol.locators import pack_locator
from rosproxy.ros2.protocol.parameters import Pid
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.documents.status_document import LocatorStatus
from tests.ros.processes import Process, wait_until
from tests.ros.topology import Place, run_command
from tests.ros2.lab import Lab
from tests.ros2.machines import PLAN as SHARED
from tests.ros2.test_kernel_plane import forwarded_ports, leases
from tests.unit.ros2.protocol.messages import data, message, payload

PLAN = replace(SHARED, name="v", forwarding=True)
# With an index Cyclone DDS takes two well-known ports (ddsi_init.c, make_uc_sockets).
TWO_PORTS = (
    "<CycloneDDS><Domain><Discovery><ParticipantIndex>auto</ParticipantIndex></Discovery>"
    "</Domain></CycloneDDS>"
)
ENV = {"CYCLONEDDS_URI": TWO_PORTS}
STRANGER = "10.77.0.66"
# Cyclone DDS skips no sample for a GAP that names no reader (ddsi_receive.c, handle_Gap).
TOPICS = ("/open", "/secret")
SUBSCRIPTIONS = 0x000004C2
ALL_BUILT_IN = 0x3F
"""Readers and writers of participants, publications and subscriptions (DDSI-RTPS 2.5, 9.3.2)."""


@pytest.fixture(params=["copy", "kernel"])
def lab(request: pytest.FixtureRequest, lab: Lab) -> Lab:
    """A proxy that denies a topic, on each data plane."""
    lab.stop()
    lab.options = (*lab.options, "--data-plane", request.param)
    lab.options += ("--policy", "deny publish /secret")
    lab.start_proxy()
    return lab


def text(value: str) -> bytes:
    raw = value.encode() + b"\0"
    return struct.pack("<I", len(raw)) + raw + bytes(-len(raw) % 4)


class Forger:
    """A participant outside of sockets, which announces best-effort readers of topics."""

    def __init__(self, place: Place, address: str, number: int) -> None:
        self.prefix = bytes([1, 15, 0xEE, number]) + bytes(8)
        with place.entered():
            self._sock = socket(AF_INET, SOCK_DGRAM)
            self._sock.bind((address, 0))
        self._sock.setblocking(False)
        self._locator = pack_locator(HostPort(address, self._sock.getsockname()[1]), "<")
        self._received = list[bytes]()

    def announce(self, topics: Sequence[str], to: tuple[str, int]) -> None:
        """Announce itself, and then a reader of each topic."""
        readers = [self._reader(topic, number) for number, topic in enumerate(topics, 1)]
        for datagram in (self._participant(), message(*readers, prefix=self.prefix)):
            self._sock.sendto(datagram, to)

    def received(self, word: bytes) -> int:
        """The number of received datagrams with a word."""
        with suppress(BlockingIOError):
            while True:
                self._received.append(self._sock.recv(65536))
        return sum(word in datagram for datagram in self._received)

    def close(self) -> None:
        """End, without a word."""
        self._sock.close()

    def _participant(self) -> bytes:
        parameters = [
            (Pid.PROTOCOL_VERSION, b"\2\3\0\0"),
            (Pid.VENDOR_ID, b"\1\x0f\0\0"),
            (Pid.PARTICIPANT_GUID, self.prefix + bytes([0, 0, 1, 0xC1])),
            (Pid.METATRAFFIC_UNICAST_LOCATOR, self._locator),
            (Pid.DEFAULT_UNICAST_LOCATOR, self._locator),
            (Pid.PARTICIPANT_LEASE_DURATION, struct.pack("<iI", 100, 0)),
            (Pid.BUILTIN_ENDPOINT_SET, struct.pack("<I", ALL_BUILT_IN)),
        ]
        return message(data(payload(parameters)), prefix=self.prefix)

    def _reader(self, topic: str, number: int) -> bytes:
        parameters = [
            (Pid.ENDPOINT_GUID, self.prefix + bytes([0, 0, number, 4])),
            (Pid.TOPIC_NAME, text(f"rt{topic}")),
            (Pid.TYPE_NAME, text("std_msgs::msg::dds_::String_")),
            (Pid.UNICAST_LOCATOR, self._locator),
        ]
        return data(payload(parameters), writer=SUBSCRIPTIONS, sequence=number)


@contextmanager
def forgers(lab: Lab) -> Iterator[tuple[Forger, Forger]]:
    """A forger at an address that is no peer's, and a forger at the address of the peer."""
    place = lab.place("out")
    (link,) = {
        line.split()[1]
        for line in run_command("ip", "-n", place.namespace, "-o", "addr").splitlines()
        if f" {place.address}/" in line
    }
    address = f"{STRANGER}/24", "dev", link
    run_command("ip", "-n", place.namespace, "addr", "add", *address)
    try:
        with (
            closing(Forger(place, STRANGER, 1)) as stranger,
            closing(Forger(place, place.address, 2)) as peer,
        ):
            yield stranger, peer
    finally:
        run_command("ip", "-n", place.namespace, "addr", "del", *address)


def data_leases(lab: Lab, count: int) -> list[LocatorStatus]:
    """The ports for user data of participants inside, once there are so many."""
    wait_until(f"{count} ports for user data", lambda: len(leases(lab)) == count)
    return leases(lab)


def publishers(lab: Lab) -> None:
    """Publish a denied topic and an allowed topic."""
    lab.node("cyclone", "c1", "pub", topic="/secret", word="hidden", env=ENV)
    lab.node("cyclone", "c1", "pub", topic="/open", env=ENV)


def readers(lab: Lab) -> tuple[Process, Process]:
    """Nodes outside that want both topics."""
    secret = lab.node("jazzy", "out", "sub", topic="/secret")
    public = lab.node("jazzy", "out", "sub", topic="/open")
    return secret, public


def test_what_is_denied_is_sent_to_no_reader_announced_at_a_port_for_user_data(lab: Lab) -> None:
    """Cyclone DDS sent the topic to a reader that a stranger had announced there."""
    publishers(lab)
    ports = data_leases(lab, 2)
    with forgers(lab) as (stranger, peer):

        def peer_gets_what_is_allowed() -> bool:
            for forger in (stranger, peer):
                for lease in ports:
                    forger.announce(TOPICS, (lab.host, lease.port))
            return peer.received(b"hello ") >= 20

        wait_until("the peer gets what is allowed", peer_gets_what_is_allowed)
        assert peer.received(b"hidden ") == 0
        assert stranger.received(b"hidden ") + stranger.received(b"hello ") == 0


def test_real_nodes_get_what_is_allowed_and_the_kernel_forwards_fast_dds_alone(lab: Lab) -> None:
    publishers(lab)
    data_leases(lab, 2)
    secret, public = readers(lab)
    public.wait_for_count("^got hello ", 20)
    assert "got" not in secret.output()
    own = {lease.port: lease for lease in leases(lab)}
    assert {lease.plane for lease in own.values()} == {"copy"}
    assert {lease.reason for lease in own.values()} == {
        "Cyclone DDS may read discovery at this port"
    }
    if "kernel" in lab.options:
        lab.node("jazzy", "c2", "sub", topic="/open")
        wait_until("the kernel forwards to Fast DDS", lambda: len(forwarded_ports(lab)) == 2)
        assert not own.keys() & set(forwarded_ports(lab))


def test_user_data_comes_in_at_such_a_port(lab: Lab) -> None:
    inside = lab.node("cyclone", "c1", "sub", topic="/inward", env=ENV)
    lab.node("jazzy", "out", "pub", topic="/inward")
    inside.wait_for_count("^got hello ", 20)
    (lease,) = leases(lab)
    assert lease.datagrams >= 20
