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
    held: Mapping[str, Sequence[Registration]],
    endpoints: Iterable[Endpoint],
    addressing: Addressing,
) -> list[TopicSubscription]:
    """Subscriptions to what the nodes of some endpoints publish, but not those of neighbours.

    ``held`` is what each node has registered at the master. A neighbour that reaches a publisher
    by its own URI is left out early: a thousand nodes that all hear each other are a million pairs.
    """
    publishers: dict[str, dict[frozenset[int], list[Endpoint]]] = {}
    for endpoint in endpoints:
        location = endpoint.location
        literal = location.named and not location.stale
        joint = _networks_of(location.address, addressing) if literal else frozenset()
        for topic in dict.fromkeys(endpoint.shown(Kind.PUBLISHER)):
            publishers.setdefault(topic, {}).setdefault(joint, []).append(endpoint)
    found: list[TopicSubscription] = []
    for node, registrations in held.items():
        itself = addressing.registry.by_caller.get(node)
        near = _networks_of(itself.location.address, addressing) if itself else frozenset()
        for one in registrations:
            groups = publishers.get(one.name, {}) if one.kind is Kind.SUBSCRIBER else {}
            found += [
                TopicSubscription(endpoint, one.name, node)
                for joint, group in groups.items()
                if not joint & near
                for endpoint in group
                if endpoint is not itself
            ]
    return found


def without_relay(
    wanted: Iterable[TopicSubscription], relays: Collection[TopicConnection]
) -> list[TopicSubscription]:
    """Those that no relay serves."""
    return [one for one in wanted if (one.endpoint.port, one.topic, one.caller_id) not in relays]


def read_bus(rows: Any) -> list[BusRow]:
    """The connections to subscribers in the value of a publisher's getBusInfo.

    Rows: ``[id, subscriber's name, "o", transport, topic, …]``; others are left out.
    """
    found: list[BusRow] = []
    for row in rows if isinstance(rows, list) else ():
        match row:
            case [_, str(caller_id), "o", str(transport), str(topic), *_]:
                found.append((topic, caller_id, transport))
    return found


def unconnected(
    left: Iterable[TopicSubscription],
    bus: Mapping[Endpoint, Sequence[BusRow]],
    addresses: Addresses,
) -> list[TopicSubscription]:
    """Those of the subscriptions without relay that no other way serves either.

    UDPROS is known by the publisher's own word. It is not asked for TCPROS: it takes connections
    for open whose other end has vanished. What the kernel forwards is known by hosts alone.
    """
    rest: dict[Endpoint, list[TopicSubscription]] = {}
    for one in left:
        if (one.topic, one.caller_id, "UDPROS") not in bus.get(one.endpoint, ()):
            rest.setdefault(one.endpoint, []).append(one)
    return [
        one
        for endpoint, group in rest.items()
        for one in _not_forwarded(endpoint, group, bus.get(endpoint, ()), addresses)
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
    hosts: dict[frozenset[str], list[TopicSubscription]] = {}
    for one in group:
        hosts.setdefault(frozenset(addresses.get(one.caller_id, ())), []).append(one)
    if not any(host & endpoint.fast_peers.keys() for host in hosts):
        return _short_of(endpoint.fast_connections, group, rows)
    return [
        one
        for host, mine in hosts.items()
        for one in _short_of(sum(endpoint.fast_peers.get(a, 0) for a in host), mine, rows)
    ]


def _short_of(
    connections: int, group: list[TopicSubscription], rows: Sequence[BusRow]
) -> list[TopicSubscription]:
    """Which of some subscriptions have none of as many connections as there are.

    The publisher has all that are open among its own. If that does not tell enough of them apart,
    all count: one that was told in vain has made a new connection, which counts for the others.
    """
    if connections >= len(group):
        return []
    named = {row[:2] for row in rows}
    unknown = [one for one in group if (one.topic, one.caller_id) not in named]
    return unknown if len(unknown) >= len(group) - connections else group
