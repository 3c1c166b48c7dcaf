"""Topics, services and actions between nodes inside and outside, in both directions."""

from __future__ import annotations

import pytest

from tests.ros.processes import wait_until
from tests.ros2.lab import Lab

ways = pytest.mark.parametrize(
    ("source", "sink"), [("c1", "out"), ("out", "c1")], ids=["outward", "inward"]
)
PAIRS = [("jazzy", "jazzy"), ("jazzy", "kilted"), ("kilted", "jazzy")]
pairings = pytest.mark.parametrize(
    ("source_vendor", "sink_vendor"),
    PAIRS,
    ids=[f"{source_vendor}-to-{sink_vendor}" for source_vendor, sink_vendor in PAIRS],
)


@ways
@pairings
def test_topics(lab: Lab, source_vendor: str, sink_vendor: str, source: str, sink: str) -> None:
    lab.node(source_vendor, source, "pub", topic="/chatter")
    lab.node(sink_vendor, sink, "sub", topic="/chatter").wait_for_count("^got hello ", 5)


@ways
@pytest.mark.parametrize("order", ["writer-first", "reader-first"])
def test_latched_topics(lab: Lab, order: str, source: str, sink: str) -> None:
    kinds = ["pub", "sub"] if order == "writer-first" else ["sub", "pub"]
    nodes = {}
    for kind in kinds:
        role = source if kind == "pub" else sink
        options: dict[str, object] = {"count": 1} if kind == "pub" else {}
        nodes[kind] = lab.node("jazzy", role, kind, topic="/map", latched=True, **options)
        nodes[kind].wait_for("^(sent|ready)")
    nodes["sub"].wait_for("^got hello 0 ")


@ways
def test_messages_in_fragments(lab: Lab, source: str, sink: str) -> None:
    lab.node("jazzy", source, "pub", topic="/image", size=8_000_000, period=1)
    lab.node("jazzy", sink, "sub", topic="/image").wait_for_count("^got hello .* size 8000000", 5)


@ways
def test_best_effort(lab: Lab, source: str, sink: str) -> None:
    lab.node("jazzy", source, "pub", topic="/scan", best_effort=True)
    reader = lab.node("jazzy", sink, "sub", topic="/scan", best_effort=True)
    reader.wait_for_count("^got hello ", 5)


@ways
@pairings
def test_services(lab: Lab, source_vendor: str, sink_vendor: str, source: str, sink: str) -> None:
    lab.node(source_vendor, source, "serve", topic="/add")
    lab.node(sink_vendor, sink, "call", topic="/add").wait_for_count("^reply .* hello", 5)


@ways
def test_a_thousand_calls(lab: Lab, source: str, sink: str) -> None:
    """A single client: with two clients of a service, rmw sometimes loses replies, without
    a proxy.
    """
    lab.node("jazzy", source, "serve", topic="/add")
    options = {"topic": "/add", "count": 1000, "period": 0.001, "in_turn": True}
    caller = lab.node("jazzy", sink, "call", **options)
    answered = [match[1] for match in caller.wait_for_count(r"^reply (\d+) hello", 1000)]
    assert answered == [str(number) for number in range(1000)]


@ways
def test_actions(lab: Lab, source: str, sink: str) -> None:
    lab.node("jazzy", source, "act", topic="/fibonacci")
    client = lab.node("jazzy", sink, "pursue", topic="/fibonacci")
    client.wait_for("^feedback 9$")
    client.wait_for("^result 0 1 1 2 3 5 8 13 21$")


def test_all_nodes_see_each_other(lab: Lab) -> None:
    roles = ("c1", "c1", "c2", "out", "out")
    names = [lab.unique("node") for _ in roles]
    nodes = [
        lab.node("jazzy", role, "names", name=name, period=0.5)
        for role, name in zip(roles, names, strict=True)
    ]
    everybody = "nodes " + " ".join(sorted(names)) + " end"
    for node in nodes:
        node.wait_for(f"^{everybody}$")
    domain = lab.domain()
    assert {len(participant.leases) for participant in domain.inside} == {3}
    assert (len(domain.inside), len(domain.outside)) == (3, 2)
    assert not any(participant.problem for participant in domain.inside)


def test_the_status_names_topics_and_services(lab: Lab) -> None:
    lab.node("jazzy", "c1", "pub", topic="/chatter").wait_for("^sent")
    lab.node("jazzy", "c2", "serve", topic="/add").wait_for("^ready")
    talker, server = (lab.place(role).address for role in ("c1", "c2"))

    def told() -> bool:
        participants = {participant.address: participant for participant in lab.domain().inside}
        if participants.keys() != {talker, server}:
            return False
        return (
            "/chatter" in participants[talker].publishes and "/add" in participants[server].services
        )

    wait_until("topics and services are told", told, 60)
    assert {participant.vendor for participant in lab.domain().inside} == {"Fast DDS"}
    shown = lab.tool("status")
    for text in ("domain 0: peers 10.77.0.2", "Fast DDS", "/chatter", "/add", "172.30.1.11:7410"):
        assert text in shown, shown


def test_the_doctor_tells_what_the_proxy_sees(lab: Lab) -> None:
    lab.node("jazzy", "c1", "pub", topic="/chatter")
    lab.node("jazzy", "out", "sub", topic="/chatter").wait_for_count("^got hello ", 5)
    report = lab.tool("doctor")
    assert "inside: 1 participant of Fast DDS" in report
    assert "outside: 1 participant of Fast DDS" in report
    assert "ERROR" not in report
    assert "WARNING" not in report
