"""Nothing is told of a healthy domain: from the first start to a minute later, and after kills."""

from __future__ import annotations

import time

import pytest

from tests.ros.processes import Process, wait_until
from tests.ros2.lab import PROGRAMS, Lab

LAN_RELAY = True
WATCHED = 60.0
"""Seconds in which nothing may be told."""
LIVES = 15


@pytest.fixture(autouse=True)
def _both_ways_out(lab: Lab) -> None:
    """The robot is a peer and on the LAN that the relay hears."""
    assert lab.proxy is not None
    lab.proxy.stop()
    lab.options = (
        "--ros2-peer",
        lab.topology.plan.robot,
        "--ros2-lan-relay",
        f"{lab.gateway}:47090",
    )
    lab.start_proxy()


def test_nothing_is_told_from_the_start_on(lab: Lab) -> None:
    readers = list[Process]()
    for vendor in ("jazzy", "kilted", "cyclone"):
        lab.node(vendor, "c1", "pub", topic=f"/outward/{vendor}")
        readers.append(lab.node(vendor, "c2", "sub", topic="/inward"))
        readers.append(lab.node("jazzy", "out", "sub", topic=f"/outward/{vendor}"))
    lab.node("jazzy", "out", "pub", topic="/inward")
    seen = set[str]()
    started = time.monotonic()
    while time.monotonic() - started < WATCHED:
        seen |= lab.told()
        time.sleep(0.5)
    for reader in readers:
        reader.wait_for_count("^got hello ", 20)
    assert not seen
    lab.tool("doctor")
    lab.restart_proxy()
    wait_until("all are known again", lambda: len(lab.domain().inside) == 6, 60)
    started = time.monotonic()
    while time.monotonic() - started < WATCHED / 2:
        seen |= lab.told()
        time.sleep(0.5)
    assert not seen


@pytest.mark.parametrize("vendor", sorted(PROGRAMS))
@pytest.mark.parametrize(
    ("source", "sink"), [("c1", "out"), ("out", "c1")], ids=["outward", "inward"]
)
def test_a_node_that_crashes_again_and_again(lab: Lab, vendor: str, source: str, sink: str) -> None:
    """A new process at a port ends the former participant before its lease duration is over.

    Cyclone DDS takes another port each time. `LIVES` lasts longer than ten seconds, after which
    even short problems of a start would be reported.
    """
    reader = lab.node("jazzy", sink, "sub", topic="/chatter")
    seen = set[str]()
    for number in range(LIVES):
        word = f"life-{number}"
        writer = lab.node(vendor, source, "pub", name="crasher", topic="/chatter", word=word)
        writer.wait_for("^sent 8")
        if vendor != "cyclone":
            lab.wait_for_participants(1, 1)
        seen |= lab.told()
        if number < LIVES - 1:
            writer.kill()
    reader.wait_for_count(f"^got life-{LIVES - 1} ", 5)
    assert not seen
