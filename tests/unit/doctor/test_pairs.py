"""The doctor's findings about given names."""

from collections.abc import Sequence
from typing import Any

import pytest

from rosproxy.doctor.facts import (
    Attempt,
    DoctorFacts,
    NodeFacts,
    ReachOutcome,
    SlaveReport,
    SystemState,
    scope,
    slave_report,
)
from rosproxy.doctor.rules import pair as pair_rules
from rosproxy.shared.documents.doctor_finding import DoctorFinding, Severity
from tests.unit.doctor.cases import (
    INSIDE_URI,
    OUTSIDE_URI,
    by_name,
    listener,
    make_facts,
    only,
    talker,
)
from tests.unit.status_json import make_connection, make_node, make_status

STRING = "std_msgs/String"
GRAPH = SystemState(
    {"/chatter": ["/talker"], "/a": ["/listener"], "/b": ["/talker"], "/rosout": ["/talker"]},
    {"/chatter": ["/listener", "/other"], "/c": ["/other"], "/rosout": ["/rosout"]},
    {"/add": ["/adder"]},
)


GRAPH_WITH_OTHER_TALKER = SystemState(
    {"/chatter": ["/other"], "/a": ["/talker"]}, {"/chatter": ["/listener"]}, {}
)


def check(names: Sequence[str], **changes: Any) -> list[DoctorFinding]:
    return [*pair_rules.check(make_facts(names=tuple(names), **changes))]


def apart(giver: NodeFacts, taker: NodeFacts, **changes: Any) -> DoctorFinding:
    """The finding on a publisher and a subscriber that are not connected."""
    (finding,) = check(["/chatter"], nodes=by_name(giver, taker), **changes)
    assert finding.severity is Severity.ERROR
    assert finding.subject == "/chatter from /talker to /listener"
    assert finding.text.startswith("not connected: ")
    return finding


def silent_talker(**changes: Any) -> NodeFacts:
    """A publisher without connections."""
    return talker(**{"report": SlaveReport({"/chatter": STRING}), **changes})


@pytest.mark.parametrize("uri", [INSIDE_URI, INSIDE_URI.rstrip("/"), "http://10.0.0.5:40001/"])
@pytest.mark.parametrize(
    "bus", [[[1, "::ffff:192.168.0.9:50000", "o", "TCPROS", "/chatter", True]], ""],
    ids=["rosnodejs", "foxglove"],
)  # fmt: skip
def test_a_publisher_may_not_name_its_subscribers(bus: object, uri: str) -> None:
    """A connected pair was told as not connected."""
    nameless = talker(report=slave_report([["/chatter", STRING]], [], bus))
    report = SlaveReport({}, {"/chatter": STRING}, frozenset({("i", "/chatter", uri)}))
    (finding,) = check(["/chatter"], nodes=by_name(nameless, listener(report=report)))
    assert (finding.severity, finding.text) == (Severity.OK, "connected")
    apart(nameless, listener())
    apart(silent_talker(), listener(report=report))


@pytest.mark.parametrize(
    ("names", "pairs", "lonely", "nodes"),
    [
        (
            ["/chatter"],
            [("/chatter", "/talker", "/listener"), ("/chatter", "/talker", "/other")],
            [],
            {"/talker", "/listener", "/other"},
        ),
        (["/listener"], [("/chatter", "/talker", "/listener")], ["/a"], {"/listener", "/talker"}),
        (["/talker", "/other"], [("/chatter", "/talker", "/other")], ["/b", "/c"], None),
        (["/chatter", "/other"], [("/chatter", "/talker", "/other")], [], None),
        (["/a"], [], ["/a"], {"/listener"}),
        (["/rosout"], [("/rosout", "/talker", "/rosout")], [], {"/talker", "/rosout"}),
        (["/add"], [], [], {"/adder"}),
        ([], [], [], set()),
    ],
)
def test_what_names_lead_to(
    names: list[str],
    pairs: list[tuple[str, str, str]],
    lonely: list[str],
    nodes: set[str] | None,
) -> None:
    asked = scope(GRAPH, names)
    assert (asked.pairs, asked.one_sided_topics) == (pairs, lonely)
    assert nodes is None or asked.nodes == nodes


def test_without_names_nothing_is_said() -> None:
    assert not check([])


def test_without_a_graph_that_is_said() -> None:
    (finding,) = check(["/chatter"], graph=None)
    assert finding.severity is Severity.INFO


def test_a_name_that_nobody_knows() -> None:
    finding = only(check(["/chater"]))
    assert finding.text.endswith("; similar names: /chatter")
    finding = only(check(["/listener2", "/nothing"])[:1])
    assert "/listener" in finding.text


@pytest.mark.parametrize("known", [False, True])
def test_a_name_that_the_policy_hides_has_another_cause(known: bool) -> None:
    """The doctor advised to check remappings, and to restart nodes outside."""
    hidden = {"kind": "publish", "name": "/camera/image", "node": "/camera"}
    hidden["reason"] = "policy, deny publish /camera/*"
    status = {**make_status(make_node()), "policy": {"hidden": [hidden]}}
    listeners = {"/camera/image": ["/listener"]} if known else {}
    facts = make_facts(
        status=status, graph=SystemState({}, listeners, {}), names=("/camera/image",)
    )
    findings = list(pair_rules.check(facts))
    assert [(f.severity, f.check) for f in findings] == [(Severity.WARNING, "policy")]
    assert "by the policy: policy, deny publish /camera/* (publish, /camera)" in findings[0].text


def test_a_name_without_its_namespace() -> None:
    graph = SystemState({"/robot1/scan": ["/talker"]}, {}, {})
    assert "similar names: /robot1/scan" in only(check(["/scan"], graph=graph)).text


@pytest.mark.parametrize(
    ("graph", "text"),
    [
        (
            SystemState(
                {"/chatter": ["/talker"], "/ns/chatter": []}, {"/ns/chatter": ["/listener"]}
            ),
            "published by /talker; no node subscribes to /chatter",
        ),
        (
            SystemState({"/ns/chatter": ["/talker"]}, {"/chatter": ["/listener"]}),
            "subscribed to by /listener; no node publishes /chatter",
        ),
    ],
)
def test_a_topic_with_one_side_only(graph: SystemState, text: str) -> None:
    finding = only(check(["/chatter"], graph=graph))
    assert finding.text == text
    assert finding.fix.startswith("compare with /ns/chatter, check namespaces and remappings; ")


def test_the_lonely_topics_of_a_node_are_no_error() -> None:
    graph = SystemState({"/chatter": ["/talker"]}, {}, {})
    (finding,) = check(["/talker"], graph=graph)
    assert (finding.subject, finding.severity) == ("/chatter", Severity.INFO)


def test_nodes_with_nothing_in_common() -> None:
    graph = SystemState({"/a": ["/talker"]}, {"/b": ["/listener"]}, {})
    finding = only(check(["/talker", "/listener"], graph=graph))
    assert finding.subject == "/talker and /listener"
    assert finding.fix.startswith("compare: rosnode info /talker /listener")


def test_a_topic_that_a_node_has_nothing_to_do_with() -> None:
    nodes = by_name(talker(), listener(), listener(name="/other"))
    graph = SystemState(
        {"/chatter": ["/talker"]}, {"/chatter": ["/listener"], "/c": ["/other"]}, {}
    )
    finding = only(check(["/chatter", "/other"], graph=graph, nodes=nodes))
    assert (finding.check, finding.subject) == ("pair", "/chatter and /other")
    assert finding.text == "/other neither publishes /chatter nor subscribes to it"
    assert finding.fix.startswith("compare: rosnode info /other; rostopic info /chatter; ")


def test_a_topic_that_none_of_two_nodes_publishes_to_the_other() -> None:
    finding = only(check(["/talker", "/chatter", "/listener"], graph=GRAPH_WITH_OTHER_TALKER))
    assert finding.text == "none of /talker, /listener publishes /chatter to another of them"
    assert finding.fix.startswith("compare: rosnode info /talker /listener; rostopic info /chatter")


def test_a_topic_with_one_side_only_is_told_once_if_a_node_is_named() -> None:
    graph = SystemState({"/chatter": ["/talker"]}, {}, {})
    finding = only(check(["/talker", "/chatter"], graph=graph))
    assert finding.text == "published by /talker; no node subscribes to /chatter"


def test_a_connected_pair_with_what_it_moves() -> None:
    status = make_status(make_node(connections=[make_connection()]))
    (finding,) = check(["/chatter"], status=status)
    assert (finding.severity, finding.text) == (
        Severity.OK,
        "connected, 3.4 MB so far, 1.2 kB/s just now",
    )


def test_the_subscribers_word_counts_where_the_publisher_cannot_be_asked() -> None:
    peers = frozenset({("i", "/chatter", INSIDE_URI)})
    nodes = by_name(
        talker(report=None), listener(report=SlaveReport({}, {"/chatter": STRING}, peers))
    )
    (finding,) = check(["/chatter"], nodes=nodes)
    assert finding.text == "connected"


def test_the_publishers_word_counts_more() -> None:
    peers = frozenset({("i", "/chatter", INSIDE_URI)})
    taker = listener(report=SlaveReport({}, {"/chatter": STRING}, peers))
    apart(silent_talker(), taker)


def test_a_node_that_cannot_be_reached() -> None:
    status = make_status(make_node(state="silent"))
    assert "/talker can't be reached" in apart(silent_talker(), listener(), status=status).text
    taker = listener(attempt=Attempt(ReachOutcome.SILENT), report=None)
    assert "/listener can't be reached" in apart(silent_talker(), taker).text
    gone = silent_talker(uri="http://robot-host:45050/10.0.0.9:1/")
    assert "/talker can't be reached" in apart(gone, listener()).text


def test_nodes_that_deny_what_the_master_says() -> None:
    giver = talker(report=SlaveReport())
    assert "/talker is registered as a publisher, but does not" in apart(giver, listener()).text
    taker = listener(report=SlaveReport())
    text = apart(silent_talker(), taker).text
    assert "/listener is registered as a subscriber, but does not subscribe to /chatter" in text


def test_types_that_differ() -> None:
    taker = listener(report=SlaveReport({}, {"/chatter": "std_msgs/Int32"}))
    finding = apart(silent_talker(), taker)
    assert "types differ: /talker publishes std_msgs/String, " in finding.text
    assert "/listener subscribes to std_msgs/Int32" in finding.text


def test_any_type_fits_all() -> None:
    taker = listener(report=SlaveReport({}, {"/chatter": "*"}))
    assert "types differ" not in apart(silent_talker(), taker).text


def test_a_subscriber_outside_that_does_not_come() -> None:
    finding = apart(silent_talker(), listener())
    assert "/listener has not connected to robot-host:45000" in finding.text
    assert finding.fix.startswith("test on the machine of /listener: nc -vz robot-host 45000")


def subscriber_inside(**settings: str | bool) -> DoctorFinding:
    """The finding for a working publisher outside and a subscriber inside."""
    giver = silent_talker(uri=OUTSIDE_URI, attempt=Attempt(ReachOutcome.ANSWERED))
    ports = {("/talker", "/chatter"): ("192.168.0.9:5000", Attempt(ReachOutcome.ANSWERED))}
    status = make_status(make_node("/listener"), settings=settings)
    return apart(giver, listener(uri=INSIDE_URI), data_ports=ports, status=status)


def test_a_subscriber_inside_that_has_no_route_outwards() -> None:
    finding = subscriber_inside()
    assert (
        "/listener, behind the proxy, has not connected to 192.168.0.9:5000 directly"
        in finding.text
    )
    assert finding.fix.startswith(
        "test where /listener runs: nc -vz 192.168.0.9 5000. If there is no"
    )
    assert "--direction both" in finding.fix


def test_a_subscriber_inside_that_has_the_proxy_as_its_way() -> None:
    finding = subscriber_inside(direction="both")
    assert f"has not connected to the proxy's port for {OUTSIDE_URI}" in finding.text
    assert "--direction" not in finding.fix
    assert "If the subscriber accepts UDPROS only, set --udp" in finding.fix
    assert "--udp" not in subscriber_inside(direction="both", udp=True).fix


def outside_pair(data_port: tuple[str, Attempt]) -> DoctorFinding:
    """The finding for a publisher outside after a connection attempt to its data port."""
    giver = silent_talker(uri=OUTSIDE_URI, attempt=Attempt(ReachOutcome.ANSWERED))
    ports = {("/talker", "/chatter"): data_port}
    return apart(giver, listener(), data_ports=ports)


def test_a_data_port_that_cannot_be_reached() -> None:
    finding = outside_pair(("laptop:5000", Attempt(ReachOutcome.UNRESOLVABLE)))
    text = "/talker gives laptop:5000 as its data port: the host name can't be resolved here"
    assert text in finding.text
    assert "ROS_IP=ADDRESS" in finding.fix
    finding = outside_pair(("", Attempt(ReachOutcome.STRANGER, "no TCPROS address")))
    assert "gives no data port" in finding.text
    assert "(no TCPROS address)" in finding.text


def test_a_data_port_on_loopback() -> None:
    finding = outside_pair(("127.0.0.1:5000", Attempt(ReachOutcome.ANSWERED)))
    assert "as its data port, a loopback address" in finding.text


def test_what_is_left_is_the_message_definition() -> None:
    finding = outside_pair(("192.168.0.9:5000", Attempt(ReachOutcome.ANSWERED)))
    assert "md5sum" in finding.text


SERVICE_GRAPH = SystemState({}, {}, {"/add": ["/talker"]})


def service(attempt: Attempt) -> DoctorFinding:
    """The finding on a service."""
    (finding,) = check(
        ["/add"],
        graph=SERVICE_GRAPH,
        service_uris={"/add": "rosrpc://robot-host:45000"},
        services={"/add": attempt},
    )
    return finding


def test_services() -> None:
    assert service(Attempt(ReachOutcome.ANSWERED)).severity is Severity.OK
    dead = service(Attempt(ReachOutcome.REFUSED))
    assert (
        dead.text
        == "/talker provides this service at rosrpc://robot-host:45000: connection refused"
    )
    assert "rosnode cleanup" in dead.fix
    assert "ROS_IP" in service(Attempt(ReachOutcome.UNRESOLVABLE)).fix


def test_no_facts_at_all() -> None:
    assert not [*pair_rules.check(DoctorFacts())]
