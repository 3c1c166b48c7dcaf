"""What is made of a proxy's /status."""

from rosproxy.admin.status_document import read_status
from rosproxy_operator.common.proxy_status import inside_addresses, nodes_by_address


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
    """Also of one that the proxy has unregistered, since the proxy shows that one as a fault."""
    nodes = [
        {"address": "172.18.0.6:4001", "nodes": ["/a"], "state": "silent"},
        {"address": "172.18.0.7:4001", "nodes": ["/b"], "state": "cleaned"},
        {"address": "172.18.0.8:4001", "nodes": ["/c"], "state": "ended"},
        {"address": "nonsense"},
    ]
    assert inside_addresses(read_status({"nodes": nodes})) == {"172.18.0.6", "172.18.0.7"}
