"""The graph of the master, read from any answer."""

from typing import Any

import msgspec
import pytest

from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.registry.endpoint import Registration
from rosproxy.ros1.registry.graph import Graph, read_state, read_types

STATE = [[["/a", ["/n", "/m"]], ["/b", ["/n"]]], [["/a", ["/m"]]], [["/s", ["/n"]]]]
TYPES = [["/a", "t/A"], ["/b", "*"], ["/unused", "t/U"]]


def test_registrations_by_node() -> None:
    assert read_state(STATE, TYPES) == {
        "/n": [
            Registration(Kind.PUBLISHER, "/a", "/n", "t/A"),
            Registration(Kind.PUBLISHER, "/b", "/n", "*"),
            Registration(Kind.SERVICE, "/s", "/n", "*"),
        ],
        "/m": [
            Registration(Kind.PUBLISHER, "/a", "/m", "t/A"),
            Registration(Kind.SUBSCRIBER, "/a", "/m", "t/A"),
        ],
    }
    assert read_state([[], [], []], []) == {}


def test_slave_uris_by_topic() -> None:
    graph = Graph(read_state(STATE, TYPES), {"/n": "http://n:1/", "/m": "http://m:1/"})
    assert graph.by_topic(Kind.PUBLISHER) == {
        "/a": ["http://n:1/", "http://m:1/"],
        "/b": ["http://n:1/"],
    }
    assert graph.by_topic(Kind.SUBSCRIBER) == {"/a": ["http://m:1/"]}
    assert Graph(graph.registrations, {}).by_topic(Kind.PUBLISHER) == {}


@pytest.mark.parametrize(
    "state",
    [
        None,
        0,
        "",
        [],
        [[], []],
        [[], [], [], []],
        {"a": 1},
        [{}, [], []],
        [[["/a"]], [], []],
        [[["/a", "/n"]], [], []],
        [[["/a", [["/n"]]]], [], []],
        [[[5, []]], [], []],
        [["/a"], [], []],
    ],
)
def test_a_state_of_another_form_is_an_error(state: Any) -> None:
    with pytest.raises(msgspec.ValidationError):
        read_state(state, [])


@pytest.mark.parametrize(
    ("rows", "types"),
    [
        (TYPES, {"/a": "t/A", "/b": "*", "/unused": "t/U"}),
        (None, {}),
        (0, {}),
        ({"/a": "t/A"}, {}),
        (
            ["/a", ["/b"], [["/c"], "t/C"], ["/d", 5], ["/e", "t/E", 1], ["/f", "t/F"]],
            {"/f": "t/F"},
        ),
    ],
)
def test_types_leave_out_what_is_none(rows: Any, types: dict[str, str]) -> None:
    assert read_types(rows) == types
