"""A node's health, as a script of probe results."""

import pytest

from rosproxy.ros1.registry.node_health import Health, ProbeResult

A = ProbeResult.ANSWERED
R = ProbeResult.REFUSED
S = ProbeResult.SILENT


@pytest.mark.parametrize(
    ("probes", "went_down", "state"),
    [
        ([], [], "new"),
        ([A], [False], "ok"),
        ([R], [False], "failing"),
        ([S], [False], "failing"),
        ([R, R], [False, True], "refused"),
        ([S, S], [False, True], "silent"),
        ([S, R], [False, True], "refused"),
        ([R, S], [False, True], "silent"),
        ([A, R, A], [False] * 3, "ok"),
        ([R, A, R], [False] * 3, "failing"),
        ([R, R, R], [False, True, False], "refused"),
        ([R, R, S], [False, True, False], "silent"),
        ([R, R, A], [False, True, False], "ok"),
        ([S, S, A, A], [False, True, False, False], "ok"),
        (
            [S, S, A, S, S],
            [False, True, False, False, True],
            "silent",
        ),
    ],
)
def test_when_it_goes_down_and_its_state(
    probes: list[ProbeResult], went_down: list[bool], state: str
) -> None:
    health = Health()
    assert [health.note(probe, float(i)) for i, probe in enumerate(probes)] == went_down
    assert health.state == state
    assert health.down == (state in ("refused", "silent"))


def test_a_node_that_was_cleaned_up_says_so_until_it_is_registered_again() -> None:
    health = Health(failures=2, failing_since=0.0, cleaned=True)
    assert health.state == "cleaned"
    assert not health.note(A, 9.0)
    assert not health.down
    assert health.state == "cleaned"
    health.cleaned = False
    assert health.state == "ok"


@pytest.mark.parametrize(
    ("probes", "now", "due"),
    [
        ([], 0.0, True),  # never looked at
        ([A], 4.9, False),
        ([A], 5.0, True),
        ([A, A], 5.5, False),  # the second was at 1
        ([R], 0.1, True),  # after a failure: ask again at once
        ([A, S], 1.1, True),
        ([S, S], 1.9, False),  # down: once a second
        ([S, S], 2.0, True),
        ([S, S, A], 6.9, False),
        ([S, S, A], 7.0, True),
    ],
)
def test_when_to_probe_with_an_interval_of_five_seconds(
    probes: list[ProbeResult], now: float, due: bool
) -> None:
    health = Health()
    for moment, probe in enumerate(probes):
        health.note(probe, float(moment))
    assert health.probe_due(now, 5.0) is due


def test_a_short_interval_holds_for_nodes_that_are_down_too() -> None:
    health = Health()
    health.note(R, 0.0)
    health.note(R, 0.0)
    assert not health.probe_due(0.1, 0.2)
    assert health.probe_due(0.2, 0.2)


def test_a_suspect_is_probed_at_once_and_its_process_id_forgotten() -> None:
    health = Health(pid=42)
    health.note(A, 0.0)
    assert not health.probe_due(1.0, 5.0)
    health.suspect()
    assert health.probe_due(1.0, 5.0)
    assert health.pid != 42


@pytest.mark.parametrize(
    ("health", "now", "after", "due"),
    [
        (Health(), 100.0, 30.0, False),
        (Health(failures=1, failing_since=0.0), 100.0, 30.0, False),
        (Health(failures=2, failing_since=0.0), 29.9, 30.0, False),
        (Health(failures=2, failing_since=0.0), 30.0, 30.0, True),
        (Health(failures=2, failing_since=0.0), 1e9, 0.0, False),  # 0: never
        (Health(failures=2, failing_since=0.0, cleaned=True), 100.0, 30.0, False),
        (Health(failures=9, failing_since=90.0), 100.0, 30.0, False),
    ],
)
def test_when_to_clean_up(health: Health, now: float, after: float, due: bool) -> None:
    assert health.cleanup_due(now, after) is due


def test_the_grace_period_counts_from_the_first_failure_and_starts_anew() -> None:
    health = Health()
    for moment, probe in [(0.0, S), (10.0, S), (20.0, A), (30.0, S), (40.0, S)]:
        health.note(probe, moment)
    assert not health.cleanup_due(59.0, 30.0)
    assert health.cleanup_due(60.0, 30.0)


def test_how_long_a_node_has_not_answered() -> None:
    health = Health()
    for moment, probe, unanswered in [(10.0, S, 0.0), (20.0, S, 10.0), (30.0, A, 0.0)]:
        health.note(probe, moment)
        assert health.unanswered(moment) == unanswered
    health.end(40.0)
    assert health.unanswered(50.0) == 0.0


def test_a_node_that_is_known_to_have_ended_is_down_at_once() -> None:
    health = Health()
    health.note(A, 1.0)
    health.end(2.0)
    assert (health.down, health.has_ended) == (True, True)
    assert health.cleanup_due(2.0, after=30.0)  # at the next look, if not at once
    assert not health.cleanup_due(2.0, after=0.0)
    health.note(S, 3.0)  # the address is silent, but the node won't come back
    assert (health.down, health.has_ended) == (True, True)
    assert not health.note(A, 4.0)
    assert not health.down
    assert (health.down, health.has_ended) == (False, False)
    assert not health.cleanup_due(99.0, after=30.0)
