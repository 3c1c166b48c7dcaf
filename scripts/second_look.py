"""What a second try of the tests that failed says: whether the product is wrong, or the try was.

Where hundreds of real nodes, an engine or a cluster share two processors, a test may fail because
the machine was late, and another one each time: of thousands it takes one to refuse a change that
is right. So tests that failed among others are run once more when all layers have ended, alone.
What fails again is wrong. What passes is *flaky*: a bug, too, of the product or of the test, but
not one that this change need have made. It is shown with both durations, not hidden, and more
than `ALLOWED` of them refuse the run all the same. Who sees one mends it.

Here are the decisions, over the JUnit reports of both tries; `test_layers` runs them.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

ALLOWED = 3
"""How many flaky tests a run may have; none where it is strict."""
MOST = 12
"""Where more than these failed the product is wrong, and a second look only takes time."""


@dataclass(frozen=True)
class Case:
    """A test in a report: its node ID, the seconds that it took, and what became of it.

    ``failed`` is also who could not be set up, collected or cleaned up.
    """

    name: str
    seconds: float
    passed: bool
    failed: bool


@dataclass(frozen=True)
class Flake:
    """A test that failed among others and passed alone, with the seconds of both tries."""

    name: str
    seconds: float
    again: float

    def __str__(self) -> str:
        return (
            f"{self.name}: failed after {self.seconds:.1f} s, passed alone after {self.again:.1f} s"
        )


def read_cases(report: Path) -> dict[str, Case]:
    """The tests of a JUnit report by their node IDs.

    A test whose clean-up fails, too, stands there twice: its times are added up.
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


def worth_a_look(cases: Iterable[Case]) -> bool:
    """Whether so few of the tests of a run failed that a second look may say something."""
    return sum(case.failed for case in cases) <= MOST


def flakes(first: Mapping[str, Case], again: Mapping[str, Case]) -> tuple[Flake, ...]:
    """The tests that failed at first, if all of them passed again; otherwise none."""
    failed = [case for case in first.values() if case.failed]
    if not all(case.name in again and again[case.name].passed for case in failed):
        return ()
    return tuple(Flake(case.name, case.seconds, again[case.name].seconds) for case in failed)


def too_many(count: int, strict: bool) -> str | None:
    """Why so many flaky tests refuse a run, if they do."""
    if strict and count:
        return "flaky tests, and STRICT=1 allows none"
    if count > ALLOWED:
        return f"{count} flaky tests, more than {ALLOWED}: one fault may be behind them"
    return None


def _node_id(classname: str, name: str) -> str:
    """As pytest takes it; the module is all of ``classname``, since no test is in a class."""
    return f"{classname.replace('.', '/')}.py::{name}" if classname else name
