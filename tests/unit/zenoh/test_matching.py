"""Nodes that do not match: by type, by type hash, or by durability."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.shared.documents.status_document import MismatchStatus
from rosproxy.zenoh.matching import MOST_COMPARISONS, MOST_MISMATCHES_OF_NAME, Comparison, compare
from rosproxy.zenoh.protocol.liveliness import Entity, EntityKind, Qos

STRING = "std_msgs::msg::dds_::String_"
NUMBER = "std_msgs::msg::dds_::Int32_"
LATCHED = Qos(durability="TRANSIENT_LOCAL")
INSIDE = "aa"
OUTSIDE = "bb"


def publisher(node: str = "/talker", session: str = INSIDE, **changes: Any) -> Entity:
    made = Entity(0, session, 1, EntityKind.PUBLISHER, node, "/chatter", STRING, "H1")
    return made._replace(**changes)


def subscription(node: str = "/listener", session: str = OUTSIDE, **changes: Any) -> Entity:
    return publisher(node, session, **{"kind": EntityKind.SUBSCRIPTION, **changes})


def found(*entities: Entity) -> tuple[MismatchStatus, ...]:
    comparison = compare(entities, {INSIDE})
    assert not comparison.not_compared
    return comparison.mismatches + comparison.late


def test_nodes_with_the_same_key_match() -> None:
    assert compare((publisher(), subscription()), {INSIDE}) == Comparison()


@pytest.mark.parametrize(
    ("changes", "policy", "offered", "requested"),
    [
        ({"type": NUMBER}, "type", "std_msgs/msg/String", "std_msgs/msg/Int32"),
        ({"type_hash": "H2"}, "type hash", "H1", "H2"),
        ({"qos": LATCHED}, "durability", "VOLATILE", "TRANSIENT_LOCAL"),
    ],
)
def test_what_differs_is_named(
    changes: dict[str, Any], policy: str, offered: str, requested: str
) -> None:
    assert found(publisher(), subscription(**changes)) == (
        MismatchStatus(
            *("topic", "/chatter", policy, offered, requested),
            *(f"0 {INSIDE}.1/talker", f"0 {OUTSIDE}.1/listener"),
        ),
    )


def test_a_service_has_a_server_and_a_client() -> None:
    server = publisher("/server", kind=EntityKind.SERVICE)
    client = publisher("/client", OUTSIDE, kind=EntityKind.SERVICE_CLIENT, type=NUMBER)
    (pair,) = found(server, client)
    assert (pair.kind, pair.writer, pair.reader) == (
        "service",
        f"0 {INSIDE}.1/server",
        f"0 {OUTSIDE}.1/client",
    )
    latched = client._replace(type=STRING, qos=LATCHED)
    assert not found(server, latched), "services keep no messages"


def test_the_best_pair_of_two_nodes_counts() -> None:
    assert not found(publisher(type=NUMBER), publisher(), subscription())
    late = subscription(qos=LATCHED)
    assert not found(publisher(), publisher(qos=LATCHED), late)
    assert not found(publisher(), late, subscription()), "one subscription gets all it asks for"


def test_a_publisher_that_keeps_messages_also_serves_those_that_want_none() -> None:
    assert not found(publisher(qos=LATCHED), subscription())


def test_other_domains_and_pairs_outside_are_not_compared() -> None:
    assert not found(publisher(domain=5), subscription(type=NUMBER))
    assert not found(publisher(session=OUTSIDE), subscription(type=NUMBER))
    assert found(publisher(session=OUTSIDE), subscription(session=INSIDE, type=NUMBER))


def test_nodes_with_the_same_entities_are_compared_once() -> None:
    many = [publisher(f"/p{n}") for n in range(300)]
    many += [subscription(f"/s{n}", qos=Qos() if n else LATCHED) for n in range(300)]
    comparison = compare((*many, subscription(type=NUMBER)), {INSIDE})
    assert len(comparison.mismatches) == len(comparison.late) == MOST_MISMATCHES_OF_NAME
    assert comparison.left_out == 300 - MOST_MISMATCHES_OF_NAME, "late pairs are not counted"
    assert not comparison.not_compared


def test_a_name_with_too_many_entities_hides_no_other_name() -> None:
    flood = [publisher(f"/p{n}", OUTSIDE, name="/flood", type=f"p{n}") for n in range(101)]
    flood += [subscription(f"/s{n}", INSIDE, name="/flood", type=f"s{n}") for n in range(101)]
    comparison = compare((*flood, publisher(), subscription(type=NUMBER)), {INSIDE})
    assert [pair.name for pair in comparison.mismatches] == ["/chatter"]
    assert comparison.not_compared == 101 * 101 > MOST_COMPARISONS


def test_all_entities_of_a_node_count() -> None:
    """With forty types of each node, the comparison took eight times as long."""
    flood = [publisher(f"/p{n % 99}", name="/flood", type=f"p{n}") for n in range(4000)]
    flood += [subscription(f"/s{n % 99}", name="/flood", type=f"s{n}") for n in range(4000)]
    comparison = compare((*flood, publisher(), subscription(type=NUMBER)), {INSIDE})
    assert [pair.name for pair in comparison.mismatches] == ["/chatter"]
    assert comparison.not_compared == 99 * 99 < MOST_COMPARISONS


def test_the_mismatches_of_a_name_are_counted() -> None:
    flood = [publisher(f"/p{n}", name="/flood") for n in range(4000)]
    flood += [subscription(f"/s{n}", INSIDE, name="/flood", type=NUMBER) for n in range(4000)]
    comparison = compare((*flood, publisher(), subscription(type=NUMBER)), {INSIDE})
    assert len(comparison.mismatches) == MOST_MISMATCHES_OF_NAME + 1
    assert comparison.left_out == 4000 * 4000 - MOST_MISMATCHES_OF_NAME


def test_a_flood_of_types_is_shortened() -> None:
    types = [publisher(type=f"{'x' * 100}{n}") for n in range(500)]
    (pair,) = found(*types, subscription())
    assert len(pair.offered) < 400


ENTITIES = st.builds(
    Entity,
    st.integers(0, 1),
    st.sampled_from([INSIDE, OUTSIDE]),
    st.integers(0, 1),
    st.sampled_from([kind for kind in EntityKind if kind is not EntityKind.NODE]),
    st.sampled_from(["/a", "/b"]),
    st.sampled_from(["/x", "/y"]),
    st.sampled_from([STRING, NUMBER]),
    st.sampled_from(["H1", "H2"]),
    st.sampled_from([Qos(), LATCHED]),
)


@given(st.lists(ENTITIES, max_size=12))
def test_nodes_that_share_a_key_differ_in_durability_alone(entities: list[Entity]) -> None:
    kinds = {
        "topic": (EntityKind.PUBLISHER, EntityKind.SUBSCRIPTION),
        "service": (EntityKind.SERVICE, EntityKind.SERVICE_CLIENT),
    }
    comparison = compare(entities, {INSIDE})
    assert not comparison.not_compared
    for pair in (*comparison.mismatches, *comparison.late):
        sides = [
            {
                (entity.type, entity.type_hash)
                for entity in entities
                if (entity.node_key, entity.kind, entity.name) == (key, kind, pair.name)
            }
            for key, kind in zip((pair.writer, pair.reader), kinds[pair.kind], strict=True)
        ]
        assert all(sides)
        assert sides[0].isdisjoint(sides[1]) is (pair.policy != "durability")
    assert all(pair.policy == "durability" for pair in comparison.late)


@given(st.lists(ENTITIES, max_size=12))
def test_every_pair_that_shares_no_key_is_found(entities: list[Entity]) -> None:
    """The simple way: compare each publisher with each subscription."""
    by_node: dict[tuple[str, str], set[tuple[str, str]]] = {}
    for entity in entities:
        if entity.name == "/x" and entity.domain == 0:
            key = (entity.kind.value, entity.node_key)
            by_node.setdefault(key, set()).add((entity.type, entity.type_hash))
    expected = {
        (writer, reader)
        for (kind, writer), offered in by_node.items()
        for (other, reader), requested in by_node.items()
        if (kind, other) == ("MP", "MS")
        and offered.isdisjoint(requested)
        and f"0 {INSIDE}." in (writer[:5], reader[:5])
    }
    told = {
        (pair.writer, pair.reader)
        for pair in compare(entities, {INSIDE}).mismatches
        if pair.kind == "topic" and pair.name == "/x" and pair.writer.startswith("0")
    }
    assert told == expected
