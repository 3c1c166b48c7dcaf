"""Topics of nodes outside that the kernel forwards inside, which has no way out by itself."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import pytest

from tests.ros import kernel
from tests.ros.combinations import each_library, each_pair
from tests.ros.kernel import LIMIT
from tests.ros.lab import Lab
from tests.ros.processes import Process, wait_until
from tests.ros.topology import SHARED

pytestmark = pytest.mark.boundary

PLAN = replace(SHARED, name="z", forwarding=True, isolated=True)


def talk(lab: Lab, library: str, sink: str) -> tuple[str, Process, Process]:
    """A publisher outside and a subscriber inside, connected: the topic and the processes."""
    topic = f"/{lab.unique('topic')}"
    sender = lab.node(library, "out", "pub", name=lab.unique("talker"), topic=topic, rate=50)
    receiver = lab.node(sink, "c1", "sub", topic=topic)
    receiver.wait_for_count("^got ", 5, LIMIT)
    return topic, sender, receiver


def stand_in(lab: Lab, name: str) -> dict[str, Any]:
    """The row of a stand-in for an outside node in the status."""
    uri = lab.node_uri(name)
    return next(row for row in kernel.status(lab)["stand_ins"] if row["uri"] == uri)


def wait_forwarded(lab: Lab, name: str) -> dict[str, Any]:
    """Waits until the kernel forwards a node's topics and counts bytes. Returns the plane's
    status.
    """

    def is_forwarded() -> bool:
        plane = stand_in(lab, name)["data_plane"]
        return plane["connections"] > 0 and plane["received"] > plane["sent"] > 0

    wait_until(f"{name} is forwarded by the kernel", is_forwarded, LIMIT)
    return stand_in(lab, name)["data_plane"]


def name_of(lab: Lab, topic: str) -> str:
    return lab.users(topic)[0][0]


@each_pair("publisher", "subscriber")
def test_the_kernel_forwards_a_topic_of_outside(lab: Lab, publisher: str, subscriber: str) -> None:
    topic, _, receiver = talk(lab, publisher, subscriber)
    plane = wait_forwarded(lab, name_of(lab, topic))
    assert (plane["plane"], plane["reason"]) == ("kernel", "")
    lab.wait_shown(topic, carried="kernel", port=plane["port"], state="ok", flows=True)
    listed = [line for line in kernel.flows(lab).splitlines() if f"dport={plane['port']}" in line]
    assert any("ESTABLISHED" in line and lab.place("c1").address in line for line in listed)
    kernel.wait_more(receiver)


@each_library
def test_messages_go_on_while_the_proxy_is_dead_and_after(lab: Lab, library: str) -> None:
    topic, _, receiver = talk(lab, library, library)
    before = wait_forwarded(lab, name_of(lab, topic))
    assert lab.proxy is not None
    lab.proxy.kill()
    kernel.wait_more(receiver, 30)
    lab.start_proxy()
    kernel.wait_more(receiver, 30)
    assert wait_forwarded(lab, name_of(lab, topic))["port"] == before["port"]
    heard = kernel.numbers(receiver)
    assert heard == list(range(heard[0], heard[0] + len(heard)))


@each_library
def test_a_node_outside_that_comes_back_is_forwarded_again(lab: Lab, library: str) -> None:
    topic, sender, receiver = talk(lab, library, library)
    name = name_of(lab, topic)
    wait_forwarded(lab, name)
    sender.kill()
    lab.node(library, "out", "pub", name=name.strip("/"), topic=topic, rate=50)
    kernel.wait_more(receiver)
    wait_forwarded(lab, name)


def test_a_proxy_that_ends_lets_its_successor_serve(lab: Lab) -> None:
    topic, _, receiver = talk(lab, "rospy", "rospy")
    wait_forwarded(lab, name_of(lab, topic))
    assert lab.proxy is not None
    lab.proxy.stop()
    assert "rosproxy" not in kernel.tables(lab)
    assert "mark=" not in kernel.flows(lab)
    lab.start_proxy()
    kernel.wait_more(receiver)
    wait_forwarded(lab, name_of(lab, topic))


def test_an_unselected_source_gets_nothing(lab: Lab) -> None:
    """The kernel forwards only connections from sources that may use the proxy as their master."""
    topic, _, receiver = talk(lab, "rospy", "roscpp")
    port = wait_forwarded(lab, name_of(lab, topic))["port"]
    c1_address = lab.place("c1").address
    c2_address = lab.place("c2").address
    code = f"import socket, time; socket.create_connection(('{lab.place('px').address}', {port}), "
    code += "2); time.sleep(1)"

    def forwarded() -> bool:
        before = kernel.flows(lab).count(f"src={c2_address}")
        lab.run("c2", "python3", "-c", code)
        return kernel.flows(lab).count(f"src={c2_address}") > before

    assert forwarded()
    lab.tell("/containers", selected=[c1_address])
    wait_until("the other source is not forwarded", lambda: not forwarded(), LIMIT)
    kernel.wait_more(receiver)
    lab.tell("/containers", selected=[c1_address, c2_address])
    wait_until("the source is forwarded again", forwarded, LIMIT)


def test_a_rule_ends_forwarding_by_the_kernel(lab: Lab) -> None:
    """The kernel cannot enforce rules, so topics with a rule go through the proxy."""
    topic, _, receiver = talk(lab, "rospy", "rospy")
    other, _, deaf = talk(lab, "rospy", "roscpp")
    for forwarded_topic in (topic, other):
        wait_forwarded(lab, name_of(lab, forwarded_topic))
    rules = [f"deny subscribe {other}"]
    assert lab.tell("/policy", layers=[{"name": "test", "rules": rules}])["cut"] >= 2
    kernel.wait_more(receiver)
    time.sleep(0.5)
    mark = deaf.mark()
    time.sleep(1.5)
    assert "got " not in deaf.output(mark)
    assert stand_in(lab, name_of(lab, topic))["data_plane"]["connections"] == 0
    lab.tell("/policy", layers=[])
