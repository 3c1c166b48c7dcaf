"""Problems in the status of a domain: reasons why participants do not discover each other."""

import re

import pytest
from msgspec.structs import replace

from rosproxy.ros2.domain_problems import LEAST_OVERFLOWED, DomainProblem, domain_problems
from rosproxy.shared.documents.status_document import (
    DataPlaneStatus,
    DomainStatus,
    MismatchStatus,
    ParticipantStatus,
)

INSIDE = ParticipantStatus("01.0f.aa", "172.30.0.5", "Fast DDS")
OUTSIDE = ParticipantStatus("01.10.bb", "10.0.0.9", "Cyclone DDS")
MISMATCH = MismatchStatus(
    "topic", "/scan", "reliability", "BEST_EFFORT", "RELIABLE", "01.0f.aa", "01.10.bb"
)
DOMAIN = DomainStatus(
    domain=3, discovery="10.0.0.1:11400", peers=("robot",), inside=(INSIDE,), outside=(OUTSIDE,)
)


def with_inside(**changes: object) -> list[DomainProblem]:
    return list(domain_problems(replace(DOMAIN, inside=(replace(INSIDE, **changes),))))


def test_nothing_is_wrong() -> None:
    assert list(domain_problems(DOMAIN)) == []


@pytest.mark.parametrize(
    ("changes", "check", "grave", "said"),
    [
        ({"domain": 5}, "domain", True, "ROS_DOMAIN_ID=3"),
        ({"security": "protected"}, "security", True, "ROS_SECURITY_ENABLE=false"),
        ({"security": "protected", "vendor": "OpenDDS"}, "security", False, "do not reach these"),
        ({"locator_fault": "tcp"}, "transport", True, "FASTDDS_BUILTIN_TRANSPORTS"),
        ({"locator_fault": "loopback"}, "transport", True, "ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET"),
        ({"locator_fault": "elsewhere"}, "transport", True, "does not announce the address"),
        ({"locator_fault": "missing"}, "transport", True, "UDPv4"),
        ({"problem": "no port of 11400-11403 is free"}, "ports", True, "--port-range"),
        (
            {"problem": "has more than 16 locators", "shortage": "bound"},
            "ports",
            True,
            "fewer addresses",
        ),
        ({"problem": "no port is free", "shortage": "range"}, "ports", True, "--port-range"),
        ({"proven": False}, "reached", False, "10.0.0.1"),
    ],
)
def test_each_cause_has_its_fix(
    changes: dict[str, object], check: str, grave: bool, said: str
) -> None:
    (problem,) = with_inside(**changes)
    assert (problem.check, problem.subject, problem.grave) == (check, "01.0f.aa", grave)
    assert said in problem.text + problem.fix
    assert problem.text.startswith("participant at 172.30.0.5 (")


@pytest.mark.parametrize(
    ("buffer", "plane", "fix"),
    [
        (212_992, "copy", "net.core.rmem_max=1048576 .*, and restart the proxy; or .* kernel"),
        (212_992, "kernel", "net.core.rmem_max=1048576 .*, and restart the proxy$"),
        (1_048_576, "copy", "^set --data-plane kernel"),
        (1_048_576, "kernel", "^send smaller or fewer messages"),
    ],
)
def test_full_receive_buffers_have_a_fix_that_is_left(buffer: int, plane: str, fix: str) -> None:
    few = replace(
        DOMAIN,
        overflowed_recently=LEAST_OVERFLOWED - 1,
        receive_buffer=buffer,
        data_plane=DataPlaneStatus(plane=plane),
    )
    assert list(domain_problems(few)) == []
    (problem,) = domain_problems(replace(few, overflowed_recently=LEAST_OVERFLOWED))
    assert (problem.subject, problem.grave) == ("domain 3", False)
    assert f"{buffer // 1024} KiB" in problem.text
    assert re.search(fix, problem.fix), problem.fix


def test_of_a_participant_the_first_cause_alone_is_told() -> None:
    (problem,) = with_inside(security="protected", locator_fault="tcp", problem="no port", domain=4)
    assert problem.check == "domain"


@pytest.mark.parametrize(
    "changes",
    [{"security": "authenticated"}, {"security": "protected", "vendor": "Cyclone DDS"}],
)
def test_dds_security_that_passes(changes: dict[str, object]) -> None:
    """SEDP with readable addresses, or without addresses, as in Cyclone DDS."""
    assert with_inside(**changes) == []


def test_outside_is_reached_by_its_own_addresses() -> None:
    secured = replace(OUTSIDE, security="protected", vendor="Fast DDS")
    assert list(domain_problems(replace(DOMAIN, outside=(secured,)))) == []


def test_a_longer_range_is_no_fix_for_too_many_locators() -> None:
    (problem,) = with_inside(problem="has more than 16 locators", shortage="bound")
    assert "--port-range" not in problem.text + problem.fix


def test_outside_is_not_reached_in_direction_both_where_its_addresses_are_protected() -> None:
    """The proxy rewrites the addresses of both sides, but cannot rewrite protected addresses."""
    secured = replace(OUTSIDE, security="protected", vendor="Fast DDS")
    both_ways = replace(DOMAIN, direction="both")
    (problem,) = domain_problems(replace(both_ways, outside=(secured,)))
    assert (problem.check, problem.subject, problem.grave) == ("security", "01.10.bb", True)
    assert "Datagrams from inside do not reach these" in problem.text
    assert "--direction out" in problem.fix
    harmless = replace(secured, security="authenticated"), replace(secured, vendor="Cyclone DDS")
    for outsider in harmless:
        assert list(domain_problems(replace(both_ways, outside=(outsider,)))) == []


def test_its_own_domain_is_no_fault() -> None:
    assert with_inside(domain=3) == []


def test_what_another_version_says_is_passed_over() -> None:
    assert with_inside(locator_fault="something new") == []


@pytest.mark.parametrize(
    ("policy", "check", "said"),
    [
        ("type", "type", "remap"),
        ("reliability", "qos", "make the publisher RELIABLE"),
        ("ownership", "qos", "set the same ownership on both sides"),
    ],
)
def test_a_pair_that_does_not_match(policy: str, check: str, said: str) -> None:
    pair = replace(MISMATCH, policy=policy)
    (problem,) = domain_problems(replace(DOMAIN, mismatches=(pair,)))
    assert (problem.check, problem.subject, problem.grave) == (check, "topic /scan", True)
    for phrase in (
        f"{policy} differs",
        "01.0f.aa at 172.30.0.5 (Fast DDS, inside) offers BEST_EFFORT",
        "01.10.bb at 10.0.0.9 (Cyclone DDS, outside) requests RELIABLE",
        said,
    ):
        assert phrase in problem.text + problem.fix, phrase


def test_a_pair_of_which_one_is_not_reached_at_all_says_nothing_more() -> None:
    bad = replace(DOMAIN, mismatches=(MISMATCH,), inside=(replace(INSIDE, security="protected"),))
    assert [problem.check for problem in domain_problems(bad)] == ["security"]
    slow = replace(DOMAIN, mismatches=(MISMATCH,), outside=(replace(OUTSIDE, proven=False),))
    assert [problem.check for problem in domain_problems(slow)] == ["reached", "qos"]


def test_pairs_that_are_left_out_are_counted() -> None:
    (problem,) = domain_problems(replace(DOMAIN, mismatches_left_out=7))
    assert "7 more pairs" in problem.text


def test_pairs_that_are_not_compared_are_told() -> None:
    (problem,) = domain_problems(replace(DOMAIN, not_compared=7))
    assert "not compared" in problem.text
    assert not problem.grave
