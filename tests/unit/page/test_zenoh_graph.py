"""The document of a proxy for rmw_zenoh."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from rosproxy.page.graph_document import graph_document
from rosproxy.page.measures import Measures
from rosproxy.page.page_document import MOST_LINKS
from rosproxy.shared.documents.status_document import (
    HiddenStatus,
    MismatchStatus,
    NamedTypeStatus,
    PolicyStatus,
    PortsStatus,
    ProxyStatus,
    StatusSettings,
    ZenohCertificateStatus,
    ZenohLinkStatus,
    ZenohNodeStatus,
    ZenohSessionStatus,
    ZenohStatus,
)
from rosproxy.zenoh.links import LinkFault

STRING = NamedTypeStatus("/chatter", "std_msgs/msg/String")
TALKER = ZenohNodeStatus(
    *("/talker", 0, "172.18.0.3", ("/chatter", "/rosout"), (), ("/add", "/talker/get_parameters")),
    types=(STRING,),
    port=7448,
    mode="peer",
    key="0 aa.0/talker",
)
LISTENER = ZenohNodeStatus("/listener", subscribes=("/chatter",), key="0 bb.0/listener")
ROBOT = ZenohSessionStatus(None, "router", "04", "172.18.0.2:50003", "192.0.2.7:7447")
ZENOH = ZenohStatus(
    ports="7448-7467",
    links=(ZenohLinkStatus("robot:7447", True, "", 60.0),),
    sessions=(
        ZenohSessionStatus(7448, "peer", "aa", "172.18.0.2:7448", "172.18.0.3:50002"),
        ROBOT,
    ),
    nodes=(TALKER, LISTENER),
)
LINK = f"topic /chatter {TALKER.key} {LISTENER.key}"
REFUSED = ZenohLinkStatus("robot:7447", error="refused", since=60.0)


def made(policy: PolicyStatus | None = None, **changes: Any) -> dict[str, Any]:
    status = ProxyStatus(
        settings=StatusSettings(ros=("zenoh",)), policy=policy, zenoh=replace(ZENOH, **changes)
    )
    return graph_document(status, None, Measures(), (), 100.0, 900.0)


def test_nodes_routers_and_a_topic() -> None:
    document = made()
    talker = document["nodes"][TALKER.key]
    assert (talker["lane"], talker["kind"], talker["label"]) == (
        "container",
        "zenoh node",
        "/talker",
    )
    assert (talker["address"], talker["ports"]) == ("172.18.0.3", "7448")
    assert talker["detail"] == "domain 0; peer at port 7448 of the proxy"
    listener = document["nodes"][LISTENER.key]
    assert (listener["lane"], listener["address"]) == ("robot", "robot:7447, behind this router")
    router = document["nodes"]["router robot:7447"]
    assert (router["lane"], router["kind"], router["since"]) == ("robot", "router", 940)
    assert router["detail"] == "linked with the hub of the proxy"
    assert "state" not in router
    link = document["links"][LINK]
    assert (link["state"], link["carried"], link["port"]) == ("ok", "router", 7448)
    assert link["type"] == "std_msgs/msg/String"
    assert not {"hz", "rate", "since", "flows", "text"} & link.keys(), "no router counts messages"
    assert not document["findings"]
    assert "master" not in document["nodes"]


def test_a_proxy_without_a_range_shows_the_ports_for_containers() -> None:
    assert made()["nodes"]["rosproxy"]["ports"] == "7448-7467 for containers of rmw_zenoh"
    status = ProxyStatus(ports=PortsStatus(advertise="11412-11443", free=32), zenoh=ZENOH)
    document = graph_document(status, None, Measures(), (), 100.0, 900.0)
    assert document["nodes"]["rosproxy"]["ports"] == (
        "11412-11443, 0 used, 32 free; 7448-7467 for containers of rmw_zenoh"
    )


def test_a_status_without_rmw_zenoh_has_nothing_of_it() -> None:
    status = ProxyStatus(settings=StatusSettings(ros=("2",)))
    document = graph_document(status, None, Measures(), (), 0.0, 0.0)
    assert [*document["nodes"]] == ["rosproxy"]
    assert not document["links"]


def test_services_have_a_link_to_each_client_and_those_of_every_node_are_quiet() -> None:
    client = replace(LISTENER, calls=("/add",))
    links = made(nodes=(TALKER, client))["links"]
    assert links[f"service /add {TALKER.key} {LISTENER.key}"]["state"] == "ok"
    alone = links[f"service /talker/get_parameters {TALKER.key} "]
    assert (alone["state"], alone["quiet"]) == ("ok", True)
    assert "text" not in alone
    assert links[f"topic /rosout {TALKER.key} "]["quiet"]


def test_the_lanes_and_routers_of_nodes_outside() -> None:
    laptop = replace(LISTENER, key="0 cc.0/laptop", address="192.0.2.50", mode="client")
    nodes = made(nodes=(laptop, LISTENER), listen=7447)["nodes"]
    assert (nodes[laptop.key]["address"], nodes[laptop.key]["ports"]) == ("192.0.2.50", "7447")
    other = replace(ROBOT, zid="05", remote="192.0.2.8:7447")
    several = made(sessions=(*ZENOH.sessions, other))["nodes"][LISTENER.key]
    assert "address" not in several, "no token tells the router"
    assert several["detail"].endswith("one of the routers 192.0.2.7:7447, 192.0.2.8:7447")
    here = made(links=(replace(ZENOH.links[0], peer="127.0.0.1:7447"),))["nodes"]
    assert here["router 127.0.0.1:7447"]["lane"] == here[LISTENER.key]["lane"] == "host"


def test_a_link_that_is_down_says_why() -> None:
    document = made(links=(REFUSED,), sessions=ZENOH.sessions[:1], nodes=(TALKER,))
    router = document["nodes"]["router robot:7447"]
    assert (router["state"], router["since"]) == ("broken", 940)
    assert router["text"].startswith("connection refused")
    assert "rmw_zenohd" in router["fix"]
    assert not document["findings"], "the router shows the finding"
    alone = document["links"][f"topic /chatter {TALKER.key} "]
    assert "state" not in alone, "unknown is the default"
    assert alone["text"] == (
        "no subscription is known in domain 0. No link to robot:7447: the nodes there are not known"
    )


@pytest.mark.parametrize("changes", [{"since": 1.0}, {"error": "not tried yet"}])
def test_of_a_new_link_it_is_too_early_to_tell(changes: dict[str, Any]) -> None:
    document = made(links=(replace(REFUSED, **changes),))
    assert document["nodes"]["router robot:7447"]["state"] == "unknown"
    assert not document["findings"]


def test_another_proxy_that_is_away_is_no_fault() -> None:
    hubs = (
        ZenohLinkStatus("node2:7447", error="refused", since=60.0, hub=True),
        ZenohLinkStatus("node3:7447", True, hub=True),
    )
    nodes = made(links=hubs)["nodes"]
    assert nodes["hub node2:7447"]["state"] == "unknown"
    assert nodes["hub node2:7447"]["text"] == "not linked (refused). The hub tries again"
    assert "state" not in nodes["hub node3:7447"]


def test_routers_that_do_not_run_are_the_only_finding() -> None:
    document = made(failure="no report for 10 s", nodes=(), sessions=())
    assert [*document["nodes"]] == ["rosproxy"], "nothing is known about the links"
    (finding,) = document["findings"]
    assert (finding["severity"], finding["text"]) == ("error", "do not run: no report for 10 s")


def test_a_mismatch_is_on_its_link_alone() -> None:
    pair = MismatchStatus("topic", "/chatter", "type", "A", "B", TALKER.key, LISTENER.key)
    other = replace(LISTENER, name="/other", key="0 cc.0/other")
    document = made(nodes=(TALKER, LISTENER, other), mismatches=(pair,))
    link = document["links"][LINK]
    assert (link["state"], "carried" in link) == ("broken", False)
    assert link["text"].startswith("type differs: the publisher /talker (172.18.0.3) offers A")
    assert link["fix"]
    assert document["links"][f"topic /chatter {TALKER.key} {other.key}"]["state"] == "ok"
    assert not document["findings"]


def test_another_durability_is_told_at_a_link_that_is_ok() -> None:
    qos = ("durability", "VOLATILE", "TRANSIENT_LOCAL")
    pair = MismatchStatus("topic", "/chatter", *qos, TALKER.key, LISTENER.key)
    link = made(mismatches=(pair,))["links"][LINK]
    assert (link["state"], link["carried"]) == ("ok", "router")
    assert link["text"].endswith("The subscription gets no messages from before its start")


def test_a_rule_is_told_and_is_no_fault() -> None:
    hidden = HiddenStatus("publish", "/chatter", "/talker", "operator: deny *", "172.18.0.3")
    link = made(PolicyStatus(hidden=(hidden,)))["links"][LINK]
    assert not {"state", "carried"} & link.keys(), "unknown is the default"
    assert link["text"] == "hidden from outside by the policy: operator: deny *"


def test_peers_of_one_container_are_direct_and_those_of_two_are_a_warning() -> None:
    near = replace(TALKER, name="/near", key="0 aa.1/near", publishes=(), services=())
    near = replace(near, subscribes=("/chatter",))
    key = f"topic /chatter {TALKER.key} {near.key}"
    link = made(nodes=(TALKER, near))["links"][key]
    assert (link["carried"], link["state"]) == ("direct", "ok")
    assert "port" not in link
    apart = replace(near, address="172.18.0.4")
    second = replace(ZENOH.sessions[0], zid="dd", remote="172.18.0.4:50002")
    document = made(nodes=(TALKER, apart), sessions=(*ZENOH.sessions, second))
    link = document["links"][key]
    assert (link["state"], link["port"]) == ("warning", 7448)
    assert "are peers of the same router" in link["text"]
    assert not document["findings"], "the link shows the finding"


def test_two_domains_are_a_warning() -> None:
    document = made(nodes=(TALKER, replace(LISTENER, domain=7)))
    link = document["links"][f"topic /chatter {TALKER.key} "]
    assert (link["state"], "in domain 7" in link["text"]) == ("warning", True)
    assert "ROS_DOMAIN_ID" in link["fix"]


def test_tokens_that_are_left_out_are_a_warning() -> None:
    (finding,) = made(left_out=5)["findings"]
    assert finding["severity"] == "warning"
    assert "left out of the status: 5" in finding["text"]


def test_a_name_with_too_many_links_is_counted_and_hides_no_other() -> None:
    flood = tuple(
        ZenohNodeStatus(f"/n{n}", 0, "", ("/a",), ("/a",), port=7448, key=f"0 ff.{n}/n{n}")
        for n in range(100)
    )
    document = made(nodes=(*flood, TALKER, LISTENER))
    assert LINK in document["links"]
    assert document["left_out"] > MOST_LINKS


@given(st.text(min_size=1, max_size=400), st.text(max_size=400))
def test_names_of_hostile_nodes_are_short_and_harmless(name: str, topic: str) -> None:
    evil = replace(TALKER, name=name, publishes=(topic,), key=f"0 ee.0{name}")
    document = made(nodes=(evil, LISTENER, TALKER))
    shown = [*document["nodes"], *(link["name"] for link in document["links"].values())]
    assert all(text.isprintable() and len(text) <= 300 for text in shown)
    assert LINK in document["links"]


def test_a_link_to_another_site_says_why_it_is_down() -> None:
    down = replace(REFUSED, protocol="tls", error=LinkFault.PEER_FOREIGN.value)
    router = made(links=(down,))["nodes"]["router tls/robot:7447"]
    assert router["state"] == "broken"
    assert "of a CA that this proxy does not trust" in router["text"]
    file = ZenohCertificateStatus("/c/tls.crt", ends_in=86400.0)
    (finding,) = made(certificates=(file,))["findings"]
    assert finding["subject"] == "zenoh file /c/tls.crt"
    assert finding["text"] == "expires within 3 days"
