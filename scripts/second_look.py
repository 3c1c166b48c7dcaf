"""Decide from a second run of failed tests whether a test is flaky or the change is wrong.

If hundreds of real nodes, an engine or a cluster share two processors, a test may fail because the
machine was late, and another test each time. A single such test would refuse a correct change. So
failed tests run once more at the end, alone. If a test fails again, the run fails. If the test
passes, the test is *flaky*: a bug of the product or of the test, but perhaps not of this change.
The summary shows flaky tests with both durations. With more than `MOST_FLAKY` flaky tests the run
fails. Mend a flaky test as soon as you see it.

This module decides, from the JUnit reports of both runs. `test_layers` runs the tests.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

MOST_FLAKY = 3
"""The highest number of flaky tests in a run that passes; 0 if the run is strict."""
MOST_FAILED = 12
"""If more tests failed, the product is wrong, and a second run would only take time."""


@dataclass(frozen=True)
class Case:
    """A test in a report: node ID, duration in seconds, result.

    ``failed`` includes failed setup, collection and teardown.
    """

    name: str
    seconds: float
    passed: bool
    failed: bool


@dataclass(frozen=True)
class Flake:
    """A test that failed at first and passed alone, with the seconds of both runs."""

    name: str
    seconds: float
    again: float

    def __str__(self) -> str:
        return (
            f"{self.name}: failed after {self.seconds:.1f} s, passed alone after {self.again:.1f} s"
        )


def read_cases(report: Path) -> dict[str, Case]:
    """Return the tests of a JUnit report, by node ID.

    If the teardown of a failed test fails, too, the report has the test twice. Then the result has
    the sum of both times.
    """
    cases: dict[str, Case] = {}
    for element in ElementTree.parse(report).getroot().iter("testcase"):
        name = _node_id(element.get("classname", ""), element.get("name", ""))
        failed = element.find("failure") is not None or element.find("error") is not None
        passed = not failed and element.find("skipped") is None
        seconds = float(element.get("time", 0))
        if former := cases.get(name):
            seconds = seconds + former.seconds
            passed = passed and former.passed
            failed = failed or former.failed
        cases[name] = Case(name, seconds, passed, failed)
    return cases


def is_worth_second_run(cases: Iterable[Case]) -> bool:
    """Whether few enough tests failed for a second run."""
    return sum(case.failed for case in cases) <= MOST_FAILED


def flakes(first: Mapping[str, Case], again: Mapping[str, Case]) -> tuple[Flake, ...]:
    """Return the tests that failed in the first run, if all passed in the second; else none."""
    failed = [case for case in first.values() if case.failed]
    if not all(case.name in again and again[case.name].passed for case in failed):
        return ()
    return tuple(Flake(case.name, case.seconds, again[case.name].seconds) for case in failed)


def flaky_failure(count: int, strict: bool) -> str | None:
    """Return the reason if a run fails because of the number of flaky tests, else None."""
    if strict and count:
        return "flaky tests, and STRICT=1 allows none"
    if count > MOST_FLAKY:
        return f"{count} flaky tests, more than {MOST_FLAKY}: they may have the same cause"
    return None


def _node_id(classname: str, name: str) -> str:
    """Return the node ID in the form of pytest.

    ``classname`` is the module, because no test is in a class.
    """
    return f"{classname.replace('.', '/')}.py::{name}" if classname else name
