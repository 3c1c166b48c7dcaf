"""Subscribers without a connection to a publisher inside, by relay, UDPROS or forwarding."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import pytest

from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.registry.endpoint import Endpoint, Registration
from rosproxy.ros1.rewriting.addressing import Addressing
from rosproxy.ros1.upkeep.decisions import resubscription as decisions
from rosproxy.ros1.upkeep.decisions.resubscription import BusRow, TopicSubscription
from tests.unit.builders import add_node, add_registration, make_addressing

PUB = Kind.PUBLISHER
SUB = Kind.SUBSCRIBER
SRV = Kind.SERVICE
LAPTOP = "192.168.1.77"
ROBOT = "192.168.1.5"
ELSEWHERE = "172.17.0.1"
HOSTS = {"/a": [LAPTOP], "/b": [LAPTOP], "/c": [ROBOT], "/d": []}


def publisher(*topics: str) -> Endpoint:
    addressing = make_addressing()
    endpoint = add_node(addressing)
    for topic in topics:
        add_registration(addressing, endpoint, PUB, topic)
    return endpoint


def subscribed(endpoint: Endpoint, *names: str, topic: str = "/t") -> list[TopicSubscription]:
    return [TopicSubscription(endpoint, topic, name) for name in names]


def found(
    registrations: Mapping[str, Sequence[Registration]],
    endpoints: Iterable[Endpoint],
    addressing: Addressing,
) -> list[TopicSubscription]:
    pieces = decisions.subscriptions(registrations.items(), endpoints, addressing)
    return [subscription for piece in pieces for subscription in piece]


def names(subscriptions: Iterable[TopicSubscription]) -> list[str]:
    return [subscription.caller_id for subscription in subscriptions]


def test_subscriptions_are_those_to_topics_that_the_endpoints_publish() -> None:
    addressing = make_addressing()
    first = add_node(addressing)
    second = add_node(addressing, "http://10.0.0.6:40001/")
    add_registration(addressing, first, PUB, "/t")
    add_registration(addressing, first, SUB, "/in")
    for topic in ("/t", "/u"):
        add_registration(addressing, second, PUB, topic, "/other")
    registrations = {
        "/a": [Registration(SUB, "/t", "/a"), Registration(SUB, "/in", "/a")],
        "/b": [Registration(PUB, "/t", "/b"), Registration(SUB, "/u", "/b")],
        "/c": [Registration(SRV, "/t", "/c")],
    }
    assert found(registrations, [first, second], addressing) == [
        TopicSubscription(first, "/t", "/a"),
        TopicSubscription(second, "/t", "/a"),
        TopicSubscription(second, "/u", "/b"),
    ]
    assert found(registrations, [first], addressing) == [TopicSubscription(first, "/t", "/a")]
    assert found({}, [first], addressing) == []


def test_subscriptions_come_in_pieces_of_a_registration() -> None:
    addressing = make_addressing()
    endpoints = [add_node(addressing, f"http://10.0.0.6:{4000 + n}/") for n in range(3)]
    for number, endpoint in enumerate(endpoints):
        for topic in range(10):
            add_registration(addressing, endpoint, PUB, f"/t{topic}", f"/publisher{number}")
    registrations = [("/a", [Registration(SUB, f"/t{topic}", "/a") for topic in range(10)])]
    pieces = [len(p) for p in decisions.subscriptions(registrations, endpoints, addressing)]
    assert pieces == [0] * 30 + [3] * 10


def test_two_publishers_of_a_topic_in_one_process_are_one() -> None:
    addressing = make_addressing()
    endpoint = add_node(addressing)
    for name in ("/one", "/two"):
        add_registration(addressing, endpoint, PUB, "/t", name)
    registrations = {"/a": [Registration(SUB, "/t", "/a")]}
    assert found(registrations, [endpoint], addressing) == [TopicSubscription(endpoint, "/t", "/a")]


@pytest.mark.parametrize(
    ("address", "options", "count"),
    [
        ("10.0.0.6", {}, 0),
        ("10.0.0.6", {"named": False}, 1),  # no host name that neighbours can resolve
        ("10.0.1.6", {}, 1),  # in another network
        ("172.20.0.7", {}, 1),  # in none
    ],
)
def test_neighbours_that_reach_a_publisher_by_its_own_uri_are_left_out(
    address: str, options: dict[str, Any], count: int
) -> None:
    addressing = make_addressing(networks=("10.0.0.0/24", "10.0.1.0/24"))
    speaker = add_node(addressing, f"http://{address}:40001/", address, **{"named": True} | options)
    add_registration(addressing, speaker, PUB, "/t", "/speaker")
    add_registration(addressing, speaker, SUB, "/t", "/speaker")
    listener = add_node(addressing)
    registrations = {
        "/listener": [add_registration(addressing, listener, SUB, "/t", "/listener")],
        "/speaker": [Registration(SUB, "/t", "/speaker")],
    }
    subscriptions = found(registrations, [speaker], addressing)
    assert subscriptions == subscribed(speaker, "/listener")[:count]


@pytest.mark.parametrize(
    ("relay", "left"),
    [
        ((45000, "/t", "/a"), ["/b"]),
        ((45001, "/t", "/a"), ["/a", "/b"]),  # another publisher of that topic
        ((45000, "/u", "/a"), ["/a", "/b"]),
        ((45000, "/t", "/c"), ["/a", "/b"]),
    ],
)
def test_a_relay_serves_one_subscriber_of_one_topic_of_one_publisher(
    relay: decisions.TopicConnection, left: list[str]
) -> None:
    wanted = subscribed(publisher("/t"), "/a", "/b")
    assert names(decisions.without_relay(wanted, {relay})) == left


ROWS = [
    ([0, "/a", "o", "TCPROS", "/t", True, "text"], ("/t", "/a", "TCPROS")),
    ([7, "/a", "o", "UDPROS", "/t", 1], ("/t", "/a", "UDPROS")),
    ([1, "/a", "o", "INTRAPROCESS", "/t"], ("/t", "/a", "INTRAPROCESS")),
    ([1, "http://laptop:5/", "i", "TCPROS", "/t"], None),
    ([1, 2, "o", "TCPROS", "/t"], None),
    ([1, "/a", "o"], None),
    ("row", None),
    (None, None),
]


@pytest.mark.parametrize(("row", "expected"), ROWS)
def test_a_row_of_bus_info_is_read(row: Any, expected: BusRow | None) -> None:
    assert decisions.read_bus([row]) == ([expected] if expected else [])


@pytest.mark.parametrize("value", [None, 0, "text", {}, []])
def test_bus_info_of_another_form_tells_nothing(value: Any) -> None:
    assert decisions.read_bus(value) == []


def test_a_subscriber_by_udpros_is_not_silent_and_one_by_tcpros_may_be() -> None:
    endpoint = publisher("/t")
    bus = {endpoint: [("/t", "/a", "UDPROS"), ("/t", "/b", "TCPROS")]}
    assert names(decisions.unconnected(subscribed(endpoint, "/a", "/b"), bus, HOSTS)) == ["/b"]
    assert names(decisions.unconnected(subscribed(endpoint, "/a", topic="/u"), bus, HOSTS)) == [
        "/a"
    ]
    assert names(decisions.unconnected(subscribed(endpoint, "/a"), {}, HOSTS)) == ["/a"]


FORWARDED = [
    # forwarded connections by peer; subscribers that the publisher names; silent subscribers
    ({}, [], ["/a", "/b", "/c"]),
    ({LAPTOP: 2}, [], ["/c"]),
    ({LAPTOP: 3}, [], ["/c"]),  # the kernel still tracks an old connection
    ({LAPTOP: 2, ROBOT: 1}, [], []),
    ({ROBOT: 1}, [], ["/a", "/b"]),
    ({LAPTOP: 1, ROBOT: 1}, [], ["/a", "/b"]),  # not known which subscriber is connected
    ({LAPTOP: 1, ROBOT: 1}, ["/a"], ["/b"]),
    ({LAPTOP: 1, ROBOT: 1}, ["/a", "/b"], ["/a", "/b"]),  # a subscriber has vanished
    ({ELSEWHERE: 3}, [], []),  # the peers' addresses are hidden
    ({ELSEWHERE: 2}, ["/a", "/c"], ["/b"]),
    ({ELSEWHERE: 2}, [], ["/a", "/b", "/c"]),
    ({LAPTOP: 2, ELSEWHERE: 1}, [], ["/c"]),
]


@pytest.mark.parametrize(("peers", "named", "silent"), FORWARDED)
def test_a_host_with_as_many_connections_in_the_kernel_as_subscriptions_has_no_silent_one(
    peers: dict[str, int], named: list[str], silent: list[str]
) -> None:
    endpoint = publisher("/t")
    endpoint.fast_peers = peers
    bus = {endpoint: [("/t", name, "TCPROS") for name in named]}
    left = subscribed(endpoint, "/a", "/b", "/c")
    assert names(decisions.unconnected(left, bus, HOSTS)) == silent


def test_connections_in_the_kernel_count_for_their_own_endpoint() -> None:
    addressing = make_addressing()
    first = add_node(addressing)
    second = add_node(addressing, "http://10.0.0.6:40001/")
    first.fast_peers = {LAPTOP: 5}
    left = [*subscribed(first, "/a"), *subscribed(second, "/a")]
    assert decisions.unconnected(left, {}, HOSTS) == subscribed(second, "/a")


def test_a_host_that_is_not_found_has_no_connections() -> None:
    endpoint = publisher("/t")
    endpoint.fast_peers = {LAPTOP: 2}
    assert names(decisions.unconnected(subscribed(endpoint, "/a", "/d"), {}, HOSTS)) == ["/d"]


def test_a_udpros_subscriber_needs_no_connection_in_the_kernel() -> None:
    endpoint = publisher("/t")
    endpoint.fast_peers = {LAPTOP: 1}
    bus = {endpoint: [("/t", "/a", "UDPROS")]}
    assert decisions.unconnected(subscribed(endpoint, "/a", "/b"), bus, HOSTS) == []
