"""Refusals are counted each time, and reported now and then."""

import pytest

from rosproxy.shared.output.problems import Problems
from rosproxy.telemetry.metrics import Metrics
from rosproxy.telemetry.refusals import (
    MOST_LINES,
    MOST_REMEMBERED_LINES,
    MOST_SOURCES,
    OVER_AFTER,
    PATIENCE,
    PAUSE,
    QUIET,
    RATE,
    START_REASONS,
    Refusals,
)


def test_each_refusal_counts_and_the_first_of_a_source_is_told(
    caplog: pytest.LogCaptureFixture,
) -> None:
    metrics = Metrics()
    problems = Problems()
    clock = [0.0]
    refusals = Refusals(metrics, problems, lambda: clock[0])
    for _ in range(5):
        refusals.note("long_body", "10.0.0.5", "the body is longer than 5 bytes")
    refusals.note("long_body", "10.0.0.6", "another")
    assert [record.message for record in caplog.records] == [
        "refused: long body, from 10.0.0.5: the body is longer than 5 bytes",
        "refused: long body, from 10.0.0.6: another",
    ]
    clock[0] = QUIET
    refusals.note("long_body", "10.0.0.5", "again")
    assert len(caplog.records) == 3
    value = metrics.registry.get_sample_value("rosproxy_refused_total", {"reason": "long_body"})
    assert value == 7
    (problem,) = problems.all()
    assert (problem.subject, problem.text) == ("refused: long body", "from 10.0.0.5: again")


def test_many_sources_are_forgotten() -> None:
    refusals = Refusals(Metrics(), Problems(), lambda: 0.0)
    for number in range(MOST_REMEMBERED_LINES + 10):
        refusals.note(f"reason_{number // MOST_LINES}", str(number), "x")
    assert len(refusals._logged_at) == MOST_REMEMBERED_LINES


def test_forged_sources_do_not_fill_the_log(caplog: pytest.LogCaptureFixture) -> None:
    clock = [0.0]
    refusals = Refusals(Metrics(), Problems(), lambda: clock[0])
    for number in range(1000):
        refusals.note("long_body", str(number), "x")
    refusals.note("malformed", "10.0.0.5", "another reason")
    assert len(caplog.records) == MOST_LINES + 1
    clock[0] = QUIET
    refusals.note("long_body", "10.0.0.5", "x")
    assert len(caplog.records) == MOST_LINES + 2


def test_a_refusal_that_is_over_is_not_shown() -> None:
    problems = Problems()
    clock = [0.0]
    refusals = Refusals(Metrics(), problems, lambda: clock[0])
    refusals.note("long_body", "10.0.0.5", "x")
    clock[0] = QUIET / 2
    refusals.note("long_body", "10.0.0.5", "x")
    clock[0] = OVER_AFTER
    refusals.end_old()
    assert problems.all(), "the last refusal was later"
    clock[0] = QUIET / 2 + OVER_AFTER
    refusals.end_old()
    assert not problems.all()
    refusals.note("long_body", "10.0.0.5", "x")
    assert problems.all(), "a new refusal is a problem again"


@pytest.mark.parametrize("reason", [*sorted(START_REASONS), RATE])
def test_what_a_start_brings_for_a_moment_is_not_told(
    reason: str, caplog: pytest.LogCaptureFixture
) -> None:
    problems = Problems()
    clock = [0.0]
    refusals = Refusals(Metrics(), problems, lambda: clock[0])
    for started in range(10):
        clock[0] = started * 2 * PAUSE
        refusals.note(reason, "10.0.0.5", "x")
        clock[0] += PATIENCE / 2
        refusals.note(reason, "10.0.0.5", "x")
    assert not problems.all()
    assert not caplog.records


def test_what_goes_on_after_a_start_is_told(caplog: pytest.LogCaptureFixture) -> None:
    """Also if each datagram has another, perhaps forged, source."""
    problems = Problems()
    clock = [0.0]
    refusals = Refusals(Metrics(), problems, lambda: clock[0])
    for number in range(3):
        clock[0] = number * 8.0
        refusals.note("not_a_peer", f"10.0.0.{number}", "x")
    (problem,) = problems.all()
    assert problem.text == "from 10.0.0.2: x"
    assert len(caplog.records) == 1


@pytest.mark.parametrize("reason", sorted(START_REASONS))
def test_a_node_that_restarts_again_and_again_is_no_problem(reason: str) -> None:
    """The proxy admits the node's participant each time."""
    problems = Problems()
    clock = [0.0]
    refusals = Refusals(Metrics(), problems, lambda: clock[0])
    for started in range(30):
        clock[0] = float(started)
        refusals.note(reason, "10.0.0.5", "x")
        refusals.settle("10.0.0.5")
    assert not problems.all()


def test_a_source_that_floods_is_told_though_it_is_met_again_and_again() -> None:
    problems = Problems()
    clock = [0.0]
    refusals = Refusals(Metrics(), problems, lambda: clock[0])
    for started in range(12):
        clock[0] = float(started)
        refusals.note(RATE, "10.0.0.5", "x")
        refusals.settle("10.0.0.5")
    assert problems.all()


@pytest.mark.parametrize("reason", sorted(START_REASONS))
def test_a_start_beside_a_running_robot_is_over_once_all_have_been_met(reason: str) -> None:
    """The robot sends datagrams all the time, and announces itself late."""
    problems = Problems()
    clock = [0.0]
    refusals = Refusals(Metrics(), problems, lambda: clock[0])
    for second in range(15):
        clock[0] = float(second)
        refusals.note(reason, "10.0.0.5", "x")
        refusals.note(reason, "10.0.0.6", "x")
    assert problems.all()
    refusals.settle("10.0.0.5")
    assert problems.all(), "10.0.0.6 has not been met"
    refusals.settle("10.0.0.6")
    assert not problems.all()
    clock[0] += QUIET
    for _ in range(15):
        clock[0] += 1.0
        refusals.note(reason, "10.0.0.5", "x")
    assert problems.all(), "what goes on again is told again"


def test_another_source_that_settles_hides_nothing() -> None:
    problems = Problems()
    clock = [0.0]
    refusals = Refusals(Metrics(), problems, lambda: clock[0])
    for started in range(12):
        clock[0] = float(started)
        refusals.note("not_a_peer", "10.0.0.6", "x")
        refusals.note("not_a_peer", "10.0.0.5", "x")
        refusals.settle("10.0.0.5")
    assert problems.all()


def test_many_forged_sources_that_settle_hide_nothing() -> None:
    problems = Problems()
    clock = [0.0]
    refusals = Refusals(Metrics(), problems, lambda: clock[0])
    for number in range(2 * MOST_SOURCES):
        clock[0] = number / 40
        refusals.note("not_a_peer", str(number), "x")
    for number in range(2 * MOST_SOURCES):
        refusals.settle(str(number))
    refusals.note("not_a_peer", "10.0.0.5", "x")
    assert problems.all()
