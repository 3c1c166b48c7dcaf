"""Connections that the kernel forwards, and their bytes."""

from collections.abc import Iterable

from hypothesis import given
from hypothesis import strategies as st

from rosproxy.forwarding import fast_ports
from rosproxy.forwarding.kernel import accounting
from rosproxy.forwarding.kernel.accounting import Account, CounterDeltas, KernelAccounts
from rosproxy.forwarding.kernel.nft import Counts
from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.registry.endpoint import Endpoint, NodeLocation, Registration
from rosproxy.ros1.registry.registry import Registry
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.ports import PortRange


def holder(registry: Registry, number: int) -> Endpoint:
    node = HostPort(f"10.0.0.{number}", 40000)
    endpoint = registry.admit(f"http://{node}/", node, NodeLocation(node.host, True), node.host)
    registry.register(endpoint, Registration(Kind.PUBLISHER, "/t", f"/node{number}"))
    assert fast_ports.claim(registry.pool, endpoint)
    return endpoint


def a_book(holders: int) -> tuple[Registry, KernelAccounts, list[Endpoint]]:
    registry = Registry(PortRange(1000, 1003))
    book = KernelAccounts()
    endpoints = [holder(registry, number) for number in range(1, holders + 1)]
    book.note_owners(registry)
    return registry, book, endpoints


def connection(
    endpoint: Endpoint, port: int, peer: str = "192.0.2.1"
) -> tuple[tuple[int, str], dict[str, int]]:
    return (port, endpoint.location.address), {peer: 1}


STEPS = st.tuples(st.integers(0, 1000), st.integers(0, 1000), st.integers(0, 10))


def added(counts: Counts, other: Iterable[int]) -> Counts:
    return Counts(*map(sum, zip(counts, other, strict=True)))


@given(st.lists(STEPS))
def test_nothing_is_lost_or_counted_twice(steps: list[tuple[int, int, int]]) -> None:
    ledger = CounterDeltas()
    counter = Counts()
    counted = Counts()
    for step in steps:
        counter = added(counter, step)
        counted = added(counted, ledger.take({45050: counter}).get(45050, Counts()))
    assert counted == counter


def test_counters_that_begin_anew_are_added() -> None:
    ledger = CounterDeltas()
    assert ledger.take({1: Counts(100, 10)}) == {1: Counts(100, 10)}
    assert ledger.take({1: Counts(100, 10)}) == {}
    assert ledger.take({1: Counts(30, 3)}) == {1: Counts(30, 3)}
    assert ledger.take({1: Counts(31, 3), 2: Counts(5)}) == {1: Counts(1), 2: Counts(5)}
    assert ledger.take({1: Counts(31, 3, 7)}) == {1: Counts(packets=7)}


def test_bytes_go_to_who_holds_the_port_and_to_its_name() -> None:
    _, book, (endpoint,) = a_book(1)
    assert book.count({1002: Counts(400, 40, 2), 1003: Counts(5, 6)}, 10.0) == [
        ("/node1", Counts(400, 40, 2)),
        ("unnamed", Counts(5, 6)),
    ]
    more = book.count({1002: Counts(600, 40, 3), 1003: Counts(5, 6)}, 12.0)
    assert more == [("/node1", Counts(200, 0, 1))]
    assert book.account(endpoint) == Account(600, 40, 3, (100.0, 0.0), 0.5)
    book.count({1002: Counts(600, 40, 3)}, 14.0)
    assert book.account(endpoint) == Account(600, 40, 3)


def test_a_port_given_back_stays_its_holders_until_somebody_else_has_it() -> None:
    registry, book, (first,) = a_book(1)
    fast_ports.give_back(registry.pool, first)
    book.note_owners(registry)
    assert book.ports_of(first) == [1002]
    book.note_peers(dict([connection(first, 1002)]))
    assert first.fast_peers == {"192.0.2.1": 1}
    registry.remove(first)
    book.note_owners(registry)
    assert book.owners == {}
    assert book.account(first) == Account()


def test_peers_are_those_of_the_nodes_own_address() -> None:
    _, book, (first, second) = a_book(2)
    connections = dict(
        [connection(first, 1002), connection(first, 1003), connection(second, 1003, "192.0.2.2")]
    )
    book.note_peers(connections)
    assert first.fast_peers == {"192.0.2.1": 1}
    assert second.fast_peers == {"192.0.2.2": 1}
    second.health.end(1.0)
    book.note_peers(connections)
    assert second.fast_peers == {}
    assert first.fast_peers == {"192.0.2.1": 1}
    book.note_peers({})
    assert first.fast_peers == second.fast_peers == {}


def test_a_node_that_has_lost_its_port_has_no_peers() -> None:
    """Otherwise the proxy does not look whether the peers have connected again."""
    registry, book, [endpoint] = a_book(holders=1)
    port = endpoint.fast_port
    assert port is not None
    registry.remove(endpoint)
    book.note_peers(dict([connection(endpoint, port)]))  # read before the node was removed
    assert endpoint.fast_peers
    book.note_owners(registry)
    assert not endpoint.fast_peers


def test_what_comes_in_and_is_not_answered_twice_in_a_row_is_silent() -> None:
    silence = accounting.UnansweredPorts()
    assert silence.look({1: Counts(0, 60), 2: Counts(0, 60), 3: Counts(5, 60)}, 10.0) == []
    assert silence.look({1: Counts(0, 60), 2: Counts(40, 60), 3: Counts(0, 60)}, 13.0) == [1]
    assert silence.look({3: Counts(0, 60), 1: Counts(0, 0)}, 16.0) == [3]
    assert silence.look({}, 19.0) == []
    assert silence.look({3: Counts(0, 60)}, 22.0) == []


def test_looks_that_follow_each_other_at_once_are_one_window() -> None:
    silence = accounting.UnansweredPorts()
    assert silence.look({1: Counts(0, 60), 2: Counts(0, 60)}, 10.0) == []
    assert silence.look({1: Counts(0, 60), 2: Counts(0, 60)}, 10.1) == []
    assert silence.look({1: Counts(40, 0)}, 11.9) == []
    assert silence.look({}, 12.0) == [2]


def test_silent_ports_are_noted_with_the_bytes() -> None:
    _, book, _ = a_book(1)
    for size in (60, 120):
        book.count({1002: Counts(0, size)}, float(size))
    assert book.unanswered == [1002]
    book.count({1002: Counts(40, 180)}, 200.0)
    assert book.unanswered == []
