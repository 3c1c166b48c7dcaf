"""The machine of the robot gets another address, to which its name leads."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.ros.processes import wait_until
from tests.ros.topology import give, ip
from tests.zenoh.lab import ROUTER_PORT, VERSIONS, Lab

VERSION = "1.6.2"
NAME = "moving-robot"
OTHER_ADDRESS = "10.77.0.40"
HEALED_WITHIN_S = 30.0
"""The proxy looks up names each 5 s, and the robot's router ends its session after 10 s."""


class Robot:
    """The machine of the robot, with a name that the proxy alone knows."""

    def __init__(self, lab: Lab) -> None:
        self.lab = lab
        self.place = lab.topology.places["out"]
        self.first_address = lab.topology.plan.robot
        self.name(self.first_address)

    def name(self, address: str) -> None:
        """Let the name lead to an address, also for programs that run."""
        hosts = Path("/etc/netns") / self.lab.topology.places["px"].namespace / "hosts"
        lines = [line for line in hosts.read_text().splitlines() if not line.endswith(NAME)]
        hosts.write_text("\n".join([*lines, f"{address} {NAME}"]) + "\n")

    def move(self, old: str, new: str) -> None:
        """Replace the address. No packet tells the other ends of connections."""
        ip("-n", self.place.namespace, "addr", "del", f"{old}/24", "dev", "eth0")
        self.place.addresses.remove(old)
        give(self.place, "eth0", f"{new}/24")
        self.name(new)

    def wait_for_session(self, address: str) -> None:
        """Wait until the hub has its only session with a router at an address."""

        def remotes() -> list[str]:
            return [s.remote for s in self.lab.zenoh().sessions if s.mode == "router"]

        wait_until("the session is there", lambda: remotes() == [f"{address}:{ROUTER_PORT}"], 30)


@pytest.fixture
def robot(lab: Lab) -> Iterator[Robot]:
    robot = Robot(lab)
    yield robot
    if OTHER_ADDRESS in robot.place.addresses:
        robot.move(OTHER_ADDRESS, robot.first_address)


@pytest.mark.parametrize("version", VERSIONS)
def test_the_link_comes_back_at_the_new_address(robot: Robot, version: str) -> None:
    """The router and all nodes run on, and no connection is closed."""
    lab = robot.lab
    lab.start_router(version)
    for role in ("c1", "c2"):
        lab.redirect(role)
    lab.start_proxy("--zenoh-peer", NAME, with_robot=False)
    lab.wait_for_link()
    outward = lab.node(version, "out", "sub", "up")
    inward = lab.node(version, "c1", "sub", "down")
    beside = lab.node(version, "c2", "sub", "up")
    lab.node(version, "c1", "pub", "up")
    lab.node(version, "out", "pub", "down")
    for node in (outward, inward, beside):
        node.wait_for_count("^got hello ", 5, timeout=30)
    began = time.monotonic()
    marks = {node: node.mark() for node in (outward, inward, beside)}
    robot.move(robot.first_address, OTHER_ADDRESS)
    for node, mark in marks.items():
        node.wait_for_count("^got hello ", 5, HEALED_WITHIN_S, since=mark)
    print(f"healed after {time.monotonic() - began:.1f} s")
    robot.wait_for_session(OTHER_ADDRESS)
    wait_until("no fault is told", lambda: not lab.status().problems, 30)
    assert lab.zenoh().links[0].up
    assert lab.zenoh().restarts == 0
    numbers = [int(line.split()[-1]) for line in lines_of(beside.output(since=marks[beside]))]
    assert numbers == [*range(numbers[0], numbers[0] + len(numbers))], "a message was lost"


def test_the_link_comes_back_with_a_router_that_starts_at_the_new_address(robot: Robot) -> None:
    lab = robot.lab
    router = lab.start_router(VERSION)
    lab.redirect("c1")
    lab.start_proxy("--zenoh-peer", NAME, with_robot=False)
    lab.wait_for_link()
    subscriber = lab.node(VERSION, "c1", "sub")
    lab.node(VERSION, "out", "pub")
    subscriber.wait_for_count("^got hello ", 5, timeout=30)
    os.kill(router.pid, 9)
    router.wait()
    robot.move(robot.first_address, OTHER_ADDRESS)
    lab.start_router(VERSION)
    subscriber.wait_for_count("^got hello ", 5, HEALED_WITHIN_S, since=subscriber.mark())
    robot.wait_for_session(OTHER_ADDRESS)


def lines_of(output: str) -> list[str]:
    """The lines about messages."""
    return [line for line in output.splitlines() if line.startswith("got ")]
