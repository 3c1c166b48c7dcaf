"""Problems in the log: once when they appear, once when they are solved."""

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
