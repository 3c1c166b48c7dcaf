"""The document of a proxy for ROS 1: lanes, ways, measures, and faults at the right object."""

import json
from typing import Any

import pytest
from msgspec.structs import replace

from rosproxy.doctor.facts import (
    Attempt,
    DoctorFacts,
    NodeFacts,
    ReachOutcome,
    SlaveReport,
    SystemState,
)
from rosproxy.page.graph_document import graph_document, relayed
from rosproxy.page.judgement import JudgedFacts, judge, topics_to_ask_about
from rosproxy.page.measures import Measures
from rosproxy.page.page_document import (
    LONGEST_NAME,
    LONGEST_TEXT,
    MOST_LINK_BYTES,
    MOST_LINKS,
    MOST_NODE_BYTES,
    MOST_NODES,
    PageLink,
    PageNode,
    document,
)
from rosproxy.shared.documents.doctor_finding import error
from rosproxy.shared.documents.status_document import (
    DomainStatus,
    ProxyStatus,
    StatusSettings,
    read_status,
)
from tests.unit.doctor.cases import ANSWERED, INSIDE_URI, by_name, listener, make_facts, talker
from tests.unit.status_json import make_connection, make_node, make_status

LINK = "topic /chatter /talker /listener"
STRING = {"/chatter": "std_msgs/String"}
KERNEL = {"plane": "kernel", "port": 45050, "connections": 1, "sent_rate": 10.0}


def judged(**changes: Any) -> JudgedFacts:
    """The doctor's findings about the topic of a talker inside and a listener outside."""
    facts = make_facts(names=("/chatter",), **changes)
    return judge(facts, judge(facts))


def made(
    judged: JudgedFacts | None,
    status: dict[str, Any] | None = None,
    measures: Measures | None = None,
) -> dict[str, Any]:
    """The document at the second 100, which was 1000 seconds since the epoch."""
    proxy: ProxyStatus = read_status(status) if status else judged.facts.proxy if judged else ...  # type: ignore[assignment]
    return graph_document(proxy, judged, measures or Measures(), (), 100.0, 900.0)


def test_who_is_where() -> None:
    nodes = made(judged())["nodes"]
    assert {name: node["lane"] for name, node in nodes.items()} == {
        "rosproxy": "host",
        "master": "robot",
        "/talker": "container",
        "/listener": "robot",
    }
    here = replace(listener(), addresses=("192.168.0.2",))
    assert made(judged(nodes=by_name(talker(), here)))["nodes"]["/listener"]["lane"] == "host"


@pytest.mark.parametrize("name", ["master", "rosproxy", "0 01020304", ""])
def test_a_subscriber_that_calls_itself_as_another_box_is_called(name: str) -> None:
    before = made(judged())["nodes"]
    connection = make_connection(caller_id=name)
    assert made(judged(status=make_status(make_node(connections=[connection]))))["nodes"] == before


def test_a_link_that_is_well() -> None:
    link = made(judged(status=make_status(make_node(connections=[make_connection()]))))["links"][
        LINK
    ]
    assert (link["state"], link["carried"], link["port"]) == ("ok", "splice", 45000)
    assert not {"text", "fix", "hz", "rate"} & link.keys(), "nothing is invented"


def test_the_kernel_carries_what_the_proxy_does_not_relay() -> None:
    status = make_status(make_node(data_plane=KERNEL))
    document = made(judged(status=status))
    assert (document["links"][LINK]["carried"], document["links"][LINK]["port"]) == (
        "kernel",
        45050,
    )
    assert document["nodes"]["/talker"]["rate"] == 10.0
    assert document["nodes"]["/talker"]["ports"] == "45000, 45050"


def test_a_pair_that_is_apart_has_the_finding_and_the_command() -> None:
    silent = talker(report=SlaveReport(STRING))
    link = made(judged(nodes=by_name(silent, listener())))["links"][LINK]
    assert link["state"] == "broken"
    assert "/listener has not connected to robot-host:45000" in link["text"]
    assert "nc -vz robot-host 45000" in link["fix"]


def test_nodes_that_have_just_started_are_not_said_to_be_apart() -> None:
    silent = talker(report=SlaveReport(STRING))
    judgement = judge(make_facts(names=("/chatter",), nodes=by_name(silent, listener())))
    assert "state" not in made(judgement)["links"][LINK]


@pytest.mark.parametrize("is_late", [True, False])
def test_a_node_that_comes_or_goes_while_all_are_asked_is_well(is_late: bool) -> None:
    """The proxy was asked first, the master afterwards, and the node answers."""
    before = make_status()
    after = make_status(make_node())
    if not is_late:
        before, after = after, before
    facts = make_facts(status=before, nodes=by_name(talker(attempt=ANSWERED), listener()))
    assert not judge(facts, None, read_status(after)).nodes
    lasting = make_facts(status=make_status(), nodes=facts.nodes)
    assert [*judge(lasting, None, lasting.proxy).nodes] == ["/talker"]


def test_a_node_whose_container_is_gone_is_not_shown() -> None:
    """The proxy was judged while the node had just failed."""
    failing = make_node(state="failing", services=["/add"], parameters=["/rate"])
    judgement = judged(status=make_status(failing))
    assert judgement.nodes
    ended = make_status(make_node(state="ended", services=["/add"], parameters=["/rate"]))
    document = made(judgement, ended)
    assert document["nodes"].keys() == {"rosproxy", "master", "/listener"}
    assert not document["links"]


def test_a_node_that_is_registered_elsewhere_by_now_is_shown() -> None:
    moved = replace(talker(), uri="http://192.168.0.9:35002/", inside=None)
    judgement = judged(nodes=by_name(moved, listener()))
    document = made(judgement, make_status(make_node(state="ended")))
    assert document["nodes"]["/talker"]["lane"] == "robot"


def test_a_node_that_is_wrong_is_the_first_cause_on_its_links() -> None:
    gone = listener(attempt=Attempt(ReachOutcome.REFUSED), report=None)
    silent = talker(report=SlaveReport(STRING))
    document = made(judged(nodes=by_name(silent, gone)))
    assert document["nodes"]["/listener"]["state"] == "broken"
    assert document["links"][LINK]["text"].startswith("/listener: registered as ")
    assert document["links"][LINK]["fix"] == "run rosnode cleanup (answer y)"


def counted(*rounds: tuple[float, int, int]) -> tuple[Measures, DoctorFacts]:
    """Rounds in which talker and listener have counted so many messages of 10 bytes."""
    measures = Measures()
    facts = make_facts()
    for at, sent, got in rounds:
        gave = SlaveReport(
            STRING,
            {},
            frozenset({("o", "/chatter", "/listener")}),
            {("o", "/chatter", "/listener"): (10 * sent, sent)},
            at,
        )
        took = SlaveReport(
            {}, STRING, counts={("i", "/chatter", INSIDE_URI): (10 * got, got)}, at=at
        )
        facts = make_facts(
            names=("/chatter",), nodes=by_name(talker(report=gave), listener(report=took))
        )
        measures.read_nodes(facts, [("/chatter", "/talker", "/listener")])
    return measures, facts


def test_measures_of_a_link_that_flows() -> None:
    measures, facts = counted((97.0, 10, 10), (99.0, 30, 30))
    link = made(judge(facts), measures=measures)["links"][LINK]
    assert (link["hz"], link["rate"], link["flows"]) == (10.0, 100.0, True)
    assert "since" not in link


def test_a_link_that_pauses_tells_since_when() -> None:
    measures, facts = counted((60.0, 10, 10), (62.0, 30, 30), (98.0, 30, 30))
    link = made(judge(facts), measures=measures)["links"][LINK]
    assert (link["hz"], link["since"], link["state"]) == (0.0, 962, "ok")
    assert "flows" not in link


def test_a_link_that_carries_nothing_is_broken_and_names_the_command() -> None:
    measures, facts = counted((60.0, 10, 10), (62.0, 30, 30), (98.0, 300, 30))
    link = made(judge(facts), measures=measures)["links"][LINK]
    assert (link["state"], link["since"]) == ("broken", 962)
    assert "no message of /talker arrives at /listener" in link["text"]
    assert link["fix"].startswith("test on the machine of /listener: nc -vz robot-host 45000. If")


def test_before_anybody_was_asked_the_status_tells() -> None:
    status = make_status(make_node(connections=[make_connection()], services=["/add"]))
    document = made(None, status)
    assert document["links"][LINK]["state"] == "ok"
    assert document["links"]["service /add /talker "]["port"] == 45000
    assert relayed(read_status(status), SystemState()) == {
        ("/chatter", "/talker", "/listener"): 3_400_000
    }


def test_a_service_of_a_node_that_is_wrong_has_the_fix() -> None:
    status = make_status(make_node(state="silent", services=["/add"]))
    facts = make_facts(status=status)
    link = made(judge(facts), status)["links"]["service /add /talker "]
    assert link["state"] == "broken"
    assert link["text"].startswith("/talker: does not answer")
    assert link["fix"].startswith("restart the node")


def test_what_every_node_has_is_quiet() -> None:
    graph = SystemState(
        {"/rosout": ["/talker"], "/chatter": ["/talker"]}, {"/rosout": ["/rosout"]}, {}
    )
    node = make_node(
        services=["/talker/get_loggers", "/add"],
        parameters=["/rosout_disable_topics_generation"],
        publishes=["/chatter", "/rosout"],
    )
    nodes = by_name(talker(), listener(name="/rosout"))
    links = made(judged(status=make_status(node), graph=graph, nodes=nodes))["links"]
    quiet = {key for key, link in links.items() if link.get("quiet")}
    assert quiet == {
        "topic /rosout /talker /rosout",
        "service /talker/get_loggers /talker ",
        "parameter /rosout_disable_topics_generation master /talker",
    }
    assert "state" not in links["topic /chatter /talker "], "the topic is not examined"


@pytest.mark.parametrize("topic", ["/tf", "/tf_static", "/rosout_agg", "/parameter_events"])
def test_a_topic_that_nearly_every_node_has_is_quiet(topic: str) -> None:
    connection = make_connection(name=topic)
    links = made(None, make_status(make_node(connections=[connection])))["links"]
    assert links[f"topic {topic} /talker /listener"]["quiet"]


def test_a_topic_that_is_copied() -> None:
    status = make_status(make_node(connections=[make_connection()]))
    status["data_plane"] = {"mode": "copy", "plane": "copy", "reason": "asked for"}
    assert made(None, status)["links"][LINK]["carried"] == "copy"


def test_the_ports_that_are_used_and_left() -> None:
    about = made(judged())["proxy"]
    assert (about["ports"], about["used"], about["free"]) == ("45000-45099", 1, 99)


def test_what_the_policy_hides_says_so() -> None:
    status = make_status(make_node())
    status["policy"] = {"hidden": [{"name": "/chatter", "node": "/talker", "reason": "deny it"}]}
    links = made(judged(status=status, graph=SystemState()))["links"]
    assert links["topic /chatter /talker "]["text"] == "hidden from outside by the policy: deny it"


def test_a_subscription_by_udpros() -> None:
    status = make_status(make_node())
    status["udpros"] = [{"topic": "/chatter", "caller_id": "/listener", "port": 45009}]
    link = made(judged(status=status))["links"][LINK]
    assert (link["carried"], link["port"]) == ("UDPROS", 45009)


def test_two_nodes_outside_are_no_concern_of_the_proxy() -> None:
    graph = SystemState({"/far": ["/one"]}, {"/far": ["/listener"]}, {})
    assert not made(judged(graph=graph))["links"].keys() & {"topic /far /one /listener"}
    assert topics_to_ask_about(make_facts().proxy, graph) == ()


def test_a_topic_with_too_many_links_keeps_no_other_topic_from_being_asked_about() -> None:
    names = ["/talker", *(f"/n{number}" for number in range(MOST_LINKS))]
    publishers = {"/a": names, "/chatter": ["/talker"]}
    graph = SystemState(publishers, {"/a": names, "/chatter": ["/listener"]}, {})
    assert topics_to_ask_about(make_facts().proxy, graph) == ("/chatter",)


@pytest.mark.parametrize(
    ("ros", "domains", "detail"),
    [
        (("1",), (), "ROS 1"),
        (("2",), (7,), "ROS 2, domain 7"),
        (("1", "2", "zenoh"), (0, 7), "ROS 1; ROS 2, domains 0, 7; rmw_zenoh"),
    ],
)
def test_a_proxy_shows_its_versions_of_ros(
    ros: tuple[str, ...], domains: tuple[int, ...], detail: str
) -> None:
    statuses = tuple(DomainStatus(domain=domain) for domain in domains)
    status = ProxyStatus(settings=StatusSettings(ros=ros), domains=statuses)
    document = graph_document(status, None, Measures(), (), 0.0, 0.0)
    assert document["nodes"]["rosproxy"]["detail"] == detail


def test_a_master_that_is_away_is_told() -> None:
    status = make_status(make_node(), master={"up": False, "error": "master is away"})
    facts = make_facts(status=status, graph=None, nodes={}, names=())
    document = graph_document(
        facts.proxy,
        judge(facts),
        Measures(),
        (error("published range", "range", "x", "y"),),
        0.0,
        0.0,
    )
    assert document["nodes"]["master"]["state"] == "broken"
    assert document["findings"][0] == {
        "severity": "error",
        "subject": "range",
        "text": "x",
        "fix": "y",
        "wrong_since": None,
        "may_be_older": False,
    }


@pytest.mark.parametrize(
    "hostile", ["<script>alert(1)</script>", "/a\u202eb\x07", "/" + "x" * 9999]
)
def test_names_are_short_and_harmless(hostile: str) -> None:
    status = make_status(make_node(publishes=[hostile]))
    (link,) = [
        candidate
        for candidate in made(None, status)["links"].values()
        if candidate["kind"] == "topic"
    ]
    assert len(link["name"]) <= LONGEST_NAME
    assert link["name"].isprintable()


def test_a_large_graph_is_cut_and_what_is_broken_stays() -> None:
    names = [f"/n{number}" for number in range(80)]
    graph = SystemState(
        {"/tf": names, "/chatter": ["/talker"]}, {"/tf": names, "/chatter": ["/listener"]}, {}
    )
    nodes = [make_node(name, 45000 + n, publishes=["/tf"]) for n, name in enumerate(names[:70])]
    status = make_status(make_node("/talker", 45080), *nodes)
    silent = by_name(talker(report=SlaveReport(STRING)), listener())
    document = made(judged(status=status, graph=graph, nodes=silent))
    assert len(document["links"]) <= MOST_LINKS
    assert document["left_out"] == 80 * 80 - 10 * 10
    assert document["links"][LINK]["state"] == "broken"


def test_links_between_nodes_outside_hide_no_link_of_a_node_inside() -> None:
    names = [f"/n{number}" for number in range(100)]
    graph = SystemState({"/pose": ["/talker", *names]}, {"/pose": names}, {})
    others = [NodeFacts(name, f"http://robot-host:{45100 + n}/") for n, name in enumerate(names)]
    document = made(judged(graph=graph, nodes=by_name(talker(), *others)))
    links = [link for link in document["links"].values() if link["name"] == "/pose"]
    assert {link["source"] for link in links} == {"/talker"}
    assert len(links) == len(names)
    assert document["left_out"] == 0


def test_of_too_many_nodes_the_broken_ones_stay() -> None:
    """Also a node behind the limit, if it has a broken link."""
    nodes = {f"/n{number}": PageNode("robot") for number in range(MOST_NODES + 9)}
    last = f"/n{MOST_NODES + 8}"
    ill = f"/n{MOST_NODES + 7}"
    nodes[ill] = PageNode("container", state="broken")
    link = PageLink("topic", "/chatter", "/n0", last, state="broken")
    made = document({}, nodes, [link], ())
    assert len(made["nodes"]) == MOST_NODES
    assert {"/n0", last, ill} <= made["nodes"].keys()
    assert list(made["links"]) == [link.key]
    assert made["left_out"] == 9
    ends_elsewhere = PageLink("topic", "/chatter", "/n0", "/nobody")
    assert document({}, nodes, [ends_elsewhere], ())["links"] == {}


def test_a_document_has_few_bytes_whatever_nodes_call_themselves() -> None:
    """200 names of 100,000 characters would make 60 MB each second, which the operator does not
    read.
    """
    names = [f"/{number}{'é' * 100_000}" for number in range(50)]
    facts = judged().facts
    graph = SystemState({"/chatter": ["/talker"]}, {"/chatter": names})
    nodes = {name: NodeFacts(name) for name in names}
    shown = made(JudgedFacts(replace(facts, graph=graph, nodes=nodes)))
    assert len(json.dumps(shown)) < 50 * 6 * 5 * LONGEST_NAME
    assert len(shown["links"]) == 50
    assert all(link["target"] in shown["nodes"] for link in shown["links"].values())


def test_of_long_rows_what_is_broken_stays() -> None:
    text = "é" * LONGEST_TEXT
    nodes = {f"/{n}{'é' * LONGEST_NAME}": PageNode("robot", text=text) for n in range(MOST_NODES)}
    nodes["/last"] = PageNode("robot", state="broken")
    links = [PageLink("topic", f"/{n}", "/last", text=text, fix=text) for n in range(MOST_LINKS)]
    links.append(PageLink("topic", "/x", "/last", state="broken"))
    shown = document({}, nodes, links, ())
    assert len(json.dumps(shown["nodes"])) <= MOST_NODE_BYTES
    assert len(json.dumps(shown["links"])) <= MOST_LINK_BYTES
    assert "/last" in shown["nodes"]
    assert next(iter(shown["links"].values()))["state"] == "broken"
    rows = len(shown["nodes"]) + len(shown["links"]) + shown["left_out"]
    assert rows == len(nodes) + len(links)
