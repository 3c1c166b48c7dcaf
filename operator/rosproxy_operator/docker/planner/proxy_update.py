"""Decide what the operator tells a proxy about the containers on the proxy's networks.

`network_facts` takes from a look what a single proxy needs. `ProxyUpdate` compares the facts with
earlier facts and with the nodes of the proxy, and decides what to tell next, and when. If the proxy
does not answer, arrivals stay due until the proxy answers, and moves for `MOVE_REPEATED_FOR_S`
seconds. Times are seconds of a monotonic clock.
"""

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from ipaddress import IPv4Network
from typing import Any

from rosproxy.shared.addresses import is_address, is_inside, is_loopback
from rosproxy.shared.policy.layers import PolicyLayer
from rosproxy_operator.docker.planner.label_policy import RecentLayers, label_layers
from rosproxy_operator.docker.planner.model import (
    STARTED,
    Attachment,
    Container,
    HostState,
    Member,
    Proxy,
)
from rosproxy_operator.docker.planner.network_owner import ByReference, by_reference, network_owner
from rosproxy_operator.docker.planner.redirect import redirect_record_name
from rosproxy_operator.proxy_spec.place import ZENOH, Master

ARRIVAL_MESSAGE_TIMES_S = (0.0, 1.0, 3.0, 10.0)
"""Seconds after a container's arrival at which the operator tells the proxy of the arrival.

The operator repeats the message, because nodes need time to register.
"""
MOVE_MESSAGE_INTERVAL_S = 1.0
"""Seconds between two messages about a move: the new address may not be reachable at once."""
ADDRESS_GONE_AFTER_S = 2.0
"""Seconds for which a running container may be off a network before the address counts as gone."""
MOVE_REPEATED_FOR_S = 5.0
"""Seconds for which the operator tells a proxy of a move, unless the proxy has found the nodes."""
ContainerNetwork = tuple[str, str]
"""The id of a container, and the name of a network."""
_HOST_NAME = re.compile(r"[\w.-]{1,253}", re.ASCII)
"""The host names that a URI of a node can have. The engine allows any text as an alias."""


@dataclass(frozen=True, slots=True)
class ContainerArrival:
    """A labelled container on a network of the proxy.

    ``endpoint`` changes with each start, so each start is a new arrival. ``redirect`` is the name
    of the redirect's record, or empty. A new redirect also is a new arrival: nodes may have
    registered at the real master before, so the proxy has to look for these nodes again.
    """

    container: str
    network: str
    address: str
    endpoint: str
    # Not compared: a later inspection may add aliases, and the arrival stays the same.
    names: frozenset[str] = field(compare=False)
    redirect: str = ""


@dataclass(frozen=True, slots=True)
class NetworkFacts:
    """The part of a look that concerns a single proxy.

    Attributes:
        master_address: The address of the master. Empty if unknown, if the URI of the master has
            an address already, and for ROS 2 and rmw_zenoh.
        addresses: The addresses of running containers on the proxy's networks.
        taken: The addresses of all containers and gateways.
        subnets: The subnets of the proxy's networks.
        arrivals: One arrival for each running member and network, including arrivals of which the
            operator has told the proxy already; none for ROS 2 and rmw_zenoh.
        running: The ids of all running containers.
        selected: The addresses of the proxy's containers on the proxy's networks. These addresses
            may use the proxy as their master.
        policy: All layers of the proxy's policy.
    """

    master_address: str = ""
    addresses: Mapping[ContainerNetwork, str] = field(default_factory=dict)
    taken: frozenset[str] = frozenset()
    subnets: tuple[IPv4Network, ...] = ()
    arrivals: frozenset[ContainerArrival] = frozenset()
    running: frozenset[str] = frozenset()
    selected: frozenset[str] = frozenset()
    policy: tuple[PolicyLayer, ...] = ()


class AddressHistory:
    """The addresses of containers, and the addresses that containers had a moment ago.

    If a running container leaves a network and joins again with another address, the container has
    moved. The nodes in the container keep running, and the proxy has to find them there.
    """

    def __init__(self) -> None:
        self._at: dict[ContainerNetwork, str] = {}
        self._absent: dict[ContainerNetwork, float] = {}
        self._moves: dict[str, tuple[str, float]] = {}

    def record(self, latest: NetworkFacts, now: float) -> None:
        """Record the latest facts. Compare them with the facts of the last call, and note moves."""
        missing = [pair for pair in self._at if pair not in latest.addresses]
        self._absent = {pair: self._absent.get(pair, now) for pair in missing}
        for pair, since in list(self._absent.items()):
            if pair[0] not in latest.running or now >= since + ADDRESS_GONE_AFTER_S:
                del self._at[pair], self._absent[pair]
        for pair, address in latest.addresses.items():
            previous = self._at.get(pair, address)
            if previous != address:
                self._moves[previous] = address, now
        self._follow(latest, now)
        self._at |= latest.addresses
        self._moves = {
            old: (new, since)
            for old, (new, since) in self._moves.items()
            if now < since + MOVE_REPEATED_FOR_S and old not in latest.addresses.values()
        }

    def _follow(self, latest: NetworkFacts, now: float) -> None:
        """Note a move if a container has left a network and is now on another network."""
        for container, network in list(self._absent):
            # A network that the container has just joined comes first (False sorts before True):
            # the container has probably moved there. Otherwise any network of the container counts.
            elsewhere = [
                ((container, other_network) in self._at, address)
                for (owner, other_network), address in latest.addresses.items()
                if owner == container
            ]
            if elsewhere:
                former = self._at.pop((container, network))
                self._moves[former] = min(elsewhere)[1], now
                del self._absent[container, network]

    @property
    def reserved_addresses(self) -> frozenset[str]:
        """The former addresses of containers that may come back, or that have moved."""
        return frozenset(self._at[pair] for pair in self._absent) | self._moves.keys()

    @property
    def next_expiry(self) -> float | None:
        """The time at which the first absence or move expires; None without absence and move."""
        times = [since + ADDRESS_GONE_AFTER_S for since in self._absent.values()]
        times += [since + MOVE_REPEATED_FOR_S for _, since in self._moves.values()]
        return min(times, default=None)

    def moved(self, addresses: Collection[str]) -> dict[str, str]:
        """The new address by old address, for each old address that a node of the proxy has.

        ``addresses`` are the addresses of the proxy's nodes.
        """
        return {old: new for old, (new, _) in self._moves.items() if old in addresses}


class ProxyUpdate:
    """The updates that the operator still has to send to a proxy, for a single run of the proxy.

    ``policy`` is the whole policy of the proxy, with layers of containers gone a short time ago.
    """

    def __init__(self) -> None:
        self.facts = NetworkFacts()
        self.policy: tuple[PolicyLayer, ...] = ()
        self._layers = RecentLayers()
        self._subnets: set[IPv4Network] = set()
        self._history = AddressHistory()
        self._due: dict[ContainerArrival, list[float]] = {}
        self._moving = False

    def record(self, latest: NetworkFacts, now: float) -> None:
        """Record the facts of a look."""
        self.facts = latest
        common = tuple(layer for layer in latest.policy if layer.addresses is None)
        own = (layer for layer in latest.policy if layer.addresses is not None)
        self.policy = (*common, *self._layers.record(own, latest.taken, now))
        self._subnets |= set(latest.subnets)
        self._due = {
            arrival: self._due.get(arrival, [now + after for after in ARRIVAL_MESSAGE_TIMES_S])
            for arrival in latest.arrivals
        }

    def body(self, addresses: Collection[str], now: float) -> dict[str, Any]:
        """Return the body of ``POST /containers`` for a proxy with nodes at these addresses.

        The body has the addresses that are ``gone``, that have ``moved``, and at which containers
        have ``arrived``. The body is empty if nothing is due. Each call also records the facts of
        the last look in the history of addresses, at the time ``now``.
        """
        self._history.record(self.facts, now)
        body = {
            "gone": sorted(address for address in addresses if self._is_gone(address)),
            "moved": self._history.moved(addresses),
            "arrived": [
                {"address": arrival.address, "names": sorted(arrival.names)}
                for arrival, times in sorted(self._due.items(), key=lambda item: item[0].address)
                if times and times[0] <= now
            ],
        }
        self._moving = bool(body["moved"])
        return {key: value for key, value in body.items() if value}

    def _is_gone(self, address: str) -> bool:
        """Whether the container of the node at an address is gone.

        No container has the address, and no container may come back to the address or has moved
        from there. Only addresses on networks of the proxy, present or former, count: the engine
        knows all containers there.
        """
        is_known = address in self.facts.taken or address in self._history.reserved_addresses
        return not is_known and is_inside(address, tuple(self._subnets))

    def mark_delivered(self, now: float) -> None:
        """Record that the proxy has received all updates that were due at the time ``now``."""
        self._due = {
            arrival: [when for when in times if when > now] for arrival, times in self._due.items()
        }

    def next_due(self, now: float) -> float | None:
        """Return the seconds until the next update may be due; None: no time is set."""
        times = [when for due in self._due.values() for when in due[:1]]
        times += [self._history.next_expiry] if self._history.next_expiry else []
        times += [now + MOVE_MESSAGE_INTERVAL_S] if self._moving else []
        return max(min(times) - now, 0.0) if times else None


def network_facts(
    observed: HostState,
    proxy: Proxy,
    members: Collection[Member],
    policy: tuple[PolicyLayer, ...] = (),
) -> NetworkFacts:
    """Return the part of a look that concerns a proxy.

    ``members`` are the members of all proxies, ``policy`` are the administrator's layers. Only a
    proxy for ROS 1 has a master, and gets arrivals: other proxies discover new nodes themselves.
    """
    host = proxy.place.master.host.lower() if isinstance(proxy.place.graph, Master) else ""
    sandbox = observed.sandbox_of(proxy)
    joined = {a.network for a in sandbox.container.attachments if a.address} if sandbox else set()
    containers = by_reference(observed.containers)
    running = [container for container in observed.containers if container.state in STARTED]
    router_ports = proxy.range if proxy.place == ZENOH else None
    own_members = [member for member in members if member.place == proxy.place]
    return NetworkFacts(
        master_address="" if not host or is_address(host) else observed.masters.get(host, ""),
        addresses={
            (container.id, a.network): a.address
            for container in running
            for a in _attachments(container, joined)
        },
        taken=observed.addresses | {network.gateway for network in observed.networks},
        subnets=tuple(
            subnet
            for network in observed.networks
            if network.name in joined
            for subnet in network.subnets
        ),
        arrivals=frozenset(
            arrival
            for member in own_members
            if isinstance(proxy.place.graph, Master)
            for arrival in _arrivals(member, observed, containers, joined)
        ),
        running=frozenset(container.id for container in running),
        selected=frozenset(
            a.address
            for member in own_members
            if member.container.alive
            for a in _attachments(network_owner(member.container, containers), joined)
        ),
        policy=(*policy, *label_layers(own_members, observed, joined, router_ports)),
    )


def _attachments(container: Container, networks: Collection[str]) -> list[Attachment]:
    return [a for a in container.attachments if a.network in networks and a.address]


def _arrivals(
    member: Member, observed: HostState, containers: ByReference, joined: set[str]
) -> list[ContainerArrival]:
    """The arrivals of a member, one for each network of ``joined``; none if it does not run."""
    container = member.container
    owner = network_owner(container, containers)
    if container.state not in STARTED or owner.state not in STARTED:
        return []
    own = {container.name, container.hostname, container.id[:12], owner.hostname}
    # Before the redirect, nodes reach the real master by address, and register there directly. The
    # registered URI then has the host that ROS_IP or ROS_HOSTNAME names.
    if member.redirected:
        own |= {container.variables.get(name, "") for name in ("ROS_IP", "ROS_HOSTNAME")}
        own = {name for name in own if not is_loopback(name)}
    return [
        ContainerArrival(
            container.id,
            attachment.network,
            attachment.address,
            attachment.endpoint,
            frozenset(name for name in attachment.names | own if _HOST_NAME.fullmatch(name)),
            redirect_record_name(observed, member.place, owner),
        )
        for attachment in _attachments(owner, joined)
    ]
