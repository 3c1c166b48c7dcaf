"""A short range: fast ports are given back before a node is refused, and nothing is cut."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.ros import kernel
from tests.ros.combinations import each_library
from tests.ros.kernel import LIMIT
from tests.ros.lab import Lab
from tests.ros.processes import Process, wait_until
from tests.ros.topology import SHARED, PortMap

pytestmark = pytest.mark.boundary

PLAN = replace(SHARED, name="f", ports=PortMap(45000, 45003, 45000), forwarding=True)
PROXY_OPTIONS = ("--probe-interval", "0.5", "--linger", "1")


def publisher(lab: Lab, library: str) -> tuple[str, str]:
    name = lab.unique("talker")
    topic = f"/{name}/topic"
    lab.node(library, "c1", "pub", name=name, topic=topic, rate=50)
    lab.wait_registered(name)
    return name, topic


def listen(lab: Lab, topic: str) -> Process:
    receiver = lab.node("roscpp", "out", "sub", topic=topic)
    receiver.wait_for_count("^got ", 5, LIMIT)
    return receiver


@each_library
def test_fast_ports_are_given_back_and_connections_under_way_go_on(lab: Lab, library: str) -> None:
    wait_until("the ports are free", lambda: kernel.status(lab)["ports"]["free"] == 4, LIMIT)
    talkers = [publisher(lab, library) for _ in range(2)]
    receivers = [listen(lab, topic) for _, topic in talkers]
    for name, _ in talkers:
        kernel.wait_forwarded(lab, name)
    assert len(kernel.forwarded_ports(lab)) == 2
    assert kernel.status(lab)["ports"] | {"used": 2, "free": 2} == kernel.status(lab)["ports"]
    talkers += [publisher(lab, library) for _ in range(2)]
    assert kernel.forwarded_ports(lab) == []
    receivers += [listen(lab, topic) for _, topic in talkers[2:]]
    for receiver in receivers:
        kernel.wait_more(receiver, 30)
        got = kernel.numbers(receiver)
        assert got == list(range(got[0], got[0] + len(got))), "a message was lost"
    for name, topic in talkers:
        plane = kernel.plane_of(lab, name)
        assert plane["plane"] == "splice"
        assert "is in use" in plane["reason"]
        listen(lab, topic)
    assert kernel.status(lab)["ports"]["free"] == 0
    before = kernel.plane_of(lab, talkers[0][0])
    assert before["connections"] > 0
    moved = before["sent"]
    wait_until("counted", lambda: kernel.plane_of(lab, talkers[0][0])["sent"] > moved, LIMIT)


def test_a_range_with_room_again_is_used(lab: Lab) -> None:
    wait_until("the ports are free", lambda: kernel.status(lab)["ports"]["free"] == 4, LIMIT)
    name, topic = publisher(lab, "roscpp")
    crowd = [lab.node("roscpp", "c2", "pub", topic=f"/{lab.unique('t')}") for _ in range(3)]
    wait_until("the range is full", lambda: kernel.status(lab)["ports"]["free"] == 0, LIMIT)
    listen(lab, topic)
    assert kernel.plane_of(lab, name)["plane"] == "splice"
    for node in crowd:
        node.stop()
    wait_until("there is room", lambda: kernel.status(lab)["ports"]["used"] == 1, LIMIT)
    listen(lab, topic)
    kernel.wait_forwarded(lab, name)
