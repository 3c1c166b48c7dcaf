"""A container on two networks loses the network with the proxy.

Not with Cyclone DDS, which keeps the interface from its start.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.ros.topology import Plan, Topology, ip
from tests.ros2.lab import Lab
from tests.ros2.machines import PORTS, built

PLAN = Plan("t", (("c1", "c2"), ("c1",)), PORTS)


@pytest.fixture
def topology(tmp_path: Path) -> Iterator[Topology]:
    """Machines for a single test, which changes the machines."""
    with built(PLAN, tmp_path) as topology:
        yield topology


@pytest.fixture
def lab(topology: Topology, tmp_path: Path) -> Iterator[Lab]:
    lab = Lab(topology, tmp_path)
    with lab.used():
        lab.start_proxy()
        yield lab


@pytest.mark.parametrize("is_told", [False, True], ids=["expires", "told"])
@pytest.mark.parametrize("vendor", ["jazzy", "kilted"])
def test_messages_flow_again_by_the_second(lab: Lab, vendor: str, is_told: bool) -> None:
    """``is_told``: an operator says that the address is gone."""
    lab.node(vendor, "c1", "pub", topic="/outward")
    lab.node("jazzy", "out", "pub", topic="/inward")
    readers = [
        lab.node("jazzy", "out", "sub", topic="/outward"),
        lab.node(vendor, "c1", "sub", topic="/inward"),
    ]
    for reader in readers:
        reader.wait_for_count("^got hello ", 5)
    c1 = lab.place("c1")
    # Each participant is served at the address that was heard first, which may differ.
    served_at = [participant.address for participant in lab.domain().inside]
    gateways = ["172.30.1.1", "172.30.2.1"]
    first = c1.addresses.index(served_at[0])
    second = 1 - first
    ip("-n", c1.namespace, "link", "set", f"eth{first}", "down")
    ip("-n", c1.namespace, "route", "replace", "default", "via", gateways[second])
    if is_told:
        told = lab.tell("/containers", gone=[c1.addresses[first]])
        assert told["unregistered"] == served_at.count(served_at[0])
    for reader in readers:
        reader.wait_for_count("^got hello ", 10, since=reader.mark())
    assert {p.address for p in lab.domain().inside} == {c1.addresses[second]}
