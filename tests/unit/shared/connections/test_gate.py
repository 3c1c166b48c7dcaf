"""Limits on connections, and the connection that is closed first."""

from itertools import count

import pytest

from rosproxy.shared.connections import gate
from rosproxy.shared.connections.gate import Gate

Told = list[tuple[str, str]]


def make_gate(per_source: int = 3, per_port: int = 5) -> tuple[Gate, Told]:
    told: Told = []
    made = Gate(per_source, per_port, lambda reason, source, _: told.append((reason, source)))
    return made, told


def enter(connection_gate: Gate, source: str, port: int, count: int) -> None:
    for _ in range(count):
        assert connection_gate.admits(source, port)
        connection_gate.enter(source, port)


def test_a_source_that_is_full_leaves_others_alone() -> None:
    connection_gate, told = make_gate()
    enter(connection_gate, "a", 1, 3)
    assert not connection_gate.admits("a", 2)
    assert told == [("connections_per_source", "a")]
    assert connection_gate.admits("b", 1)
    connection_gate.leave("a", 1)
    assert connection_gate.admits("a", 2)


def test_a_port_has_its_own_bound() -> None:
    connection_gate, told = make_gate(per_source=100)
    enter(connection_gate, "a", 1, 5)
    assert not connection_gate.admits("b", 1)
    assert told == [("connections_per_lease", "b")]
    assert connection_gate.admits("b", 2)


def test_a_full_source_loses_the_one_that_has_said_nothing_for_longest() -> None:
    connection_gate, _ = make_gate()
    ended: list[str] = []
    spoke = connection_gate.note_waiting("a", lambda: ended.append("first"))
    connection_gate.note_waiting("a", lambda: ended.append("second"))
    connection_gate.note_waiting("a", lambda: ended.append("third"))
    enter(connection_gate, "a", 1, 3)
    spoke()
    assert connection_gate.admits("a", 1)
    assert connection_gate.admits("a", 1)
    assert ended == ["second", "third"]
    assert not connection_gate.admits("a", 1)


def test_silent_connections_are_bounded_by_source() -> None:
    connection_gate, told = make_gate(10_000, 10_000)
    ended: list[int] = []
    for number in range(gate.MOST_WAITING + 2):
        connection_gate.note_waiting("a", lambda number=number: ended.append(number))  # type: ignore[misc]
    connection_gate.note_waiting("b", lambda: ended.append(-1))
    assert ended == [0, 1]
    assert told == [("silent_connections", "a")] * 2


def fill(connection_gate: Gate, source: str) -> int:
    """Open all connections that a source gets, and return their number."""
    for number in count():
        if not connection_gate.admits(source, 1):
            return number
        connection_gate.enter(source, 1)
    raise AssertionError


@pytest.mark.parametrize(("files", "number"), [(1_000_000, 1000), (2000, 500), (-1, 64)])
def test_file_descriptors_bound_a_source_as_well(files: int, number: int) -> None:
    connection_gate, _ = make_gate(per_source=1000, per_port=10_000)
    connection_gate.bound(files)
    assert fill(connection_gate, "a") == number


def test_several_sources_leave_file_descriptors_to_others() -> None:
    """Four addresses had all of them."""
    connection_gate, told = make_gate(per_source=4096, per_port=10_000)
    connection_gate.bound(4096)
    numbers = [fill(connection_gate, f"192.0.2.{number}") for number in range(4)]
    assert numbers == [1024, 512, 256, 128]
    assert sum(numbers) * 2 < 4096
    assert fill(connection_gate, "192.0.2.99") > 0
    assert {reason for reason, _ in told} == {"connections_per_source"}


def test_the_addresses_of_an_ipv6_network_share() -> None:
    connection_gate, _ = make_gate(per_source=100, per_port=10_000)
    numbers = [fill(connection_gate, f"2001:db8::{number}") for number in range(1, 9)]
    assert numbers == [100, 50, 0, 0, 0, 0, 0, 0]
    assert fill(connection_gate, "2001:db8:0:1::1") == 100
    connection_gate.bound(700)
    assert fill(connection_gate, "2001:db8:0:2::1") > 0
    assert fill(connection_gate, "2001:db8:0:2::2") == 0


def test_nothing_is_kept_of_who_has_gone() -> None:
    connection_gate, _ = make_gate()
    for number in range(100):
        source = f"source {number}"
        enter(connection_gate, source, number, 1)
        with connection_gate.waiting(source, lambda: None):
            pass
        connection_gate.leave(source, number)
    assert not connection_gate._by_source
    assert not connection_gate._by_port
    assert not connection_gate._waiting


def test_the_fix_names_what_bounds_a_source() -> None:
    texts: list[str] = []
    for files, fix in ((100_000, "--max-connections-per-source"), (4 * 100, "open files")):
        connection_gate = Gate(300, 10_000, lambda _reason, _source, text: texts.append(text))
        connection_gate.bound(files)
        fill(connection_gate, "a")
        assert fix in texts[-1]
    assert texts[0].startswith("the source already has 300 connections. Set a larger --max-")
    assert texts[1].startswith("the source has 100 of the 200 connections that the 400 open files ")
    assert "--max-connections" not in texts[1]
