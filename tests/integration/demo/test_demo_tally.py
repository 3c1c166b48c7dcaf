"""The demo's arithmetic: what counts as lost, cut off, duplicated or unheard."""

import dataclasses

import pytest

from rosproxy.demo.tally import Evidence, count_stream, first_message_after, judge

KILLED = 100.0


def session(first, last, closed=None, tail=()):
    return {"first": first, "last": last, "closed": closed, "tail": list(tail)}


def stream(sessions, runs, published=30, count=None):
    numbers = sum(last - first + 1 for first, last in runs)
    subscription = {"runs": runs, "count": numbers if count is None else count}
    publisher = {"published": published, "sessions": sessions}
    return count_stream("there", publisher, subscription, KILLED)


def test_everything_arrived_over_two_connections():
    count = stream([session(3, 10, closed=100.0), session(20, 30)], [[3, 10], [20, 30]])
    assert count.fits
    assert (count.unheard_before, count.unheard_during_outage) == (2, 9)
    assert (count.sent, count.received, count.cut_off, count.lost) == (19, 19, 0, 0)


def test_a_gap_is_a_loss():
    count = stream([session(1, 30)], [[1, 9], [11, 30]])
    assert (count.lost, count.fits) == (1, False)


def test_what_was_written_at_the_kill_is_cut_off_and_not_lost():
    tail = [[9, 99.5], [10, 99.95], [11, 100.01]]
    count = stream([session(1, 11, closed=100.02, tail=tail), session(20, 30)], [[1, 9], [20, 30]])
    assert (count.cut_off, count.lost, count.fits) == (2, 0, True)


def test_what_was_written_well_before_the_kill_is_lost():
    tail = [[9, 99.5], [10, 99.85], [11, 100.01]]
    count = stream([session(1, 11, closed=100.02, tail=tail), session(20, 30)], [[1, 8], [20, 30]])
    assert (count.cut_off, count.lost, count.fits) == (1, 2, False)


def test_a_connection_that_broke_before_the_kill_excuses_nothing():
    count = stream([session(1, 11, closed=99.99, tail=[[11, 99.98]])], [[1, 10]], published=11)
    assert (count.cut_off, count.lost, count.fits) == (0, 1, False)


def test_duplicates_and_strangers_are_seen():
    count = stream([session(1, 10)], [[1, 10], [10, 10], [12, 12]], published=10)
    assert (count.duplicates, count.strangers, count.fits) == (1, 1, False)


def test_nothing_at_all_does_not_fit():
    count = stream([], [], published=5)
    assert (count.unheard_before, count.sent, count.fits) == (5, 0, False)


def test_recovery_is_measured_on_new_connections_only():
    def link(connected, first_message):
        return {"connected": connected, "first_message": first_message}

    links = [link(1.0, 1.1), link(101.0, None), link(102.0, 102.2), link(103.0, 103.1)]
    assert first_message_after({"links": links}, KILLED) == 102.2
    assert first_message_after({"links": links[:2]}, KILLED) is None


GOOD = Evidence(
    direct_received=0,
    direct_problem="no route to host",
    streams=(stream([session(1, 30)], [[1, 30]]),),
    service_before=("", ""),
    service_after=("", ""),
    addresses_before={"/n": "h:1"},
    addresses_after={"/n": "h:1"},
    message_recovery=0.5,
    service_recovery=0.4,
)


def test_good_evidence_meets_every_expectation():
    assert all(verdict.met for verdict in judge(GOOD))


@pytest.mark.parametrize(
    ("change", "failed"),
    [
        ({"direct_received": 3}, "without the proxy"),
        ({"direct_problem": ""}, "without the proxy"),
        ({"streams": (stream([session(1, 30)], [[2, 30]]),)}, "every message there"),
        ({"service_before": ("", "refused")}, "before the kill"),
        ({"service_after": ()}, "after the restart"),
        ({"addresses_after": {"/n": "h:2"}}, "same ports"),
        ({"addresses_before": None, "addresses_after": None}, "same ports"),
        ({"message_recovery": 2.1}, "recovered"),
        ({"service_recovery": None}, "recovered"),
    ],
)
def test_each_failure_is_named(change, failed):
    verdicts = judge(dataclasses.replace(GOOD, **change))
    assert [failed in verdict.expectation for verdict in verdicts if not verdict.met] == [True]


def test_a_demo_that_ended_early_fails_everything_it_did_not_show():
    assert not any(verdict.met for verdict in judge(Evidence()))
