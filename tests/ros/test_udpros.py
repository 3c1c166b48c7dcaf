"""UDPROS between roscpp nodes (rospy has no UDPROS), if neither side has a way to the other.

Without ``--direction both``, datagrams of an inside publisher still pass NAT: see
`tests/ros/test_boundary.py`.
"""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import pytest

from tests.ros.lab import Lab
from tests.ros.processes import Process, wait_until
from tests.ros.topology import SHARED

PLAN = replace(SHARED, name="u", isolated=True)
PROXY_OPTIONS = ("--udp",)

SIDES = {"c1": "inside", "c2": "inside", "out": "outside"}
PAIRS = [("c1", "c2"), ("c1", "out"), ("out", "c1"), ("out", "out")]
RELAYED = [pair for pair in PAIRS if SIDES[pair[0]] != SIDES[pair[1]]]


def in_directions(pairs: list[tuple[str, str]]) -> pytest.MarkDecorator:
    """From where to where: publisher and subscriber."""
    ids = [f"{SIDES[source]}-to-{SIDES[sink]}" for source, sink in pairs]
    return pytest.mark.parametrize(("source", "sink"), pairs, ids=ids)


def listener(lab: Lab, role: str, topic: str) -> Process:
    options: dict[str, Any] = {"topic": topic, "udp": 1}
    return lab.node("roscpp", role, "sub", name=lab.unique("udp_listener"), **options)


def relays(lab: Lab, topic: str) -> list[dict[str, Any]]:
    """The rows for the datagrams of a topic in the proxy's status."""
    if lab.flat:
        return []
    document = json.loads(lab.rosproxy("status", "--json").output)
    return [relay for relay in document["udpros"] if relay["topic"] == topic]


@in_directions(PAIRS)
@pytest.mark.parametrize("size", [0, 10000], ids=["small", "in-several-datagrams"])
@pytest.mark.parametrize("first", ["publisher", "subscriber"], ids=lambda w: f"{w}-first")
def test_messages_come_by_udp(lab: Lab, first: str, size: int, source: str, sink: str) -> None:
    topic = f"/{lab.unique('udp')}"
    name = lab.unique("udp_talker")
    if first == "subscriber":
        receiver = listener(lab, sink, topic)
        receiver.wait_for("^ready")
    sender = lab.node("roscpp", source, "pub", name=name, topic=topic, size=size, rate=50)
    sender.wait_for("^sent hello 2 ")
    if first == "publisher":
        receiver = listener(lab, sink, topic)
    receiver.wait_for_count(r"^got hello \d+ size", 20)
    for side in ("c1", "out"):
        info = lab.run(side, "rosnode", "info", name).output
        assert "transport: UDPROS" in info, side
        assert f"topic: {topic}" in info, side


@pytest.mark.boundary
@in_directions(RELAYED)
def test_a_relay_ends_with_its_subscriber(lab: Lab, source: str, sink: str) -> None:
    topic = f"/{lab.unique('udp')}"
    lab.node("roscpp", source, "pub", topic=topic, rate=50)
    receivers = [listener(lab, sink, topic) for _ in range(2)]
    for receiver in receivers:
        receiver.wait_for("^got hello ")
    assert len(relays(lab, topic)) == 2
    shown = lab.wait_shown(topic, carried="UDPROS", state="ok", flows=True)
    assert shown["port"] in {relay["port"] for relay in relays(lab, topic)}
    assert receivers[0].stop() == 0
    receivers[1].kill()
    wait_until("no relay is left", lambda: not relays(lab, topic))


@pytest.mark.boundary
@in_directions(RELAYED)
def test_messages_come_again_after_the_proxy_was_killed(lab: Lab, source: str, sink: str) -> None:
    """The subscriber's node gets its publishers again, and sends a new request."""
    topic = f"/{lab.unique('udp')}"
    sender = lab.node("roscpp", source, "pub", topic=topic, rate=50)
    receiver = listener(lab, sink, topic)
    receiver.wait_for("^got hello ")
    assert lab.proxy is not None
    lab.proxy.kill()
    lab.start_proxy()
    receiver.wait_for_count("^got hello ", 5, since=receiver.mark())
    assert sender.returncode is None
    assert len(relays(lab, topic)) == 1
