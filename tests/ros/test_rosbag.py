"""rosbag records and plays, inside and outside."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.ros.lab import Lab
from tests.ros.processes import wait_until


@pytest.mark.parametrize(
    ("library", "source", "sink"),
    [("rospy", "c1", "out"), ("roscpp", "out", "c1"), ("rospy", "c1", "c2")],
    ids=["inside-to-outside", "outside-to-inside", "inside-to-inside"],
)
def test_rosbag_records_and_plays(
    lab: Lab, library: str, source: str, sink: str, tmp_path: Path
) -> None:
    """Recorded at the sink from a node of the source, played there to a node of the source."""
    topic = f"/{lab.unique('recorded')}"
    bag = tmp_path / "test.bag"
    lab.node(library, source, "pub", topic=topic, rate=50)
    recorder = lab.start(sink, "rosbag", "record", "-O", str(bag), topic)
    wait_until("the recorder has subscribed", lambda: lab.users(topic)[1])
    lab.node("roscpp", sink, "sub", topic=topic).wait_for_count("^got ", 20)
    assert recorder.stop() == 0
    lab.stop_nodes()
    info = lab.run(sink, "rosbag", "info", str(bag)).output
    assert int(re.findall(r"messages:\s+(\d+)", info)[0]) >= 10
    receiver = lab.node(library, source, "sub", topic=topic)
    receiver.wait_for("^ready")
    player = lab.start(sink, "rosbag", "play", "-d", "1", str(bag))
    receiver.wait_for_count("^got hello ", 10)
    assert player.wait() == 0
