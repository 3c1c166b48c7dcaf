"""The state of the routers, from reports: sessions with both addresses, links, nodes, metrics."""

from dataclasses import dataclass
from pathlib import Path

import pytest
from msgspec.structs import replace
from prometheus_client import CollectorRegistry, generate_latest

from rosproxy.shared.documents.status_document import (
    NamedTypeStatus,
    ZenohApartStatus,
    ZenohCertificateStatus,
    ZenohFullStatus,
    ZenohQosStatus,
    ZenohSessionStatus,
    ZenohUnlinkedStatus,
)
from rosproxy.shared.policy.rules import RuleKind
from rosproxy.zenoh.protocol.liveliness import graph_of
from rosproxy.zenoh.protocol.report import Report, RouterReport, RouterSession, SessionConnection
from rosproxy.zenoh.router_policy import InsideName
from rosproxy.zenoh.status import (
    MOST_LISTED_MISMATCHES,
    MOST_LISTED_NODES,
    MOST_LISTED_SESSIONS,
    ZenohState,
)
from tests import certificates
from tests.run_options import parse_settings

NODE_ZID = "aa"
TOKENS = (
    f"@ros2_lv/0/{NODE_ZID}/0/0/NN/%/%/talker",
    f"@ros2_lv/0/{NODE_ZID}/0/10/MP/%/%/talker/%chatter/T_/H/::,10:,:,:,,",
    "@ros2_lv/0/bb/0/0/NN/%/%/robot",
    "@ros2_lv/no/token",
)


@dataclass
class Clock:
    """The time of a state."""

    time: float = 10.0

    def __call__(self) -> float:
        return self.time


@dataclass
class FakeProcess:
    """A process of routers."""

    failure: str = ""
    restarts: int = 2


def session(zid: str, mode: str, local: str, remote: str) -> RouterSession:
    return RouterSession(zid, mode, (SessionConnection(f"tcp/{local}", f"tcp/{remote}"),))


HUB = RouterReport(
    "03",
    (
        session("01", "router", "127.0.0.1:50001", "127.0.0.1:7448"),
        session("04", "router", "172.18.0.2:50003", "192.0.2.7:7447"),
    ),
)
REPORT = Report(
    (
        RouterReport(
            "01",
            (
                session("03", "router", "127.0.0.1:7448", "127.0.0.1:50001"),
                session(NODE_ZID, "peer", "172.18.0.2:7448", "172.18.0.3:50002"),
            ),
        ),
        RouterReport("02"),
        HUB,
    ),
    TOKENS,
    tokens_left_out=5,
)


def make_state(process: FakeProcess, clock: Clock | None = None) -> ZenohState:
    options = {
        "ros": ("zenoh",),
        "zenoh_ports": "7448-7449",
        "zenoh_peer": ("192.0.2.7", "192.0.2.8"),
    }
    state = ZenohState(parse_settings(options), process, clock or Clock())
    for link in state.links:
        link.addresses = (link.peer.host,)
    state.take(REPORT, graph_of(TOKENS))
    return state


def metrics_of(state: ZenohState) -> list[str]:
    registry = CollectorRegistry()
    registry.register(state)
    return generate_latest(registry).decode().splitlines()


def test_sessions_at_the_port_for_outside_are_outside() -> None:
    given = {"ros": ("zenoh",), "zenoh_ports": "7448-7448", "zenoh_listen": 7447}
    state = ZenohState(parse_settings(given), FakeProcess(), lambda: 10.0)
    laptop = session(NODE_ZID, "client", "172.18.0.2:7447", "192.0.2.7:50002")
    node = session("bb", "peer", "172.18.0.2:7448", "172.18.0.3:50002")
    for_hub = session("03", "router", "172.18.0.2:7447", "172.18.0.2:50001")
    routers = (RouterReport("01", (node,)), RouterReport("02", (laptop, for_hub)), HUB)
    state.take(Report(routers, TOKENS), graph_of(TOKENS))
    ports = {s.zid: s.port for s in state.status().sessions}
    assert ports == {NODE_ZID: None, "bb": 7448, "04": None}
    assert state.container_sessions == [(7448, "172.18.0.3")]
    assert not state.inside_names()
    nodes = [line for line in metrics_of(state) if line.startswith("rosproxy_zenoh_nodes")]
    assert nodes == [
        'rosproxy_zenoh_nodes{side="inside"} 1.0',
        'rosproxy_zenoh_nodes{side="outside"} 1.0',
    ]


def test_a_container_with_the_zenoh_id_of_a_router_is_no_router() -> None:
    """The rules of the container did not hold at the port of another container."""
    state = make_state(FakeProcess())
    borrowed = session("01", "client", "172.18.0.2:7449", "172.18.0.3:50009")
    routers = (REPORT.routers[0], RouterReport("02", (borrowed,)), HUB)
    state.take(Report(routers), None)
    assert (7449, "172.18.0.3") in state.container_sessions
    assert not [port for port, address in state.container_sessions if address == "127.0.0.1"]


def test_sessions_have_both_addresses_and_their_router() -> None:
    status = make_state(FakeProcess()).status()
    assert status.sessions == (
        ZenohSessionStatus(7448, "peer", NODE_ZID, "172.18.0.2:7448", "172.18.0.3:50002"),
        ZenohSessionStatus(None, "router", "04", "172.18.0.2:50003", "192.0.2.7:7447"),
    )
    assert (status.ports, status.restarts, status.left_out) == ("7448-7449", 2, 6)


def test_nodes_here_have_an_address() -> None:
    talker, robot = reversed(make_state(FakeProcess()).status().nodes)
    assert (talker.name, talker.address, talker.publishes) == (
        "/talker",
        "172.18.0.3",
        ("/chatter",),
    )
    assert (talker.port, talker.mode, talker.key) == (7448, "peer", f"0 {NODE_ZID}.0/talker")
    assert talker.types == (NamedTypeStatus("/chatter", "T_"),)
    assert talker.qos == (
        ZenohQosStatus("/chatter", "publisher", "RELIABLE", "VOLATILE", "KEEP_LAST", 10),
    )
    assert (robot.name, robot.address, robot.port, robot.mode) == ("/robot", "", None, "")


def without_node(state: ZenohState) -> dict[str, float]:
    return {session.zid: session.without_node for session in state.status().sessions}


def test_a_session_has_the_time_without_a_node() -> None:
    clock = Clock()
    state = make_state(FakeProcess(), clock)
    clock.time = 15.0
    assert without_node(state) == {NODE_ZID: 0.0, "04": 0.0}
    state.take(Report(REPORT.routers), graph_of(()))
    clock.time = 21.0
    state.take(Report(REPORT.routers), None)
    clock.time = 22.0
    assert without_node(state) == {NODE_ZID: 7.0, "04": 0.0}
    state.take(Report(REPORT.routers), graph_of(TOKENS))
    assert without_node(state) == {NODE_ZID: 0.0, "04": 0.0}
    state.take(Report(REPORT.routers), graph_of(()))
    assert without_node(state) == {NODE_ZID: 0.0, "04": 0.0}, "the time begins again"


def test_the_time_without_a_node_ends_with_the_session() -> None:
    clock = Clock()
    state = make_state(FakeProcess(), clock)
    state.take(Report(REPORT.routers), graph_of(()))
    clock.time = 20.0
    state.take(Report((RouterReport("01"), *REPORT.routers[1:])), None)
    state.take(Report(REPORT.routers), None)
    clock.time = 21.0
    assert without_node(state)[NODE_ZID] == 1.0


def test_a_router_at_a_port_for_containers_has_a_node_if_a_node_has_no_session_here() -> None:
    clock = Clock()
    state = make_state(FakeProcess(), clock)
    own_router = session("05", "router", "172.18.0.2:7449", "172.18.0.4:50002")
    routers = (REPORT.routers[0], RouterReport("02", (own_router,)), HUB)
    state.take(Report(routers), graph_of(TOKENS))
    clock.time = 20.0
    assert without_node(state)["05"] == 0.0, "the node /robot may be behind this router"
    state.take(Report(routers), graph_of(TOKENS[:2]))
    clock.time = 25.0
    assert without_node(state) == {NODE_ZID: 0.0, "05": 5.0, "04": 0.0}


def test_nodes_that_do_not_match_are_pairs_with_a_node_inside() -> None:
    state = make_state(FakeProcess())
    reader = "@ros2_lv/0/bb/0/10/MS/%/%/robot/%chatter/Other_/H/::,10:,:,:,,"
    state.take(Report(REPORT.routers), graph_of((*TOKENS, reader)))
    (pair,) = state.status().mismatches
    assert (pair.name, pair.policy, pair.offered, pair.requested) == (
        *("/chatter", "type", "T_", "Other_"),
    )
    assert (pair.writer, pair.reader) == (f"0 {NODE_ZID}.0/talker", "0 bb.0/robot")
    state.take(Report((RouterReport("01"), *REPORT.routers[1:])), None)
    assert not state.status().mismatches, "the talker has no session here any more"


def test_the_list_of_mismatches_is_bounded() -> None:
    state = make_state(FakeProcess())
    readers = [
        f"@ros2_lv/0/bb/{number}/10/MS/%/%/robot/%chatter/Other_/H/::,10:,:,:,,"
        for number in range(MOST_LISTED_MISMATCHES + 3)
    ]
    state.take(Report(REPORT.routers), graph_of((*TOKENS, *readers)))
    status = state.status()
    assert (len(status.mismatches), status.mismatches_left_out) == (MOST_LISTED_MISMATCHES, 3)


def test_listed_nodes_and_sessions_are_bounded_with_fair_shares() -> None:
    """With 8,192 nodes, the event loop took 0.2 s for a status."""
    state = make_state(FakeProcess())
    crowd = [f"@ros2_lv/0/bb/{number}/0/NN/%/%/robot" for number in range(MOST_LISTED_NODES + 7)]
    many = tuple(
        session(f"c{number}", "peer", "172.18.0.2:7448", f"172.18.0.9:{number + 1}")
        for number in range(MOST_LISTED_SESSIONS + 5)
    )
    routers = (REPORT.routers[0], RouterReport("02", many), HUB)
    state.take(Report(routers), graph_of((*TOKENS[:2], *crowd)))
    status = state.status()
    assert (len(status.nodes), len(status.sessions)) == (MOST_LISTED_NODES, MOST_LISTED_SESSIONS)
    assert "172.18.0.3" in {node.address for node in status.nodes}
    assert "172.18.0.3" in {listed.remote.partition(":")[0] for listed in status.sessions}
    assert status.left_out == 8 + 7
    metrics = metrics_of(state)
    assert f'rosproxy_zenoh_nodes{{side="outside"}} {len(crowd)}.0' in metrics
    assert f'rosproxy_zenoh_sessions{{mode="peer"}} {len(many) + 1}.0' in metrics


def test_names_of_nodes_inside_have_port_and_address() -> None:
    state = make_state(FakeProcess())
    assert state.container_sessions == [(7448, "172.18.0.3")]
    assert state.inside_names() == (
        InsideName(7448, "172.18.0.3", "/talker", RuleKind.PUBLISH, "/chatter"),
    )


def test_tokens_stay_until_a_report_has_others() -> None:
    state = make_state(FakeProcess())
    state.take(Report(REPORT.routers), None)
    assert len(state.status().nodes) == 2
    state.take(Report(REPORT.routers, ()), graph_of(()))
    assert not state.status().nodes


def test_a_link_is_up_while_the_routers_run() -> None:
    process = FakeProcess()
    state = make_state(process)
    assert [state.is_up(link) for link in state.links] == [True, False]
    process.failure = "no report for 10 s"
    assert not state.is_up(state.links[0])
    status = state.status()
    assert (status.sessions, status.nodes, status.left_out) == ((), (), 0)


def test_hubs_are_links_that_may_be_away() -> None:
    hubs = ("192.0.2.7", "hub:7448")  # the first is a router outside as well
    options = {"ros": ("zenoh",), "zenoh_peer": ("192.0.2.7", "robot"), "zenoh_hub": hubs}
    state = ZenohState(parse_settings(options), FakeProcess(), lambda: 10.0)
    told = [(link.peer, link.hub) for link in state.status().links]
    assert told == [("192.0.2.7:7447", True), ("robot:7447", False), ("hub:7448", True)]
    lines = metrics_of(state)
    assert [line for line in lines if line.startswith("rosproxy_zenoh_link_up{")] == [
        'rosproxy_zenoh_link_up{peer="robot:7447"} 0.0'
    ]
    assert "rosproxy_zenoh_hubs_up 0.0" in lines


def test_every_connection_of_a_session_counts() -> None:
    state = make_state(FakeProcess())
    first = SessionConnection("tcp/172.18.0.2:7447", "tcp/10.0.0.9:50003")
    second = SessionConnection("tcp/172.18.0.2:50004", "tcp/192.0.2.8:7447")
    hub = RouterSession("04", "router", (first, second))
    state.take(Report((*REPORT.routers[:2], RouterReport("03", (hub,)))), None)
    assert [state.is_up(link) for link in state.links] == [False, True]


def test_metrics() -> None:
    lines = metrics_of(make_state(FakeProcess()))
    for line in (
        "rosproxy_zenoh_routers_up 1.0",
        "rosproxy_zenoh_restarts_total 2.0",
        'rosproxy_zenoh_link_up{peer="192.0.2.7:7447"} 0.0',
        'rosproxy_zenoh_sessions{mode="peer"} 1.0',
        'rosproxy_zenoh_nodes{side="inside"} 1.0',
    ):
        assert line in lines


@pytest.mark.parametrize(("most", "few_files"), [(2, True), (1000, False)])
def test_a_router_with_the_most_sessions_is_full_until_a_session_ends(
    most: int, *, few_files: bool
) -> None:
    state = make_state(FakeProcess())
    peer = session(NODE_ZID, "peer", "172.18.0.2:7448", "172.18.0.3:50002")
    for_hub = RouterSession("03", "router", (SessionConnection("unixsock-stream/a", ""),))
    first = RouterReport("01", (for_hub, *[peer] * (most - 1)), most_sessions=most)
    state.take(Report((first, RouterReport("02", most_sessions=most), HUB)), None)
    full = ZenohFullStatus(7448, most, ("172.18.0.3",), few_files)
    assert state.status().full == (full,)
    assert "rosproxy_zenoh_routers_full 1.0" in metrics_of(state)
    first = RouterReport("01", (for_hub, *[peer] * (most - 2)), most_sessions=most)
    state.take(Report((first, HUB)), None)
    assert not state.status().full
    assert "rosproxy_zenoh_routers_full 0.0" in metrics_of(state)


def test_a_router_without_a_link_to_the_hub_is_told_until_it_is_linked() -> None:
    clock = Clock()
    state = make_state(FakeProcess(), clock)
    clock.time += 5.0
    state.take(REPORT, None)
    assert state.status().unlinked == (ZenohUnlinkedStatus(7449, 5.0),)
    full = RouterReport("02", REPORT.routers[0].sessions, most_sessions=1)
    state.take(Report((REPORT.routers[0], full, HUB)), None)
    assert not state.status().unlinked
    link = session("02", "router", "127.0.0.1:50004", "127.0.0.1:7449")
    linked = replace(HUB, sessions=(*HUB.sessions, link))
    state.take(Report((*REPORT.routers[:2], linked)), None)
    assert not state.status().unlinked


def sites_state(process: FakeProcess, protocol: str = "tls") -> ZenohState:
    options = {
        "ros": ("zenoh",),
        "zenoh_ports": "7448-7448",
        "zenoh_link": (f"{protocol}/cloud.example",),
        "zenoh_link_listen": f"{protocol}/7449",
        "zenoh_limit": ("/camera/*=2",),
        **certificates.options(Path("/c")),
    }
    file = ZenohCertificateStatus("/c/tls.crt", ends_in=5.0)
    state = ZenohState(parse_settings(options), process, lambda: 10.0, lambda: (file,))
    state.links[0].addresses = ("192.0.2.9",)
    return state


def site_report(protocol: str, remote: str, *locators: str) -> Report:
    """A router for containers, the router of links, and the hub."""
    link = SessionConnection(f"{protocol}/172.18.0.2:50000", f"{protocol}/{remote}")
    to_hub = RouterSession("03", "router", (SessionConnection("unixsock-stream/a", "b"),))
    links = RouterReport("02", (RouterSession("09", "router", (link,)), to_hub), locators)
    return Report((RouterReport("01"), links, RouterReport("03")))


@pytest.mark.parametrize(
    ("protocol", "remote"), [("tls", "192.0.2.9:7447"), ("quic", "cloud.example:7447")]
)
def test_a_link_to_another_site_is_a_session_of_its_router(protocol: str, remote: str) -> None:
    state = sites_state(FakeProcess(), protocol)
    assert not state.is_up(state.links[0])
    state.take(site_report(protocol, remote, f"{protocol}/172.18.0.2:7449"), None)
    assert state.is_up(state.links[0])
    status = state.status()
    (link,) = status.links
    assert link.title == f"{protocol}/cloud.example:7447"
    assert [(session.port, session.link) for session in status.sessions] == [(None, True)]
    assert (status.link_listen, status.link_listens) == (f"{protocol}/7449", True)
    assert status.limits == ("/camera/*=2Hz",)
    assert [file.file for file in status.certificates] == ["/c/tls.crt"]
    shown = "\n".join(metrics_of(state))
    assert f'rosproxy_zenoh_link_up{{peer="{protocol}/cloud.example:7447"}}' in shown
    assert 'rosproxy_zenoh_certificate_expiry_seconds{file="/c/tls.crt"}' in shown


def test_a_session_of_the_hub_is_no_link_to_another_site() -> None:
    """`--zenoh-peer` and `--zenoh-link` may name the same host and port."""
    state = sites_state(FakeProcess())
    at_hub = SessionConnection("tcp/172.18.0.2:50000", "tcp/192.0.2.9:7447")
    hub = RouterReport("03", (RouterSession("09", "router", (at_hub,)),))
    state.take(Report((RouterReport("01"), RouterReport("02"), hub)), None)
    assert not state.is_up(state.links[0])
    assert [session.link for session in state.status().sessions] == [False]


def test_a_port_for_other_sites_may_fail_to_open() -> None:
    state = sites_state(FakeProcess())
    assert state.status().link_listens, "nothing is known before a report"
    state.take(site_report("tls", "192.0.2.9:7447", "unixsock-stream/x"), None)
    assert not state.status().link_listens


def test_peers_of_a_router_outside_that_are_apart_have_a_time_and_nodes() -> None:
    clock = Clock()
    state = make_state(FakeProcess(), clock)
    answer = RouterReport(
        "04",
        (
            session("c1", "peer", "127.0.0.1:7447", "127.0.0.1:50004"),
            session("bb", "peer", "192.0.2.7:7447", "192.0.2.10:50005"),
            session("03", "router", "192.0.2.7:7447", "192.0.2.10:50003"),
        ),
    )
    told = replace(REPORT, outside=(answer, RouterReport("bb")))
    state.take(told, None)
    clock.time += 20.0
    state.take(told, None)
    apart = ZenohApartStatus("192.0.2.7:7447", "192.0.2.10", ("/robot",), True, 20.0)
    assert state.status().apart == (apart,)
    state.take(REPORT, None)
    assert state.status().apart == ()
