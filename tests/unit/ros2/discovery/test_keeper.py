"""What a participant keeps for the proxy: its ports, in one number with a proof."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.leases.ports import PortRange
from rosproxy.net.addresses import HostPort
from rosproxy.ros2.discovery.port_keeper import (
    COUNTS_EACH_SECOND,
    HALF_BITS,
    WRITERS,
    Keeper,
    keeper_key,
)
from rosproxy.ros2.protocol.addressing import destination
from rosproxy.ros2.protocol.reliable import heartbeats
from rosproxy.ros2.protocol.rtps import source_prefix
from tests.unit.ros2.discovery.domains import kept_halves, kept_number

RANGE = PortRange(11400, 11463)
PEER = bytes(range(12))
BACK = HostPort("172.30.0.2", 7410)
ADDRESS = "172.30.0.5"
KEY = keeper_key("a secret of the proxy")
keys = st.sampled_from([b"", KEY])
some_ports = st.lists(st.integers(RANGE.first, RANGE.last), max_size=6, unique=True)


def make_keeper(started: float = 0.0, key: bytes = KEY, ports: PortRange = RANGE) -> Keeper:
    """A keeper of a process that started at a Unix time."""
    return Keeper.of("10.0.0.1", ports, 0, started, key)


def answered(keeper: Keeper, number: int, proof: int = 1, prefix: bytes = PEER) -> int:
    """Have a participant answer a keeper; how many ports that proves."""
    assert keeper.take(prefix, kept_halves(keeper.prefix, prefix, number, keeper.port_bits))
    assert keeper.has_answered(prefix) is not bool(keeper.key)
    if keeper.key:
        assert keeper.take(prefix, kept_halves(keeper.witness, prefix, proof, HALF_BITS))
    assert keeper.has_answered(prefix)
    return keeper.proven_count(prefix)


@given(some_ports, keys)
def test_numbers_hold_ports_and_prove_them(ports: list[int], key: bytes) -> None:
    keeper = make_keeper(key=key)
    later = make_keeper(1000.0, key)
    count = answered(later, keeper.number(ports), keeper.proof(PEER, ports))
    assert count == (len(ports) if key else 0)
    assert later.former_ports(PEER) == ports
    assert later.keeps(PEER, ports)


@given(some_ports)
def test_a_port_more_is_a_greater_number(ports: list[int]) -> None:
    counts = range(len(ports) + 1)
    numbers = [make_keeper().number(ports[:count]) for count in counts]
    proofs = [make_keeper().proof(PEER, ports[:count]) for count in counts]
    for told in (numbers, proofs):
        assert all(smaller < greater for smaller, greater in pairwise(told))
    for smaller, greater in pairwise(make_keeper().numbers(PEER, ports[:n]) for n in counts):
        assert all(smaller[writer] <= greater[writer] for writer in smaller)


@given(st.integers(1, 60_000), st.data())
def test_no_number_keeps_fast_dds_busy(size: int, drawn: st.DataObject) -> None:
    """Fast DDS counts up to a number one by one: with 1,100 ports a participant counted for days.

    So it did where a container had announced five locators in the name of the participant.
    """
    keeper = make_keeper(ports=PortRange(2000, 1999 + size))
    ports = drawn.draw(st.lists(st.integers(2000, 1999 + size), max_size=16, unique=True))
    told = keeper.reminders(PEER, ports, BACK, 0.0) + keeper.questions(PEER, BACK, 0.0)
    assert all(0 < beat.first <= 2**24 for datagram in told for beat in heartbeats(datagram))


@given(some_ports.filter(bool), st.binary(min_size=12, max_size=12), st.integers(1, 2**40 - 1))
def test_a_number_with_another_proof_proves_nothing(
    ports: list[int], prefix: bytes, error: int
) -> None:
    keeper = make_keeper()
    number = keeper.number(ports)
    right = keeper.proof(PEER, ports)
    assert answered(make_keeper(), number, right ^ error) == 0
    assert answered(make_keeper(), number) == 0
    assert answered(make_keeper(), number ^ 1, right) == 0
    assert answered(make_keeper(), number, make_keeper(key=b"another").proof(PEER, ports)) == 0
    if prefix != PEER:
        assert answered(make_keeper(), number, right, prefix) == 0
    assert answered(Keeper.of("10.0.0.1", RANGE, 1, 0.0, KEY), number, right) == 0
    assert answered(keeper, number, right) == len(ports)


def test_a_proof_of_the_first_ports_proves_these() -> None:
    """The proxy was killed before the participant kept the proof of its last port."""
    keeper = make_keeper()
    assert answered(keeper, keeper.number([11405, 11406]), keeper.proof(PEER, [11405])) == 1
    assert not keeper.keeps(PEER, [11405, 11406])


@pytest.mark.parametrize(
    ("size", "count"),
    [(100, 6), (127, 6), (128, 4), (1023, 4), (1024, 4), (4095, 4), (4096, 2), (60000, 2)],
)
def test_how_many_ports_fit_into_a_number(size: int, count: int) -> None:
    keeper = make_keeper(ports=PortRange(2000, 1999 + size))
    ports = [2000 + size - 1 - index for index in range(10)]
    assert answered(keeper, keeper.number(ports), keeper.proof(PEER, ports)) == count
    assert keeper.former_ports(PEER) == ports[:count]
    assert keeper.keeps(PEER, ports)
    assert not keeper.keeps(PEER, ports[1:])


@pytest.mark.parametrize("is_proof", [True, False])
def test_a_participant_forgets_a_number_that_is_greater(is_proof: bool) -> None:
    """A reader heeds no smaller one."""
    keeper = make_keeper()
    number = keeper.number([11405])
    proof = keeper.proof(PEER, [11405])
    answered(keeper, number + (not is_proof), proof + is_proof)
    dispose_messages = keeper.reminders(PEER, [11405], BACK, 0.0)
    assert [source_prefix(told) for told in dispose_messages] == [keeper.prefix, keeper.witness]
    assert not [beat for told in dispose_messages for beat in heartbeats(told)]
    assert len(keeper.reminders(PEER, [11405], BACK, 0.0)) == 4


def test_a_participant_of_the_version_before_gets_proofs_for_what_it_keeps() -> None:
    keeper = make_keeper()
    answered(keeper, keeper.number([11405, 11406]))
    (*_, proof) = keeper.reminders(PEER, [11405], BACK, 0.0)
    wanted = keeper.numbers(PEER, [11405])
    assert [beat.first for beat in heartbeats(proof)] == [
        number for (own, _), number in wanted.items() if own == keeper.witness
    ]


def test_all_ports_that_a_former_version_kept_by_one_writer_are_read() -> None:
    keeper = make_keeper()
    ports = [11405, 11406, 11407, 11408]
    number = keeper.number(ports)
    assert keeper.take(PEER, kept_number(keeper.prefix, PEER, number))
    assert keeper.former_ports(PEER) == ports


def test_another_secret_has_another_witness() -> None:
    keeper = make_keeper()
    other = make_keeper(key=b"another")
    without = make_keeper(key=b"")
    assert keeper.prefix == other.prefix == without.prefix
    assert len({keeper.prefix, keeper.witness, other.witness, without.witness}) == 4
    assert without.witness == b""


def test_the_key_follows_from_the_secret() -> None:
    assert keeper_key("a secret of the proxy") == KEY
    assert keeper_key("another secret") != KEY
    assert keeper_key(None) == b""


@given(st.integers(0, 2**63 - 1), st.integers(1, 30_000), keys)
def test_no_number_names_a_port_outside_of_the_range(number: int, size: int, key: bytes) -> None:
    keeper = make_keeper(key=key, ports=PortRange(11400, 11399 + size))
    keeper.take(PEER, kept_number(keeper.prefix, PEER, number))
    assert all(port in keeper.ports for port in keeper.former_ports(PEER))


def test_the_next_process_is_the_same_keeper_and_counts_on() -> None:
    first = make_keeper(1000.0)
    later = make_keeper(2000.0)
    assert first.prefix == later.prefix
    assert first.prefix != Keeper.of("10.0.0.1", RANGE, 1, 0.0).prefix
    asked = [count_of(keeper.questions(PEER, BACK, 0.0)[-1]) for keeper in (first, later)]
    assert asked[0] < asked[1]


def count_of(question: bytes) -> int:
    return int.from_bytes(question[-4:], "little")


def test_participants_that_come_and_go_do_not_raise_the_count_of_others() -> None:
    """A participant heeds only what counts more than the last, also from the next process.

    A container whose participants came and went for an hour had others ignore the next process.
    """
    first = make_keeper(1000.0)
    later = make_keeper(1001.0)
    for number in range(100):
        first.questions(number.to_bytes(12, "big"), BACK, 0.0)
        first.forget(number.to_bytes(12, "big"))
    asked = [count_of(first.questions(PEER, BACK, 0.0)[-1]) for _ in range(COUNTS_EACH_SECOND)]
    assert sorted(set(asked)) == asked
    first.forget(PEER)
    assert count_of(first.questions(PEER, BACK, 1.0)[-1]) > max(asked)
    assert count_of(later.questions(PEER, BACK, 0.0)[-1]) > max(asked)


@given(some_ports, st.integers(0, 63))
def test_a_longer_range_has_the_same_keeper(ports: list[int], more: int) -> None:
    keeper = make_keeper()
    longer = make_keeper(ports=PortRange(11400, 11463 + more))
    assert keeper.prefix == longer.prefix
    assert answered(longer, keeper.number(ports), keeper.proof(PEER, ports)) == len(ports)
    assert longer.former_ports(PEER) == ports


def test_it_asks_and_reminds_by_heartbeats() -> None:
    keeper = make_keeper()
    for sent, numbers in (
        (keeper.questions(PEER, BACK, 0.0), [1] * 4),
        (keeper.reminders(PEER, [11405], BACK, 0.0), keeper.numbers(PEER, [11405]).values()),
    ):
        told = [beat for datagram in sent[1::2] for beat in heartbeats(datagram)]
        assert [beat.first for beat in told] == [*numbers]
        assert [beat.last for beat in told] == [number - 1 for number in numbers]
        assert [beat.writer for beat in told] == [*WRITERS] * 2
        assert {destination(datagram) for datagram in sent[1::2]} == {PEER}
        for datagrams in (sent[::2], sent[1::2]):
            assert [source_prefix(told) for told in datagrams] == [keeper.prefix, keeper.witness]
