"""Problems in the log: a line at the beginning, a line at the end."""

import logging

import pytest

from rosproxy_operator.common.problem import Fault, Problem, ProblemLog

FATAL = Problem("container talker", "no master is known", reason="X")
WARNING = Problem("container talker", "label x is unknown", fatal=False, reason="X")


def test_each_problem_is_told_once(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    log = ProblemLog()
    for problems in ([FATAL], [FATAL, WARNING], [FATAL, WARNING], [WARNING], [], [], [FATAL]):
        log.update(problems, 0.0)
    told = [(record.levelname, record.getMessage()) for record in caplog.records]
    assert told == [
        ("ERROR", "container talker: no master is known"),
        ("WARNING", "container talker: label x is unknown"),
        ("INFO", "container talker: solved"),
        ("ERROR", "container talker: no master is known"),
    ]


def test_a_problem_keeps_its_time_until_it_is_solved() -> None:
    log = ProblemLog()
    log.update([FATAL], 1.0)
    log.update([FATAL, WARNING], 2.0)
    assert log.since == {FATAL: 1.0, WARNING: 2.0}
    log.update([], 3.0)
    log.update([FATAL], 4.0)
    assert log.since == {FATAL: 4.0}


def test_what_a_problem_is_about_is_a_field_of_the_record(caplog: pytest.LogCaptureFixture) -> None:
    proxy = Problem("proxy rosproxy-a", "ends", reason="ProxyStuck")
    ProblemLog().update([FATAL, proxy, Problem("uplink", "is gone", reason="Y")], 0.0)
    names = ("container", "proxy", "reason")
    fields = [tuple(vars(record).get(name) for name in names) for record in caplog.records]
    assert fields == [("talker", None, "X"), (None, "rosproxy-a", "ProxyStuck"), (None, None, "Y")]


@pytest.mark.parametrize(
    ("fault", "told"),
    [
        (Fault("is odd"), "is odd"),
        (Fault("is odd", "Stop it"), "is odd. Stop it"),
        (Fault("is it?", "Stop it"), "is it? Stop it"),
        (Fault("is very odd indeed", "Stop it"), "is very od… Stop it"),
        (Fault("is very odd indeed, and old"), "is very odd indeed,…"),
        (Fault("is odd", "Stop it or leave it"), "… Stop it or lea…"),
    ],
)
def test_a_long_text_is_cut_before_the_fix(fault: Fault, told: str) -> None:
    assert str(fault.shortened(20)) == told
