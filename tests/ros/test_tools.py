"""rosparam, rosbag, topic_tools and roslaunch, inside and outside."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.ros.combinations import each_direction, each_library, each_side
from tests.ros.cpp import compiled_node
from tests.ros.lab import Lab
from tests.ros.processes import wait_until

OTHER = {"c1": "out", "out": "c1"}


@each_side
def test_rosparam_set_get_list_and_delete(lab: Lab, side: str) -> None:
    key = f"/{lab.unique('tree')}"
    lab.run(side, "rosparam", "set", f"{key}/gains", "{p: 1.5, i: 2, name: '', flag: true}")
    lab.run(side, "rosparam", "set", f"{key}/text", "two words")
    assert lab.run(OTHER[side], "rosparam", "get", f"{key}/text").output == "two words\n"
    listed = lab.run(OTHER[side], "rosparam", "list", key).output.split()
    assert set(listed) == {
        f"{key}/{leaf}" for leaf in ("gains/p", "gains/i", "gains/name", "gains/flag", "text")
    }
    got = lab.run(OTHER[side], "rosparam", "get", f"{key}/gains").output
    assert sorted(got.split("\n")) == ["", "", "flag: true", "i: 2", "name: ''", "p: 1.5"]
    lab.run(OTHER[side], "rosparam", "delete", key)
    assert lab.run(side, "rosparam", "get", key, check=False).returncode != 0


@each_side
def test_rosparam_dump_and_load(lab: Lab, side: str, tmp_path: Path) -> None:
    key, copy = f"/{lab.unique('origin')}", f"/{lab.unique('copy')}"
    value = {"list": [1, 2.5, "x"], "deep": {"flag": False, "empty": ""}}
    lab.ask_master("setParam", key, value, role=OTHER[side])
    lab.run(side, "rosparam", "dump", str(tmp_path / "p.yaml"), key)
    lab.run(side, "rosparam", "load", str(tmp_path / "p.yaml"), copy)
    assert lab.ask_master("getParam", copy) == value


@each_direction
@each_library
def test_rosbag_records_and_plays(
    lab: Lab, library: str, source: str, sink: str, tmp_path: Path
) -> None:
    """Recorded at the sink from a node of the source, played there to a node of the source."""
    topic, bag = f"/{lab.unique('recorded')}", tmp_path / "test.bag"
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


@each_direction
def test_topic_tools_relay(lab: Lab, source: str, sink: str) -> None:
    topic, again = f"/{lab.unique('source')}", f"/{lab.unique('again')}"
    lab.node("rospy", source, "pub", topic=topic)
    lab.start(sink, "/usr/lib/topic_tools/relay", topic, again)
    lab.node("rospy", source, "sub", topic=again).wait_for_count("^got hello ", 5)


@each_direction
def test_topic_tools_throttle(lab: Lab, source: str, sink: str) -> None:
    topic, slow = f"/{lab.unique('source')}", f"/{lab.unique('slow')}"
    lab.node("roscpp", source, "pub", topic=topic, rate=50)
    lab.start(sink, "/usr/lib/topic_tools/throttle", "messages", topic, "5", slow)
    lines = lab.node("roscpp", source, "sub", topic=slow).wait_for_count(
        r"^got hello (\d+) .* at ([\d.]+)$", 5
    )
    seconds = float(lines[4][2]) - float(lines[0][2])
    assert seconds == pytest.approx(0.8, abs=0.25)


LAUNCH = """
<launch>
  <param name="/{ns}/greeting" value="from launch"/>
  <group ns="{ns}">
    <rosparam>limits: {{low: 1, high: 2.5}}</rosparam>
    <node pkg="rosproxy_test_nodes" type="node" name="talker" args="pub --topic chatter"/>
    <node pkg="topic_tools" type="relay" name="relay" args="chatter again"/>
  </group>
</launch>
"""


def launch_package(folder: Path) -> Path:
    """A ROS package with the C++ node as its program."""
    package = folder / "rosproxy_test_nodes"
    package.mkdir()
    (package / "package.xml").write_text(
        '<package format="2"><name>rosproxy_test_nodes</name><version>0.0.0</version>'
        "<description>nodes</description><maintainer email='a@b.c'>m</maintainer>"
        "<license>Apache-2.0</license></package>"
    )
    (package / "node").symlink_to(compiled_node())
    return package


@each_side
def test_roslaunch(lab: Lab, side: str, tmp_path: Path) -> None:
    space = lab.unique("launched")
    launch_package(tmp_path)
    file = tmp_path / "test.launch"
    file.write_text(LAUNCH.format(ns=space))
    path = {"ROS_PACKAGE_PATH": f"{tmp_path}:/usr/share"}
    launched = lab.start(side, "roslaunch", str(file), env=path)
    receiver = lab.node("roscpp", OTHER[side], "sub", topic=f"/{space}/again")
    receiver.wait_for_count("^got hello ", 5, timeout=30)
    assert lab.ask_master("getParam", f"/{space}/greeting") == "from launch"
    assert lab.ask_master("getParam", f"/{space}/limits") == {"low": 1, "high": 2.5}
    listed = lab.run(OTHER[side], "rosnode", "list").output.split()
    assert {f"/{space}/talker", f"/{space}/relay"} <= set(listed)
    assert launched.stop() == 0
    lab.wait_unregistered(f"/{space}/talker")
    lab.wait_unregistered(f"/{space}/relay")


@each_side
def test_roslaunch_sees_that_a_required_node_died(lab: Lab, side: str, tmp_path: Path) -> None:
    """roslaunch's own children are watched by roslaunch, through the boundary or not."""
    space = lab.unique("required")
    launch_package(tmp_path)
    file = tmp_path / "test.launch"
    file.write_text(
        LAUNCH.format(ns=space).replace('name="talker"', 'name="talker" required="true"')
    )
    path = {"ROS_PACKAGE_PATH": f"{tmp_path}:/usr/share"}
    launched = lab.start(side, "roslaunch", str(file), env=path)
    lab.wait_registered(f"/{space}/talker", timeout=30)
    lab.run(OTHER[side], "rosnode", "kill", f"/{space}/talker")
    launched.wait(timeout=20)
    lab.wait_unregistered(f"/{space}/relay")
