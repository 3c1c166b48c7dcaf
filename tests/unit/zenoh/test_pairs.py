"""Pairs of nodes: the proxy says why two nodes do not meet, and claims no more than it knows."""

from itertools import product
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from rosproxy.shared.documents.doctor_finding import DoctorFinding, Severity
from rosproxy.shared.documents.status_document import (
    HiddenStatus,
    MismatchStatus,
    PolicyStatus,
    ZenohLinkStatus,
    ZenohNodeStatus,
    ZenohSessionStatus,
    ZenohStatus,
)
from rosproxy.zenoh.pairs import Graph, Pair, is_inside

TALKER = ZenohNodeStatus(
    "/talker",
    address="172.18.0.3",
    publishes=("/chatter",),
    port=7448,
    mode="peer",
    key="0 a.0/talker",
)
LISTENER = ZenohNodeStatus("/listener", subscribes=("/chatter",), key="0 b.0/listener")
NEIGHBOUR = replace(
    LISTENER, name="/neighbour", address="172.18.0.4", port=7449, mode="peer", key="0 c.0/neighbour"
)
NAMES = ("topic", 0, "/chatter")
HIDDEN = PolicyStatus(
    hidden=(HiddenStatus("publish", "/chatter", "/talker", "operator: deny /c*", "172.18.0.3"),)
)


def judged(
    *nodes: ZenohNodeStatus, policy: PolicyStatus | None = None, **zenoh: Any
) -> list[DoctorFinding]:
    """The findings about the pairs of /chatter in domain 0."""
    graph = Graph(ZenohStatus(nodes=nodes, **zenoh), policy)
    return [graph.judge(pair) for pair in graph.pairs(NAMES)]


def checks(*nodes: ZenohNodeStatus, **given: Any) -> list[str]:
    return [finding.check for finding in judged(*nodes, **given)]


def test_nodes_with_the_same_topic_match() -> None:
    (finding,) = judged(TALKER, LISTENER)
    assert (finding.severity, finding.check) == (Severity.OK, "match")
    assert finding.text == "/talker (172.18.0.3) and /listener (outside) match"


def test_every_publisher_is_a_pair_with_every_subscriber() -> None:
    other = replace(TALKER, name="/other", key="0 d.0/other")
    graph = Graph(ZenohStatus(nodes=(TALKER, other, LISTENER, NEIGHBOUR)), None)
    assert [*graph.pairs(NAMES)] == [
        Pair("topic", "/chatter", *ends) for ends in product((TALKER, other), (LISTENER, NEIGHBOUR))
    ]


def test_pairs_outside_do_not_concern_the_proxy() -> None:
    assert not checks(replace(TALKER, port=None), LISTENER)


@pytest.mark.parametrize(
    ("policy", "check", "severity"),
    [("type", "type", Severity.ERROR), ("durability", "qos", Severity.OK)],
)
def test_what_does_not_match_is_told_with_the_pair(
    policy: str, check: str, severity: Severity
) -> None:
    pair = MismatchStatus("topic", "/chatter", policy, "A", "B", TALKER.key, LISTENER.key)
    broken, other = judged(TALKER, LISTENER, NEIGHBOUR, mismatches=(pair,))
    assert (broken.check, broken.severity) == (check, severity)
    assert broken.fix
    assert other.check == "match"


def test_type_hashes_are_shortened_and_humble_is_named() -> None:
    hashes = ("RIHS01_" + "a" * 64, "RIHS01_" + "b" * 64)
    pair = MismatchStatus("topic", "/chatter", "type hash", *hashes, TALKER.key, LISTENER.key)
    (finding,) = judged(TALKER, LISTENER, mismatches=(pair,))
    assert len(finding.text) < 200
    assert "same version of its package" in finding.fix
    humble = replace(pair, requested="TypeHashNotSupported")
    (finding,) = judged(TALKER, LISTENER, mismatches=(humble,))
    assert "Humble" in finding.fix


def test_a_rule_keeps_nodes_of_two_containers_apart_and_not_those_of_one() -> None:
    (denied,) = judged(TALKER, LISTENER, policy=HIDDEN)
    assert (denied.check, denied.severity) == ("policy", Severity.INFO)
    assert denied.text == "hidden from outside by the policy: operator: deny /c*"
    assert checks(TALKER, NEIGHBOUR, policy=HIDDEN) == ["policy"]
    beside = replace(NEIGHBOUR, port=TALKER.port, address=TALKER.address)
    assert checks(TALKER, beside, policy=HIDDEN) == ["match"]
    assert checks(TALKER, policy=HIDDEN) == ["policy"], "also without another end"
    new = replace(TALKER, not_judged=True)
    for finding in (*judged(new, LISTENER), *judged(new)):
        assert finding.severity is Severity.INFO
        assert finding.text.startswith("not known yet")
    assert judged(new, LISTENER, policy=HIDDEN) == [denied]
    assert checks(new, replace(beside, not_judged=True)) == ["match"]


def test_a_rule_for_another_container_changes_nothing() -> None:
    other = replace(TALKER, address="172.18.0.9", key="0 e.0/talker")
    assert checks(other, LISTENER, policy=HIDDEN) == ["match"]


def test_peers_of_one_router_at_two_addresses_do_not_meet() -> None:
    beside = replace(NEIGHBOUR, port=TALKER.port)
    sessions = tuple(
        ZenohSessionStatus(7448, "peer", "", "172.18.0.2:7448", f"{node.address}:50000")
        for node in (TALKER, beside)
    )
    (finding,) = judged(TALKER, beside, sessions=sessions)
    assert (finding.check, finding.severity) == ("shared port", Severity.WARNING)
    client = replace(beside, mode="client")
    assert checks(TALKER, client, sessions=sessions) == ["match"]


@pytest.mark.parametrize(
    "gap", [{"policy": PolicyStatus(left_out=1)}, {"not_compared": 1}, {"mismatches_left_out": 1}]
)
def test_a_pair_is_not_known_to_match_if_the_status_has_gaps(gap: dict[str, Any]) -> None:
    (finding,) = judged(TALKER, LISTENER, **gap)
    assert finding.severity is Severity.INFO
    assert finding.text.startswith("not known")


def test_a_publisher_alone_names_the_other_domain_and_links_that_are_down() -> None:
    (alone,) = judged(TALKER)
    assert (alone.check, alone.severity) == ("alone", Severity.INFO)
    assert alone.text == "no subscription is known in domain 0"
    (alone,) = judged(TALKER, links=(ZenohLinkStatus("robot:7447", error="refused"),))
    assert alone.text.endswith("No link to robot:7447: the nodes there are not known")
    elsewhere = replace(LISTENER, domain=7)
    assert checks(TALKER, elsewhere) == ["domain"]
    served = replace(TALKER, name="/other", domain=7, port=None)
    assert checks(TALKER, elsewhere, served) == ["alone"], "the other domain is complete"


def test_a_subscriber_alone_is_told_and_a_node_is_no_pair_with_itself() -> None:
    (alone,) = judged(replace(LISTENER, port=7448))
    assert alone.text == "no publisher is known in domain 0"
    both = replace(TALKER, subscribes=("/chatter",))
    assert checks(both) == ["alone", "alone"]


NODES = st.lists(
    st.builds(
        ZenohNodeStatus,
        st.sampled_from(["/a", "/b"]),
        st.integers(0, 1),
        st.sampled_from(["", "172.18.0.3", "172.18.0.4"]),
        st.sets(st.sampled_from(["/chatter", "/scan"])).map(tuple),
        st.sets(st.sampled_from(["/chatter", "/scan"])).map(tuple),
        port=st.sampled_from([None, 7448, 7449]),
        mode=st.sampled_from(["peer", "client", ""]),
    ),
    max_size=6,
)


@given(NODES)
def test_every_pair_has_a_node_inside_and_a_finding(nodes: list[ZenohNodeStatus]) -> None:
    graph = Graph(ZenohStatus(nodes=tuple(nodes)), None)
    for names in [*graph.by_name]:
        pairs = [*graph.pairs(names)]
        assert len(pairs) <= graph.size(names)
        for pair in pairs:
            ends = [node for node in (pair.source, pair.target) if node]
            assert any(map(is_inside, ends))
            assert all(node.domain == names[1] for node in ends)
            assert graph.judge(pair).subject == f"topic {pair.name}"
