"""Nodes of topic_tools, inside and outside."""

from __future__ import annotations

import pytest

from tests.ros.combinations import each_direction
from tests.ros.lab import Lab


@each_direction
def test_topic_tools_relay(lab: Lab, source: str, sink: str) -> None:
    topic = f"/{lab.unique('source')}"
    again = f"/{lab.unique('again')}"
    lab.node("rospy", source, "pub", topic=topic)
    lab.start(sink, "/usr/lib/topic_tools/relay", topic, again)
    lab.node("rospy", source, "sub", topic=again).wait_for_count("^got hello ", 5)


@each_direction
def test_topic_tools_throttle(lab: Lab, source: str, sink: str) -> None:
    topic = f"/{lab.unique('source')}"
    slow = f"/{lab.unique('slow')}"
    lab.node("roscpp", source, "pub", topic=topic, rate=50)
    lab.start(sink, "/usr/lib/topic_tools/throttle", "messages", topic, "5", slow)
    lines = lab.node("roscpp", source, "sub", topic=slow).wait_for_count(
        r"^got hello (\d+) .* at ([\d.]+)$", 5
    )
    seconds = float(lines[4][2]) - float(lines[0][2])
    assert seconds == pytest.approx(0.8, abs=0.25)
