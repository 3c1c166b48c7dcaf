"""ROS 2 with a range of more ports than most have."""

from __future__ import annotations

import pytest

from tests.ros.processes import wait_until
from tests.ros2.lab import Lab

PROXY = False


@pytest.mark.parametrize("vendor", ["jazzy", "kilted", "cyclone"])
def test_nodes_meet_with_a_range_of_1100_ports(lab: Lab, vendor: str) -> None:
    """Fast DDS counts in steps of 1 up to the number that encodes a participant's ports.

    With a number of 48 bits, a node would not answer for days.
    """
    lab.proxy_role = "host"
    lab.port_range = "47200-48299"
    lab.start_proxy()
    lab.node("jazzy", "out", "pub", topic="/inward")
    reader = lab.node(vendor, "c1", "sub", topic="/inward")
    reader.wait_for_count("^got hello ", 5)
    wait_until("the ports are kept", lambda: all(p.kept for p in lab.domain().inside), 30)
