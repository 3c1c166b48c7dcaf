"""The demonstration's small ROS 2 nodes talk to real nodes, through the proxy."""

from __future__ import annotations

import os
import sys

import pytest

from tests.ros.processes import Process
from tests.ros2.lab import NODES, Lab


def demo_node(lab: Lab, kind: str, topic: str) -> Process:
    """Start a node of the demonstration inside."""
    place = lab.place("c1")
    proxy = lab.place("px")
    argv = [sys.executable, str(NODES / "demo_node.py"), kind, place.address, proxy.address, topic]
    env = {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    node = Process(f"demo {kind}", place, argv, env, lab.folder / "demo.log")
    lab.nodes.append(node)
    return node


@pytest.mark.parametrize("vendor", ["jazzy", "kilted"])
def test_a_node_of_the_demonstration_is_heard_by_a_real_one(lab: Lab, vendor: str) -> None:
    demo_node(lab, "pub", "/demo")
    lab.node(vendor, "out", "sub", topic="/demo").wait_for_count("^got [0-9]+ size", 20)


@pytest.mark.parametrize("vendor", ["jazzy", "kilted"])
def test_a_node_of_the_demonstration_hears_a_real_one(lab: Lab, vendor: str) -> None:
    listener = demo_node(lab, "sub", "/demo")
    lab.node(vendor, "out", "pub", topic="/demo")
    listener.wait_for_count("^got hello [0-9]+$", 20)
