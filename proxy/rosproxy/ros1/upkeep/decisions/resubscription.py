"""Which subscribers have no connection to a publisher behind the proxy, though they should.

roscpp never tries again after a connection that was refused at once
(transport_publisher_link.cpp, onRetryTimer), nor after a requestTopic that got no answer
(subscription.cpp, pendingConnectionDone); rospy does not try again at all. Such a subscriber hears
nothing until its list of publishers changes.

Nobody can be asked for the connections that are missing, so they are what is left of all
subscriptions at the master, once those are taken off that are served: by a relay of the proxy, by
UDPROS, by the kernel, or directly, without the proxy.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from ipaddress import ip_address
from typing import Any

import msgspec

from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.registry.endpoint import Endpoint, Registration
from rosproxy.ros1.rewriting.addressing import Addressing

TopicConnection = tuple[int, str, str]
"""A connection through the proxy: its port, the topic and the subscriber's name."""
BusRow = tuple[str, str, str]
"""One of a publisher's own connections: the topic, the subscriber's name and the transport."""
Addresses = Mapping[str, Collection[str]]
"""Nodes' names with the addresses of their hosts."""


class TopicSubscription(msgspec.Struct, frozen=True):
    """A node's subscription to a topic that an endpoint's node publishes."""

    endpoint: Endpoint
    topic: str
    caller_id: str


def subscriptions(
    registrations_by_node: Mapping[str, Sequence[Registration]],
    endpoints: Iterable[Endpoint],
    addressing: Addressing,
) -> list[TopicSubscription]:
    """Subscriptions to what the nodes of some endpoints publish, but not those of neighbours.

    ``registrations_by_node`` is what the master has. A neighbour that reaches a publisher by its
    own URI is left out early: a thousand nodes that all hear each other are a million pairs.
    """
    topics: dict[str, dict[frozenset[int], list[Endpoint]]] = {}
    for endpoint in endpoints:
        location = endpoint.location
        uses_own_uri = location.named and not location.stale
        networks = _networks_of(location.address, addressing) if uses_own_uri else frozenset()
        for topic in dict.fromkeys(endpoint.names_at_master(Kind.PUBLISHER)):
            topics.setdefault(topic, {}).setdefault(networks, []).append(endpoint)
    distant: list[TopicSubscription] = []
    for node, registrations in registrations_by_node.items():
        subscriber = addressing.registry.by_caller.get(node)
        local = _networks_of(subscriber.location.address, addressing) if subscriber else frozenset()
        for registration in registrations:
            groups = (
                topics.get(registration.name, {}) if registration.kind is Kind.SUBSCRIBER else {}
            )
            distant += [
                TopicSubscription(endpoint, registration.name, node)
                for networks, group in groups.items()
                if not networks & local
                for endpoint in group
                if endpoint is not subscriber
            ]
    return distant


def without_relay(
    candidates: Iterable[TopicSubscription], relays: Collection[TopicConnection]
) -> list[TopicSubscription]:
    """Those that no relay serves."""
    return [s for s in candidates if (s.endpoint.port, s.topic, s.caller_id) not in relays]


def read_bus(rows: Any) -> list[BusRow]:
    """The connections to subscribers in the value of a publisher's getBusInfo.

    Rows: ``[id, subscriber's name, "o", transport, topic, …]``; others are left out.
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
    """Those of the subscriptions without relay that no other way serves either.

    For UDPROS the publisher's rows count. For TCPROS they don't: it takes connections for open
    whose other end has vanished. What the kernel forwards is known by hosts alone.
    """
    remaining: dict[Endpoint, list[TopicSubscription]] = {}
    for sub in unrelayed:
        if (sub.topic, sub.caller_id, "UDPROS") not in bus_rows.get(sub.endpoint, ()):
            remaining.setdefault(sub.endpoint, []).append(sub)
    return [
        s
        for endpoint, group in remaining.items()
        for s in _not_forwarded(endpoint, group, bus_rows.get(endpoint, ()), addresses)
    ]


def _networks_of(address: str, addressing: Addressing) -> frozenset[int]:
    """Which of the inside networks an address is in."""
    ip = ip_address(address)
    return frozenset(i for i, network in enumerate(addressing.networks) if ip in network)


def _not_forwarded(
    endpoint: Endpoint, group: list[TopicSubscription], rows: Sequence[BusRow], addresses: Addresses
) -> list[TopicSubscription]:
    """Those of an endpoint's subscriptions that its connections in the kernel don't account for.

    Where none comes from a host of theirs, something on the way hides addresses (NAT, Docker's
    own proxy): they are then counted together.
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
    """The subscriptions that none of a number of connections serves.

    The publisher's rows have all that are open. If they don't tell enough subscriptions apart, all
    count: one that was told in vain has made a new connection, which counts for the others.
    """
    if connections >= len(group):
        return []
    connected = {row[:2] for row in rows}
    unknown = [s for s in group if (s.topic, s.caller_id) not in connected]
    return unknown if len(unknown) >= len(group) - connections else group
