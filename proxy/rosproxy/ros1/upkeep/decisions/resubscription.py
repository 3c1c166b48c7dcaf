"""Find the subscribers that lack a connection to a publisher behind the proxy.

roscpp does not try again after a connection that was refused at once
(transport_publisher_link.cpp, onRetryTimer), nor after a requestTopic without an answer
(subscription.cpp, pendingConnectionDone). rospy does not try again at all. Such a subscriber
receives nothing until its list of publishers changes.

No node tells which connections are missing. So the proxy begins with all subscriptions at the
master, and removes the subscriptions that have a connection: a relay of the proxy, UDPROS, the
kernel, or a direct connection without the proxy.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from ipaddress import ip_address
from typing import Any

import msgspec

from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.registry.endpoint import Endpoint, Registration
from rosproxy.ros1.rewriting.addressing import Addressing

TopicConnection = tuple[int, str, str]
"""A connection through the proxy: its port, the topic and the subscriber's name."""
BusRow = tuple[str, str, str]
"""A connection that a publisher names: the topic, the subscriber's name and the transport."""
Addresses = Mapping[str, Collection[str]]
"""The addresses of the hosts of nodes, by node name."""


class TopicSubscription(msgspec.Struct, frozen=True):
    """A node's subscription to a topic that an endpoint's node publishes."""

    endpoint: Endpoint
    topic: str
    caller_id: str


def subscriptions(
    registrations_by_node: Iterable[tuple[str, Sequence[Registration]]],
    endpoints: Iterable[Endpoint],
    addressing: Addressing,
) -> Iterator[list[TopicSubscription]]:
    """Subscriptions to topics of some endpoints, without the subscriptions of neighbours.

    ``registrations_by_node`` has registrations of the master. A neighbour reaches the publisher by
    the publisher's own URI. The function leaves neighbours out early, for speed: a thousand nodes
    that all subscribe to each other make a million pairs. The subscriptions come in small pieces,
    some of them empty, so that the caller can do other work in between.
    """
    topics: dict[str, dict[frozenset[int], list[Endpoint]]] = {}
    for endpoint in endpoints:
        location = endpoint.location
        uses_own_uri = location.named and not location.stale
        networks = _networks_of(location.address, addressing) if uses_own_uri else frozenset()
        for topic in dict.fromkeys(endpoint.names_at_master(Kind.PUBLISHER)):
            topics.setdefault(topic, {}).setdefault(networks, []).append(endpoint)
            yield []
    for node, registrations in registrations_by_node:
        subscriber = addressing.registry.by_caller.get(node)
        local = _networks_of(subscriber.location.address, addressing) if subscriber else frozenset()
        for registration in registrations:
            groups = (
                topics.get(registration.name, {}) if registration.kind is Kind.SUBSCRIBER else {}
            )
            yield [
                TopicSubscription(endpoint, registration.name, node)
                for networks, group in groups.items()
                if not networks & local
                for endpoint in group
                if endpoint is not subscriber
            ]


def without_relay(
    candidates: Iterable[TopicSubscription], relays: Collection[TopicConnection]
) -> list[TopicSubscription]:
    """The subscriptions without a relay."""
    return [s for s in candidates if (s.endpoint.port, s.topic, s.caller_id) not in relays]


def read_bus(rows: Any) -> list[BusRow]:
    """The connections to subscribers, from the value of a publisher's getBusInfo.

    A row is ``[id, subscriber's name, "o", transport, topic, …]``. Other rows are left out.
    """
    connections: list[BusRow] = []
    for row in rows if isinstance(rows, list) else ():
        match row:
            case [_, str(caller_id), "o", str(transport), str(topic), *_]:
                connections.append((topic, caller_id, transport))
    return connections


def unconnected(
    unrelayed: Iterable[TopicSubscription],
    bus_rows: Mapping[Endpoint, Sequence[BusRow]],
    addresses: Addresses,
) -> list[TopicSubscription]:
    """The subscriptions without a relay that have no other connection either.

    The publisher's rows count for UDPROS, but not for TCPROS: a publisher still lists connections
    whose other end has vanished. The proxy knows connections in the kernel only by host.
    """
    remaining: dict[Endpoint, list[TopicSubscription]] = {}
    row_sets = {endpoint: frozenset(rows) for endpoint, rows in bus_rows.items()}
    for sub in unrelayed:
        if (sub.topic, sub.caller_id, "UDPROS") not in row_sets.get(sub.endpoint, ()):
            remaining.setdefault(sub.endpoint, []).append(sub)
    return [
        s
        for endpoint, group in remaining.items()
        for s in _not_forwarded(endpoint, group, bus_rows.get(endpoint, ()), addresses)
    ]


def _networks_of(address: str, addressing: Addressing) -> frozenset[int]:
    """The indices of the inside networks that contain an address."""
    ip = ip_address(address)
    return frozenset(i for i, network in enumerate(addressing.networks) if ip in network)


def _not_forwarded(
    endpoint: Endpoint, group: list[TopicSubscription], rows: Sequence[BusRow], addresses: Addresses
) -> list[TopicSubscription]:
    """The subscriptions to an endpoint that its connections in the kernel do not serve.

    If no connection comes from the host of a subscriber, NAT or Docker's port proxy hides the
    addresses. The function then counts all connections together.
    """
    if not endpoint.fast_peers:
        return group
    groups: dict[frozenset[str], list[TopicSubscription]] = {}
    for sub in group:
        groups.setdefault(frozenset(addresses.get(sub.caller_id, ())), []).append(sub)
    if not any(host & endpoint.fast_peers.keys() for host in groups):
        return _unserved(endpoint.fast_connections, group, rows)
    return [
        s
        for host, of_host in groups.items()
        for s in _unserved(sum(endpoint.fast_peers.get(a, 0) for a in host), of_host, rows)
    ]


def _unserved(
    connections: int, group: list[TopicSubscription], rows: Sequence[BusRow]
) -> list[TopicSubscription]:
    """The subscriptions of a group that no connection in the kernel serves.

    ``connections`` is the number of the group's connections there. The publisher's rows contain all
    open connections. If the rows do not tell enough subscriptions apart, the whole group counts as
    unserved. A subscriber that was told in vain makes a new connection, and the next look counts
    this connection.
    """
    if connections >= len(group):
        return []
    connected = {row[:2] for row in rows}
    unknown = [s for s in group if (s.topic, s.caller_id) not in connected]
    return unknown if len(unknown) >= len(group) - connections else group
