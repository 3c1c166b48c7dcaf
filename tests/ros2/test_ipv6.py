"""IPv6 alone: each implementation announces participants to a different group.

So Fast DDS and Cyclone DDS do not discover each other by multicast. The proxy hears both groups, as
does the LAN relay on the LAN.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.ros.processes import Process, wait_until
from tests.ros.topology import Topology, remove_leftovers
from tests.ros2.ipv6 import DUAL, GATEWAY6, PLAN6, Topology6
from tests.ros2.lab import LAN_RELAY_PORT, Lab, is_whole, numbers
from tests.ros2.machines import wait_for_links, with_shared_memory

FAST_DDS = {"FASTDDS_BUILTIN_TRANSPORTS": "UDPv6"}
GENERAL = "<General><Transport>udp6</Transport></General>"
CYCLONE = {"CYCLONEDDS_URI": f"<CycloneDDS><Domain>{GENERAL}</Domain></CycloneDDS>"}
SPEAKING = {"jazzy": FAST_DDS, "kilted": FAST_DDS, "cyclone": CYCLONE}
PAIRS = [
    ("jazzy", "jazzy"),
    ("jazzy", "kilted"),
    ("cyclone", "cyclone"),
    ("jazzy", "cyclone"),
    ("cyclone", "jazzy"),
]
pairings = pytest.mark.parametrize(
    ("source_vendor", "sink_vendor"),
    PAIRS,
    ids=[f"{source_vendor}-to-{sink_vendor}" for source_vendor, sink_vendor in PAIRS],
)
ways = pytest.mark.parametrize(
    ("source", "sink"), [("c1", "out"), ("out", "c1")], ids=["outward", "inward"]
)
PEER = ("--bind", "::", "--ros2-peer", "robot")
LAN_RELAY = ("--bind", "::", "--ros2-lan-relay", f"[{GATEWAY6}]:{LAN_RELAY_PORT}")


@pytest.fixture(scope="module", params=[PLAN6, DUAL], ids=["ipv6", "dual"])
def topology(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Topology]:
    """The machines with IPv6 alone, and with both."""
    remove_leftovers()
    topology = Topology6(request.param)
    try:
        topology.build()
        with_shared_memory(topology, tmp_path_factory.mktemp("machines"))
        wait_for_links(topology)
        yield topology
    finally:
        topology.remove()


@pytest.fixture
def lab(topology: Topology, tmp_path: Path) -> Iterator[Lab]:
    """Nothing runs yet."""
    lab = Lab(topology, tmp_path)
    lab.gateway = GATEWAY6
    with lab.used():
        yield lab


def proxy(lab: Lab, *options: str) -> None:
    """Start the proxy, with the LAN relay if in the options."""
    lab.options = options
    if options == LAN_RELAY:
        lab.start_lan_relay()
    lab.start_proxy()


def node(lab: Lab, vendor: str, role: str, kind: str, **options: object) -> Process:
    """Start a node that speaks IPv6 alone."""
    return lab.node(vendor, role, kind, env=SPEAKING[vendor], **options)


@pytest.mark.parametrize("vendor", SPEAKING)
def test_without_the_proxy_nobody_is_met_across(lab: Lab, vendor: str) -> None:
    node(lab, vendor, "c1", "pub", topic="/chatter")
    outer = node(lab, vendor, "out", "sub", topic="/chatter")
    node(lab, vendor, "c2", "sub", topic="/chatter").wait_for_count("^got hello ", 30)
    assert not numbers(outer)


def test_without_the_proxy_implementations_do_not_meet(lab: Lab) -> None:
    node(lab, "jazzy", "c1", "pub", topic="/chatter")
    stranger = node(lab, "cyclone", "c2", "sub", topic="/chatter")
    # On the stranger's machine, this membership would deliver the group to all programs.
    node(lab, "jazzy", "c1", "sub", topic="/chatter").wait_for_count("^got hello ", 30)
    assert not numbers(stranger)


@ways
@pairings
def test_topics(lab: Lab, source_vendor: str, sink_vendor: str, source: str, sink: str) -> None:
    proxy(lab, *LAN_RELAY)
    node(lab, source_vendor, source, "pub", topic="/chatter")
    node(lab, sink_vendor, sink, "sub", topic="/chatter").wait_for_count("^got hello ", 5)


@ways
def test_services(lab: Lab, source: str, sink: str) -> None:
    proxy(lab, *PEER)
    node(lab, "jazzy", source, "serve", topic="/add")
    node(lab, "jazzy", sink, "call", topic="/add").wait_for_count("^reply .* hello", 5)


@ways
def test_where_inside_has_no_way_out(lab: Lab, source: str, sink: str) -> None:
    proxy(lab, *PEER, "--direction", "both")
    node(lab, "jazzy", source, "pub", topic="/chatter")
    node(lab, "jazzy", sink, "sub", topic="/chatter").wait_for_count("^got hello ", 5)
    (participant,) = lab.domain().outside
    assert all(":" in lease.where for lease in participant.leases)


@ways
def test_the_proxy_may_be_killed(lab: Lab, source: str, sink: str) -> None:
    proxy(lab, *LAN_RELAY)
    node(lab, "jazzy", source, "pub", topic="/chatter", period=0.02, depth=1000)
    reader = node(lab, "jazzy", sink, "sub", topic="/chatter", depth=1000)
    reader.wait_for_count("^got hello ", 5)
    before = lab.ports()
    lab.restart_proxy()
    reader.wait_for_count("^got hello ", 5, since=reader.mark())
    wait_until("the same ports", lambda: lab.ports() == before, 60)
    assert is_whole(reader)
