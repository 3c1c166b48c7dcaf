"""The master runs inside. Outside finds the master at a port that the proxy publishes."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.ros.combinations import each_direction
from tests.ros.lab import Lab
from tests.ros.topology import ADVERTISED_NAME, PUBLISHED_MASTER_PORT, SHARED

pytestmark = [pytest.mark.boundary, pytest.mark.direct]  # the master itself calls nodes outside

PLAN = replace(SHARED, name="h", hairpin=True)
MASTER_ROLE = "c1"
ADVERTISE_HOST = ADVERTISED_NAME
PROXY_OPTIONS = ("--publish-master", str(PUBLISHED_MASTER_PORT))

each_mixed_pair = pytest.mark.parametrize(
    ("first", "second"), [("rospy", "roscpp"), ("roscpp", "rospy")], ids=lambda library: library
)


@each_direction
@each_mixed_pair
def test_topics(lab: Lab, first: str, second: str, source: str, sink: str) -> None:
    topic = f"/{lab.unique('topic')}"
    receiver = lab.node(second, sink, "sub", topic=topic)
    receiver.wait_for("^ready")
    lab.node(first, source, "pub", topic=topic)
    receiver.wait_for_count("^got hello ", 5)


@each_direction
@each_mixed_pair
def test_services(lab: Lab, first: str, second: str, source: str, sink: str) -> None:
    service = f"/{lab.unique('service')}"
    lab.node(first, source, "serve", service=service)
    lab.node(second, sink, "call", service=service).wait_for("^reply ask 0 ")


def test_the_published_master_tells_its_published_address(lab: Lab) -> None:
    assert lab.ask_master("getUri") == f"http://{ADVERTISED_NAME}:{PUBLISHED_MASTER_PORT}/"


def test_parameters_and_tools_through_the_published_master(lab: Lab) -> None:
    key = f"/{lab.unique('value')}"
    name = lab.unique("talker")
    lab.ask_master("setParam", key, {"a": [1, 2.0, ""]})
    assert lab.ask_master("getParam", key, role="c2") == {"a": [1, 2.0, ""]}
    node = lab.node("rospy", "c2", "pub", name=name, topic=f"/{name}/topic")
    node.wait_for("^sent ")
    assert f"Pid: {node.pid}" in lab.run("out", "rosnode", "info", name).output
    lab.run("out", "rosnode", "kill", name)
    node.wait(timeout=60)
