"""What the doctor does at most, whatever nodes, participants and the master say."""

import asyncio
from collections.abc import Mapping
from typing import Any

import pytest

from rosproxy.doctor import graph_survey
from rosproxy.doctor.facts import (
    MOST_PAIRS,
    DoctorFacts,
    ReachOutcome,
    SlaveReport,
    SystemState,
    scope,
    slave_report,
)
from rosproxy.doctor.graph_survey import MOST_QUESTIONS, MOST_TRIED, ask_graph
from rosproxy.doctor.rules import node as node_rules
from rosproxy.doctor.rules import pair as pair_rules
from rosproxy.doctor.rules.pair import MOST_COMPARED_NAMES, MOST_ONE_SIDED
from rosproxy.ros1.protocol.xmlrpc.limits import OWN_REPLY, Limits
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.machine.resolver import NODES
from tests.unit.doctor.cases import make_facts


class MadeUpMaster:
    """A master and nodes that answer.

    ``asked`` are the hosts and methods of calls to nodes, ``parameters`` the bounds of parameters.
    """

    def __init__(self, uris: Mapping[str, str], topics: Mapping[str, Any]) -> None:
        self.master_uri = "http://robot:11311"
        self.asked = list[tuple[str, str]]()
        self.parameters = dict[str, Limits]()
        self.under_way = self.most_under_way = 0
        self._uris = uris
        self._state = [[*map(list, topics.items())], [], []]

    async def master_addresses(self) -> list[str]:
        return ["192.0.2.1"]

    async def close(self) -> None:
        pass

    def reach(self, target: HostPort) -> HostPort:
        return target

    async def call_master(self, method: str, *params: Any, limits: Limits = OWN_REPLY) -> Any:
        if method == "getParam":
            self.parameters[params[0]] = limits
        return {"getSystemState": self._state, "getPid": 1}.get(method)

    async def look_up(self, _: str, names: Any) -> dict[str, str]:
        return {name: self._uris[name] for name in names if name in self._uris}

    async def call_node(self, slave: HostPort, _: float, method: str, *__: Any, **___: Any) -> Any:
        self.asked.append((slave.host, method))
        self.under_way += 1
        self.most_under_way = max(self.most_under_way, self.under_way)
        await asyncio.sleep(0)
        self.under_way -= 1
        return {"getPid": 7, "getPublications": [["/t", "x" * 1000]]}.get(method, [])


@pytest.fixture
def resolved(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The sources of the names that are looked up."""
    sources = list[str]()

    async def resolve(host: str, source: str = "") -> list[str]:
        sources.append(source)
        return [host]

    monkeypatch.setattr(graph_survey, "resolve", resolve)
    return sources


async def survey(
    monkeypatch: pytest.MonkeyPatch,
    master: MadeUpMaster,
    choose: Any = None,
    names: tuple[str, ...] = (),
) -> DoctorFacts:
    monkeypatch.setattr(graph_survey, "MasterClient", lambda *_: master)
    return await ask_graph(DoctorFacts(names=names), master.master_uri, None, choose)


async def test_of_many_nodes_a_fair_part_is_tried(
    monkeypatch: pytest.MonkeyPatch, resolved: list[str]
) -> None:
    """Ten thousand made-up nodes that do not answer took a quarter of an hour."""
    uris = {f"/evil{n}": f"http://192.0.2.66:{n + 1}/" for n in range(MOST_TRIED + 500)}
    uris["/robot"] = "http://192.0.2.7:40000/"
    master = MadeUpMaster(uris, {"/t": list(uris)})
    facts = await survey(monkeypatch, master)
    assert len(master.asked) == MOST_TRIED
    assert facts.nodes["/robot"].attempt.reach is ReachOutcome.ANSWERED
    assert facts.untried == 501
    assert master.most_under_way <= MOST_QUESTIONS
    assert set(resolved) == {""}
    texts = [f.text for f in node_rules.check(facts)]
    assert "501 nodes are not tried: too many are registered at the master" in texts


async def test_the_page_looks_names_up_as_names_of_nodes(
    monkeypatch: pytest.MonkeyPatch, resolved: list[str]
) -> None:
    """Names that hang took the look-ups that the proxy needs for the master."""
    master = MadeUpMaster({"/n": "http://robot:40000/"}, {"/t": ["/n"]})
    await survey(monkeypatch, master, lambda _: ("/t",))
    assert set(resolved) == {NODES}


async def test_no_long_parameter_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    """Any program can set it: 70,000 structs held up the proxy for 1.8 s, at each look."""
    master = MadeUpMaster({}, {})
    await survey(monkeypatch, master)
    assert master.parameters.keys() == {"/rosproxy", "/use_sim_time"}
    for limits in master.parameters.values():
        assert limits.size <= 4 * 1024 * 1024
        assert limits.elements <= 10_000


@pytest.mark.parametrize(("most", "is_kept"), [(2000, True), (1000, False)])
async def test_a_long_report_of_a_node_is_not_kept(
    monkeypatch: pytest.MonkeyPatch, resolved: list[str], most: int, is_kept: bool
) -> None:
    """While a page was open, the reports of hostile nodes filled the memory of the proxy."""
    monkeypatch.setattr(graph_survey, "MOST_REPORT_CHARACTERS", 2 * most)
    nodes = ["/m", "/n"]
    uris = {name: f"http://192.0.2.7:4000{index}/" for index, name in enumerate(nodes)}
    master = MadeUpMaster(uris, {"/t": nodes})
    master._state[1] = [["/t", nodes]]
    facts = await survey(monkeypatch, master, None, ("/t",))
    assert {node.report is not None for node in facts.nodes.values()} == {is_kept}


def test_a_report_has_only_the_topics_in_question() -> None:
    bus = [[1, "/peer", "o", "TCPROS", topic, 1] for topic in ("/t", "/other")]
    report = slave_report([["/t", "T"], ["/x", "X"]], [["/x", "X"]], bus, topics={"/t"})
    assert report == SlaveReport({"/t": "T"}, {}, frozenset({("o", "/t", "/peer")}))
    assert report.characters == 2 * 200 + len("/tT" + "o/t/peer")


def crowd(name: str, count: int) -> list[str]:
    return [f"/{name}{number}" for number in range(count)]


def test_many_pairs_of_a_topic_hide_no_other_topic() -> None:
    """Two crowds of ten thousand nodes at a topic made a hundred million pairs."""
    publishers = {"/crowded": crowd("p", 10_000), "/quiet": ["/n"]}
    subscribers = {"/crowded": [*crowd("s", 10_000), "/n"], "/quiet": ["/m"]}
    asked = scope(SystemState(publishers, subscribers), ["/n"])
    assert len(asked.pairs) == MOST_PAIRS
    assert asked.has_more_pairs
    assert ("/quiet", "/n", "/m") in asked.pairs
    assert not scope(SystemState(publishers, subscribers), ["/quiet"]).has_more_pairs


def test_a_node_with_many_topics_has_a_bounded_number_of_findings() -> None:
    topics = {f"/n{number}/t": ["/evil"] for number in range(MOST_ONE_SIDED + 5)}
    facts = make_facts(graph=SystemState(topics), names=("/evil",))
    findings = [*pair_rules.check(facts)]
    assert len(findings) == MOST_ONE_SIDED + 1
    assert "5 more topics" in findings[-1].text
    assert findings[0].fix.startswith(
        "compare with /n1/t, /n10/t, /n100/t, /n101/t, /n102/t and 99 "
    )
    assert all(len(finding.fix) < 400 for finding in findings)


def test_an_unknown_name_is_compared_with_some_of_many_names(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    compared = list[int]()

    def matches(_: str, names: list[str], *__: Any) -> list[str]:
        compared.append(len(names))
        return []

    monkeypatch.setattr(pair_rules, "get_close_matches", matches)
    topics = {f"/t{number}": ["/n"] for number in range(2 * MOST_COMPARED_NAMES)}
    facts = make_facts(graph=SystemState(topics), names=("/absent",))
    (finding,) = pair_rules.check(facts)
    assert finding.check == "unknown name"
    assert compared == [MOST_COMPARED_NAMES]
