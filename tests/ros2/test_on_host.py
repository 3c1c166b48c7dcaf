"""A proxy by hand on the host itself, which is in the LAN and in the network of the containers."""

from __future__ import annotations

import pytest

from tests.ros2.lab import Lab

PROXY = False
UNPUBLISHED = "47200-47263"
"""Ports that the host does not lead to another machine."""


@pytest.mark.parametrize("vendor", ["jazzy", "cyclone"])
def test_the_lan_and_the_peer_are_outside(lab: Lab, vendor: str) -> None:
    lab.proxy_role = "host"
    lab.port_range = UNPUBLISHED
    lab.start_proxy()
    lab.node(vendor, "c1", "pub", topic="/outward")
    lab.node("jazzy", "out", "pub", topic="/inward")
    for reader in (
        lab.node("jazzy", "out", "sub", topic="/outward"),
        lab.node(vendor, "c1", "sub", topic="/inward"),
    ):
        reader.wait_for_count("^got hello ", 5)
    assert lab.status().settings.inside_networks == ("172.30.1.0/24",)
    assert {participant.address for participant in lab.domain().outside} == {
        lab.topology.plan.robot
    }
