"""Problems in the log: a line at the beginning, a line at the end."""

import logging

import pytest

from rosproxy_operator.common.problem import Problem, ProblemLog

FATAL = Problem("container talker", "no master is known")
WARNING = Problem("container talker", "label x is unknown", fatal=False)


def test_each_problem_is_told_once(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    log = ProblemLog()
    for problems in ([FATAL], [FATAL, WARNING], [FATAL, WARNING], [WARNING], [], [], [FATAL]):
        log.update(problems)
    told = [(record.levelname, record.getMessage()) for record in caplog.records]
    assert told == [
        ("ERROR", "container talker: no master is known"),
        ("WARNING", "container talker: label x is unknown"),
        ("INFO", "container talker: solved"),
        ("ERROR", "container talker: no master is known"),
    ]


def test_what_a_problem_is_about_is_a_field_of_the_record(caplog: pytest.LogCaptureFixture) -> None:
    ProblemLog().update([FATAL, Problem("proxy rosproxy-a", "ends"), Problem("uplink", "is gone")])
    fields = [(vars(r).get("container"), vars(r).get("proxy")) for r in caplog.records]
    assert fields == [("talker", None), (None, "rosproxy-a"), (None, None)]
