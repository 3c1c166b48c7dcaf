"""Decisions: connections that the kernel forwards, and reasons against it."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.forwarding.kernel.decisions import (
    LONGEST_PAUSE_S,
    HostForwarding,
    Pauses,
    changes,
    destination,
    forwards_to_keep,
    unchanged_forwards,
)
from rosproxy.ros1.registry.endpoint import Endpoint, NodeLocation
from rosproxy.ros1.registry.node_health import ProbeResult
from rosproxy.shared.addresses import HostPort, Route

NODE = "10.0.0.5"
ROUTE = Route("10.0.0.2", 1500)
THERE = HostPort(NODE, 50000)
THERE_SIX = HostPort("fd00::5", 50000)


def an_endpoint(address: str = NODE, **changed: Any) -> Endpoint:
    node = HostPort(address, 40001)
    made = Endpoint(f"http://{node}/", node, NodeLocation(address, True), 45000)
    made.topic_ports = {"/a": 50000}
    for name, value in changed.items():
        setattr(made, name, value)
    return made


BOTH = HostForwarding()


@pytest.mark.parametrize(
    "named",
    [{}, {"topic_ports": {"/a": 50000, "/b": 50000}}],
)
def test_a_node_that_named_its_port_is_forwarded_to(named: dict[str, Any]) -> None:
    assert destination(an_endpoint(**named), BOTH, ROUTE, True) == THERE
    assert destination(an_endpoint("fd00::5", **named), BOTH, ROUTE, True) == THERE_SIX


@pytest.mark.parametrize(
    ("endpoint", "world", "why"),
    [
        (an_endpoint(trusted=False), BOTH, "does not answer"),
        (an_endpoint(topic_ports={}), BOTH, "no subscriber has asked"),
        (an_endpoint(topic_ports={"/a": 1, "/b": 2}), BOTH, "several TCPROS ports"),
        (an_endpoint("127.0.0.1"), BOTH, "namespace of the proxy itself"),
        (an_endpoint(), HostForwarding(ipv4=False), "net.ipv4.ip_forward"),
        (an_endpoint("fd00::5"), HostForwarding(ipv6=False), "net.ipv6.conf.all.forwarding"),
    ],
)
def test_what_keeps_a_node_in_user_space(
    endpoint: Endpoint, world: HostForwarding, why: str
) -> None:
    said = destination(endpoint, world, ROUTE, True)
    assert isinstance(said, str)
    assert why in said


@pytest.mark.parametrize(
    ("route", "why"),
    [
        (Route(NODE, 65_536), "namespace of the proxy itself"),
        (Route("127.0.0.1", 65_536), "no route to 10.0.0.5: add the proxy"),
    ],
)
def test_what_the_route_to_a_node_tells(route: Route, why: str) -> None:
    said = destination(an_endpoint(), BOTH, route, True)
    assert isinstance(said, str)
    assert why in said


@pytest.mark.parametrize(("mtu", "has_connections"), [(1500, False), (9000, False), (1400, True)])
def test_datagrams_are_forwarded_where_the_way_inside_takes_them(
    mtu: int, has_connections: bool
) -> None:
    host = HostForwarding(longest_packet=1500)
    assert destination(an_endpoint(), host, Route("10.0.0.2", mtu), has_connections) == THERE


def test_datagrams_stay_in_user_space_where_the_way_inside_takes_shorter_ones() -> None:
    host = HostForwarding(longest_packet=1500)
    said = destination(an_endpoint(), host, Route("10.0.0.2", 1400), False)
    assert isinstance(said, str)
    assert "takes packets of at most 1400 bytes, and packets of 1500 bytes may arrive" in said


def test_a_node_that_is_down_stays_in_user_space() -> None:
    endpoint = an_endpoint()
    for _ in range(2):
        assert destination(endpoint, BOTH, ROUTE, True) == THERE
        endpoint.health.note(ProbeResult.REFUSED, 1.0)
    assert destination(endpoint, BOTH, ROUTE, True) == "the node does not answer"


PORTS = st.integers(1, 9)
FORWARDS = st.dictionaries(PORTS, st.builds(HostPort, st.sampled_from(["10.0.0.1", "::5"]), PORTS))


@given(FORWARDS, FORWARDS)
def test_changes_lead_from_what_there_is_to_what_is_wanted(
    now: dict[int, HostPort], wanted: dict[int, HostPort]
) -> None:
    change = changes(now, wanted)
    after = {port: target for port, target in now.items() if port not in change.removed}
    assert not set(after) & set(change.added)
    assert {**after, **change.added} == wanted
    assert all(now[port] == target for port, target in change.removed.items())
    assert bool(change) == (now != wanted)


@given(FORWARDS)
def test_everything_is_kept_until_the_registry_is_rebuilt(now: dict[int, HostPort]) -> None:
    assert forwards_to_keep(now, [], recovered=False) == now
    assert forwards_to_keep(now, [], recovered=True) == {}


def test_what_leads_to_a_node_that_was_not_heard_yet_is_kept() -> None:
    waiting = an_endpoint(fast_port=45050, trusted=False)
    now = {45050: THERE, 45051: THERE}
    assert forwards_to_keep(now, [waiting], recovered=True) == {45050: THERE}
    elsewhere = {45050: HostPort("10.0.0.6", 50000)}
    assert forwards_to_keep(elsewhere, [waiting], recovered=True) == {}
    waiting.trusted = True
    assert forwards_to_keep(now, [waiting], recovered=True) == {}


def test_what_did_not_change_stays() -> None:
    holders = [an_endpoint(fast_port=45050 + number) for number in range(3)]
    now = dict.fromkeys(range(45050, 45055), THERE)
    owners = {endpoint.fast_port or 0: endpoint for endpoint in holders} | {45053: holders[0]}
    assert unchanged_forwards(now, owners, []) == dict.fromkeys(range(45050, 45053), THERE)
    assert unchanged_forwards(now, owners, {holders[1]}) == {45050: THERE, 45052: THERE}


def test_a_forward_without_answer_is_not_made_for_longer_each_time() -> None:
    pauses = Pauses()
    now = 0.0
    lasted = []
    assert pauses.reason(45050, THERE, now) is None
    for _ in range(12):
        pauses.note(45050, THERE, "no answer", now)
        start = now
        while pauses.reason(45050, THERE, now):
            now += 2.5
        lasted.append(now - start)
    assert lasted[:3] == [5.0, 10.0, 20.0]
    assert lasted[-2:] == [LONGEST_PAUSE_S] * 2
    assert pauses.reason(45050, HostPort(NODE, 50001), now) is None


def test_pauses_of_ports_that_nobody_has_are_forgotten() -> None:
    pauses = Pauses()
    for port in (45050, 45051):
        pauses.note(port, THERE, "no answer", 0.0)
    pauses.keep({45051})
    assert pauses.reason(45050, THERE, 1.0) is None
    assert pauses.reason(45051, THERE, 1.0) == "no answer"
