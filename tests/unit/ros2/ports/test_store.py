"""The ports that a participant keeps for the proxy, as a number with a proof."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.ros2.ports.store import (
    COUNTS_EACH_SECOND,
    HALF_BITS,
    WRITERS,
    PortStore,
    port_store_key,
)
from rosproxy.ros2.protocol.addressing import destination
from rosproxy.ros2.protocol.reliable import heartbeats
from rosproxy.ros2.protocol.rtps import HEADER_BYTES, source_prefix
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.ports import PortRange
from tests.unit.ros2.discovery.domains import kept_halves, kept_number

RANGE = PortRange(11400, 11463)
PEER = bytes(range(12))
BACK = HostPort("172.30.0.2", 7410)
ADDRESS = "172.30.0.5"
KEY = port_store_key("a secret of the proxy")
keys = st.sampled_from([b"", KEY])
some_ports = st.lists(st.integers(RANGE.first, RANGE.last), max_size=6, unique=True)


def make_port_store(started: float = 0.0, key: bytes = KEY, ports: PortRange = RANGE) -> PortStore:
    """A port store of a process that started at a Unix time."""
    return PortStore.of("10.0.0.1", ports, 0, started, key)


def answered(port_store: PortStore, number: int, proof: int = 1, prefix: bytes = PEER) -> int:
    """Have a participant answer a port store; how many ports that proves."""
    assert port_store.take(
        prefix, kept_halves(port_store.prefix, prefix, number, port_store.lower_half_bits)
    )
    assert port_store.has_answered(prefix) is not bool(port_store.key)
    if port_store.key:
        assert port_store.take(
            prefix, kept_halves(port_store.proof_prefix, prefix, proof, HALF_BITS)
        )
    assert port_store.has_answered(prefix)
    return port_store.proven_count(prefix)


def test_the_example_of_the_module() -> None:
    port_store = make_port_store(key=b"")
    numbers = port_store.numbers(PEER, [11403, 11404, 11405])
    assert list(numbers.values()) == [98949, 1]
    assert f"{98949 - 1:021b}" == "0000110" + "0000101" + "0000100"


@given(some_ports, keys)
def test_numbers_hold_ports_and_prove_them(ports: list[int], key: bytes) -> None:
    port_store = make_port_store(key=key)
    later = make_port_store(1000.0, key)
    count = answered(later, port_store.number(ports), port_store.proof(PEER, ports))
    assert count == (len(ports) if key else 0)
    assert later.former_ports(PEER) == ports
    assert later.keeps(PEER, ports)


@given(some_ports)
def test_a_port_more_is_a_greater_number(ports: list[int]) -> None:
    counts = range(len(ports) + 1)
    numbers = [make_port_store().number(ports[:count]) for count in counts]
    proofs = [make_port_store().proof(PEER, ports[:count]) for count in counts]
    for told in (numbers, proofs):
        assert all(smaller < greater for smaller, greater in pairwise(told))
    for smaller, greater in pairwise(make_port_store().numbers(PEER, ports[:n]) for n in counts):
        assert all(smaller[writer] <= greater[writer] for writer in smaller)


@given(st.integers(1, 60_000), st.data())
def test_no_number_keeps_fast_dds_busy(size: int, drawn: st.DataObject) -> None:
    """Fast DDS counts up to a number in steps of 1.

    With 1,100 ports a participant counted for days, and so it did after a container had announced
    five locators in the participant's name.
    """
    port_store = make_port_store(ports=PortRange(2000, 1999 + size))
    ports = drawn.draw(st.lists(st.integers(2000, 1999 + size), max_size=16, unique=True))
    told = port_store.reminders(PEER, ports, BACK, 0.0) + port_store.questions(PEER, BACK, 0.0)
    assert all(0 < beat.first <= 2**24 for datagram in told for beat in heartbeats(datagram))


@given(some_ports.filter(bool), st.binary(min_size=12, max_size=12), st.integers(1, 2**40 - 1))
def test_a_number_with_another_proof_proves_nothing(
    ports: list[int], prefix: bytes, error: int
) -> None:
    port_store = make_port_store()
    number = port_store.number(ports)
    right = port_store.proof(PEER, ports)
    assert answered(make_port_store(), number, right ^ error) == 0
    assert answered(make_port_store(), number) == 0
    assert answered(make_port_store(), number ^ 1, right) == 0
    assert (
        answered(make_port_store(), number, make_port_store(key=b"another").proof(PEER, ports)) == 0
    )
    if prefix != PEER:
        assert answered(make_port_store(), number, right, prefix) == 0
    assert answered(PortStore.of("10.0.0.1", RANGE, 1, 0.0, KEY), number, right) == 0
    assert answered(port_store, number, right) == len(ports)


def test_a_proof_of_the_first_ports_proves_these() -> None:
    """The proxy was killed before the participant kept the proof of its last port."""
    port_store = make_port_store()
    assert (
        answered(port_store, port_store.number([11405, 11406]), port_store.proof(PEER, [11405]))
        == 1
    )
    assert not port_store.keeps(PEER, [11405, 11406])


@pytest.mark.parametrize(
    ("size", "count"),
    [(100, 6), (127, 6), (128, 4), (1023, 4), (1024, 4), (4095, 4), (4096, 2), (60000, 2)],
)
def test_how_many_ports_fit_into_a_number(size: int, count: int) -> None:
    port_store = make_port_store(ports=PortRange(2000, 1999 + size))
    ports = [2000 + size - 1 - index for index in range(10)]
    assert answered(port_store, port_store.number(ports), port_store.proof(PEER, ports)) == count
    assert port_store.former_ports(PEER) == ports[:count]
    assert port_store.keeps(PEER, ports)
    assert not port_store.keeps(PEER, ports[1:])


@pytest.mark.parametrize("is_proof", [True, False])
def test_a_participant_forgets_a_number_that_is_greater(is_proof: bool) -> None:
    """A reader ignores smaller numbers."""
    port_store = make_port_store()
    number = port_store.number([11405])
    proof = port_store.proof(PEER, [11405])
    answered(port_store, number + (not is_proof), proof + is_proof)
    dispose_messages = port_store.reminders(PEER, [11405], BACK, 0.0)
    assert [source_prefix(told) for told in dispose_messages] == [
        port_store.prefix,
        port_store.proof_prefix,
    ]
    assert not [beat for told in dispose_messages for beat in heartbeats(told)]
    assert len(port_store.reminders(PEER, [11405], BACK, 0.0)) == 4


def test_a_participant_of_the_version_before_gets_proofs_for_what_it_keeps() -> None:
    port_store = make_port_store()
    answered(port_store, port_store.number([11405, 11406]))
    (*_, proof) = port_store.reminders(PEER, [11405], BACK, 0.0)
    wanted = port_store.numbers(PEER, [11405])
    assert [beat.first for beat in heartbeats(proof)] == [
        number for (own, _), number in wanted.items() if own == port_store.proof_prefix
    ]


def test_all_ports_that_a_former_version_kept_by_one_writer_are_read() -> None:
    port_store = make_port_store()
    ports = [11405, 11406, 11407, 11408]
    number = port_store.number(ports)
    assert port_store.take(PEER, kept_number(port_store.prefix, PEER, number))
    assert port_store.former_ports(PEER) == ports


def test_another_secret_has_another_prefix() -> None:
    port_store = make_port_store()
    other = make_port_store(key=b"another")
    without = make_port_store(key=b"")
    assert port_store.prefix == other.prefix == without.prefix
    assert (
        len({port_store.prefix, port_store.proof_prefix, other.proof_prefix, without.proof_prefix})
        == 4
    )
    assert without.proof_prefix == b""


def test_the_key_follows_from_the_secret() -> None:
    assert port_store_key("a secret of the proxy") == KEY
    assert port_store_key("another secret") != KEY
    assert port_store_key(None) == b""


@given(st.integers(0, 2**63 - 1), st.integers(1, 30_000), keys)
def test_no_number_names_a_port_outside_of_the_range(number: int, size: int, key: bytes) -> None:
    port_store = make_port_store(key=key, ports=PortRange(11400, 11399 + size))
    port_store.take(PEER, kept_number(port_store.prefix, PEER, number))
    assert all(port in port_store.ports for port in port_store.former_ports(PEER))


def test_the_next_process_is_the_same_port_store_and_counts_on() -> None:
    first = make_port_store(1000.0)
    later = make_port_store(2000.0)
    assert first.prefix == later.prefix
    assert first.prefix != PortStore.of("10.0.0.1", RANGE, 1, 0.0).prefix
    asked = [count_of(port_store.questions(PEER, BACK, 0.0)[-1]) for port_store in (first, later)]
    assert asked[0] < asked[1]


def count_of(question: bytes) -> int:
    return int.from_bytes(question[-4:], "little")


def test_participants_that_come_and_go_do_not_raise_the_count_of_others() -> None:
    """A participant ignores counts that are not greater than the last, also from the next process.

    Once participants that came and went for an hour made others ignore the next process.
    """
    first = make_port_store(1000.0)
    later = make_port_store(1001.0)
    for number in range(100):
        first.questions(number.to_bytes(12, "big"), BACK, 0.0)
        first.forget(number.to_bytes(12, "big"))
    asked = [count_of(first.questions(PEER, BACK, 0.0)[-1]) for _ in range(COUNTS_EACH_SECOND)]
    assert sorted(set(asked)) == asked
    first.forget(PEER)
    assert count_of(first.questions(PEER, BACK, 1.0)[-1]) > max(asked)
    assert count_of(later.questions(PEER, BACK, 0.0)[-1]) > max(asked)


@given(some_ports, st.integers(0, 63))
def test_a_longer_range_has_the_same_port_store(ports: list[int], more: int) -> None:
    port_store = make_port_store()
    longer = make_port_store(ports=PortRange(11400, 11463 + more))
    assert port_store.prefix == longer.prefix
    assert answered(longer, port_store.number(ports), port_store.proof(PEER, ports)) == len(ports)
    assert longer.former_ports(PEER) == ports


def test_it_asks_and_reminds_by_heartbeats() -> None:
    port_store = make_port_store()
    for sent, numbers in (
        (port_store.questions(PEER, BACK, 0.0), [1] * 4),
        (
            port_store.reminders(PEER, [11405], BACK, 0.0),
            port_store.numbers(PEER, [11405]).values(),
        ),
    ):
        told = [beat for datagram in sent[1::2] for beat in heartbeats(datagram)]
        assert [beat.first for beat in told] == [*numbers]
        assert [beat.last for beat in told] == [number - 1 for number in numbers]
        assert [beat.writer for beat in told] == [*WRITERS] * 2
        assert {destination(datagram) for datagram in sent[1::2]} == {PEER}
        for datagrams in (sent[::2], sent[1::2]):
            assert [source_prefix(told) for told in datagrams] == [
                port_store.prefix,
                port_store.proof_prefix,
            ]


@pytest.mark.parametrize("is_first", [True, False])
def test_answers_to_both_in_one_message(is_first: bool) -> None:
    """Cyclone DDS packs both answers into a message. The numbers must not be mixed up."""
    port_store = make_port_store()
    ports = [11405]
    answers = [
        kept_halves(port_store.prefix, PEER, port_store.number(ports), port_store.lower_half_bits),
        kept_halves(port_store.proof_prefix, PEER, port_store.proof(PEER, ports), HALF_BITS),
    ]
    first, second = answers if is_first else answers[::-1]
    assert port_store.take(PEER, first + second[HEADER_BYTES:])
    assert port_store.keeps(PEER, ports)
    assert port_store.former_ports(PEER) == ports
    assert port_store.proven_count(PEER) == 1
