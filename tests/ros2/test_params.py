"""Parameters of a node on the other side: listed, set and got."""

from __future__ import annotations

import pytest

from tests.ros2.lab import Lab


@pytest.mark.parametrize("vendor", ["jazzy", "kilted"])
@pytest.mark.parametrize(
    ("source", "sink"), [("c1", "out"), ("out", "c1")], ids=["outward", "inward"]
)
def test_parameters(lab: Lab, vendor: str, source: str, sink: str) -> None:
    holder = lab.node(vendor, source, "hold", name="motor")
    client = lab.node("jazzy", sink, "tune", of="motor")
    client.wait_for("^listed .*speed")
    client.wait_for("^set True$")
    client.wait_for("^parameter 7$")
    holder.wait_for("^changed speed=7$")
