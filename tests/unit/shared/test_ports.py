"""The port range: mapping with an offset, and which free port is handed out."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.shared.ports import PortMap, PortPool, PortRange

RANGE = PortRange(45000, 45003)


def test_a_range_holds_both_ends() -> None:
    assert len(RANGE) == 4
    assert list(RANGE.ports()) == [45000, 45001, 45002, 45003]
    assert str(RANGE) == "45000-45003"
    assert [port in RANGE for port in (44999, 45000, 45003, 45004)] == [False, True, True, False]
    assert None not in RANGE
    assert "45000" not in RANGE
    assert len(PortRange(5, 5)) == 1


@pytest.mark.parametrize("advertise", [RANGE, PortRange(30000, 30003), PortRange(45002, 45005)])
def test_advertised_ports_are_an_offset_away(advertise: PortRange) -> None:
    ports = PortMap(RANGE, advertise)
    assert [*map(ports.advertised, RANGE.ports())] == [*advertise.ports()]
    assert [*map(ports.listening, advertise.ports())] == [*RANGE.ports()]
    assert ports.listening(advertise.first - 1) is None
    assert ports.listening(advertise.last + 1) is None


@given(st.integers(1, 60000), st.integers(1, 60000), st.integers(0, 500), st.data())
def test_the_mapping_has_an_inverse(
    first: int, outside: int, more: int, data: st.DataObject
) -> None:
    ports = PortMap(PortRange(first, first + more), PortRange(outside, outside + more))
    port = data.draw(st.integers(first, first + more))
    assert ports.listening(ports.advertised(port)) == port


def test_the_port_that_was_free_longest_is_handed_out() -> None:
    pool = PortPool(RANGE)
    assert [pool.take() for _ in range(3)] == [45000, 45001, 45002]
    pool.give_back(45001)
    pool.give_back(45000)
    assert [pool.take() for _ in range(4)] == [45003, 45001, 45000, None]
    assert pool.free == 0


@pytest.mark.parametrize(
    ("prefer", "taken"),
    [(45002, 45002), (None, 45000), (45001, 45000), (1, 45000)],
)
def test_a_preferred_port_is_handed_out_if_it_is_free(prefer: int | None, taken: int) -> None:
    pool = PortPool(RANGE)
    assert pool.claim(45001)
    assert pool.take(prefer) == taken


def test_a_claim_takes_that_port_or_none() -> None:
    pool = PortPool(RANGE)
    assert pool.claim(45002)
    assert not pool.claim(45002)
    assert not pool.claim(1)
    assert pool.free == 3


def test_a_blocked_port_is_never_handed_out() -> None:
    pool = PortPool(RANGE)
    pool.block(45000)
    assert pool.take() == 45001
    pool.block(45001)
    pool.give_back(45001)
    assert (pool.free, len(pool.blocked)) == (2, 2)
    assert not pool.claim(45001)
    assert [pool.take(45001), pool.take(), pool.take()] == [45002, 45003, None]


def test_a_port_that_is_let_go_by_another_program_is_handed_out_last() -> None:
    pool = PortPool(RANGE)
    pool.block(45000)
    pool.block(45002)
    assert pool.blocked == {45000, 45002}
    pool.unblock(45000)
    assert pool.blocked == {45002}
    assert [pool.take() for _ in range(4)] == [45001, 45003, 45000, None]


STEPS = st.sampled_from(["take", "give", "block", "unblock"])


@given(st.lists(st.tuples(STEPS, st.integers(0, 3))))
def test_every_port_is_free_held_or_blocked(steps: list[tuple[str, int]]) -> None:
    pool = PortPool(RANGE)
    taken_ports = set[int]()
    blocked = set[int]()
    for step, index in steps:
        port = RANGE.first + index
        if step == "take" and (taken := pool.take(port)) is not None:
            assert taken not in taken_ports | blocked
            taken_ports.add(taken)
        elif step == "give" and port in taken_ports:
            pool.give_back(port)
            taken_ports.discard(port)
        elif step == "block":
            pool.block(port)
            blocked.add(port)
        elif step == "unblock" and port in blocked - taken_ports:
            pool.unblock(port)
            blocked.discard(port)
        assert pool.free == len(RANGE) - len(taken_ports | blocked)
        assert pool.blocked == blocked
