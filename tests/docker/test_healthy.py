"""A healthy host has no problems, from the operator's start to a minute later.

A network has ROS 1 nodes, and two domains of ROS 2 with Fast DDS and Cyclone DDS.
"""

import json
import time
from collections.abc import Callable, Iterator
from contextlib import suppress

import pytest

from tests.docker.controller import Controller, proxies
from tests.docker.engine import logs, wait_until
from tests.docker.inside import ENABLE, Inside
from tests.docker.robot import Robot, named_robot
from tests.docker.ros2 import HERE, Inside2, Outside
from tests.docker.test_doctor import page

ROVER = 96
WATCHED_S = 60
"""Seconds in which nothing may be told."""
DOMAIN = ("--env", "ROS_DOMAIN_ID=7")
ON_LAN = (ENABLE, f"rosproxy.advertise-host={HERE}")


@pytest.fixture(scope="module")
def named(ros_image: str) -> Iterator[Robot]:
    """A robot with a new master, without nodes of other tests."""
    with named_robot(ros_image, "rover", ROVER) as robot:
        robot.start_master()
        yield robot


@pytest.fixture(autouse=True)
def _nodes_end(lan: Outside, named: Robot) -> Iterator[None]:
    yield
    lan.end()
    named.end("pub")
    named.end("sub")


def is_up() -> bool:
    """Whether the operator answers. Before, the doctor uses its own options."""
    with suppress(OSError):
        return bool(page())
    return False


def told(controller: Controller) -> Iterator[str]:
    """All reported problems: by operator, doctor and page, and in the proxies' logs."""
    yield from controller.problems().splitlines()
    text = controller.command("doctor", "--json", check=False)
    for finding in json.loads(text[text.index("{") :])["findings"]:
        if finding["severity"] in ("error", "warning"):
            yield f"{finding['subject']}: {finding['text']}"
    document = page()
    yield from (finding["text"] for finding in document["findings"])
    for key, shown in {**document["nodes"], **document["links"]}.items():
        if shown.get("state") in ("warning", "broken"):
            yield f"{key}: {shown['text']}"
    for name in (controller.container, *(proxy.name for proxy in proxies(check=False))):
        lines = logs(name).splitlines()
        yield from (f"{name}: {line}" for line in lines if "WARNING" in line or "ERROR" in line)


def test_nothing_is_told_from_the_start_on(
    start_controller: Callable[..., Controller],
    net: Inside,
    inside2: Inside2,
    named: Robot,
    lan: Outside,
) -> None:
    network = net.network()
    for library in ("rospy", "roscpp"):
        net.node(network, library, "pub", "--topic", "/out")
        net.node(network, library, "sub", "--topic", "/back")
    for vendor, domain in (("jazzy", ()), ("cyclone", ()), ("kilted", DOMAIN)):
        for kind, topic in (("pub", "/outward"), ("sub", "/inward")):
            inside2.node(network, vendor, kind, topic, labels=ON_LAN, options=domain)
    named.node("pub", "rospy", "pub", "--topic", "/back")
    listener = named.node("sub", "roscpp", "sub", "--topic", "/out")
    lan.node("jazzy", "pub", "/inward")
    reader = lan.node("cyclone", "sub", "/outward")

    controller = start_controller("--ports", "40")

    wait_until(is_up, 30, controller.logs)
    seen = dict[str, float]()
    started = time.monotonic()
    while time.monotonic() - started < WATCHED_S:
        for text in told(controller):
            seen.setdefault(text, time.monotonic() - started)
    listener.wait_for("")
    assert reader.log.read().count("got hello") > 20
    assert {row["name"] for row in controller.status()["proxies"]} == {p.name for p in proxies()}
    assert len(proxies()) == 3
    assert not seen, "\n".join(f"{at:5.1f} s {text}" for text, at in seen.items())
