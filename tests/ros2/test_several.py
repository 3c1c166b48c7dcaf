"""Several participants in a process and in a container, several containers, robots, hosts, domains.

Both hosts have the same addresses inside, so containers on the two hosts look like the same
machine.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import pytest

from tests.ros.processes import Process
from tests.ros2.lab import Lab
from tests.ros2.machines import PORTS


def all_hear_all(nodes: Mapping[str, Process]) -> None:
    """Wait until each node gets the word of each other node."""
    marks = {name: node.mark() for name, node in nodes.items()}
    for name, node in nodes.items():
        for other in nodes.keys() - {name}:
            node.wait_for_count(f"^got {other} ", 3, since=marks[name])


def all_see_all(nodes: Iterable[Process], names: Iterable[str]) -> None:
    """Wait until each node lists all these names, and no other."""
    for node in nodes:
        node.wait_for(f"^nodes {' '.join(sorted(names))} end$")


def talk(lab: Lab, role: str, name: str, **options: object) -> Process:
    """A node that publishes its name and subscribes to all names."""
    return lab.node("jazzy", role, "names,pub,sub", name=name, word=name, period=0.2, **options)


def test_participants_containers_and_robots(lab: Lab, other: Lab) -> None:
    robots = [host_lab.topology.plan.robot for host_lab in (lab, other)]
    lab.options = tuple(argument for robot in robots for argument in ("--ros2-peer", robot))
    lab.restart_proxy()
    nodes = {
        "one": talk(lab, "c1", "one"),
        "two": talk(lab, "c1", "two", contexts=2),
        "three": talk(lab, "c2", "three"),
        "four": talk(lab, "out", "four", contexts=2),
        "five": talk(lab, "out", "five"),
        "six": talk(other, "out", "six"),
    }
    all_see_all(nodes.values(), [*nodes, "two_1", "four_1"])
    all_hear_all(nodes)
    lab.wait_for_participants(4, 4)


def test_two_proxies_that_meet(lab: Lab, other: Lab) -> None:
    robot = lab.topology.plan.robot
    lab.options = ("--ros2-peer", robot, "--ros2-peer", f"{other.host}:{PORTS.first}")
    lab.restart_proxy()
    other.options = ("--ros2-peer", robot, "--ros2-peer", f"{lab.host}:{PORTS.first}")
    other.start_proxy()
    nodes = {
        "here": talk(lab, "c1", "here"),
        "there": talk(other, "c1", "there"),
        "yonder": talk(other, "c2", "yonder"),
        "robot": talk(lab, "out", "robot"),
    }
    lab.node("jazzy", "c2", "serve", topic="/add", name="adder")
    caller = other.node("jazzy", "c2", "call", topic="/add", name="caller")
    caller.wait_for_count("^reply .* hello", 5)
    all_see_all(nodes.values(), [*nodes, "adder", "caller"])
    all_hear_all(nodes)
    for killed in ([lab], [other], [lab, other]):
        for killed_lab in killed:
            killed_lab.restart_proxy()
        all_hear_all(nodes)
    caller.wait_for_count("^reply .* hello", 5, since=caller.mark())


@pytest.mark.parametrize(
    ("source", "sink"), [("c1", "out"), ("out", "c1")], ids=["outward", "inward"]
)
def test_domains_stay_apart(lab: Lab, source: str, sink: str) -> None:
    lab.options += ("--ros2-domain", "0", "--ros2-domain", "1")
    lab.restart_proxy()
    readers = {}
    for domain in ("0", "1"):
        env = {"ROS_DOMAIN_ID": domain}
        lab.node("jazzy", source, "pub", topic="/chatter", word=f"domain-{domain}", env=env)
        readers[domain] = lab.node("jazzy", sink, "sub", topic="/chatter", env=env)
    for _ in range(2):
        for domain, reader in readers.items():
            reader.wait_for_count(f"^got domain-{domain} ", 10, since=reader.mark())
        lab.restart_proxy()
    assert "domain-1" not in readers["0"].output()
    assert "domain-0" not in readers["1"].output()
