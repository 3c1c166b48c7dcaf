"""Limits on connections, and the connection that is closed first."""

from rosproxy.net import gate
from rosproxy.net.gate import LEAST_PER_SOURCE, Gate

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


def test_file_descriptors_bound_a_source_as_well() -> None:
    connection_gate, _ = make_gate(per_source=1000)
    connection_gate.bound(1_000_000)
    assert connection_gate.per_source == 1000
    connection_gate.bound(2000)
    assert connection_gate.per_source == 500
    connection_gate.bound(-1)
    assert connection_gate.per_source == LEAST_PER_SOURCE


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
        enter(connection_gate, "a", 1, connection_gate.per_source)
        assert not connection_gate.admits("a", 1)
        assert fix in texts[-1]
    assert texts[0].startswith("the source already has 300 connections. Set a larger --max-")
    assert texts[1].startswith("the source already has 100 connections, as many as the 400 open ")
    assert "--max-connections" not in texts[1]
