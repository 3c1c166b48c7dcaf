"""User data on the kernel plane: real nodes, and a proxy with the rights for nftables."""

from __future__ import annotations

import re
import signal
from dataclasses import replace

import pytest

from rosproxy.shared.documents.status_document import LocatorStatus
from tests.ros.processes import Process, wait_until
from tests.ros.topology import MASTER_PORT, OUT_NODE
from tests.ros2.lab import Lab
from tests.ros2.machines import PLAN as SHARED
from tests.ros2.machines import PORTS

PLAN = replace(SHARED, name="k", forwarding=True)
TABLE = f"rosproxy-udp-{PORTS.first}"

ways = pytest.mark.parametrize(
    ("inside", "outside"), [("pub", "sub"), ("sub", "pub")], ids=["outward", "inward"]
)
sizes = pytest.mark.parametrize("size", [0, 1_000_000], ids=["small", "in-fragments"])


def leases(lab: Lab, kind: str = "data") -> list[LocatorStatus]:
    """The leases of a kind of all participants inside."""
    return [
        lease
        for participant in lab.domain().inside
        for lease in participant.leases
        if lease.kind == kind
    ]


def are_forwarded(lab: Lab, count: int) -> bool:
    """Whether there are ``count`` port mappings for user data, all forwarded by the kernel."""
    data_leases = leases(lab)
    return len(data_leases) == count and all(lease.plane == "kernel" for lease in data_leases)


def by_kernel(lab: Lab) -> int:
    """The number of datagrams that the kernel has forwarded."""
    return sum(lease.kernel_datagrams for lease in leases(lab))


def by_proxy(lab: Lab) -> int:
    """The number of user datagrams that the proxy has relayed."""
    return sum(lease.datagrams for lease in leases(lab))


def forwarded_ports(lab: Lab) -> list[int]:
    """The ports that the kernel forwards."""
    text = lab.in_proxy("nft", "list", "map", "inet", TABLE, "ports")
    return [int(port) for port in re.findall(r"(\d+) : \d+", text)]


def tracked_ports(lab: Lab) -> set[int]:
    """The proxy's ports with entries in conntrack on the proxy's machine."""
    text = lab.in_proxy("conntrack", "-L", "-p", "udp", "--orig-dst", lab.place("px").address)
    # The first port of a line is of the original datagrams, the second of the answers.
    return {int(port) for port in re.findall(r"^udp .*?dport=(\d+)", text, re.M)}


def forwarded_reader(lab: Lab, **options: object) -> tuple[Process, Process]:
    """A publisher outside and a subscriber inside, with messages forwarded by the kernel."""
    reader = lab.node("jazzy", "c1", "sub", topic="/chatter", depth=100, **options)
    wait_until("the kernel forwards", lambda: are_forwarded(lab, 2))
    writer = lab.node("jazzy", "out", "pub", topic="/chatter", depth=100, **options)
    reader.wait_for_count("^got hello ", 5)
    return writer, reader


def numbers(reader: Process) -> set[int]:
    """The numbers of the messages that a subscriber has got."""
    return {int(number) for number in re.findall(r"^got hello (\d+) ", reader.output(), re.M)}


@ways
@sizes
def test_no_datagram_passes_user_space(lab: Lab, inside: str, outside: str, size: int) -> None:
    options = {"topic": "/chatter", "size": size, "period": 0.3 if size else 0.1}
    nodes = {inside: lab.node("jazzy", "c1", inside, **options)}
    wait_until("the kernel forwards", lambda: are_forwarded(lab, 2))
    nodes[outside] = lab.node("jazzy", "out", outside, **options)
    nodes["sub"].wait_for_count("^got hello .* size %s" % (size or ""), 10)
    wait_until("datagrams are counted", lambda: by_kernel(lab) > 0)
    assert by_proxy(lab) == 0
    assert all(
        lease.kernel_bytes > 28 * lease.kernel_datagrams
        for lease in leases(lab)
        if lease.kernel_datagrams
    )
    shown = lab.tool("status")
    assert "user data forwarded by the kernel" in shown
    assert re.search(r"kernel .*datagrams, .* as IP packets", shown)


def test_services_pass_the_kernel(lab: Lab) -> None:
    lab.node("jazzy", "c1", "serve", topic="/add")
    wait_until("the kernel forwards", lambda: are_forwarded(lab, 2))
    lab.node("jazzy", "out", "call", topic="/add").wait_for_count("^reply .* hello", 5)
    wait_until("datagrams are counted", lambda: by_kernel(lab) > 0)
    assert by_proxy(lab) == 0


def test_a_locator_for_discovery_too_stays_with_the_proxy(lab: Lab) -> None:
    reader = lab.node("cyclone", "c1", "sub", topic="/chatter")
    lab.node("jazzy", "out", "pub", topic="/chatter")
    reader.wait_for_count("^got hello ", 5)
    (lease,) = leases(lab, "metatraffic")
    assert (lease.plane, lease.reason) == ("copy", "the proxy reads and rewrites discovery")
    assert forwarded_ports(lab) == []


def test_messages_go_on_while_the_proxy_is_dead_and_after(lab: Lab) -> None:
    _, reader = forwarded_reader(lab)
    before = lab.ports()
    assert lab.proxy is not None
    lab.proxy.kill()
    reader.wait_for_count("^got hello ", 20, since=reader.mark())
    lab.start_proxy()
    wait_until("the same ports are given", lambda: lab.ports() == before)
    wait_until("the kernel forwards", lambda: are_forwarded(lab, 2))
    reader.wait_for_count("^got hello ", 20, since=reader.mark())
    assert by_proxy(lab) == 0
    got = numbers(reader)
    assert got == set(range(min(got), max(got) + 1)), "messages were lost"


def test_a_graceful_stop_leaves_nothing_in_the_kernel(lab: Lab) -> None:
    _, reader = forwarded_reader(lab)
    assert lab.proxy is not None
    assert TABLE in lab.in_proxy("nft", "list", "tables")
    lab.proxy.stop(signal.SIGTERM)
    assert "rosproxy" not in lab.in_proxy("nft", "list", "tables")
    lab.start_proxy()
    reader.wait_for_count("^got hello ", 10, since=reader.mark())
    wait_until("the kernel forwards", lambda: are_forwarded(lab, 2))


@pytest.mark.parametrize("way", ["stopped", "killed"])
def test_what_led_to_a_node_that_has_ended_is_gone(lab: Lab, way: str) -> None:
    _, reader = forwarded_reader(lab)
    if way == "stopped":
        reader.stop()
    else:
        reader.kill()
    wait_until("nothing is forwarded", lambda: forwarded_ports(lab) == [])


def test_no_sender_is_tracked(lab: Lab) -> None:
    _, reader = forwarded_reader(lab)
    reader.wait_for_count("^got hello ", 10, since=reader.mark())
    assert not tracked_ports(lab) & set(range(PORTS.first, PORTS.last + 1))


def test_senders_that_began_before_are_forwarded_too(lab: Lab) -> None:
    _, reader = forwarded_reader(lab, period=0.05)
    lab.in_proxy("nft", "delete", "table", "inet", TABLE)
    wait_until("the proxy passes on", lambda: by_proxy(lab) > 0)
    wait_until("the table is there", lambda: TABLE in lab.in_proxy("nft", "list", "tables"))

    def is_led() -> bool:
        before = by_proxy(lab), by_kernel(lab)
        reader.wait_for_count("^got hello ", 20, since=reader.mark())
        return by_proxy(lab) == before[0] and by_kernel(lab) > before[1]

    wait_until("the kernel alone forwards", is_led)


def test_without_the_capability_the_proxy_passes_on_and_says_why(lab: Lab) -> None:
    assert lab.proxy is not None
    lab.proxy.stop(signal.SIGTERM)
    lab.proxy_prefix = ("setpriv", "--bounding-set=-net_admin")
    lab.start_proxy()
    reader = lab.node("jazzy", "c1", "sub", topic="/chatter")
    lab.node("jazzy", "out", "pub", topic="/chatter")
    reader.wait_for_count("^got hello ", 5)
    plane = lab.domain().data_plane
    assert plane is not None
    assert (plane.mode, plane.plane) == ("auto", "copy")
    assert "NET_ADMIN" in plane.reason
    assert {lease.plane for lease in leases(lab)} == {"copy"}
    assert by_proxy(lab) > 0
    assert "NET_ADMIN" in " ".join(lab.tool("status").split())


def test_both_versions_of_ros_have_a_table_each(lab: Lab) -> None:
    assert lab.proxy is not None
    lab.proxy.stop(signal.SIGTERM)
    lab.options += ("--ros", "1", "--master-uri", f"http://{OUT_NODE}:{MASTER_PORT}")
    lab.start_proxy()
    _, reader = forwarded_reader(lab)
    tables = lab.in_proxy("nft", "list", "tables")
    assert f"inet {TABLE}" in tables
    assert f"inet rosproxy-{MASTER_PORT}" in tables
    reader.wait_for_count("^got hello ", 10, since=reader.mark())
    assert by_proxy(lab) == 0
    lab.proxy.stop(signal.SIGTERM)
    assert "rosproxy" not in lab.in_proxy("nft", "list", "tables")
    lab.start_proxy()
