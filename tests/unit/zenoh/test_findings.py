"""Faults of the routers: each finding has an object, a text and a fix."""

import pytest
from msgspec.structs import replace

from rosproxy.shared.documents.doctor_finding import Severity
from rosproxy.shared.documents.status_document import (
    MismatchStatus,
    ZenohApartStatus,
    ZenohCertificateStatus,
    ZenohFullStatus,
    ZenohLinkStatus,
    ZenohNodeStatus,
    ZenohSessionStatus,
    ZenohStatus,
    ZenohUnlinkedStatus,
)
from rosproxy.zenoh.findings import (
    APART_GRACE_S,
    GRAPH_GRACE_S,
    HUB_GRACE_S,
    LINK_GRACE_S,
    MOST_LIMIT_COMPARISONS,
    MOST_REPORTED_MISMATCHES,
    NODE_GRACE_S,
    WARNING_DAYS,
    faults,
    first_mismatches,
    routers_without_node,
    shared_limits,
)
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
    unseen = replace(hub, error="no session")  # behind NAT, the other side may see the session
    assert not [*faults(replace(GOOD, links=(LINK, unseen)))]


def test_a_hub_without_the_certificate_is_a_fault() -> None:
    hub = replace(LINK, up=False, error=LinkFault.PEER_FOREIGN.value, hub=True)
    (finding,) = faults(replace(GOOD, links=(hub,)))
    assert finding.severity is Severity.ERROR
    assert finding.subject == "zenoh hub robot:7447"
    assert "of a CA that this proxy does not trust" in finding.text
    assert "--zenoh-hub-certificate" in finding.fix


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


@pytest.mark.parametrize("few_files", [False, True])
def test_a_router_that_refuses_sessions_is_told(*, few_files: bool) -> None:
    full = ZenohFullStatus(7448, 33, ("172.18.0.3", "172.18.0.4"), few_files)
    (finding,) = faults(replace(GOOD, full=(full,)))
    assert finding.severity is Severity.ERROR
    assert finding.subject == "zenoh router at port 7448"
    assert finding.text.startswith("has 33 sessions with 172.18.0.3, 172.18.0.4, and accepts no")
    assert finding.fix.startswith("stop the program that opens these sessions")
    assert ("raise the limit of open files" in finding.fix) is few_files


def test_a_router_without_a_link_to_the_hub_is_told() -> None:
    def told(since: float) -> list[str]:
        alone = ZenohUnlinkedStatus(7450, since)
        return [finding.subject for finding in faults(replace(GOOD, unlinked=(alone,)))]

    assert told(HUB_GRACE_S - 0.1) == []
    assert told(HUB_GRACE_S) == ["zenoh router at port 7450"]


def test_sessions_that_announce_no_node_are_told() -> None:
    silent = replace(SESSION, without_node=NODE_GRACE_S + 0.1)
    (finding,) = faults(replace(GOOD, sessions=(silent,)))
    assert finding.severity is Severity.WARNING
    assert finding.subject == "zenoh sessions at port 7448"
    assert finding.text.startswith("programs at 172.18.0.3 are connected, but announce no node.")
    assert "zenoh 1.9 or later loses the liveliness tokens of nodes with 1.8" in finding.text
    assert "Lyrical: 1.8.0" in finding.fix


@pytest.mark.parametrize(
    "zenoh",
    [
        replace(GOOD, sessions=(replace(SESSION, without_node=NODE_GRACE_S),)),
        replace(GOOD, sessions=(replace(SESSION, mode="router", without_node=60.0),)),
        replace(GOOD, sessions=(replace(SESSION, without_node=60.0),), left_out=1),
    ],
    ids=["still starts", "a router", "nodes are left out of the status"],
)
def test_a_session_may_have_no_node(zenoh: ZenohStatus) -> None:
    assert not [*faults(zenoh)]


AWAY = ZenohNodeStatus("/away")
HERE = ZenohNodeStatus("/here", address="172.18.0.3", port=7448)
LAPTOP = ZenohNodeStatus("/laptop", address="192.0.2.9")


def test_a_router_without_a_node_behind_it_is_a_note() -> None:
    router = ZenohSessionStatus(
        7449, "router", "cd", "172.18.0.2:7449", "172.18.0.4:50000", without_node=31.0
    )
    hub = replace(LINK, peer="hub:7447", hub=True)
    zenoh = replace(GOOD, links=(LINK, hub), sessions=(SESSION, router), nodes=(HERE, LAPTOP))
    noted = routers_without_node(zenoh)
    assert [*noted] == ["zenoh peer robot:7447", "zenoh router 172.18.0.4:50000"]
    for finding in noted.values():
        assert finding.severity is Severity.INFO
        assert finding.text.startswith("linked, but no node is known behind this router.")
        assert "zenoh 1.9 or later" in finding.text
    assert not [*faults(zenoh)], "a robot whose nodes do not run yet is no fault"
    assert not routers_without_node(replace(zenoh, nodes=(HERE, AWAY)))
    assert not routers_without_node(replace(zenoh, left_out=1))


@pytest.mark.parametrize("link", [replace(LINK, since=GRAPH_GRACE_S), replace(LINK, up=False)])
def test_a_router_has_time_to_tell_the_first_node(link: ZenohLinkStatus) -> None:
    assert not routers_without_node(replace(GOOD, links=(link,)))


SITE = ZenohLinkStatus("cloud.example:7447", True, "", 60.0, protocol="tls")
FILE = ZenohCertificateStatus("/run/certificates/tls.crt", ends_in=WARNING_DAYS[-1] * 86400.0 + 1.0)


@pytest.mark.parametrize(
    ("fault", "text", "fix"),
    [
        (LinkFault.REFUSED, "no proxy listens there", "publish the port"),
        (LinkFault.SILENT, "a firewall drops the packets", "firewall"),
        (LinkFault.NO_TLS, "does not speak TLS", "links between sites"),
        (LinkFault.NO_QUIC_SESSION, "a firewall drops UDP", "tls/ in place of quic/"),
        (LinkFault.NO_SESSION, "accepts the certificate", "P-256"),
        (LinkFault.PEER_EXPIRED, "certificate of the other proxy, or its CA, has exp", "renew"),
        (LinkFault.PEER_TOO_EARLY, "not valid yet", "clocks"),
        (LinkFault.PEER_FOREIGN, "of a CA that this proxy does not trust", "add its CA"),
        (LinkFault.PEER_OTHER_NAME, "for another host name", "subjectAltName"),
        (LinkFault.PEER_INVALID, "not valid for a TLS server", "serverAuth"),
        (LinkFault.OWN_EXPIRED, "refuses the certificate of this proxy as expired", "renew"),
        (LinkFault.OWN_FOREIGN, "the other proxy does not trust", "certificate of that CA"),
        (LinkFault.OWN_REFUSED, "refuses the certificate of this proxy", "status there"),
    ],
)
def test_a_link_to_another_site_says_why_it_is_down(fault: LinkFault, text: str, fix: str) -> None:
    link = replace(SITE, up=False, error=fault.value)
    (finding,) = faults(replace(GOOD, links=(link,)))
    assert finding.severity is Severity.ERROR
    assert finding.subject == "zenoh link tls/cloud.example:7447"
    assert text in finding.text
    assert fix in finding.fix


@pytest.mark.parametrize(
    ("file", "severity", "text"),
    [
        (replace(FILE, ends_in=13.5 * 86400), Severity.WARNING, "expires within 14 days"),
        (replace(FILE, ends_in=6.5 * 86400), Severity.WARNING, "expires within 7 days"),
        (replace(FILE, ends_in=3600.0), Severity.WARNING, "expires within 1 day"),
        (replace(FILE, ends_in=-7200.0), Severity.ERROR, "has expired"),
        (replace(FILE, starts_in=3600.0), Severity.ERROR, "is not valid yet"),
        (replace(FILE, error="can't be read: No such file"), Severity.ERROR, "can't be read: No"),
    ],
)
def test_a_certificate_is_told_before_its_end_and_after(
    file: ZenohCertificateStatus, severity: Severity, text: str
) -> None:
    (finding,) = faults(replace(GOOD, certificates=(FILE, file)))
    assert finding.severity is severity
    assert finding.subject == "zenoh file /run/certificates/tls.crt"
    assert finding.text.startswith(text)


def test_the_certificate_of_hubs_is_told_before_its_end() -> None:
    file = ZenohCertificateStatus("--zenoh-hub-certificate", ends_in=10 * 86400.0, hub=True)
    (finding,) = faults(replace(GOOD, certificates=(file,)))
    assert finding.severity is Severity.WARNING
    assert finding.subject == "zenoh certificate of hubs"
    assert finding.text == "expires within 14 days"
    assert "a valid --zenoh-hub-certificate" in finding.fix
    assert finding.fix


def test_a_port_for_other_sites_that_is_not_open_is_told() -> None:
    assert not [*faults(replace(GOOD, link_listen="tls/7447"))]
    (finding,) = faults(replace(GOOD, link_listen="tls/7447", link_listens=False))
    assert finding.subject == "zenoh port tls/7447"
    assert "accepts no connections" in finding.text


def test_topics_that_share_a_limit_are_told() -> None:
    topics = ("/camera/image", "/camera/info", "/camera/raw", "/scan")
    node = ZenohNodeStatus("/driver", publishes=topics, port=7448)
    outside = ZenohNodeStatus("/far", publishes=("/camera/far",))
    limits = ("/camera/raw=1Hz", "/camera/*=2Hz", "/scan=5Hz", "*=100Hz")
    zenoh = replace(GOOD, nodes=(node, outside), limits=limits)
    (finding,) = shared_limits(zenoh)
    assert finding.severity is Severity.INFO
    assert finding.subject == "zenoh limit /camera/*=2Hz"
    assert finding.text.startswith("/camera/image, /camera/info share this rate")
    assert not [*shared_limits(replace(zenoh, limits=()))]


def test_the_comparison_of_topics_with_limits_is_bounded() -> None:
    many = tuple(f"/t{number:05}" for number in range(MOST_LIMIT_COMPARISONS))
    zenoh = replace(GOOD, nodes=(ZenohNodeStatus("/n", publishes=many, port=7448),))
    (finding,) = shared_limits(replace(zenoh, limits=("/never=1Hz", "/t*=1Hz")))
    assert f"{MOST_LIMIT_COMPARISONS // 2 - 5} more" in finding.text


def test_each_address_has_a_share_of_the_reported_mismatches() -> None:
    nodes = tuple(
        ZenohNodeStatus(f"/{host}", address=f"172.18.0.{host}", port=7448, key=f"{host}")
        for host in (3, 4)
    )
    names = [("3", f"/a{number}") for number in range(50)] + [("4", "/b"), ("4", "/c")]
    pairs = [MismatchStatus("topic", name, "type", "A", "B", key, "9") for key, name in names]
    late = MismatchStatus("topic", "/late", "durability", "A", "B", "4", "9")
    again = replace(pairs[-1], reader="8")
    zenoh = replace(GOOD, nodes=nodes, mismatches=(*pairs, late, again))
    found = first_mismatches(zenoh)
    assert len(found) == MOST_REPORTED_MISMATCHES
    assert "/late" not in str(found)
    assert "the subscription 9 requests B" in found["topic /c"].text


def test_peers_of_a_router_outside_that_are_apart_are_told_with_their_nodes() -> None:
    here = ZenohApartStatus("robot:7447", "192.0.2.10", ("/talker",), True, APART_GRACE_S)
    laptop = ZenohApartStatus("robot:7447", "192.0.2.20", (), False, APART_GRACE_S)
    late = replace(laptop, address="192.0.2.30", since=APART_GRACE_S - 1)
    (finding,) = faults(replace(GOOD, apart=(here, laptop, late)))
    assert finding.severity is Severity.WARNING
    assert finding.subject == "zenoh peers of router robot:7447"
    assert finding.text.startswith("nodes at 192.0.2.10 (/talker), 192.0.2.20 are connected to")
    assert "192.0.2.10 is also the address of this proxy as the router sees it" in finding.text
    assert "192.0.2.30" not in finding.text
    assert finding.fix.startswith('set mode="client" in ZENOH_CONFIG_OVERRIDE of these nodes')
