"""roslaunch starts nodes, sets parameters and ends together with the nodes, inside and outside."""

from __future__ import annotations

from pathlib import Path

from tests.ros.combinations import each_side
from tests.ros.cpp import compiled_node
from tests.ros.lab import Lab

OTHER = {"c1": "out", "out": "c1"}

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
    """A ROS package with the C++ node as the only program."""
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
    receiver.wait_for_count("^got hello ", 5)
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
    launched.wait(timeout=60)
    lab.wait_unregistered(f"/{space}/relay")
