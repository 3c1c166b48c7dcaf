"""Ports for locators: the same after a restart, and first for participants named at a port."""

from copy import deepcopy
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.ros2.ports.locator_ports import (
    EVIDENCE_PERIOD_S,
    SETTLING_PERIOD_S,
    LocatorPorts,
    NamedBy,
    _Claim,
    order_for,
)
from rosproxy.ros2.registry.participants import TrafficKind
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.ports import PortPool, PortRange

RANGE = PortRange(45000, 45019)
DATA = TrafficKind.USER_DATA
METATRAFFIC = TrafficKind.METATRAFFIC
OTHERS = NamedBy.OTHERS
PROVEN = NamedBy.PROVEN
PEER = NamedBy.PEER
prefixes = st.binary(min_size=12, max_size=12)


def locator(number: int) -> HostPort:
    return HostPort("172.30.0.5", 7410 + number)


def ports() -> LocatorPorts:
    return LocatorPorts(PortPool(RANGE), 0.0)


@given(st.text())
def test_each_port_is_tried_once(key: str) -> None:
    assert sorted(order_for(key, RANGE)) == list(RANGE.ports())


@given(prefixes)
def test_a_new_process_gives_the_same_port(prefix: bytes) -> None:
    assert ports().take(prefix, locator(0), DATA, 2) == ports().take(prefix, locator(0), DATA, 9)


@given(st.lists(st.tuples(prefixes, st.integers(0, 9)), min_size=21, max_size=25, unique=True))
def test_no_port_is_given_twice(wanted: list[tuple[bytes, int]]) -> None:
    pool = ports()
    given = [pool.take(prefix, locator(number), DATA, 2) for prefix, number in wanted]
    assert sorted(port for port in given if port) == list(RANGE.ports())
    assert given[len(RANGE) :] == [None] * (len(wanted) - len(RANGE))


@given(prefixes, prefixes)
def test_who_is_meant_at_a_port_gets_it(prefix: bytes, other_prefix: bytes) -> None:
    pool = ports()
    (first, *_) = order_for(f"{prefix.hex()} {locator(0)}", RANGE)
    pool.note_former_user(first, other_prefix, DATA, PEER, 0.5)
    if prefix != other_prefix:
        assert pool.take(prefix, locator(0), DATA, SETTLING_PERIOD_S) != first
    assert pool.take(other_prefix, locator(3), DATA, SETTLING_PERIOD_S) == first


@given(prefixes, st.integers(45000, 45019))
def test_who_says_what_it_had_gets_it(prefix: bytes, had: int) -> None:
    pool = ports()
    assert pool.take(prefix, locator(0), DATA, SETTLING_PERIOD_S, had) == had
    assert pool.take(prefix, locator(1), DATA, SETTLING_PERIOD_S, had) != had


def test_what_outside_says_counts_more_than_ones_own_word() -> None:
    pool = ports()
    prefix = bytes(12)
    other_prefix = bytes(range(12))
    pool.note_former_user(45007, other_prefix, DATA, PEER, 0.5)
    assert pool.take(prefix, locator(0), DATA, SETTLING_PERIOD_S, 45007) != 45007
    assert pool.take(other_prefix, locator(0), DATA, SETTLING_PERIOD_S) == 45007


def test_a_port_for_metatraffic_is_none_for_data() -> None:
    pool = ports()
    prefix = bytes(12)
    pool.note_former_user(45007, prefix, METATRAFFIC, PEER, 0.5)
    assert pool.take(prefix, locator(1), DATA, SETTLING_PERIOD_S) != 45007
    assert pool.take(prefix, locator(0), METATRAFFIC, SETTLING_PERIOD_S) == 45007


@given(st.permutations([(bytes(12), 45003), (bytes(range(12)), 45007)]))
def test_if_several_are_named_their_own_claims_decide(
    had: list[tuple[bytes, int]],
) -> None:
    """The last participant that was named at a port may not be the former user."""
    pool = ports()
    for port in (45003, 45007):
        for prefix, _ in had:
            pool.note_former_user(port, prefix, DATA, PEER, 0.5)
    taken = [pool.take(prefix, locator(0), DATA, SETTLING_PERIOD_S, port) for prefix, port in had]
    assert taken == [port for _, port in had]


def test_each_locator_of_a_participant_gets_its_own_port() -> None:
    """Fast DDS has two for data, and outside names the participant at both."""
    pool = ports()
    prefix = bytes(12)
    had = {0: 45003, 1: 45007}
    for port in had.values():
        pool.note_former_user(port, prefix, DATA, PEER, 0.5)
    taken = {
        n: pool.take(prefix, locator(n), DATA, SETTLING_PERIOD_S, port) for n, port in had.items()
    }
    assert taken == had


def test_each_locator_gets_its_own_port_though_outside_names_one_alone() -> None:
    pool = ports()
    prefix = bytes(12)
    had = {0: 45003, 1: 45007}
    pool.note_former_user(45007, prefix, DATA, PEER, 0.5)
    taken = {
        n: pool.take(prefix, locator(n), DATA, SETTLING_PERIOD_S, port) for n, port in had.items()
    }
    assert taken == had


@given(st.permutations([0, 1, 2]))
def test_each_locator_gets_its_former_port_without_a_claim(order: list[int]) -> None:
    """Where it is possible: no other participant had the wanted port."""
    before = ports()
    after = ports()
    prefix = bytes(12)
    had = {n: before.take(prefix, locator(n), DATA, SETTLING_PERIOD_S) for n in range(3)}
    for port in had.values():
        after.note_former_user(port or 0, prefix, DATA, PEER, 0.5)
    assert {n: after.take(prefix, locator(n), DATA, SETTLING_PERIOD_S) for n in order} == had


def test_a_locator_for_both_kinds_keeps_its_port() -> None:
    """Of Cyclone DDS: outside may have sent data alone, and the announcement begins with either."""
    pool = ports()
    prefix = bytes(12)
    pool.note_former_user(45007, prefix, DATA, PEER, 0.5)
    assert pool.take(prefix, locator(0), METATRAFFIC, SETTLING_PERIOD_S, 45007) == 45007


def test_a_locator_for_both_kinds_keeps_its_port_without_a_word() -> None:
    pool = ports()
    prefix = bytes(12)
    first, *_ = order_for(f"{prefix.hex()} {locator(0)}", RANGE)
    pool.note_former_user(first, prefix, DATA, PEER, 0.5)
    assert pool.take(prefix, locator(0), METATRAFFIC, SETTLING_PERIOD_S) == first


def test_a_stranger_names_nobody_where_a_peer_has() -> None:
    pool = ports()
    prefix = bytes(12)
    other_prefix = bytes(range(12))
    pool.note_former_user(45007, prefix, DATA, PEER, 0.5)
    pool.note_former_user(45007, other_prefix, DATA, OTHERS, 0.5)
    assert pool.take(other_prefix, locator(0), DATA, SETTLING_PERIOD_S, 45007) != 45007
    assert pool.take(prefix, locator(0), DATA, SETTLING_PERIOD_S) == 45007


def test_too_many_names_at_a_port_count_for_nothing() -> None:
    """An attacker cannot take a port from its former user by naming many participants there."""
    pool = ports()
    prefix = bytes(12)
    for number in range(1, 100):
        pool.note_former_user(45007, number.to_bytes(12, "big"), DATA, PEER, 0.5)
    pool.note_former_user(45007, b"a stranger's", DATA, OTHERS, 0.5)
    assert pool.take(prefix, locator(0), DATA, SETTLING_PERIOD_S, 45007) == 45007


def test_a_port_of_somebody_who_may_come_back_is_better_than_none() -> None:
    pool = ports()
    prefix = bytes(12)
    other_prefix = bytes(range(12))
    for port in RANGE.ports():
        pool.note_former_user(port, other_prefix, DATA, PEER, 0.5)
    first, second, *_ = order_for(f"{prefix.hex()} {locator(0)}", RANGE)
    assert [pool.take(prefix, locator(0), DATA, SETTLING_PERIOD_S) for _ in range(2)] == [
        first,
        second,
    ]


def test_what_was_heard_is_forgotten_after_a_time() -> None:
    pool = ports()
    prefix = bytes(12)
    other_prefix = bytes(range(12))
    (first, *_) = order_for(f"{prefix.hex()} {locator(0)}", RANGE)
    pool.note_former_user(first, other_prefix, DATA, PEER, 0.5)
    pool.note_former_user(45000, other_prefix, DATA, PEER, EVIDENCE_PERIOD_S + 1)
    assert pool.take(prefix, locator(0), DATA, EVIDENCE_PERIOD_S) == first


@given(prefixes, prefixes, st.integers(45000, 45019))
def test_what_the_kernel_forwarded_leads_there_again(
    prefix: bytes, other_prefix: bytes, port: int
) -> None:
    pool = ports()
    pool.note_forwarded({port: locator(1), 9: locator(1)})
    pool.note_former_user(port, other_prefix, DATA, PEER, 0.5)
    assert pool.take(other_prefix, locator(0), DATA, SETTLING_PERIOD_S, former_port=port) != port
    assert pool.take(prefix, locator(1), METATRAFFIC, SETTLING_PERIOD_S, former_port=port) != port
    assert pool.take(prefix, locator(1), DATA, SETTLING_PERIOD_S) == port
    pool.give_back(port)
    order = order_for(f"{other_prefix.hex()} {locator(2)}", RANGE)
    taken = [pool.take(other_prefix, locator(2), DATA, SETTLING_PERIOD_S) for _ in range(18)]
    assert taken == [number for number in order if number in taken]


def test_what_the_kernel_forwarded_is_forgotten_in_time() -> None:
    pool = ports()
    first, *_ = order_for(f"{bytes(12).hex()} {locator(0)}", RANGE)
    pool.note_forwarded({first: locator(1)})
    assert pool.take(bytes(12), locator(0), DATA, EVIDENCE_PERIOD_S) == first


@given(st.permutations([(b"a" * 12, True), (b"b" * 12, False)]), prefixes)
def test_a_proof_counts_more_than_a_word(order: list[tuple[bytes, bool]], stranger: bytes) -> None:
    pool = ports()
    pool.note_former_user(45007, stranger, DATA, PEER, 0.5)
    for prefix, is_proven in order:
        pool.note_claims(prefix, [45007], is_proven)
    taken = {
        prefix: pool.take(prefix, locator(0), DATA, SETTLING_PERIOD_S, 45007) for prefix, _ in order
    }
    assert taken[b"a" * 12] == 45007
    assert taken[b"b" * 12] != 45007


@given(st.booleans(), st.integers(45000, 45019))
def test_equal_claims_give_the_port_to_neither(is_proven: bool, port: int) -> None:
    pool = ports()
    one, other, third = (letter * 12 for letter in (b"a", b"b", b"c"))
    for prefix in (one, other):
        pool.note_claims(prefix, [port], is_proven)
    assert pool.take(one, locator(0), DATA, SETTLING_PERIOD_S, port) != port
    pool.forget_claims(one)
    assert pool.take(other, locator(0), DATA, SETTLING_PERIOD_S, port) != port
    assert pool.displaced_by(other, SETTLING_PERIOD_S) == set()
    rest = [pool.take(third, locator(n), DATA, SETTLING_PERIOD_S) for n in range(18)]
    assert rest[-1] == port  # the last that is left
    assert pool.take(third, locator(18), DATA, SETTLING_PERIOD_S) is None


def test_a_proof_gets_a_port_back_from_a_participant_that_came_first() -> None:
    pool = ports()
    first = b"a" * 12
    later = b"b" * 12
    had = pool.take(first, locator(0), DATA, SETTLING_PERIOD_S)
    assert had is not None
    pool.note_claims(later, [had], 0)
    assert pool.displaced_by(later, 3.0) == set()
    pool.note_claims(later, [had], 1)
    assert pool.displaced_by(later, 3.0) == {first}
    assert pool.displaced_by(later, EVIDENCE_PERIOD_S) == set()
    pool.give_back(had)
    assert pool.displaced_by(later, 3.0) == set()
    assert pool.take(later, locator(0), DATA, 3.0, had) == had


def test_what_the_kernel_forwarded_stays_with_its_locator() -> None:
    pool = ports()
    pool.note_forwarded({45007: locator(1)})
    assert pool.take(b"a" * 12, locator(1), DATA, SETTLING_PERIOD_S) == 45007
    pool.note_claims(b"b" * 12, [45007], 1)
    assert pool.displaced_by(b"b" * 12, 3.0) == set()


def test_a_name_that_may_be_forged_makes_a_word_no_better_and_voids_one_without_a_rival() -> None:
    liar = b"a" * 12
    owner = b"b" * 12
    pool = ports()
    pool.note_former_user(45007, liar, DATA, OTHERS, 0.5)
    pool.note_claims(owner, [45007], 0)
    assert pool.take(liar, locator(0), DATA, SETTLING_PERIOD_S) != 45007
    assert pool.take(owner, locator(0), DATA, SETTLING_PERIOD_S, 45007) != 45007
    pool.note_former_user(45008, liar, DATA, OTHERS, 0.5)
    pool.note_former_user(45008, owner, DATA, PROVEN, 0.5)
    assert pool.take(liar, locator(1), DATA, SETTLING_PERIOD_S, 45008) != 45008
    assert pool.take(owner, locator(1), DATA, SETTLING_PERIOD_S, 45008) == 45008


def test_no_set_of_names_is_made_while_a_port_is_chosen() -> None:
    """Strangers may name eight participants at each port: a port of 4,096 then took 45 ms."""
    pool = ports()
    for number in range(8):
        pool.note_former_user(45007, number.to_bytes(12, "big"), DATA, OTHERS, 0.5)
    named = pool._former_users[45007]
    assert named.prefixes is named.prefixes
    assert len(named.users) == len(named.prefixes) == 8


def test_few_of_the_ports_at_which_others_are_named_are_looked_at_closely(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With a name at each of 4,096 ports, 16 locators of a participant took 0.18 s."""
    looked_at = list[int]()
    real = LocatorPorts._claim

    def claim(pool: LocatorPorts, port: int, *values: Any) -> Any:
        looked_at.append(port)
        return real(pool, port, *values)

    monkeypatch.setattr(LocatorPorts, "_claim", claim)
    wide = PortRange(45000, 49100)
    pool = LocatorPorts(PortPool(wide), 0.0)
    for number, port in enumerate(wide.ports()):
        pool.note_former_user(port, number.to_bytes(12, "big"), DATA, OTHERS, 0.5)
    pool.note_forwarded({port: HostPort("172.30.0.9", port) for port in wide.ports()})
    taken = {pool.take(bytes(range(12)), locator(n), DATA, 2, 45007) for n in range(16)}
    assert len(taken) == 16
    assert set(looked_at) == {45007}


NUMBERED = st.sampled_from([bytes([number] * 12) for number in range(3)])
SOME_PORTS = st.integers(45000, 45005)
EVIDENCE = st.one_of(
    st.tuples(
        st.just("named"),
        SOME_PORTS,
        NUMBERED,
        st.sampled_from(TrafficKind),
        st.sampled_from(NamedBy),
    ),
    st.tuples(st.just("claimed"), NUMBERED, st.lists(SOME_PORTS, max_size=3), st.integers(0, 3)),
    st.tuples(st.just("taken"), NUMBERED, st.integers(0, 2)),
)


@given(
    st.lists(EVIDENCE, max_size=12),
    st.dictionaries(SOME_PORTS, st.integers(0, 2).map(locator)),
    NUMBERED,
    st.sampled_from(TrafficKind),
    st.none() | SOME_PORTS,
)
def test_the_claims_are_those_of_a_close_look_at_each_port(
    evidence: list[tuple[Any, ...]],
    forwarded: dict[int, HostPort],
    prefix: bytes,
    kind: TrafficKind,
    former_port: int | None,
) -> None:
    pool = ports()
    pool.note_forwarded(forwarded)
    for word, *values in evidence:
        if word == "named":
            port, named, traffic, by = values
            pool.note_former_user(port, named, traffic, by, 0.5)
        elif word == "claimed":
            pool.note_claims(*values)
            pool.displaced_by(values[0], 0.5)
        else:
            pool.take(values[0], locator(values[1]), DATA, 2)
    user = prefix, kind
    own, others, disputed = deepcopy(pool)._ports_by_claim(user, locator(0), former_port)
    one_by_one = {
        port: deepcopy(pool)._claim(port, user, locator(0), former_port) for port in RANGE.ports()
    }
    assert own == {p: claim for p, claim in one_by_one.items() if claim < _Claim.UNCLAIMED}
    assert others == {p for p, claim in one_by_one.items() if claim is _Claim.OF_ANOTHER}
    assert disputed == {p for p, claim in one_by_one.items() if claim is _Claim.DISPUTED}
