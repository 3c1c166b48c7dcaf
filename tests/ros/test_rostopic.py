"""Every subcommand of rostopic, run inside and outside, about topics of either side."""

from __future__ import annotations

import re

import pytest

from tests.ros.combinations import each_direction, each_side, each_view, each_view_of_a_library
from tests.ros.lab import Lab

STAMPED = ("geometry_msgs/PointStamped", "{header: auto, point: {x: 1.0, y: 2.0, z: 3.0}}")


def talker(lab: Lab, machine: str, library: str = "roscpp", **options: int) -> tuple[str, str]:
    """Starts a publisher at 20 Hz. Returns the names of node and topic."""
    name = lab.unique("talker")
    topic = f"/{name}/chatter"
    lab.node(library, machine, "pub", name=name, topic=topic, **options).wait_for("^sent ")
    return f"/{name}", topic


@each_side
def test_list_names_the_topics_of_both_sides(lab: Lab, side: str) -> None:
    topics = {talker(lab, machine)[1] for machine in ("c1", "out")}
    assert topics <= set(lab.run(side, "rostopic", "list").output.split())
    published = lab.run(side, "rostopic", "list", "-p", "-v").output
    for topic in topics:
        assert f" * {topic} [std_msgs/String] 1 publisher" in published


@each_side
def test_list_by_host(lab: Lab, side: str) -> None:
    _, topic = talker(lab, "c1")
    output = lab.run(side, "rostopic", "list", "--host").output
    assert re.search(rf"^Host \[\S+\]:(\n  .*)*\n  {topic}$", output, re.MULTILINE), output


@each_view_of_a_library
def test_info_names_publishers_with_their_address(
    lab: Lab, library: str, side: str, machine: str
) -> None:
    name, topic = talker(lab, machine, library)
    output = lab.run(side, "rostopic", "info", topic).output
    assert "Type: std_msgs/String" in output
    assert re.search(rf"^ \* {name} \(http://\S+:\d+/\S*\)$", output, re.MULTILINE), output


@each_side
def test_type_and_find(lab: Lab, side: str) -> None:
    _, topic = talker(lab, "c1")
    assert lab.run(side, "rostopic", "type", topic).output == "std_msgs/String\n"
    assert topic in lab.run(side, "rostopic", "find", "std_msgs/String").output.split()


@each_view_of_a_library
def test_echo_prints_messages(lab: Lab, library: str, side: str, machine: str) -> None:
    _, topic = talker(lab, machine, library)
    output = lab.run(side, "rostopic", "echo", "-n", "3", topic).output
    assert len(re.findall(r'^data: "hello \d+ "$', output, re.MULTILINE)) == 3


@each_direction
def test_pub_once_and_at_a_rate(lab: Lab, source: str, sink: str) -> None:
    topic = f"/{lab.unique('pub')}"
    listener = lab.node("roscpp", sink, "sub", topic=topic)
    listener.wait_for("^ready")
    lab.run(source, "rostopic", "pub", "-1", topic, "std_msgs/String", "once 1 x")
    listener.wait_for("^got once 1 size 8 ")
    lab.start(source, "rostopic", "pub", "-r", "20", topic, "std_msgs/String", "often 1 x")
    listener.wait_for_count("^got often 1 ", 10)


@each_view
def test_hz_measures_the_rate(lab: Lab, side: str, machine: str) -> None:
    _, topic = talker(lab, machine)
    tool = lab.start(side, "rostopic", "hz", topic)
    rates = [float(match[1]) for match in tool.wait_for_count(r"average rate: ([\d.]+)", 2)]
    assert rates[-1] == pytest.approx(20, rel=0.25)


@each_view
def test_bw_measures_the_bandwidth(lab: Lab, side: str, machine: str) -> None:
    _, topic = talker(lab, machine, size=10_000)
    tool = lab.start(side, "rostopic", "bw", topic)
    tool.wait_for_count(r"average: [\d.]+KB/s", 2)
    assert re.search(r"mean: 10\.00KB min: 10\.00KB max: 10\.00KB", tool.output()), tool.output()


@each_direction
def test_delay_reads_the_stamps(lab: Lab, source: str, sink: str) -> None:
    topic = f"/{lab.unique('stamped')}"
    lab.start(source, "rostopic", "pub", "-s", "-r", "20", topic, *STAMPED)
    tool = lab.start(sink, "rostopic", "delay", topic)
    delay = float(tool.wait_for(r"average delay: (-?[\d.]+)")[1])
    assert 0 <= delay < 10
