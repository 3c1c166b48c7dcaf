"""How many connections there may be, and which one goes first."""

from rosproxy.net import gate
from rosproxy.net.gate import LEAST_PER_SOURCE, Gate

Told = list[tuple[str, str]]


def make_gate(per_source: int = 3, per_port: int = 5) -> tuple[Gate, Told]:
    told: Told = []
    made = Gate(per_source, per_port, lambda reason, source, _: told.append((reason, source)))
    return made, told


def enter(one: Gate, source: str, port: int, count: int) -> None:
    for _ in range(count):
        assert one.admits(source, port)
        one.enter(source, port)


def test_a_source_that_is_full_leaves_others_alone() -> None:
    one, told = make_gate()
    enter(one, "a", 1, 3)
    assert not one.admits("a", 2)
    assert told == [("connections_per_source", "a")]
    assert one.admits("b", 1)
    one.leave("a", 1)
    assert one.admits("a", 2)


def test_a_port_has_its_own_bound() -> None:
    one, told = make_gate(per_source=100)
    enter(one, "a", 1, 5)
    assert not one.admits("b", 1)
    assert told == [("connections_per_lease", "b")]
    assert one.admits("b", 2)


def test_a_full_source_loses_the_one_that_has_said_nothing_for_longest() -> None:
    one, _ = make_gate()
    ended: list[str] = []
    spoke = one.wait("a", lambda: ended.append("first"))
    one.wait("a", lambda: ended.append("second"))
    one.wait("a", lambda: ended.append("third"))
    enter(one, "a", 1, 3)
    spoke()
    assert one.admits("a", 1)
    assert one.admits("a", 1)
    assert ended == ["second", "third"]
    assert not one.admits("a", 1)


def test_silent_connections_are_bounded_by_source() -> None:
    one, told = make_gate(10_000, 10_000)
    ended: list[int] = []
    for number in range(gate.MOST_WAITING + 2):
        one.wait("a", lambda number=number: ended.append(number))  # type: ignore[misc]
    one.wait("b", lambda: ended.append(-1))
    assert ended == [0, 1]
    assert told == [("silent_connections", "a")] * 2


def test_file_descriptors_bound_a_source_as_well() -> None:
    one, _ = make_gate(per_source=1000)
    one.bound(1_000_000)
    assert one.per_source == 1000
    one.bound(2000)
    assert one.per_source == 500
    one.bound(-1)
    assert one.per_source == LEAST_PER_SOURCE


def test_nothing_is_kept_of_who_has_gone() -> None:
    one, _ = make_gate()
    for number in range(100):
        source = f"source {number}"
        enter(one, source, number, 1)
        with one.waiting(source, lambda: None):
            pass
        one.leave(source, number)
    assert not one._by_source
    assert not one._by_port
    assert not one._waiting
