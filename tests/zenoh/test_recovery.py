"""Routers, the proxy and the robot's router end and come back; nodes start before the routers."""

from __future__ import annotations

import os
import time
from itertools import pairwise

import pytest

from tests.ros.processes import Process, wait_until
from tests.zenoh.lab import PORTS, VERSIONS, Lab

VERSION = "1.6.2"
"""Nodes of Kilted."""
BEFORE_ROUTER = 7446
"""A port on the machine of the robot."""
BACK_WITHIN_S = 15.0
"""Nodes dial again 1, 3, 7 and 11 s after the end of a connection."""
KILLS = 3
LONGEST_GAP_S = 2.0
"""Seconds without messages after the end of the routers, if nodes connect at the first try.

On a machine without free CPU, the routers may be back too late for this try. So only the median of
several kills has this bound.
"""


def started(lab: Lab, version: str) -> None:
    """The robot's router, redirects, and the proxy."""
    lab.start_router(version)
    for role in PORTS:
        lab.redirect(role)
    lab.start_proxy()
    lab.wait_for_link()


class Watched:
    """Nodes with a topic, a service and the graph, between two machines."""

    def __init__(self, lab: Lab, version: str, source: str, target: str) -> None:
        self.subscriber = lab.node(version, target, "sub", f"chatter_{source}")
        self.server = lab.node(version, target, "serve", f"add_{source}")
        self.publisher = lab.node(version, source, "pub", f"chatter_{source}")
        self.client = lab.node(version, source, "call", f"add_{source}")
        self.graph = lab.node(version, source, "graph")

    def wait(self, timeout: float = 30.0) -> None:
        """Wait until messages, answers and the graph arrive, from now on."""
        marks = {node: node.mark() for node in (self.subscriber, self.client)}
        self.subscriber.wait_for_count("^got ", 3, timeout, since=marks[self.subscriber])
        self.client.wait_for_count("^answer ", 3, timeout, since=marks[self.client])
        wait_until("the graph is complete", lambda: self.sees(self.server), timeout)

    def sees(self, node: Process) -> bool:
        """Whether the node has appeared in its last change in the graph."""
        lines = [line for line in self.graph.output().splitlines() if line.endswith(node.title)]
        return bool(lines) and lines[-1].startswith("seen ")


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize(("source", "target"), [("c1", "c2"), ("c1", "out")])
def test_all_is_back_after_the_end_of_the_routers(
    lab: Lab, version: str, source: str, target: str
) -> None:
    started(lab, version)
    watched = Watched(lab, version, source, target)
    clock = lab.node(version, target, "clock", f"chatter_{source}")
    clock.wait_for("^at ", timeout=30)
    watched.wait()
    gaps = []
    for _ in range(KILLS):
        gaps.append(gap_after_kill(lab, clock))
        watched.wait(BACK_WITHIN_S)
    print(f"without messages for {', '.join(f'{gap:.2f} s' for gap in gaps)}")
    assert sorted(gaps)[KILLS // 2] <= LONGEST_GAP_S
    assert lab.zenoh().restarts == KILLS
    assert lab.proxy is not None
    lab.proxy.wait_for("zenoh routers ended: the process was ended by SIGKILL")


def test_all_is_back_after_the_end_of_the_proxy(lab: Lab) -> None:
    started(lab, VERSION)
    pairs = [Watched(lab, VERSION, "c1", "c2"), Watched(lab, VERSION, "out", "c1")]
    for watched in pairs:
        watched.wait()
    lab.restart_proxy()
    for watched in pairs:
        watched.wait(BACK_WITHIN_S)


def test_routers_that_hang_are_replaced(lab: Lab) -> None:
    started(lab, VERSION)
    watched = Watched(lab, VERSION, "c1", "c2")
    watched.wait()
    os.kill(lab.router_process(), 19)
    assert lab.proxy is not None
    lab.proxy.wait_for("zenoh routers ended: no report for 10 s", timeout=30)
    watched.wait(BACK_WITHIN_S)


def test_the_link_is_back_with_the_router_of_the_robot(lab: Lab) -> None:
    router = lab.start_router(VERSION)
    lab.redirect("c1")
    lab.start_proxy()
    lab.wait_for_link()
    watched = Watched(lab, VERSION, "c1", "out")
    watched.wait()
    router.kill()
    subject = f"zenoh peer {lab.topology.plan.robot}:7447"
    wait_until("the fault is told", lambda: subject in lab.problems(), 30)
    assert lab.problems()[subject].startswith("connection refused: no router listens there")
    lab.start_router(VERSION)
    lab.wait_for_link()
    watched.wait(BACK_WITHIN_S)
    wait_until("the fault is over", lambda: subject not in lab.problems(), 30)


def test_a_router_that_ended_its_session_at_once_is_dialed_again(lab: Lab) -> None:
    """zenoh 1.7.2 dials no more if a session ends within some milliseconds of its begin."""
    lab.start_router(VERSION)
    for role in ("c1", "c2"):
        lab.redirect(role)
    lab.start_cutter(BEFORE_ROUTER)
    peer = f"{lab.topology.plan.robot}:{BEFORE_ROUTER}"
    lab.start_proxy("--zenoh-peer", peer, with_robot=False)
    beside = Watched(lab, VERSION, "c1", "c2")
    beside.wait()
    assert lab.proxy is not None
    lab.proxy.wait_for(f"zenoh does not dial tcp/{peer} again; opening the hub anew", timeout=90)
    lab.wait_for_link()
    for watched in (beside, Watched(lab, VERSION, "out", "c1")):
        watched.wait(BACK_WITHIN_S)
    assert lab.zenoh().restarts == 0


@pytest.mark.parametrize("version", VERSIONS)
def test_nodes_may_start_before_the_routers(lab: Lab, version: str) -> None:
    for role in PORTS:
        lab.redirect(role)
    watched = Watched(lab, version, "c1", "c2")
    watched.graph.wait_for("^ready")
    outward = Watched(lab, version, "out", "c1")
    lab.start_proxy()
    lab.start_router(version)
    for pair in (watched, outward):
        pair.wait(BACK_WITHIN_S)


def gap_after_kill(lab: Lab, clock: Process) -> float:
    """Kill the routers. Return the longest time in seconds between two messages after that."""
    before = times(clock)[-1]
    os.kill(lab.router_process(), 9)
    killed = time.monotonic()
    # What the dead routers have passed on arrives within milliseconds.
    wait_until("messages arrive", lambda: times(clock)[-1] > killed + 0.3, BACK_WITHIN_S)
    return max(late - early for early, late in pairwise(t for t in times(clock) if t >= before))


def times(clock: Process) -> list[float]:
    """The times at which messages have arrived, in seconds."""
    return [float(line.split()[1]) for line in clock.output().splitlines() if line[:3] == "at "]
