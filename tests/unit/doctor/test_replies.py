"""Replies to the doctor, sound and broken."""

from typing import Any

import pytest

from rosproxy.doctor.facts import SlaveReport, SystemState, data_port, slave_report, system_state
from rosproxy.shared.addresses import HostPort


def test_graph() -> None:
    state = [[["/t", ["/a", "/b"]]], [["/t", ["/c"]]], [["/s", ["/a"]]]]
    assert system_state(state) == SystemState({"/t": ["/a", "/b"]}, {"/t": ["/c"]}, {"/s": ["/a"]})


@pytest.mark.parametrize("state", [None, "x", 7, [], [1, 2, 3], [[["/t"]], [[1, []]], {}]])
def test_a_broken_graph_is_an_empty_one(state: Any) -> None:
    graph = system_state(state)
    assert not graph.topics
    assert not graph.names()


def test_words() -> None:
    bus = [
        [1, "/c", "o", "TCPROS", "/t", True, "more"],
        [2, "http://a:1/", "i", "TCPROS", "/u", True],
        [3, "http://b:1/", "i", "TCPROS", "/u", False],
        [4, "short"],
        "broken",
    ]
    assert slave_report([["/t", "T"], ["/x"], 3], [["/u", "U"]], bus) == SlaveReport(
        {"/t": "T"}, {"/u": "U"}, frozenset({("o", "/t", "/c"), ("i", "/u", "http://a:1/")})
    )
    assert slave_report(None, "x", 3) == SlaveReport()


def test_a_row_of_rosjava_does_not_say_whether_it_is_connected() -> None:
    """The doctor reported its publishers as not connected, although messages flowed."""
    report = slave_report([], [], [["1", "/c", "o", "TCPROS", "/t"]])
    assert report.peers == {("o", "/t", "/c")}


def test_a_row_that_is_not_connected_is_not_counted() -> None:
    """Nodes may write the boolean as a number or a text."""
    rows = [
        [n, "/x", "o", "TCPROS", f"/{n}", said] for n, said in enumerate((True, 1, "1", 0, "0"))
    ]
    assert {topic for _, topic, _ in slave_report([], [], rows).peers} == {"/0", "/1", "/2"}


@pytest.mark.parametrize(
    ("answer", "expected"),
    [
        (["TCPROS", "a", 5], HostPort("a", 5)),
        (["TCPROS", "a", 0], None),
        (["TCPROS", "a", 70000], None),
        (["TCPROS", 1, 5], None),
        (["UDPROS", "a", 5], None),
        ([], None),
        (0, None),
    ],
)
def test_data_port(answer: Any, expected: HostPort | None) -> None:
    assert data_port(answer) == expected
