"""Nothing is told of a healthy domain: from the first start to a minute later, and after kills."""

from __future__ import annotations

import time

import pytest

from tests.ros.processes import Process, wait_until
from tests.ros2.lab import Lab

EAR = True
WATCHED = 60.0
"""Seconds in which nothing may be told."""


@pytest.fixture(autouse=True)
def _both_ways_out(lab: Lab) -> None:
    """The robot is a peer and on the LAN that the relay hears."""
    assert lab.proxy is not None
    lab.proxy.stop()
    lab.options = ("--ros2-peer", lab.topology.plan.robot, "--ros2-ear", f"{lab.gateway}:47090")
    lab.start_proxy()


def told(lab: Lab) -> set[str]:
    """What the proxy tells by itself: problems, and findings on its live page."""
    page = lab.page()
    shown = [finding["text"] for finding in page.get("findings", ())]
    broken = [link["text"] for link in page["links"].values() if link["state"] == "broken"]
    problems = [f"{problem.subject}: {problem.text}" for problem in lab.status().problems]
    return {*problems, *shown, *broken}


def test_nothing_is_told_from_the_start_on(lab: Lab) -> None:
    readers = list[Process]()
    for vendor in ("jazzy", "kilted", "cyclone"):
        lab.node(vendor, "c1", "pub", topic=f"/outward/{vendor}")
        readers.append(lab.node(vendor, "c2", "sub", topic="/inward"))
        readers.append(lab.node("jazzy", "out", "sub", topic=f"/outward/{vendor}"))
    lab.node("jazzy", "out", "pub", topic="/inward")
    seen = set[str]()
    started = time.monotonic()
    while time.monotonic() - started < WATCHED:
        seen |= told(lab)
        time.sleep(0.5)
    for reader in readers:
        reader.wait_for_count("^got hello ", 20)
    assert not seen
    lab.tool("doctor")
    lab.restart_proxy()
    wait_until("all are known again", lambda: len(lab.domain().inside) == 6, 60)
    started = time.monotonic()
    while time.monotonic() - started < WATCHED / 2:
        seen |= told(lab)
        time.sleep(0.5)
    assert not seen
