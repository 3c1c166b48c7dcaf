"""The document at ``/status``: any content is read, and writing and reading change nothing."""

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.shared.documents.status_document import (
    MOST_MISFITS,
    MOST_ROWS,
    ConnectionStatus,
    EndpointStatus,
    NotAStatus,
    ProxyStatus,
    parse_status,
    read_status,
    to_json,
)
from tests.unit.status_json import make_connection, make_node, make_status

PLANE = {"plane": "kernel", "port": 45050, "reason": None, "connections": 2, "sent": 7}


def a_status() -> dict[str, Any]:
    node = make_node(connections=[make_connection()], data_plane=PLANE)
    return make_status(node, problems=[{"age": 3, "subject": "/talker", "text": "gone"}])


def test_a_status_is_the_same_after_reading_and_writing() -> None:
    status = parse_status(json.dumps(a_status()))
    assert (status.version, status.pid, status.uptime) == ("0.1.0", 42, 75.0)
    assert status.settings.inside_networks == ("10.0.0.0/24",)
    (node,) = status.nodes
    assert (node.nodes, node.address, node.given_up) == (("/talker",), "10.0.0.5:40001", False)
    assert node.connections[0].caller_id == "/listener"
    assert node.data_plane is not None
    assert (node.data_plane.port, node.data_plane.reason) == (45050, None)
    assert parse_status(json.dumps(to_json(status))) == status
    assert make_status().keys() <= to_json(status).keys()
    assert make_node().keys() <= to_json(status)["nodes"][0].keys()


@pytest.mark.parametrize(
    "text", ["", "no JSON", "[]", "null", '{"hello": "world"}', "[" * 100_000, b"\xff"]
)
def test_what_is_no_status(text: str | bytes) -> None:
    with pytest.raises(NotAStatus):
        parse_status(text)


def test_what_is_missing_has_a_default_and_what_is_unknown_is_ignored() -> None:
    assert parse_status('{"settings": {}, "of another version": [1]}') == ProxyStatus()


def test_what_does_not_fit_leaves_the_rest_alone() -> None:
    status = a_status()
    status |= {"uptime": float("nan"), "pid": 2**64, "stand_ins": 3, "data_plane": []}
    status["master"] |= {"error": None, "round_trip": "fast", "since": float("inf")}
    status["ports"]["used"] = -1
    status["nodes"][0] |= {"state": 7, "publishes": ["/a", 1, None], "data_plane": {"port": []}}
    status["nodes"][0]["connections"] += ["x", {"name": "/b", "sent": True}]
    status["nodes"] += ["x", None]
    parsed = parse_status(json.dumps(status))
    assert (parsed.uptime, parsed.pid, parsed.stand_ins, parsed.data_plane) == (0.0, 0, (), None)
    assert (parsed.master.up, parsed.master.uri) == (True, "http://robot:11311")
    assert (parsed.master.error, parsed.master.round_trip, parsed.master.since) == ("", None, 0.0)
    assert (parsed.ports.used, parsed.ports.free) == (0, 99)
    (node,) = parsed.nodes
    assert (node.state, node.publishes, node.address) == ("", ("/a",), "10.0.0.5:40001")
    assert [c.name for c in node.connections] == ["/chatter", "/b"]
    assert node.data_plane is not None
    assert node.data_plane.port is None


@pytest.mark.parametrize(
    "odd", ['{"settings": {"udp": "\\ud800"}}', '{"settings": {"\\ud800": 1}}']
)
def test_half_of_a_surrogate_pair_leaves_the_rest_alone(odd: str) -> None:
    """Such a text must not end the operator's task for the proxy."""
    assert parse_status(odd) == ProxyStatus()


def test_rows_with_a_value_that_does_not_fit_are_bounded() -> None:
    """To read 40,000 of them took 1.2 s of an operator's event loop."""
    rows = [{"nodes": [1], "address": "172.18.0.5:1"}] * (2 * MOST_MISFITS)
    status = read_status({"settings": {}, "nodes": [{"nodes": ["/good"]}, *rows], "pid": 7})
    assert status.nodes[0].nodes == ("/good",)
    assert status.nodes[1] == EndpointStatus(address="172.18.0.5:1")
    assert len(status.nodes) == MOST_MISFITS
    assert status.pid == 7


def test_a_document_of_too_many_rows_is_not_read() -> None:
    """A hostile proxy may send a million rows in 4 MB, which would take the operator minutes."""
    full: dict[str, Any] = {"settings": {}, "nodes": [{}] * (MOST_ROWS - 2)}
    assert len(parse_status(json.dumps(full)).nodes) == MOST_ROWS - 2
    full["nodes"] = [{}] * (MOST_ROWS - 1)
    with pytest.raises(NotAStatus, match="more than 50000 objects"):
        parse_status(json.dumps(full))
    with pytest.raises(NotAStatus):
        read_status({"domains": [{"inside": [{}] * MOST_ROWS}]})


def test_names_hold_whatever_a_node_says() -> None:
    odd = "/\udc80\x1b[2J\u202e" + "x" * 100_000
    assert parse_status(json.dumps(make_status(make_node(odd)))).nodes[0].nodes == (odd,)


_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: (
        st.lists(inner)
        | st.dictionaries(
            st.sampled_from([*ProxyStatus.__struct_fields__, *EndpointStatus.__struct_fields__])
            | st.sampled_from(ConnectionStatus.__struct_fields__)
            | st.text(),
            inner,
        )
    ),
)


@given(_JSON)
def test_nothing_is_too_strange(document: Any) -> None:
    status = read_status(document)
    assert parse_status(json.dumps(to_json(status))) == status
