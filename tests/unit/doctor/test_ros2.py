"""The doctor's findings about ROS 2."""

import pytest
from msgspec.structs import replace

from rosproxy.doctor.facts import DoctorFacts, HeardParticipant, SystemState
from rosproxy.doctor.rules import diagnose
from rosproxy.shared.documents.doctor_finding import UNKNOWN_NAME, Severity, failed
from rosproxy.shared.documents.requests import PortProbe, RangeProbe
from rosproxy.shared.documents.status_document import (
    DomainStatus,
    HiddenStatus,
    MismatchStatus,
    ParticipantStatus,
    PolicyStatus,
    PortsStatus,
    ProblemStatus,
    ProxyStatus,
    StatusSettings,
    ZenohNodeStatus,
    ZenohStatus,
)

INSIDE = ParticipantStatus("01.0f.aa", "172.30.0.5", "Fast DDS")
OUTSIDE = ParticipantStatus("01.10.bb", "10.0.0.9", "Cyclone DDS")


def diagnose_domain(
    domain: DomainStatus,
    *names: str,
    heard: tuple[HeardParticipant, ...] = (),
    problems: tuple[ProblemStatus, ...] = (),
    uptime: float = 60.0,
    policy: PolicyStatus | None = None,
) -> dict[tuple[str, str], tuple[Severity, str]]:
    settings = StatusSettings(ros=("2",))
    ports = PortsStatus("11400-11431", "11400-11431", free=32)
    status = ProxyStatus(
        settings=settings,
        ports=ports,
        domains=(domain,),
        problems=problems,
        uptime=uptime,
        policy=policy,
    )
    facts = DoctorFacts(
        admin="http://127.0.0.1:11312",
        status=status,
        probe=RangeProbe((PortProbe(11400, "host:11400", "ok", "unknown", "udp"),)),
        advertise_host="host",
        advertised_addresses=("192.0.2.10",),
        names=names,
        heard_participants=heard,
    )
    findings = diagnose(facts)
    assert failed(findings) == any(finding.severity is Severity.ERROR for finding in findings)
    return {
        (finding.check, finding.subject): (finding.severity, finding.text + finding.fix)
        for finding in findings
    }


def test_all_is_well() -> None:
    told = diagnose_domain(DomainStatus(peers=("10.0.0.9",), inside=(INSIDE,), outside=(OUTSIDE,)))
    assert {severity for severity, _ in told.values()} == {Severity.OK}
    assert "1 participant of Fast DDS" in told["inside", "domain 0"][1]


def test_who_tells_nobody_is_told_what_to_give() -> None:
    severity, text = diagnose_domain(DomainStatus(inside=(INSIDE,)))["announcing", "domain 0"]
    assert severity is Severity.ERROR
    assert "--ros2-peer" in text


def test_who_hears_nobody_is_told_where_to_look() -> None:
    told = diagnose_domain(
        DomainStatus(domain=7, lan_relay="172.30.0.1:7500", discovery="10.0.0.1:11400")
    )
    assert "ROS_DOMAIN_ID=7" in told["inside", "domain 7"][1]
    assert "10.0.0.1:11400" in told["outside", "domain 7"][1]


def test_a_peer_without_a_known_participant_gets_a_finding() -> None:
    """With multicast, Cyclone DDS does not listen on the usual ports and misses announcements."""
    peers = ("10.0.0.9", "fd00::9", "10.0.0.7", "10.0.0.6:11400")
    told = diagnose_domain(
        DomainStatus(peers=peers, discovery="10.0.0.1:11400", inside=(INSIDE,), outside=(OUTSIDE,))
    )
    assert ("outside", "peer 10.0.0.9") not in told
    assert ("outside", "peer fd00::9") not in told  # another address of 10.0.0.9
    for peer in peers[2:]:
        severity, text = told["outside", f"peer {peer}"]
        assert severity is Severity.INFO
        assert '<Peer address="10.0.0.1:11400"/>' in text


def test_a_range_that_is_too_short_and_a_port_that_is_not_reached() -> None:
    short = ParticipantStatus("01.0f.cc", "172.30.0.6", problem="no port of 11400-11403 is free")
    unheard = ParticipantStatus("01.10.dd", "10.0.0.8", proven=False)
    told = diagnose_domain(
        DomainStatus(
            peers=("10.0.0.9",), discovery="10.0.0.1:11400", inside=(short,), outside=(unheard,)
        )
    )
    assert told["ports", "01.0f.cc"][0] is Severity.ERROR
    assert told["reached", "01.10.dd"][0] is Severity.WARNING
    assert "10.0.0.1" in told["reached", "01.10.dd"][1]
    alone = DomainStatus(peers=("10.0.0.9",), outside=(unheard,))
    assert ("reached", "01.10.dd") not in diagnose_domain(alone)  # no participant inside


TALKER = replace(INSIDE, publishes=("/chatter", "/scan"), services=("/add",))
LISTENER = replace(OUTSIDE, subscribes=("/chatter", "/scan"))
BOTH = DomainStatus(peers=("10.0.0.9",), inside=(TALKER,), outside=(LISTENER,))
MISMATCH = MismatchStatus(
    "topic", "/scan", "reliability", "BEST_EFFORT", "RELIABLE", "01.0f.aa", "01.10.bb"
)


def test_a_topic_that_matches() -> None:
    severity, text = diagnose_domain(BOTH, "/chatter")["topic", "/chatter"]
    assert severity is Severity.OK
    for expected in ("01.0f.aa at 172.30.0.5", "01.10.bb at 10.0.0.9", "outside) match"):
        assert expected in text


def test_a_topic_that_does_not_match() -> None:
    told = diagnose_domain(replace(BOTH, mismatches=(MISMATCH,)), "/scan", "/chatter")
    assert told["qos", "topic /scan"][0] is Severity.ERROR
    assert ("topic", "/scan") not in told
    assert ("topic", "/chatter") in told


def test_who_can_t_be_reached_matches_nobody() -> None:
    lost = replace(BOTH, inside=(replace(TALKER, locator_fault="tcp"),))
    told = diagnose_domain(lost, "/chatter")
    assert told["transport", "01.0f.aa"][0] is Severity.ERROR
    assert ("topic", "/chatter") not in told


@pytest.mark.parametrize(
    ("domain", "said"),
    [
        (replace(BOTH, outside=(OUTSIDE,)), "no participant subscribes to /chatter"),
        (replace(BOTH, inside=(INSIDE,)), "no participant publishes /chatter"),
        (replace(BOTH, inside=(TALKER, replace(LISTENER)), outside=()), "on one side"),
    ],
)
def test_a_topic_that_lacks_a_side(domain: DomainStatus, said: str) -> None:
    severity, text = diagnose_domain(domain, "/chatter")["topic", "/chatter"]
    assert severity is Severity.INFO
    assert said in text


def test_who_serves_a_service() -> None:
    severity, text = diagnose_domain(BOTH, "/add")["service", "/add"]
    assert severity is Severity.OK
    assert "served by participant 01.0f.aa at 172.30.0.5" in text


def test_a_topic_that_the_policy_hides_does_not_match() -> None:
    hidden = HiddenStatus("publish", "/t", "01.0f.aa", "policy, deny publish /t")
    inside = replace(INSIDE, publishes=("/t",))
    outside = replace(OUTSIDE, subscribes=("/t",))
    domain = DomainStatus(peers=("10.0.0.9",), inside=(inside,), outside=(outside,))
    told = diagnose_domain(domain, "/t", policy=PolicyStatus(hidden=(hidden,)))
    assert ("topic", "/t") not in told
    severity, text = told["policy", "/t"]
    assert severity is Severity.WARNING
    assert "deny publish /t" in text


def test_a_name_that_nobody_has() -> None:
    assert diagnose_domain(BOTH, "/chater")["unknown name", "/chater"][0] is Severity.ERROR


def test_who_is_on_a_network_inside_and_not_heard() -> None:
    told = diagnose_domain(
        BOTH,
        heard=(
            HeardParticipant(0, "01.0f.aa", "172.30.0.5", "Fast DDS"),
            HeardParticipant(0, "01.0f.cc", "172.30.0.6", "Fast DDS"),
            HeardParticipant(5, "01.10.dd", "172.30.0.7", "Cyclone DDS"),
        ),
    )
    assert not any(subject == "01.0f.aa" for _, subject in told)
    severity, text = told["range", "01.0f.cc"]
    assert severity is Severity.WARNING
    assert "at 172.30.0.6 (Fast DDS, inside)" in text
    assert "ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET" in text
    severity, text = told["domain", "01.10.dd"]
    assert severity is Severity.WARNING
    assert "is in domain 5, but this proxy serves domain 0" in text
    assert "--ros2-domain 5" in text


def test_an_unlabelled_container_is_not_told_to_change_its_discovery_range() -> None:
    stranger = HeardParticipant(0, "01.0f.cc", "172.30.0.6", "Fast DDS")
    domain = replace(BOTH, unselected=("172.30.0.6",))
    told = diagnose_domain(domain, heard=(stranger,))
    assert ("range", "01.0f.cc") not in told
    severity, text = told["selected", "01.0f.cc"]
    assert severity is Severity.WARNING
    assert "the operator has not selected this address" in text
    assert "select the address" in text


def test_a_proxy_that_has_just_started_may_know_them_and_not_tell() -> None:
    unknown = HeardParticipant(0, "01.0f.cc", "172.30.0.6", "Fast DDS")
    assert not any(
        name == "01.0f.cc" for _, name in diagnose_domain(BOTH, heard=(unknown,), uptime=3.0)
    )


def test_what_was_refused_lately_is_told() -> None:
    text = "from 10.0.0.8: it announces no locator for discovery at 10.0.0.8 (tcp)"
    recent = ProblemStatus(10.0, "refused: no locator", text)
    old = ProblemStatus(1000.0, "refused: not a peer", "from 10.0.0.7")
    told = diagnose_domain(BOTH, problems=(recent, old))
    assert told["refused", "refused: no locator"][0] is Severity.WARNING
    assert ("refused", "refused: not a peer") not in told


def test_an_engine_that_hides_who_sends_is_an_error() -> None:
    hidden = ProblemStatus(10.0, "refused: hidden source", "from 172.18.0.1: it is the gateway")
    told = diagnose_domain(BOTH, problems=(hidden,))
    assert told["refused", "refused: hidden source"][0] is Severity.ERROR


def test_a_lan_relay_with_another_secret_is_an_error() -> None:
    """The doctor found nothing wrong, and no participant outside was heard."""
    wrong = ProblemStatus(10.0, "refused: relay proof", "from 172.30.0.1: another secret")
    severity, text = diagnose_domain(BOTH, problems=(wrong,))["refused", "refused: relay proof"]
    assert severity is Severity.ERROR
    assert "give the proxy and its LAN relay the same secret" in text


def test_the_name_of_a_node_is_known() -> None:
    """The doctor said that no participant had a topic or service of this name."""
    inside = replace(INSIDE, nodes=("/talker",))
    told = diagnose_domain(replace(BOTH, inside=(inside,)), "/talker")
    assert told["node", "/talker"][0] is Severity.OK
    assert not any(severity is Severity.ERROR for severity, _ in told.values())


def test_nothing_is_heard_of_zenoh() -> None:
    told = diagnose_domain(DomainStatus(peers=("10.0.0.9",)))["inside", "domain 0"][1]
    assert "RMW_IMPLEMENTATION=rmw_zenoh_cpp does not use DDS" in told
    assert "start the proxy with --ros zenoh" in told


def test_a_proxy_that_has_just_started_misses_no_participant_yet() -> None:
    domain = DomainStatus(peers=("10.0.0.9",))
    severity, text = diagnose_domain(domain, uptime=1.0)["inside", "domain 0"]
    assert severity is Severity.INFO
    assert "just started" in text
    assert diagnose_domain(domain)["inside", "domain 0"][0] is Severity.WARNING


ALL_STACKS = ProxyStatus(
    settings=StatusSettings(ros=("1", "2", "zenoh")),
    domains=(BOTH,),
    zenoh=ZenohStatus(nodes=(ZenohNodeStatus("/arm", 0, "172.18.0.3", ("/joints",)),)),
)


@pytest.mark.parametrize(
    ("name", "check"),
    [("/scan", "pair"), ("/chatter", "topic"), ("/joints", "topic"), ("/arm", "node")],
)
def test_a_proxy_for_all_versions_finds_a_name_in_any(name: str, check: str) -> None:
    """A topic of ROS 2 alone was told as a name that the master does not know."""
    graph = SystemState(publishers={"/scan": ["/lidar"]})
    told = diagnose(DoctorFacts(status=ALL_STACKS, graph=graph, names=(name,)))
    checks = {finding.check for finding in told if finding.subject == name}
    assert check in checks
    assert UNKNOWN_NAME not in checks


def test_a_name_in_none_of_all_versions_is_told_of_each() -> None:
    facts = DoctorFacts(status=ALL_STACKS, graph=SystemState(), names=("/chater",))
    told = [finding.text for finding in diagnose(facts) if finding.check == UNKNOWN_NAME]
    assert [text.split(" ")[1] for text in told] == ["master", "participant", "node"]


def test_a_hidden_name_is_told_once() -> None:
    hidden = HiddenStatus("publish", "/chatter", "01.0f.aa", "a rule")
    status = replace(ALL_STACKS, policy=PolicyStatus(hidden=(hidden,)))
    told = diagnose(DoctorFacts(status=status, graph=SystemState(), names=("/chatter",)))
    assert [finding.text for finding in told if finding.check == "policy"] == [
        "hidden from outside by the policy: a rule (publish, 01.0f.aa)"
    ]
