"""Without peers: the LAN relay passes announcements between the LAN and the proxy.

So the proxy also discovers Cyclone DDS outside, which by default has no well-known ports.
"""

from __future__ import annotations

import pytest

from tests.ros.processes import wait_until
from tests.ros2.lab import Lab

OPTIONS = ("--ros2-lan-relay", "172.30.1.1:47090")
LAN_RELAY = True
PAIRS = [
    ("jazzy", "jazzy"),
    ("kilted", "kilted"),
    ("jazzy", "cyclone"),
    ("cyclone", "jazzy"),
    ("cyclone", "cyclone"),
    ("cyclone", "kilted"),
    ("kilted", "cyclone"),
]
ways = pytest.mark.parametrize(
    ("source", "sink"), [("c1", "out"), ("out", "c1")], ids=["outward", "inward"]
)


@ways
@pytest.mark.parametrize(
    ("source_vendor", "sink_vendor"),
    PAIRS,
    ids=[f"{source_vendor}-to-{sink_vendor}" for source_vendor, sink_vendor in PAIRS],
)
def test_topics(lab: Lab, source_vendor: str, sink_vendor: str, source: str, sink: str) -> None:
    lab.node(source_vendor, source, "pub", topic="/chatter")
    lab.node(sink_vendor, sink, "sub", topic="/chatter").wait_for_count("^got hello ", 5)


@ways
@pytest.mark.parametrize(
    ("source_vendor", "sink_vendor"), PAIRS[2:4], ids=["jazzy-to-cyclone", "cyclone-to-jazzy"]
)
def test_messages_in_fragments(
    lab: Lab, source_vendor: str, sink_vendor: str, source: str, sink: str
) -> None:
    lab.node(source_vendor, source, "pub", topic="/image", size=1_000_000, period=0.5)
    reader = lab.node(sink_vendor, sink, "sub", topic="/image")
    reader.wait_for_count("^got hello .* size 1000000", 5)


def test_a_participant_on_the_host_itself_is_met(lab: Lab) -> None:
    lab.node("jazzy", "c1", "pub", topic="/chatter")
    lab.node("jazzy", "host", "sub", topic="/chatter").wait_for_count("^got hello ", 5)


@pytest.mark.parametrize("vendor", ["jazzy", "kilted", "cyclone"])
def test_participants_prove_that_they_receive(lab: Lab, vendor: str) -> None:
    """An address that does not counts as forged, once there are many."""
    for role in ("c1", "c2", "out"):
        lab.node(vendor, role, "sub", topic="/chatter")
    lab.wait_for_participants(inside=2, outside=1)
    wait_until("all have answered", lambda: lab.unproven() == {"inside": 0, "outside": 0})


def test_the_lan_relay_may_be_killed(lab: Lab) -> None:
    lab.node("jazzy", "c1", "pub", topic="/chatter")
    reader = lab.node("jazzy", "out", "sub", topic="/chatter")
    reader.wait_for_count("^got hello ", 5)
    assert lab.lan_relay is not None
    lab.lan_relay.kill()
    lab.start_lan_relay()
    later = lab.node("jazzy", "out", "sub", topic="/chatter")
    for subscriber in (reader, later):
        subscriber.wait_for_count("^got hello ", 5, since=subscriber.mark())
