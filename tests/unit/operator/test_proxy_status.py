"""What is made of a proxy's /status."""

from rosproxy.admin.status_document import read_status
from rosproxy_operator.common.proxy_status import nodes_by_address


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
