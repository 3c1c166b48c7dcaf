"""Rates, ages, and connections without traffic, from counters and times alone."""

from typing import Any

import pytest
from msgspec.structs import replace

from rosproxy.doctor.facts import DoctorFacts, NodeFacts, SlaveReport, slave_report
from rosproxy.page import measures as module
from rosproxy.page.measures import FLOW_PERIOD_S, STALLED_AFTER_S, Measures
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.uris import parse_slave_uri

KEY = ("/chatter", "/talker", "/listener")
URI = "http://robot-host:45000/"


def facts(sent: int | None, got: int | None, at: float) -> DoctorFacts:
    """Both nodes have counted so many messages of 10 bytes."""
    gave = {} if sent is None else {("o", "/chatter", "/listener"): (10 * sent, sent)}
    took = {} if got is None else {("i", "/chatter", URI): (10 * got, got)}
    return DoctorFacts(
        nodes={
            "/talker": NodeFacts("/talker", URI, report=SlaveReport(counts=gave, at=at)),
            "/listener": NodeFacts(
                "/listener", "http://r:1/", report=SlaveReport(counts=took, at=at)
            ),
        }
    )


def read(*rounds: tuple[float, int | None, int | None]) -> Measures:
    """The measures after some rounds, each with a time and the counts of both sides."""
    measures = Measures()
    for at, sent, got in rounds:
        measures.read_nodes(facts(sent, got, at), [KEY])
    return measures


def test_nothing_is_known_at_first() -> None:
    link = Measures().get(KEY)
    assert (link.message_rate(9.0), link.byte_rate(9.0), link.last(9.0)) == (None, None, None)
    assert not link.is_stalled(100.0)
    once = read((1.0, 5, 5)).get(KEY)
    assert (once.message_rate(9.0), once.last(9.0)) == (None, None)


def test_rates_are_those_of_what_arrives() -> None:
    link = read((1.0, 100, 50), (3.0, 140, 70)).get(KEY)
    assert (link.message_rate(3.0), link.byte_rate(3.0), link.last(3.0)) == (10.0, 100.0, 3.0)


def test_where_the_subscriber_does_not_count_the_publisher_does() -> None:
    assert read((1.0, 100, None), (3.0, 140, None)).get(KEY).message_rate(3.0) == 20.0


def test_where_nobody_counts_nothing_is_said() -> None:
    assert read((1.0, None, None), (3.0, None, None)).get(KEY).message_rate(3.0) is None


def test_the_age_is_that_of_the_last_message_that_arrived() -> None:
    link = read((1.0, 10, 10), (3.0, 20, 20), (5.0, 30, 20), (7.0, 40, 20)).get(KEY)
    assert link.last(7.0) == 3.0
    assert link.message_rate(7.0) == 0.0


def test_a_connection_that_carries_nothing_is_told_after_a_while() -> None:
    rounds = [(1.0, 10, 10), (3.0, 20, 20)]
    rounds += [(3.0 + 2 * step, 20 + 20 * step, 20) for step in (1, 2, 3)]
    link = read(*rounds).get(KEY)
    assert not link.is_stalled(3.0 + STALLED_AFTER_S - 0.1)
    assert link.is_stalled(3.0 + STALLED_AFTER_S)
    assert not read(*rounds, (11.0, 90, 25)).get(KEY).is_stalled(11.0 + STALLED_AFTER_S)


def test_a_topic_on_which_nothing_is_sent_is_well() -> None:
    assert not read((1.0, 10, 10), (3.0, 10, 10), (60.0, 10, 10)).get(KEY).is_stalled(60.0)


def test_one_message_under_way_is_none_that_is_lost() -> None:
    assert not read((1.0, 10, 10), (3.0, 11, 10), (60.0, 11, 10)).get(KEY).is_stalled(60.0)


def test_a_new_connection_begins_anew() -> None:
    link = read((1.0, 900, 900), (3.0, 2, 2), (5.0, 6, 6)).get(KEY)
    assert link.message_rate(5.0) == 2.0
    assert not link.is_stalled(5.0 + STALLED_AFTER_S)


def test_what_the_proxy_relays_counts_while_it_does() -> None:
    measures = Measures()
    measures.read_relays({KEY: 1000}, 1.0)
    measures.read_relays({KEY: 3000}, 2.0)
    assert (measures.get(KEY).byte_rate(2.0), measures.get(KEY).last(2.0)) == (2000.0, 2.0)
    measures.read_relays({}, 3.0)
    assert measures.get(KEY).byte_rate(3.0) is None


def test_what_the_proxy_relays_is_newer_than_what_nodes_are_asked_for() -> None:
    """With a thousand nodes each is asked once in a minute; the proxy counts each second."""
    measures = read((1.0, 10, 10), (31.0, 310, 310))
    for second in range(31, 62):
        measures.read_relays({KEY: 1000 * second}, float(second))
    link = measures.get(KEY)
    assert (link.last(61.0), link.flows(61.0)) == (61.0, True)
    assert not link.flows(61.0 + FLOW_PERIOD_S)
    assert link.last(61.0 + FLOW_PERIOD_S) == 61.0


def test_relayed_bytes_hide_no_connection_without_traffic() -> None:
    """The proxy's counter grows until the buffers behind the proxy are full."""
    measures = read((1.0, 10, 10), (3.0, 20, 20), (9.0, 80, 20))
    measures.read_relays({KEY: 1000}, 8.0)
    measures.read_relays({KEY: 2000}, 9.0)
    link = measures.get(KEY)
    assert link.is_stalled(9.0)
    assert (link.last(9.0), link.flows(9.0)) == (3.0, False)


@pytest.mark.parametrize(("count", "flows"), [(310, True), (11, False), (10, False)])
def test_where_nodes_alone_count_it_flows_if_it_came_often_between_two_questions(
    count: int, flows: bool
) -> None:
    link = read((1.0, 10, 10), (31.0, count, count)).get(KEY)
    assert link.flows(60.0) == flows
    assert read((1.0, 10, 10), (31.0, 310, 310), (61.0, 310, 310)).get(KEY).flows(90.0) is False


def test_counts_of_a_node_that_answers_no_more_are_not_shown() -> None:
    link = read((1.0, 10, 10), (31.0, 310, 310)).get(KEY)
    assert link.flows(90.0), "a round may take longer than the last round"
    assert not link.flows(95.0)
    assert link.last(95.0) == 31.0


def test_a_node_that_answers_no_more_has_no_rate() -> None:
    measures = read((1.0, 10, 10), (3.0, 30, 30))
    measures.read_nodes(facts(60, None, 5.0), [KEY])
    silent = DoctorFacts(nodes={"/talker": NodeFacts("/talker", URI)})
    measures.read_nodes(silent, [KEY])
    link = measures.get(KEY)
    assert (link.message_rate(6.0), link.byte_rate(6.0)) == (15.0, 150.0)
    assert (link.message_rate(60.0), link.byte_rate(60.0)) == (None, None)


def test_the_publisher_counts_if_the_subscriber_answers_no_more() -> None:
    measures = read((1.0, 10, 10), (3.0, 30, 20))
    publisher = facts(90, 0, 9.0).nodes["/talker"]
    measures.read_nodes(DoctorFacts(nodes={**facts(0, 0, 0.0).nodes, "/talker": publisher}), [KEY])
    assert measures.get(KEY).message_rate(11.0) == 10.0


def test_links_that_are_no_more_are_forgotten() -> None:
    measures = read((1.0, 10, 10), (3.0, 20, 20))
    measures.read_nodes(facts(30, 30, 5.0), [])
    assert measures.get(KEY).message_rate(5.0) is None


def test_roscpp_knows_a_publisher_without_the_path_of_its_uri() -> None:
    uri = "http://robot-host:45000/"
    taker = NodeFacts(
        "/listener",
        "http://r:1/",
        report=SlaveReport(counts={("i", "/chatter", uri): (10, 1)}, at=1.0),
    )
    measures = Measures()
    for at, got in ((1.0, 10), (3.0, 30)):
        report = SlaveReport(counts={("i", "/chatter", uri): (10 * got, got)}, at=at)
        nodes = {"/talker": NodeFacts("/talker", URI), "/listener": replace(taker, report=report)}
        measures.read_nodes(DoctorFacts(nodes=nodes), [KEY])
    assert measures.get(KEY).message_rate(3.0) == 10.0


def test_the_report_of_a_node_is_read_once_for_all_its_publishers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A node may register a thousand publishers, and answer a thousand rows."""
    read = list[str]()

    def parse(uri: str) -> HostPort | None:
        read.append(uri)
        return parse_slave_uri(uri)

    monkeypatch.setattr(module, "parse_slave_uri", parse)
    uris = {f"/p{number}": f"http://r:{number}/" for number in range(1, 101)}
    report = SlaveReport(counts={("i", "/t", uri): (1, 1) for uri in uris.values()}, at=1.0)
    nodes = {name: NodeFacts(name, uri) for name, uri in uris.items()}
    nodes["/taker"] = NodeFacts("/taker", "http://r:101/", report=report)
    Measures().read_nodes(DoctorFacts(nodes=nodes), [("/t", name, "/taker") for name in uris])
    assert len(read) == len(uris)


ROSPY: list[Any] = [
    [["/chatter", 120, [[7, 100, 4, True]]]],
    [["/back", [[9, 55, 3, -1, True]]]],
    [],
]
ROSCPP: list[Any] = [[["/chatter", [[7, 100, 96, 4, 0]]]], [["/back", [[9, 55, 3, 0, 0]]]], []]
BUS = [
    [7, "/listener", "o", "TCPROS", "/chatter", True, ""],
    [9, "http://robot:1/", "i", "TCPROS", "/back", 1, ""],
]


def test_counts_of_both_libraries_are_read() -> None:
    for stats in (ROSPY, ROSCPP):
        assert slave_report([], [], BUS, stats, 2.5).counts == {
            ("o", "/chatter", "/listener"): (100, 4),
            ("i", "/back", "http://robot:1/"): (55, 3),
        }


def test_counts_that_make_no_sense_are_none() -> None:
    nonsense: list[Any] = [None, 1, [], [[]], [[["/chatter"]]], [[["/chatter", [[7]]]], 3, "x"]]
    nonsense += [[[["/chatter", 1, [["7", "100", "4", True]]]]], {"a": 1}, [[[[], [[7, 1, 2, 3]]]]]]
    for stats in nonsense:
        assert not slave_report([], [], BUS, stats).counts
