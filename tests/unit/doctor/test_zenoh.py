"""The doctor's findings about rmw_zenoh."""

from typing import Any

from msgspec.structs import replace

from rosproxy.doctor.facts import DoctorFacts
from rosproxy.doctor.rules import diagnose
from rosproxy.shared.documents.doctor_finding import DoctorFinding, Severity
from rosproxy.shared.documents.status_document import (
    MismatchStatus,
    ProxyStatus,
    StatusSettings,
    ZenohLinkStatus,
    ZenohNodeStatus,
    ZenohSessionStatus,
    ZenohStatus,
)
from rosproxy.zenoh.links import LinkFault

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


def test_a_proxy_that_waits_for_other_hubs_has_a_way_to_outside() -> None:
    told = findings(ZenohStatus(ports="7448-7448", hub_listen=7447))
    assert Severity.WARNING not in {finding.severity for finding in told}


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


def test_a_hub_without_the_certificate_is_one_error() -> None:
    links = (ZenohLinkStatus("b", error=LinkFault.PEER_FOREIGN.value, since=60.0, hub=True),)
    told = findings(ZenohStatus(links=links, sessions=GOOD.sessions))
    assert [finding.severity for finding in told] == [Severity.ERROR, Severity.OK]
    assert told[0].subject == "zenoh hub b"


def test_a_link_without_a_node_behind_it_is_a_note_in_place_of_a_success() -> None:
    told = findings(replace(GOOD, nodes=GOOD.nodes[:1]))
    assert [finding.severity for finding in told] == [Severity.INFO, Severity.OK]
    assert f"{told[0].subject}: {told[0].text}".startswith(
        "zenoh peer robot:7447: linked, but no node is known behind this router."
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


TALKER = ZenohNodeStatus("/talker", 0, "172.18.0.3", ("/chatter",), port=7448, key="0 a.0/talker")
LISTENER = ZenohNodeStatus("/listener", subscribes=("/chatter",), key="0 b.0/listener")
MET = replace(GOOD, nodes=(TALKER, LISTENER))


def test_nodes_that_do_not_match_are_an_error_without_a_question() -> None:
    pair = MismatchStatus(
        *("topic", "/chatter", "type", "std_msgs/msg/String", "std_msgs/msg/Int32"),
        *(TALKER.key, LISTENER.key),
    )
    told = findings(replace(MET, mismatches=(pair,)))
    assert (told[-1].severity, told[-1].subject) == (Severity.ERROR, "topic /chatter")
    assert told[-1].text == (
        "type differs: the publisher /talker (172.18.0.3) offers std_msgs/msg/String, the "
        "subscription /listener (outside) requests std_msgs/msg/Int32"
    )
    asked = findings(replace(MET, mismatches=(pair,)), "/chatter")
    assert asked.count(told[-1]) == 1


def test_a_question_tells_the_other_domain() -> None:
    elsewhere = replace(LISTENER, domain=7)
    told = findings(replace(MET, nodes=(TALKER, elsewhere)), "/chatter")[-1]
    assert told.severity is Severity.WARNING
    assert told.text == (
        "no subscription is known in domain 0, but: /listener (outside) in domain 7"
    )
    assert "ROS_DOMAIN_ID" in told.fix
    assert not findings(replace(MET, nodes=(TALKER, elsewhere)))[2:], "only if the user asks"


def test_a_service_without_a_server_is_a_note() -> None:
    client = ZenohNodeStatus("/client", calls=("/add",))
    told = texts(replace(GOOD, nodes=(*GOOD.nodes, client)), "/add")
    assert told[-1] == "/add: served by /talker (172.18.0.3); called by /client (outside)"
    told = texts(replace(GOOD, nodes=(client,)), "/add")
    assert told[-1] == "/add: called by /client (outside), and served by no node"


def test_a_graph_with_gaps_is_a_warning() -> None:
    told = findings(replace(MET, left_out=3, not_compared=2))[2:]
    assert [finding.severity for finding in told] == [Severity.WARNING] * 2
    assert "left out of the status: 3." in told[0].text


def test_links_to_other_sites_and_their_limits() -> None:
    link = ZenohLinkStatus("cloud:7447", True, protocol="tls")
    topics = ("/camera/image", "/camera/info")
    node = replace(TALKER, publishes=topics)
    told = findings(replace(GOOD, links=(link,), nodes=(node,), limits=("/camera/*=2Hz",)))
    assert (told[0].severity, told[0].subject) == (Severity.OK, "zenoh link tls/cloud:7447")
    assert (told[-1].severity, told[-1].subject) == (Severity.INFO, "zenoh limit /camera/*=2Hz")
    alone = ZenohStatus(ports="7448-7467", link_listen="tls/7447", sessions=GOOD.sessions)
    assert [finding.severity for finding in findings(alone)] == [Severity.OK]
