"""Faults of the routers: each finding has an object, a text and a fix."""

import pytest
from msgspec.structs import replace

from rosproxy.admin.doctor_finding import Severity
from rosproxy.admin.status_document import (
    ZenohLinkStatus,
    ZenohSessionStatus,
    ZenohStatus,
)
from rosproxy.zenoh.findings import LINK_GRACE_S, faults
from rosproxy.zenoh.links import LinkFault

LINK = ZenohLinkStatus("robot:7447", True, "", 60.0)
SESSION = ZenohSessionStatus(7448, "peer", "ab", "172.18.0.2:7448", "172.18.0.3:50000")
GOOD = ZenohStatus(ports="7448-7467", links=(LINK,), sessions=(SESSION,))


def down(error: str, since: float = 60.0) -> ZenohStatus:
    return replace(GOOD, links=(replace(LINK, up=False, error=error, since=since),))


def test_nothing_is_wrong() -> None:
    assert not [*faults(GOOD)]


def test_routers_that_do_not_run_are_the_first_cause() -> None:
    zenoh = replace(down("refused"), failure="the process ended with status 3")
    (finding,) = faults(zenoh)
    assert finding.severity is Severity.ERROR
    assert finding.subject == "zenoh routers"
    assert finding.text == "do not run: the process ended with status 3"


@pytest.mark.parametrize(
    ("fault", "text", "fix"),
    [
        (LinkFault.REFUSED, "no router listens there", "ros2 run rmw_zenoh_cpp rmw_zenohd"),
        (LinkFault.SILENT, "a firewall drops the packets", "firewall"),
        (LinkFault.UNRESOLVABLE, "can't be resolved", "give the address of the router"),
        (LinkFault.UNREACHABLE, "no route", "address"),
        (LinkFault.NO_SESSION, "zenoh opens no session", "port"),
    ],
)
def test_a_link_that_is_down_says_why(fault: LinkFault, text: str, fix: str) -> None:
    (finding,) = faults(down(fault.value))
    assert finding.severity is Severity.ERROR
    assert finding.subject == "zenoh peer robot:7447"
    assert text in finding.text
    assert fix in finding.fix


def test_a_link_has_time_to_come_up() -> None:
    assert not [*faults(down("refused", LINK_GRACE_S - 0.1))]
    assert not [*faults(down(LinkFault.NOT_TRIED.value))]


def test_a_hub_that_is_away_is_no_fault() -> None:
    hub = replace(LINK, up=False, error="refused", hub=True)
    assert not [*faults(replace(GOOD, links=(LINK, hub)))]


def test_peers_of_two_containers_at_a_port_are_told() -> None:
    other = replace(SESSION, zid="cd", remote="172.18.0.4:50000")
    again = replace(SESSION, zid="ef", remote="172.18.0.3:50001")
    client = replace(other, mode="client")
    assert not [*faults(replace(GOOD, sessions=(SESSION, again, client)))]
    (finding,) = faults(replace(GOOD, sessions=(SESSION, again, other)))
    assert finding.severity is Severity.WARNING
    assert finding.subject == "zenoh port 7448"
    assert "172.18.0.3, 172.18.0.4" in finding.text
    assert "give each container a port of its own (7448-7467)" in finding.fix
    outside = [replace(session, port=None) for session in (SESSION, other)]
    (finding,) = faults(replace(GOOD, listen=7447, sessions=tuple(outside)))
    assert finding.subject == "zenoh port 7447"
    assert "a port of its own" not in finding.fix
