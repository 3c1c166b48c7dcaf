"""The proxy is killed, and nodes: nothing is lost, and without anything on disk."""

from __future__ import annotations

import signal
import socket
import time

import pytest

from rosproxy.ros2.protocol.locators import pack_locator
from rosproxy.ros2.protocol.parameters import Pid
from rosproxy.shared.addresses import HostPort
from tests.ros.processes import wait_until
from tests.ros2.lab import Lab, is_whole
from tests.unit.ros2.protocol.messages import data, message, payload


def test_ten_participants_get_their_ports_again(lab: Lab) -> None:
    readers = []
    for number in range(10):
        role = ("c1", "c2")[number % 2]
        topic = f"/topic{number}"
        readers.append(lab.node("jazzy", role, "sub", topic=topic, depth=100))
    readers.append(lab.node("jazzy", "out", "sub", topic="/outward", depth=100))
    for number in range(10):
        lab.node("jazzy", "out", "pub", topic=f"/topic{number}", depth=100, period=0.2)
    lab.node("jazzy", "c1", "pub", topic="/outward", depth=100, period=0.2)
    for reader in readers:
        reader.wait_for_count("^got hello ", 5)
    wait_until("all ports are given", lambda: lab.domain().ports_used == 33, 90)
    wait_until("all kept", lambda: all(participant.kept for participant in lab.domain().inside), 90)
    before = lab.ports()

    lab.restart_proxy()

    wait_until("the same ports are given", lambda: lab.ports() == before, 90)
    for reader in readers:
        reader.wait_for_count("^got hello ", 15, since=reader.mark())
    for reader in readers:
        assert is_whole(reader), "messages were lost"


@pytest.mark.parametrize(("vendor", "ports"), [("jazzy", 3), ("kilted", 3), ("cyclone", 1)])
def test_a_participant_gets_its_ports_again(lab: Lab, vendor: str, ports: int) -> None:
    lab.node(vendor, "c1", "pub", topic="/chatter")
    lab.node(vendor, "c1", "pub", topic="/chatter")
    reader = lab.node("jazzy", "out", "sub", topic="/chatter")
    reader.wait_for_count("^got hello ", 5)
    wait_until("all ports are given", lambda: lab.domain().ports_used == 2 * ports, 90)
    wait_until("all kept", lambda: all(participant.kept for participant in lab.domain().inside), 90)
    before = lab.ports()
    for _ in range(2):
        lab.restart_proxy()
        wait_until("the same ports are given", lambda: lab.ports() == before, 90)
    later = lab.node("jazzy", "out", "sub", topic="/chatter")
    later.wait_for_count("^got hello ", 5)


def test_best_effort_is_back_soon(lab: Lab) -> None:
    lab.node("jazzy", "out", "pub", topic="/scan", best_effort=True, period=0.05)
    reader = lab.node("jazzy", "c1", "sub", topic="/scan", best_effort=True)
    reader.wait_for_count("^got hello ", 5)
    assert lab.proxy is not None
    lab.proxy.kill()
    mark = reader.mark()
    lab.start_proxy()
    started = time.monotonic()
    reader.wait_for_count("^got hello ", 5, since=mark)
    print(f"best effort again after {time.monotonic() - started:.1f} s")


def test_a_node_that_comes_back_is_heard_again(lab: Lab) -> None:
    reader = lab.node("jazzy", "out", "sub", topic="/chatter")
    for _ in range(3):
        writer = lab.node("jazzy", "c1", "pub", name="talker", topic="/chatter")
        reader.wait_for_count("^got hello ", 5, since=reader.mark())
        writer.kill()


def test_a_node_that_ends_gives_its_ports_back(lab: Lab) -> None:
    node = lab.node("jazzy", "c1", "pub", topic="/chatter")
    lab.wait_for_participants(1, 0)
    wait_until("the ports are given", lambda: lab.domain().ports_used == 3, 20)
    node.stop()
    wait_until("the ports are free", lambda: lab.domain().ports_used == 0, 20)


@pytest.mark.smoke
def test_50_messages_a_second_and_calls_go_on_without_a_loss(lab: Lab) -> None:
    topics = {"c1": "/inward", "out": "/outward"}
    readers = {}
    for role, topic in topics.items():
        options = {"topic": topic, "depth": 1000}
        readers[role] = lab.node("jazzy", role, "sub,serve", **options)
        other = "out" if role == "c1" else "c1"
        lab.node("jazzy", other, "pub", period=0.02, **options)
    callers = [
        lab.node("jazzy", role, "call", topic=topic, period=0.02, in_turn=True)
        for role, topic in (("out", "/inward"), ("c1", "/outward"))
    ]
    for reader in readers.values():
        reader.wait_for_count("^got hello ", 50)
    for caller in callers:
        caller.wait_for_count("^reply ", 50)
    wait_until("all ports are given", lambda: lab.domain().ports_used == 9, 90)
    wait_until("all kept", lambda: all(participant.kept for participant in lab.domain().inside), 90)

    lab.restart_proxy()

    for reader in readers.values():
        reader.wait_for_count("^got hello ", 100, since=reader.mark())
        assert is_whole(reader), "messages were lost"
    for caller in callers:
        caller.wait_for_count("^reply ", 50, since=caller.mark())


@pytest.mark.parametrize("count", [1, 16])
@pytest.mark.parametrize(("source", "sink"), [("c1", "out"), ("out", "c1")])
def test_a_forged_announcement_after_a_restart_is_no_end(
    lab: Lab, source: str, sink: str, count: int
) -> None:
    """A container with the right for raw packets is the first to announce another container's node.

    The 16 forged locators must not take all ports of the node.
    """
    lab.node("jazzy", source, "pub", topic="/chatter")
    reader = lab.node("jazzy", sink, "sub", topic="/chatter")
    reader.wait_for_count("^got hello ", 5)
    (participant,) = lab.domain().inside
    node = next(node for node in lab.nodes if "(c1)" in node.title)
    node.send(signal.SIGSTOP)
    lab.restart_proxy()
    prefix = bytes.fromhex(participant.guid_prefix.replace(".", ""))
    guid = prefix + bytes([0, 0, 1, 0xC1])
    address = lab.place("c1").address
    locators = [
        (Pid.METATRAFFIC_UNICAST_LOCATOR, pack_locator(HostPort(address, 9000 + number), "<"))
        for number in range(count)
    ]
    forged = message(data(payload([(Pid.PARTICIPANT_GUID, guid), *locators])), prefix=prefix)

    def is_taken_in() -> bool:
        with lab.place("c1").entered(), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            sock.sendto(forged, (lab.place("px").address, 7410))
        return bool(lab.domain().inside)

    wait_until("the forged announcement is accepted", is_taken_in)
    node.send(signal.SIGCONT)
    reader.wait_for_count("^got hello ", 20, since=reader.mark())
