"""The doctor's findings about rmw_zenoh."""

from typing import Any

from rosproxy.admin.doctor_finding import DoctorFinding, Severity
from rosproxy.admin.status_document import (
    ProxyStatus,
    StatusSettings,
    ZenohLinkStatus,
    ZenohNodeStatus,
    ZenohSessionStatus,
    ZenohStatus,
)
from rosproxy.doctor.facts import DoctorFacts
from rosproxy.doctor.rules import diagnose

GOOD = ZenohStatus(
    ports="7448-7467",
    links=(ZenohLinkStatus("robot:7447", True, "", 60.0),),
    sessions=(ZenohSessionStatus(7448, "peer", "ab", "172.18.0.2:7448", "172.18.0.3:50000"),),
    nodes=(
        ZenohNodeStatus("/talker", 0, "172.18.0.3", ("/chatter", "/rosout"), (), ("/add",)),
        ZenohNodeStatus("/robot", 0, "", (), ("/chatter", "/cmd_vel")),
    ),
)


def findings(zenoh: ZenohStatus, *names: str, **facts: Any) -> list[DoctorFinding]:
    status = ProxyStatus(settings=StatusSettings(ros=("zenoh",)), zenoh=zenoh)
    told = diagnose(DoctorFacts(status=status, probe_error="", names=names, **facts))
    return [finding for finding in told if finding.check not in ("admin", "published range")]


def texts(zenoh: ZenohStatus, *names: str) -> list[str]:
    return [f"{finding.subject}: {finding.text}" for finding in findings(zenoh, *names)]


def test_nothing_is_wrong() -> None:
    assert texts(GOOD) == [
        "zenoh peer robot:7447: linked",
        "zenoh routers: 1 node connected here, 1 outside",
    ]


def test_what_follows_from_routers_that_do_not_run_is_not_told() -> None:
    (finding,) = findings(ZenohStatus(ports="7448-7467", failure="no report for 10 s"), "/x")
    assert finding.severity is Severity.ERROR
    assert finding.text == "do not run: no report for 10 s"


def test_without_outside_and_without_nodes_the_doctor_says_what_to_set() -> None:
    told = findings(ZenohStatus(ports="7448-7467"))
    severities = [Severity.WARNING, Severity.INFO, Severity.OK]
    assert [finding.severity for finding in told] == severities
    assert "--zenoh-peer HOST" in told[0].fix
    assert 'mode="client";connect/endpoints=["tcp/PROXY:7448"]' in told[1].fix


def test_a_hub_that_is_away_is_a_note() -> None:
    links = (
        ZenohLinkStatus("a:7447", True, hub=True),
        ZenohLinkStatus("b", error="refused", hub=True),
    )
    told = findings(ZenohStatus(links=links, sessions=GOOD.sessions))
    assert [finding.severity for finding in told] == [Severity.OK, Severity.INFO, Severity.OK]
    assert f"{told[1].subject}: {told[1].text}" == (
        "zenoh hub b: not linked (refused). The hub tries again"
    )


def test_names_that_the_user_asks_for() -> None:
    told = texts(GOOD, "/chatter", "/cmd_vel", "/add", "/robot", "/nothing")[2:]
    assert told == [
        "/chatter: published by /talker (172.18.0.3); subscribed to by /robot (outside)",
        "/cmd_vel: published by no node; subscribed to by /robot (outside)",
        "/add: served by /talker (172.18.0.3)",
        "/robot: connected from outside",
        "/nothing: no node has this name, and no node has a topic or service of this name",
    ]
