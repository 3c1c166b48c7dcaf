"""The names of nodes outside that have no service of their own."""

from __future__ import annotations

import os

import pytest

from tests.ros.processes import wait_until
from tests.ros2.lab import Lab

NO_KERNEL = pytest.mark.skipif(
    os.environ.get("ROS_TESTS_KERNEL") == "1", reason="the kernel forwards ros_discovery_info"
)


@NO_KERNEL
@pytest.mark.parametrize("vendor", ["jazzy", "kilted"])
def test_a_node_without_services_has_a_name(lab: Lab, vendor: str) -> None:
    heard = lab.node("jazzy", "c1", "sub")
    lab.node(vendor, "out", "pub", name="plain", without_services=True)
    heard.wait_for("^got ")
    wait_until(
        "the proxy knows the name",
        lambda: [participant.nodes for participant in lab.domain().outside] == [("/plain",)],
    )
    assert not any(
        service.startswith("/plain/")
        for participant in lab.domain().outside
        for service in participant.services
    )
