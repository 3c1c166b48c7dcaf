"""Each ROS 2 problem is reported once, and removed after the repair."""

import asyncio
import logging
from typing import cast

import pytest
from msgspec.structs import replace

from rosproxy.ros2.domain_plane import DomainPlane
from rosproxy.ros2.domain_watch import MOST_NOTED, DomainWatch
from rosproxy.ros2.status import Ros2State
from rosproxy.shared.documents.status_document import DomainStatus, ParticipantStatus
from rosproxy.shared.output.problems import MOST_PROBLEMS, Problems

GOOD = ParticipantStatus("01.0f.aa", "172.30.0.5", "Fast DDS")
TCP = replace(GOOD, locator_fault="tcp")


class Told(Ros2State):
    """A state whose domain a test sets."""

    def __init__(self) -> None:
        super().__init__((), cast(DomainPlane, None))
        self.domain = DomainStatus()

    def status(self) -> tuple[DomainStatus, ...]:
        return (self.domain,)


def look(watch: DomainWatch, told: Told, *inside: ParticipantStatus) -> None:
    told.domain = DomainStatus(inside=inside)
    asyncio.run(watch.look())


def test_what_lasts_is_told_once(caplog: pytest.LogCaptureFixture) -> None:
    told = Told()
    problems = Problems()
    watch = DomainWatch(told, problems)
    with caplog.at_level(logging.WARNING):
        look(watch, told, TCP)
        assert problems.all() == []
        for _ in range(3):
            look(watch, told, TCP)
    (noted,) = problems.all()
    assert noted.subject == "01.0f.aa"
    assert "FASTDDS_BUILTIN_TRANSPORTS" in noted.text
    assert len(caplog.records) == 1


def test_what_is_mended_is_told_no_more() -> None:
    told = Told()
    problems = Problems()
    watch = DomainWatch(told, problems)
    for participant in (TCP, TCP, GOOD):
        look(watch, told, participant)
    assert problems.all() == []


def test_another_cause_takes_the_place_of_the_first() -> None:
    told = Told()
    problems = Problems()
    watch = DomainWatch(told, problems)
    secured = replace(GOOD, security="protected")
    for participant in (TCP, TCP, secured, secured):
        look(watch, told, participant)
    (noted,) = problems.all()
    assert "DDS Security" in noted.text


def test_so_many_are_told_and_no_more() -> None:
    told = Told()
    problems = Problems()
    watch = DomainWatch(told, problems)
    crowd = [replace(TCP, guid_prefix=f"01.0f.{number:02x}") for number in range(MOST_NOTED + 5)]
    for _ in range(2):
        look(watch, told, *crowd)
    assert len(problems.all()) == MOST_NOTED


def test_an_address_with_many_problems_hides_no_other() -> None:
    """Otherwise an address with low prefixes would take all places of the list."""
    told = Told()
    problems = Problems()
    watch = DomainWatch(told, problems)
    many = [replace(TCP, guid_prefix=f"01.0f.{number:02d}") for number in range(2 * MOST_NOTED)]
    other = replace(TCP, guid_prefix="ff.0f", address="172.30.0.6")
    for _ in range(2):
        look(watch, told, *many, other)
    noted = [problem.subject for problem in problems.all()]
    assert "ff.0f" in noted
    assert len(noted) == MOST_NOTED


def test_many_events_push_out_no_grave_problem() -> None:
    """A participant that receives by TCP only was missing in rosproxy status after 50 events."""
    told = Told()
    problems = Problems()
    watch = DomainWatch(told, problems)
    unproven = replace(GOOD, guid_prefix="02.0f.bb", proven=False)
    for _ in range(2):
        look(watch, told, TCP, unproven)
    assert {p.subject: p.holds for p in problems.all()} == {
        TCP.guid_prefix: True,
        "02.0f.bb": False,
    }
    for number in range(MOST_PROBLEMS):
        problems.add(f"peer {number}", "gone")
    look(watch, told, TCP, unproven)
    assert TCP.guid_prefix in {problem.subject for problem in problems.all()}
    look(watch, told, GOOD)
    assert not any(problem.holds for problem in problems.all())
