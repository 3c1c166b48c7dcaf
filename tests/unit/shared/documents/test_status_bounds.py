"""The document at ``/status`` stays small, and no address hides the rows of another."""

import json
import re
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from rosproxy.shared.documents import status_bounds
from rosproxy.shared.documents.status_bounds import (
    MOST_BYTES,
    bounded,
    encode,
    encoded_size,
    fair_choice,
    fair_shares,
    fair_shares_by_owner,
    left_out,
)
from rosproxy.shared.documents.status_document import (
    ConnectionStatus,
    DomainStatus,
    EndpointStatus,
    HiddenStatus,
    LayerStatus,
    LocatorStatus,
    MismatchStatus,
    NamedTypeStatus,
    ParticipantStatus,
    PolicyStatus,
    ProblemStatus,
    ProxyStatus,
    StandInStatus,
    UdprosStatus,
    ZenohNodeStatus,
    ZenohQosStatus,
    ZenohSessionStatus,
    ZenohStatus,
    parse_status,
)

GOOD = "172.18.0.5"
EVIL = "172.18.0.66"
LONG = "x" * 1000
MANY = tuple(f"/{number}{LONG}" for number in range(2000))
GOOD_NODE = EndpointStatus(
    nodes=("/good",),
    address=f"{GOOD}:40001",
    publishes=tuple(f"/topic{number}" for number in range(20)),
    connections=(ConnectionStatus(name="/topic1"),),
    problems=("a problem",),
)
GOOD_PARTICIPANT = ParticipantStatus(
    guid_prefix="01",
    address=GOOD,
    publishes=("/scan",),
    types=(NamedTypeStatus("/scan", "sensor_msgs/msg/LaserScan"),),
    leases=(LocatorStatus(11401),),
)
GOOD_DOMAIN = DomainStatus(
    inside=(GOOD_PARTICIPANT,),
    mismatches=(MismatchStatus(name="/scan", writer="01", reader="09"),),
    peers=("robot",),
)
GOOD_STATUS = ProxyStatus(
    nodes=(GOOD_NODE,),
    stand_ins=(StandInStatus(11500, f"http://{GOOD}:40002/"),),
    udpros=(UdprosStatus("/camera", "/viewer", GOOD),),
    policy=PolicyStatus(
        layers=(LayerStatus("administrator", rules=("deny publish /camera",)),),
        hidden=(HiddenStatus("publish", "/camera", "/good", "a rule", GOOD),),
    ),
    domains=(GOOD_DOMAIN,),
    problems=(ProblemStatus(subject="/good", text="a problem"),),
)
EVIL_NODE = EndpointStatus(
    nodes=("/evil",),
    address=f"{EVIL}:40001",
    subscribes=MANY,
    connections=(ConnectionStatus(caller_id=LONG),) * 2000,
)
EVIL_PARTICIPANT = ParticipantStatus(
    guid_prefix="66",
    address=EVIL,
    publishes=MANY,
    types=tuple(NamedTypeStatus(name, LONG) for name in MANY),
)


def _policy(status: ProxyStatus, **more: Any) -> ProxyStatus:
    assert status.policy
    rows = {name: (*rows, *getattr(status.policy, name)) for name, rows in more.items()}
    return replace(status, policy=replace(status.policy, **rows))


def _domain(status: ProxyStatus, **more: Any) -> ProxyStatus:
    (domain,) = status.domains
    rows = {name: (*rows, *getattr(domain, name)) for name, rows in more.items()}
    return replace(status, domains=(replace(domain, **rows),))


FLOODS = {
    "names of a node": replace(GOOD_STATUS, nodes=(EVIL_NODE, GOOD_NODE)),
    "nodes": replace(
        GOOD_STATUS,
        nodes=(*(EndpointStatus(uri=LONG, address=f"{EVIL}:{n}") for n in range(2000)), GOOD_NODE),
    ),
    "stand-ins": replace(
        GOOD_STATUS,
        stand_ins=(
            *(StandInStatus(n, f"http://{EVIL}:{n + 1}/{LONG}") for n in range(2000)),
            *GOOD_STATUS.stand_ins,
        ),
    ),
    "UDPROS": replace(
        GOOD_STATUS, udpros=(UdprosStatus(LONG, LONG, EVIL),) * 2000 + GOOD_STATUS.udpros
    ),
    "hidden names": _policy(
        GOOD_STATUS,
        hidden=tuple(HiddenStatus("publish", name, "/evil", "a rule", EVIL) for name in MANY),
    ),
    "layers": _policy(
        GOOD_STATUS,
        layers=tuple(LayerStatus(name[:200], rules=(LONG[:100],) * 10) for name in MANY[:1000]),
    ),
    "names of a participant": _domain(GOOD_STATUS, inside=(EVIL_PARTICIPANT,)),
    "participants": _domain(GOOD_STATUS, inside=(replace(EVIL_PARTICIPANT, types=()),) * 500),
    "participants outside": _domain(GOOD_STATUS, outside=(EVIL_PARTICIPANT,) * 100),
    "ports": _domain(
        GOOD_STATUS,
        inside=(ParticipantStatus(address=EVIL, leases=(LocatorStatus(where=LONG),) * 16),) * 500,
    ),
    "mismatches": _domain(
        GOOD_STATUS,
        inside=(ParticipantStatus("66", EVIL),),
        mismatches=tuple(MismatchStatus(name=name, writer="66", reader="09") for name in MANY),
    ),
    "peers": _domain(GOOD_STATUS, peers=MANY),
}


@pytest.mark.parametrize("flood", FLOODS)
def test_every_list_is_bounded_and_hides_nothing_of_others(flood: str) -> None:
    status = FLOODS[flood]
    shown = bounded(status)
    assert len(encode(status)) > MOST_BYTES
    assert 0.5 * MOST_BYTES < len(encode(shown)) <= MOST_BYTES
    assert parse_status(encode(shown)) == shown
    assert GOOD_NODE in shown.nodes
    assert GOOD_STATUS.problems == shown.problems
    assert set(GOOD_STATUS.stand_ins) <= set(shown.stand_ins)
    assert set(GOOD_STATUS.udpros) <= set(shown.udpros)
    assert shown.policy
    assert GOOD_STATUS.policy
    assert set(GOOD_STATUS.policy.hidden) <= set(shown.policy.hidden)
    (domain,) = shown.domains
    assert GOOD_PARTICIPANT in domain.inside
    assert set(GOOD_DOMAIN.mismatches) <= set(domain.mismatches)
    assert set(GOOD_STATUS.policy.layers) <= set(shown.policy.layers)
    assert _rows(shown) + _rows_left_out(shown) == _rows(status)
    assert re.search(rb'left_out":[1-9]', encode(shown))


@pytest.mark.parametrize(
    "flood",
    [
        {"nodes": (ZenohNodeStatus("/evil", address=EVIL, publishes=MANY),) * 2},
        {"nodes": tuple(ZenohNodeStatus(name, address=EVIL) for name in MANY)},
        {"sessions": (ZenohSessionStatus(zid=LONG, remote=f"{EVIL}:40000"),) * 2000},
        {"mismatches": (MismatchStatus(offered=LONG, writer="0 bb.0/evil"),) * 2000},
    ],
)
def test_what_zenoh_tells_is_bounded(flood: dict[str, Any]) -> None:
    good_node = ZenohNodeStatus("/good", address=GOOD, publishes=("/scan",))
    good_session = ZenohSessionStatus(zid="01", remote=f"{GOOD}:40000")
    good_mismatch = MismatchStatus(name="/scan", writer="0 aa.0/good")
    good_node = replace(good_node, port=7448, key=good_mismatch.writer)
    flood = {"nodes": (), "sessions": (), "mismatches": ()} | flood
    zenoh = ZenohStatus(
        nodes=(*flood["nodes"], good_node),
        sessions=(*flood["sessions"], good_session),
        mismatches=(*flood["mismatches"], good_mismatch),
    )
    shown = bounded(ProxyStatus(zenoh=zenoh))
    assert 0.5 * MOST_BYTES < len(encode(shown)) <= MOST_BYTES
    assert shown.zenoh is not None
    assert good_node in shown.zenoh.nodes
    assert good_session in shown.zenoh.sessions
    assert good_mismatch in shown.zenoh.mismatches
    assert left_out(shown) > 0


def test_the_qos_of_a_node_goes_before_its_names() -> None:
    """A QoS belongs to a name, so ``left_out`` does not count it."""
    names = tuple(f"/t{number:04}" for number in range(9000))
    qos = tuple(ZenohQosStatus(n, "publisher", "RELIABLE", "VOLATILE", "KEEP_LAST") for n in names)
    node = ZenohNodeStatus("/crowd", address=EVIL, publishes=names, qos=qos)
    shown = bounded(ProxyStatus(zenoh=ZenohStatus(nodes=(node,))))
    assert len(encode(shown)) <= MOST_BYTES
    assert shown.zenoh is not None
    assert shown.zenoh.nodes[0].publishes == names
    assert 4000 < len(shown.zenoh.nodes[0].qos) < 9000
    assert left_out(shown) == 0


def _rows(status: ProxyStatus) -> int:
    """The number of rows in each table."""
    policy = status.policy
    (domain,) = status.domains
    assert policy
    return sum(
        map(
            len,
            (
                *(status.nodes, status.stand_ins, status.udpros, policy.layers, policy.hidden),
                *(domain.inside, domain.outside, domain.mismatches, domain.peers),
            ),
        )
    )


def _rows_left_out(status: ProxyStatus) -> int:
    policy = status.policy
    (domain,) = status.domains
    assert policy
    counters = domain.left_out, domain.mismatches_left_out, policy.layers_left_out
    return status.left_out + policy.left_out + sum(counters)


def test_an_address_that_is_cut_keeps_its_rows_before_their_lists() -> None:
    (first, second) = bounded(ProxyStatus(nodes=(EVIL_NODE, EVIL_NODE))).nodes
    assert first == second
    assert (first.nodes, first.connections) == (("/evil",), ())
    assert first.left_out == 4000 - len(first.subscribes)
    assert len(first.subscribes) > 0.4 * MOST_BYTES / 1010


def test_what_fits_is_left_as_it_is() -> None:
    assert bounded(GOOD_STATUS) is GOOD_STATUS


def test_letters_count_as_they_are_sent() -> None:
    """In JSON of ASCII each of these takes six bytes or twelve; so the document was larger."""
    status = ProxyStatus(nodes=(EndpointStatus(publishes=("é\U0001f916\x1b\u202e" * 100,) * 1000),))
    shown = encode(bounded(status))
    assert shown.isascii()
    assert len(shown) <= MOST_BYTES
    assert json.loads(shown)["nodes"][0]["publishes"][0] == "é\U0001f916\x1b\u202e" * 100


def test_letters_of_a_name_are_escaped_in_one_call(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a call for each run of letters, a status with 10,000,000 letters took eleven seconds."""
    escaped: list[object] = []
    real = json.dumps

    def dumps(value: object, **options: Any) -> str:
        escaped.append(value)
        return real(value, **options)

    monkeypatch.setattr("rosproxy.shared.documents.status_bounds.json.dumps", dumps)
    name = "a\xe9" * 500
    assert encode((name, name, None)) == b'["%b","%b",null]' % ((b"a\\u00e9" * 500,) * 2)
    assert len(escaped) == 1


@given(st.recursive(st.text() | st.integers(0, 9), lambda inner: st.lists(inner, max_size=9)))
def test_the_size_of_json_is_known_without_escapes(value: object) -> None:
    encoded = encode(value)
    assert encoded_size(value) == len(encoded)
    assert encoded.decode("ascii").isprintable()
    assert json.loads(encoded) == value


ROWS = st.builds(
    EndpointStatus,
    address=st.sampled_from(["10.0.0.1:1", "10.0.0.2:2", "?"]),
    publishes=st.lists(st.text(max_size=60), max_size=20).map(tuple),
    services=st.lists(st.text(max_size=60), max_size=20).map(tuple),
)


@given(st.lists(ROWS, max_size=12), st.integers(0, 20_000))
def test_it_fits_whatever_there_is(nodes: list[EndpointStatus], most: int) -> None:
    status = ProxyStatus(nodes=tuple(nodes))
    shown = bounded(status, most)
    assert len(encode(shown)) <= max(most, len(encode(ProxyStatus())) + 10)
    assert sum(
        len(node.publishes) + len(node.services) + node.left_out for node in shown.nodes
    ) <= sum(len(node.publishes) + len(node.services) for node in nodes)


@given(st.lists(st.integers(0, 10**6), max_size=30), st.integers(0, 10**6))
def test_shares_are_fair(wanted: list[int], most: int) -> None:
    shares = fair_shares(wanted, most)
    assert all(0 <= share <= want for share, want in zip(shares, wanted, strict=True))
    assert sum(shares) <= most
    cut = [share for share, want in zip(shares, wanted, strict=True) if share < want]
    if cut:  # no share exceeds a cut share by more than the remainder of the division
        assert max(shares) - min(cut) <= 1
        assert most - sum(shares) < len(wanted)


def test_shares_of_several_with_one_owner() -> None:
    assert fair_shares_by_owner("aaab", [10, 10, 10, 5], 11) == [2, 2, 2, 5]
    assert fair_shares_by_owner("aab", [1, 2, 3], 6) == [1, 2, 3]
    assert fair_shares_by_owner("", [], 6) == []


def test_each_owner_has_its_first_items_chosen() -> None:
    items = [*(("evil", n) for n in range(100)), ("good", 0), ("good", 1)]
    chosen = fair_choice(items, lambda item: item[0], 10)
    assert chosen == [*(("evil", n) for n in range(8)), ("good", 0), ("good", 1)]
    assert fair_choice(items[:10], lambda item: item[0], 10) == items[:10]


class CountedList(list[Any]):
    """A list that counts the walks through it."""

    walks = 0

    def __iter__(self) -> Any:
        self.walks += 1
        return super().__iter__()


def test_the_rows_are_walked_through_a_few_times_for_any_number_of_addresses(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With 1,000 participants at as many addresses, a status took 0.1 s longer."""
    made = list[CountedList]()
    real = status_bounds._entries

    def entries(status: ProxyStatus) -> CountedList:
        made.append(CountedList(real(status)))
        return made[-1]

    monkeypatch.setattr(status_bounds, "_entries", entries)
    participants = tuple(
        ParticipantStatus(address=f"10.0.{number // 250}.{number % 250}", publishes=MANY[:20])
        for number in range(500)
    )
    status = bounded(ProxyStatus(domains=(replace(GOOD_DOMAIN, inside=participants),)))
    assert len(encode(status)) <= MOST_BYTES
    assert made[0].walks < 5
