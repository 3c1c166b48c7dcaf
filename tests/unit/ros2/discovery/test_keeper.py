"""What a participant keeps for the proxy: its ports, in one number."""

from hypothesis import given
from hypothesis import strategies as st

from rosproxy.leases.ports import PortRange
from rosproxy.net.addresses import HostPort
from rosproxy.ros2.discovery.port_keeper import COUNTS_EACH_SECOND, Keeper
from rosproxy.ros2.protocol.addressing import destination
from rosproxy.ros2.protocol.reliable import heartbeats
from rosproxy.ros2.protocol.rtps import source_prefix

RANGE = PortRange(11400, 11463)
PEER, BACK = bytes(range(12)), HostPort("172.30.0.2", 7410)
some_ports = st.lists(st.integers(RANGE.first, RANGE.last), max_size=8, unique=True)


def make_keeper(started: float = 0.0) -> Keeper:
    return Keeper.of("10.0.0.1", RANGE, 0, started)


@given(some_ports)
def test_a_number_holds_ports(ports: list[int]) -> None:
    keeper = make_keeper()
    keeper.number_by_prefix[PEER] = keeper.number(ports)
    assert keeper.former_ports(PEER) == ports


@given(some_ports)
def test_a_port_more_is_a_greater_number(ports: list[int]) -> None:
    numbers = [make_keeper().number(ports[:count]) for count in range(len(ports) + 1)]
    assert numbers == sorted(set(numbers))


@given(st.integers(0, 2**63 - 1), st.integers(1, 3000))
def test_no_number_names_a_port_outside_of_the_range(number: int, size: int) -> None:
    keeper = Keeper.of("10.0.0.1", PortRange(11400, 11399 + size), 0, 0.0)
    keeper.number_by_prefix[PEER] = number
    assert all(port in keeper.ports for port in keeper.former_ports(PEER))


def test_the_next_process_is_the_same_keeper_and_counts_on() -> None:
    first, later = make_keeper(1000.0), make_keeper(2000.0)
    assert first.prefix == later.prefix
    assert first.prefix != Keeper.of("10.0.0.1", RANGE, 1, 0.0).prefix
    asked = [count_of(keeper.questions(PEER, BACK)[-1]) for keeper in (first, later)]
    assert asked[0] < asked[1]


def count_of(question: bytes) -> int:
    return int.from_bytes(question[-4:], "little")


def test_how_many_others_were_asked_is_nothing_to_a_participant() -> None:
    """It heeds only what counts more than the last, also from the next process a second later."""
    first, later = make_keeper(1000.0), make_keeper(1001.0)
    for number in range(100):
        first.questions(number.to_bytes(12, "big"), BACK)
    asked = [count_of(first.questions(PEER, BACK)[-1]) for _ in range(COUNTS_EACH_SECOND)]
    first.forget(PEER)
    assert count_of(first.questions(PEER, BACK)[-1]) > max(asked)
    assert count_of(later.questions(PEER, BACK)[-1]) > max(asked)


@given(some_ports, st.integers(0, 63))
def test_a_longer_range_has_the_same_keeper(ports: list[int], more: int) -> None:
    keeper, longer = make_keeper(), Keeper.of("10.0.0.1", PortRange(11400, 11463 + more), 0, 0.0)
    assert keeper.prefix == longer.prefix
    longer.number_by_prefix[PEER] = keeper.number(ports)
    assert longer.former_ports(PEER) == ports


def test_it_asks_and_reminds_by_heartbeats() -> None:
    keeper = make_keeper()
    _, question = keeper.questions(PEER, BACK)
    _, reminder = keeper.reminders(PEER, [11405], BACK)
    for sent, first in ((question, 1), (reminder, keeper.number([11405]))):
        (told,) = heartbeats(sent)
        assert (told.first, told.last) == (first, first - 1)
        assert (source_prefix(sent), destination(sent)) == (keeper.prefix, PEER)
