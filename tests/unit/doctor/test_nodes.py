"""The doctor's findings about nodes."""

from typing import Any

import pytest

from rosproxy.doctor.facts import Attempt, DoctorFacts, NodeFacts, ReachOutcome, SystemState
from rosproxy.doctor.rules import node as node_rules
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.documents.doctor_finding import DoctorFinding, Severity
from tests.unit.doctor.cases import (
    ANSWERED,
    INSIDE,
    INSIDE_URI,
    by_name,
    listener,
    make_facts,
    make_master,
    only,
    talker,
    without_proxy,
)
from tests.unit.status_json import HOST, make_node, make_status

REFUSED = Attempt(ReachOutcome.REFUSED)
UNRESOLVABLE = Attempt(ReachOutcome.UNRESOLVABLE)


def check(facts: DoctorFacts) -> list[DoctorFinding]:
    return [*node_rules.check(facts)]


def faults(facts: DoctorFacts) -> list[DoctorFinding]:
    return [f for f in check(facts) if f.severity >= Severity.WARNING]


def inside(**changes: Any) -> DoctorFinding:
    """The finding on a node behind the proxy."""
    return only(check(make_facts(status=make_status(make_node(**changes)))))


def outside(**changes: Any) -> DoctorFinding:
    """The finding on a node that the master knows."""
    return only(check(make_facts(nodes=by_name(listener(**changes)))))


def test_sound_nodes_are_counted() -> None:
    assert [(f.severity, f.subject, f.text) for f in check(make_facts())] == [
        (Severity.OK, "inside nodes", "1 of 1 answer"),
        (Severity.OK, "nodes at the master", "2 registered, none with faults"),
    ]


@pytest.mark.parametrize("state", ["refused", "silent", "failing", "cleaned"])
def test_an_ended_node_does_not_count_as_silent(state: str) -> None:
    """The container was restarted and the node is back, or the node has unregistered its name."""
    former = make_node(uri="http://10.0.0.5:40009/", port=45009, state=state)
    nameless = make_node(nodes=[], uri="http://10.0.0.5:40008/", port=45008, state=state)
    facts = make_facts(status=make_status(former, make_node(), nameless))
    assert [(f.severity, f.text) for f in check(facts) if f.subject != "nodes at the master"] == [
        (Severity.OK, "1 of 1 answer; ended nodes still hold 2 ports for up to 30 s")
    ]


def test_a_node_whose_container_is_gone_is_no_fault() -> None:
    gone = make_node(nodes=["/other"], uri="http://10.0.0.5:40009/", port=45009, state="ended")
    findings = check(make_facts(status=make_status(gone, make_node())))
    assert [(f.severity, f.text) for f in findings if f.subject != "nodes at the master"] == [
        (Severity.OK, "1 of 1 answer; ended nodes still hold 1 port for up to 30 s")
    ]


@pytest.mark.parametrize("state", ["refused", "silent", "cleaned"])
def test_one_that_is_not_back_is_told(state: str) -> None:
    gone = make_node(nodes=["/other"], uri="http://10.0.0.5:40009/", port=45009, state=state)
    findings = check(make_facts(status=make_status(gone, make_node())))
    counted = [(f.severity, f.text) for f in findings if f.subject == "inside nodes"]
    assert counted == [(Severity.INFO, "1 of 2 answer")]
    assert any(f.subject == "/other" and f.severity >= Severity.WARNING for f in findings)


def test_an_address_of_the_proxy_is_of_its_host_and_range() -> None:
    facts = make_facts()
    ports = [port for port in (44999, 45000, 45099, 45100) if facts.is_ours(HostPort(HOST, port))]
    assert ports == [45000, 45099]
    assert not facts.is_ours(HostPort("192.168.0.9", 45000))
    assert not without_proxy().is_ours(HostPort(HOST, 45000))


def test_nobody_uses_the_proxy() -> None:
    finding = only(check(make_facts(status=make_status(), nodes={})))
    assert (finding.severity, finding.text) == (
        Severity.WARNING,
        "no node has registered through the proxy",
    )
    assert "ROS_MASTER_URI=http://PROXY:11311" in finding.fix


def test_a_proxy_that_has_just_started_misses_no_node_yet() -> None:
    young = {**make_status(), "uptime": node_rules.FIRST_NODE_TIMEOUT_S - 0.1}
    findings = check(make_facts(status=young, nodes={}))
    assert [f.severity for f in findings if f.check == "inside node"] == [Severity.INFO]


@pytest.mark.parametrize(("host", "state"), [("127.0.0.1", "refused"), ("localhost", "ok")])
def test_a_node_that_listens_on_loopback_only(host: str, state: str) -> None:
    """A roscpp node still answers probes: only the TCPROS server is on loopback."""
    finding = inside(uri=f"http://{host}:40001/", state=state)
    assert (finding.severity, finding.subject) == (Severity.ERROR, "/talker")
    assert "listens on loopback only" in finding.text
    assert finding.fix.startswith(
        "where the node runs: unset ROS_IP ROS_HOSTNAME, or set ROS_IP=10.0.0.5;"
    )


def test_a_node_on_the_proxys_own_machine_may_give_loopback() -> None:
    node = make_node(uri="http://localhost:40001/", address="127.0.0.1:40001")
    node["advertised_uri"] = make_node()["advertised_uri"]
    assert not faults(make_facts(status=make_status(node)))


@pytest.mark.parametrize(
    ("state", "severity", "text", "fix"),
    [
        (
            "refused",
            Severity.ERROR,
            "10.0.0.5:40001 refuses connections",
            "unregisters the node after 30 s",
        ),
        ("silent", Severity.ERROR, "does not answer at 10.0.0.5:40001", "nc -vz 10.0.0.5 40001"),
        ("failing", Severity.WARNING, "did not answer the last probe", "run the doctor again"),
        ("unverified", Severity.WARNING, "found at the master when the proxy started", "wait"),
        ("cleaned", Severity.WARNING, "the proxy unregistered the node", "restart the node"),
    ],
)
def test_a_node_behind_the_proxy_that_does_not_answer(
    state: str, severity: Severity, text: str, fix: str
) -> None:
    finding = inside(state=state)
    assert (finding.severity, finding.subject) == (severity, "/talker")
    assert text in finding.text
    assert fix in finding.fix


def test_fixes_have_ipv6_addresses_without_brackets() -> None:
    address = "[fd00::5]:40001"
    assert "nc -vz fd00::5 40001" in inside(address=address, state="silent").fix
    on_loopback = inside(address=address, state="ok", uri="http://localhost:40001/")
    assert "set ROS_IP=fd00::5;" in on_loopback.fix


def test_a_dead_node_with_clean_up_switched_off() -> None:
    status = make_status(make_node(state="refused"), settings={"cleanup_after": 0})
    assert "rosnode cleanup" in only(check(make_facts(status=status))).fix


def test_two_nodes_of_one_name() -> None:
    nodes = by_name(talker(uri="http://192.168.0.9:4/", attempt=ANSWERED))
    finding = only(check(make_facts(nodes=nodes)))
    assert "two nodes have this name" in finding.text
    assert "__name:=" in finding.fix


def test_a_registration_with_a_port_that_nobody_holds() -> None:
    nodes = by_name(NodeFacts("/old", "http://robot-host:45007/"))
    finding = only(check(make_facts(nodes=nodes)))
    assert (finding.check, finding.subject) == ("stale registration", "/old")
    assert "a port that no node holds any more" in finding.text
    assert finding.fix == "run rosnode cleanup (answer y)"


def test_a_registration_with_a_port_that_another_node_holds() -> None:
    nodes = by_name(NodeFacts("/old", "http://robot-host:45000/"))
    assert "a port that /talker holds now" in only(check(make_facts(nodes=nodes))).text


def test_nodes_that_share_a_lease_are_sound() -> None:
    status = make_status(make_node(nodes=["/manager", "/talker"]))
    nodes = by_name(talker(), NodeFacts("/manager", INSIDE_URI))
    assert not faults(make_facts(status=status, nodes=nodes))


@pytest.mark.parametrize(
    ("changes", "severity", "text", "fix"),
    [
        (
            {"attempt": REFUSED},
            Severity.ERROR,
            "registered as http://192.168.0.9:35001/, but gone: connection refused",
            "rosnode cleanup (answer y)",
        ),
        (
            {"attempt": Attempt(ReachOutcome.STRANGER, "HTTP status 404")},
            Severity.ERROR,
            "but gone: unexpected answer (HTTP status 404)",
            "rosnode cleanup (answer y)",
        ),
        (
            {"attempt": Attempt(ReachOutcome.SILENT)},
            Severity.ERROR,
            "no answer at http://192.168.0.9:35001/",
            "nc -vz 192.168.0.9 35001",
        ),
        (
            {"uri": "http://laptop:4000/", "attempt": UNRESOLVABLE},
            Severity.ERROR,
            "the host name laptop can't be resolved here",
            "ROS_IP=ADDRESS, then restart the node; or make laptop known to the proxy and to all "
            "inside nodes: docker run --add-host laptop:ADDRESS",
        ),
        (
            {"uri": "http://3f2a9c1b7d10:4000/", "attempt": UNRESOLVABLE},
            Severity.ERROR,
            "looks like a container that uses the real master instead of the proxy",
            "ROS_MASTER_URI=http://PROXY:11311",
        ),
        (
            {"uri": "http://10.0.0.7:4000/", "addresses": ("10.0.0.7",)},
            Severity.WARNING,
            "but not through the proxy",
            "ROS_MASTER_URI=http://PROXY:11311",
        ),
        (
            {"uri": "http://robot-host:47000/", "inside": INSIDE, "attempt": REFUSED},
            Severity.ERROR,
            "registered through a rosproxy",
            "if this proxy had robot-host:47000 before",
        ),
        ({"uri": ""}, Severity.ERROR, "no usable address for this node: ''", "restart the node"),
    ],
)
def test_an_outside_node_that_cannot_be_reached(
    changes: dict[str, Any], severity: Severity, text: str, fix: str
) -> None:
    finding = outside(**changes)
    assert (finding.severity, finding.subject) == (severity, "/listener")
    assert (finding.check == "stale registration") is ("but gone" in text)
    assert text in finding.text
    assert fix in finding.fix


def test_no_such_suspicion_where_the_master_is_in_that_network_too() -> None:
    nodes = by_name(listener(uri="http://10.0.0.7:4000/", addresses=("10.0.0.7",)))
    facts = make_facts(nodes=nodes, master=make_master(addresses=("10.0.0.1",)))
    assert not faults(facts)


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "[::1]"])
def test_an_outside_node_that_calls_itself_loopback(host: str) -> None:
    finding = outside(uri=f"http://{host}:4000/")
    assert "a loopback address. Other machines reach only themselves" in finding.text
    assert "ROS_IP=ADDRESS" in finding.fix


def test_loopback_is_fine_where_all_is_on_one_machine() -> None:
    nodes = by_name(listener(uri="http://localhost:4000/"))
    assert not faults(make_facts(nodes=nodes, master=make_master(addresses=("127.0.0.1",))))


def test_cleaning_up_is_no_advice_while_the_proxy_is_down() -> None:
    facts = without_proxy(nodes=by_name(talker(attempt=REFUSED)))
    finding = only(check(facts))
    assert "run the doctor on robot-host" in finding.fix
    assert "cleanup" not in finding.fix


def test_a_service_with_a_port_that_nobody_holds() -> None:
    graph = SystemState({}, {}, {"/add": ["/listener"], "/other": ["/listener"]})
    uris = {"/add": "rosrpc://robot-host:45009", "/other": "rosrpc://192.168.0.9:4"}
    finding = only(check(make_facts(graph=graph, service_uris=uris)))
    assert (finding.subject, finding.check) == ("/listener", "stale registration")
    assert "the service /add is registered as rosrpc://robot-host:45009" in finding.text


def test_simulated_time_without_a_clock() -> None:
    assert "no node publishes /clock" in only(check(make_facts(uses_simulated_time=True))).text
    graph = SystemState({"/clock": ["/talker"]}, {}, {})
    assert not faults(make_facts(uses_simulated_time=True, graph=graph))


def test_names_leave_out_what_is_said_of_others() -> None:
    nodes = by_name(talker(), listener(), listener(name="/dead", attempt=REFUSED))
    assert not check(make_facts(nodes=nodes, names=("/chatter",)))
    graph = SystemState({"/chatter": ["/talker"]}, {"/chatter": ["/listener", "/dead"]}, {})
    facts = make_facts(nodes=nodes, names=("/chatter",), graph=graph)
    assert [f.subject for f in check(facts)] == ["/dead"]


def test_a_proxy_whose_advertised_name_is_unknown_here() -> None:
    nodes = by_name(talker(attempt=UNRESOLVABLE))
    assert "--advertise-host ADDRESS" in only(check(without_proxy(nodes=nodes))).fix


def test_a_dead_node_on_the_proxys_own_machine() -> None:
    finding = inside(address="127.0.0.1:4", uri="http://localhost:4/", state="refused")
    assert "has ended" in finding.text
