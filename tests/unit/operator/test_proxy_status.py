"""Facts from a proxy's /status."""

from typing import Any

from rosproxy.shared.documents.requests import ContainerUpdate, read_body
from rosproxy.shared.documents.status_document import MOST_ROWS, read_status
from rosproxy_operator.common.proxy_status import (
    MOST_PARTICIPANTS,
    inside_addresses,
    leases,
    nodes_by_address,
    participants_by_address,
)

PREFIX = "01.0f.45.d1.3c.00.a7.12.00.00.00.00"


def test_the_addresses_of_nodes() -> None:
    ended = {"address": "172.18.0.7:4001", "state": "cleaned", "nodes": ["/ended"]}
    nodes = [
        {"address": "172.18.0.6:4001", "nodes": ["/a"]},
        {"address": "[fd00::1]:1", "nodes": ["/b"]},
        {"address": "172.18.0.6:4002", "nodes": ["/c"]},
        {"address": "nonsense"},
        {},
        ended,
    ]
    by_address = nodes_by_address(read_status({"nodes": nodes}))
    names = {address: [node.nodes for node in statuses] for address, statuses in by_address.items()}
    assert names == {"172.18.0.6": [("/a",), ("/c",)], "fd00::1": [("/b",)]}
    assert not nodes_by_address(read_status({}))


def test_the_proxy_hears_of_each_node_whose_container_is_gone_once() -> None:
    """Also of a node that the proxy has unregistered, because the proxy shows this node as
    a fault.
    """
    nodes = [
        {"address": "172.18.0.6:4001", "nodes": ["/a"], "state": "silent"},
        {"address": "172.18.0.7:4001", "nodes": ["/b"], "state": "cleaned"},
        {"address": "172.18.0.8:4001", "nodes": ["/c"], "state": "ended"},
        {"address": "nonsense"},
    ]
    assert inside_addresses(read_status({"nodes": nodes})) == {"172.18.0.6", "172.18.0.7"}


def inside(*participants: dict[str, Any]) -> dict[str, Any]:
    return {"domains": [{"inside": [*participants]}]}


def test_all_may_be_at_one_address() -> None:
    """The time must not grow with the square of the number: 40,000 nodes took 12 seconds."""
    half = MOST_ROWS // 2 - 2
    nodes = [{"address": "172.18.0.6:4001"}] * half
    status = read_status(inside(*[{"address": "172.18.0.7"}] * half) | {"nodes": nodes})
    assert [len(group) for group in nodes_by_address(status).values()] == [half]
    assert [len(group) for group in participants_by_address(status).values()] == [half]


def test_ports_that_the_next_proxy_would_refuse_are_not_kept() -> None:
    """The next proxy would refuse the whole update, and get no allowed callers."""
    leased = [{"port": port} for port in (0, 11401, 65536, 2**63 - 1)]
    status = read_status(
        inside(
            {"guid_prefix": PREFIX, "leases": leased},
            {"guid_prefix": "", "leases": leased},
            {"guid_prefix": PREFIX.upper(), "leases": leased},
            {"guid_prefix": f"{PREFIX}\n", "leases": leased},
        )
    )
    former = leases(status)
    assert former == {PREFIX: (0, 11401)}
    body = {"former": {prefix: list(ports) for prefix, ports in former.items()}}
    assert read_body(body, ContainerUpdate).former == former


def test_ports_are_kept_up_to_a_bound() -> None:
    """A proxy refuses more than a megabyte."""
    prefixes = [number.to_bytes(12, "big").hex(".") for number in range(2000)]
    each = [{"guid_prefix": prefix, "leases": [{"port": 1}] * 20} for prefix in prefixes]
    kept = leases(read_status(inside(*each)))
    assert (len(kept), {len(ports) for ports in kept.values()}) == (MOST_PARTICIPANTS, {16})
