"""`rosproxy status` and `rosproxy doctor` tell the truth about real nodes."""

from __future__ import annotations

import json
import re
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families

from tests.ros.combinations import each_library
from tests.ros.lab import Lab
from tests.ros.processes import wait_until

pytestmark = pytest.mark.boundary

NOWHERE = {"ROS_HOSTNAME": "a-name-that-resolves-nowhere"}


def status_of(lab: Lab, name: str) -> dict[str, Any]:
    """The row of an inside node in the status; empty if missing."""
    nodes = json.loads(lab.rosproxy("status", "--json").output)["nodes"]
    return next((node for node in nodes if f"/{name}" in node["nodes"]), {})


@each_library
def test_status_shows_a_node_with_its_addresses_and_connections(lab: Lab, library: str) -> None:
    name = lab.unique("shown")
    topic = f"/{name}/topic"
    service = f"/{name}/service"
    lab.node(library, "c1", "pub", name=name, topic=topic)
    lab.node(library, "c2", "serve", name=f"{name}_server", service=service).wait_for("^ready")
    lab.node(library, "out", "sub", name=f"{name}_sub", topic=topic).wait_for_count("^got ", 3)
    node = status_of(lab, name)
    assert node["address"].startswith(lab.place("c1").address)
    assert node["advertised_uri"] == lab.node_uri(name)
    assert node["state"] == "ok"
    assert topic in node["publishes"]
    assert service in status_of(lab, f"{name}_server")["services"]
    connection = next(item for item in node["connections"] if item["name"] == topic)
    assert connection["caller_id"] == f"/{name}_sub"
    assert connection["sent"] > 0
    table = lab.rosproxy("status").output
    assert f"/{name} " in table
    assert f"topic {topic} with /{name}_sub" in table


def counted(lab: Lab, topic: str, side: str) -> float:
    """The number of messages of a topic in the metrics."""
    families = text_string_to_metric_families(lab.read("/metrics"))
    labels = {"name": topic, "side": side}
    return sum(
        sample.value
        for family in families
        for sample in family.samples
        if sample.name == "rosproxy_topic_messages_total" and sample.labels == labels
    )


@each_library
def test_metrics_count_the_messages_of_nodes_inside(lab: Lab, library: str) -> None:
    """Each message once, even with two subscribers; incoming messages, too."""
    name = lab.unique("counted")
    outward = f"/{name}/outward"
    inward = f"/{name}/inward"
    publisher = lab.node(library, "c1", "pub", name=name, topic=outward)
    lab.node("roscpp", "out", "pub", topic=inward)
    for role, topic in (("out", outward), ("out", outward), ("c2", inward)):
        lab.node(library, role, "sub", topic=topic).wait_for("^got ")
    first = counted(lab, outward, "published")
    wait_until("sent messages are counted", lambda: counted(lab, outward, "published") > first, 60)
    wait_until("received messages are counted", lambda: counted(lab, inward, "received") > 0, 60)
    published = counted(lab, outward, "published")
    sent = re.findall("^sent ", publisher.output(), re.MULTILINE)
    assert published <= len(sent) + 1, "the last line is printed after the sending"
    assert not counted(lab, inward, "published")


def test_doctor_finds_nothing_wrong_with_healthy_nodes(lab: Lab) -> None:
    for library in ("rospy", "roscpp"):
        for role in ("c1", "c2", "out"):
            lab.node(library, role, "pub", topic="/healthy").wait_for("^sent ")
    report = lab.rosproxy("doctor")
    assert "Nothing wrong was found." in report.output


@each_library
def test_doctor_names_a_node_on_loopback_and_what_mends_it(lab: Lab, library: str) -> None:
    name = lab.unique("lonely")
    loopback = {"ROS_IP": "127.0.0.1"}
    lab.node(library, "c1", "pub", name=name, topic="/x", env=loopback).wait_for("^sent ")
    wait_until("the node is known", lambda: status_of(lab, name))
    report = lab.rosproxy("doctor", check=False)
    assert report.returncode == 1
    assert f"ERROR    /{name}" in report.output
    assert f"ROS_IP={lab.place('c1').address}" in report.output


def test_doctor_names_an_outside_node_that_inside_cannot_resolve(lab: Lab) -> None:
    name = lab.unique("unknown")
    lab.node("rospy", "out", "pub", name=name, topic="/x", env=NOWHERE).wait_for("^sent ")
    report = lab.rosproxy("doctor", check=False)
    assert report.returncode == 1
    assert f"/{name}" in report.output
    assert "a-name-that-resolves-nowhere" in report.output


def test_doctor_names_a_stale_registration_and_the_clean_up(lab: Lab) -> None:
    name = lab.unique("stale")
    node = lab.node("rospy", "out", "pub", name=name, topic="/x")
    node.wait_for("^sent ")
    node.kill()
    report = lab.rosproxy("doctor", check=False)
    assert f"/{name}" in report.output
    assert "rosnode cleanup" in report.output
    lab.run("out", "sh", "-c", "yes | rosnode cleanup")
    assert f"/{name}" not in lab.rosproxy("doctor", check=False).output
