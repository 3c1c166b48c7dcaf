"""The advertised host gets another address, as by DHCP. The name leads there, and all flows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from tests.ros.topology import ADVERTISED_NAME, Topology, boundary_rules, ip, run_command
from tests.ros2.lab import Lab
from tests.ros2.machines import PLAN, built

MOVED = "10.77.0.21"


@pytest.fixture
def topology(tmp_path: Path) -> Iterator[Topology]:
    """Machines for a single test, which changes the machines."""
    with built(PLAN, tmp_path) as topology:
        yield topology


@pytest.fixture
def lab(topology: Topology, tmp_path: Path) -> Iterator[Lab]:
    lab = Lab(topology, tmp_path)
    lab.host = ADVERTISED_NAME
    with lab.used():
        lab.start_proxy()
        yield lab


def move(topology: Topology) -> None:
    """Give the host another address on the LAN, and let its name lead there."""
    host = topology.places["host"].namespace
    proxy = topology.places["px"]
    rules = boundary_rules(replace(PLAN, host=MOVED), [proxy.address])
    run_command("ip", "netns", "exec", host, "nft", "delete", "table", "ip", "boundary")
    run_command("ip", "netns", "exec", host, "nft", "-f", "-", text=rules)
    ip("-n", host, "addr", "del", f"{PLAN.host}/24", "dev", "out0")
    ip("-n", host, "addr", "add", f"{MOVED}/24", "dev", "out0")
    names = Path("/etc/netns") / proxy.namespace / "hosts"
    names.write_text(names.read_text().replace(PLAN.host, MOVED))


@pytest.mark.parametrize("vendor", ["jazzy", "cyclone"])
def test_messages_flow_again_where_the_host_is_now(lab: Lab, vendor: str) -> None:
    lab.node(vendor, "c1", "pub", topic="/outward")
    lab.node("jazzy", "out", "pub", topic="/inward")
    readers = [
        lab.node("jazzy", "out", "sub", topic="/outward"),
        lab.node(vendor, "c2", "sub", topic="/inward"),
    ]
    for reader in readers:
        reader.wait_for_count("^got hello ", 5)
    ports = lab.ports()
    move(lab.topology)
    assert lab.proxy is not None
    lab.proxy.wait_for(f"advertised host {ADVERTISED_NAME} moved: from {PLAN.host} to {MOVED}")
    for reader in readers:
        reader.wait_for_count("^got hello ", 10, since=reader.mark())
    later = lab.node("jazzy", "out", "sub", topic="/outward")
    later.wait_for_count("^got hello ", 5)
    assert lab.ports() == ports
