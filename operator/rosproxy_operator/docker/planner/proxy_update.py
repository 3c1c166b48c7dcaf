"""What a proxy is to be told of the containers on its networks.

`network_facts` is what one look says to one proxy. `ProxyUpdate` compares it with what the proxy
was told before and with the nodes that it has, and says what is new and when something is due
again. Nothing is forgotten until the proxy has heard it. Times are seconds of a monotonic clock.
"""

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from ipaddress import IPv4Network
from typing import Any

from rosproxy.access.layers import PolicyLayer
from rosproxy.net.addresses import is_address, is_inside, is_loopback
from rosproxy_operator.docker.planner.label_policy import (
    RecentLayers,
    label_layers,
    network_owner,
)
from rosproxy_operator.docker.planner.model import (
    STARTED,
    Attachment,
    Container,
    HostState,
    Member,
    Proxy,
)
from rosproxy_operator.docker.planner.redirect import redirect_record_name
from rosproxy_operator.docker.planner.specs import master

AGAIN = (0.0, 1.0, 3.0, 10.0)
"""Seconds after a container's arrival at which its proxy is told: nodes take time to register."""
AGAIN_MOVED = 1.0
"""Seconds until a move is told again: the new address may not be reachable at once."""
AWAY = 2.0
"""Seconds for which a running container may be off a network before its address counts as gone."""
MOVING = 5.0
"""Seconds for which a proxy is told of a move, until it has found the nodes at the new address."""
ContainerNetwork = tuple[str, str]
"""A container's id and a network."""
_HOST_NAME = re.compile(r"[\w.-]{1,253}", re.ASCII)
"""What a node can call its host in a URI; aliases may be anything."""


@dataclass(frozen=True, slots=True)
class ContainerArrival:
    """A labelled container on a network of its proxy, since one start of it (``endpoint``).

    ``redirect`` is what leads its nodes to the proxy, if anything does: those that were quicker
    are looked for again once it is there.
    """

    container: str
    network: str
    address: str
    endpoint: str
    # Not compared: aliases are known from a later inspection on, and make no other arrival of it.
    names: frozenset[str] = field(compare=False)
    redirect: str = ""


@dataclass(frozen=True, slots=True)
class NetworkFacts:
    """What one look says to one proxy.

    ``addresses`` are those of running containers on its networks, by container id and network;
    ``taken`` those of all containers and gateways. ``subnets`` are those of its networks,
    ``running`` the ids of all containers that run. ``master_address`` is empty if there is nothing
    to be told. ``selected`` are the addresses, on its networks, of all containers whose labels mean
    this proxy: those that may use it as their master. ``policy`` are all layers of its policy.
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
    """Where containers are, as far as their proxy knows, and where they were just now.

    A container that is disconnected and connected again under another address has moved, and its
    nodes live on.
    """

    def __init__(self) -> None:
        self._at: dict[ContainerNetwork, str] = {}
        self._absent: dict[ContainerNetwork, float] = {}
        self._moves: dict[str, tuple[str, float]] = {}

    def look(self, latest: NetworkFacts, now: float) -> None:
        """Compare with what the last look has found."""
        missing = [place for place in self._at if place not in latest.addresses]
        self._absent = {place: self._absent.get(place, now) for place in missing}
        for place, since in list(self._absent.items()):
            if place[0] not in latest.running or now >= since + AWAY:
                del self._at[place], self._absent[place]
        for place, address in latest.addresses.items():
            previous = self._at.get(place, address)
            if previous != address:
                self._moves[previous] = address, now
        self._follow(latest, now)
        self._at |= latest.addresses
        self._moves = {
            old: (new, since)
            for old, (new, since) in self._moves.items()
            if now < since + MOVING and old not in latest.addresses.values()
        }

    def _follow(self, latest: NetworkFacts, now: float) -> None:
        """Let nodes of a network that their container has left be found on one that it is on."""
        for container, network in list(self._absent):
            # The first is a network that it was not on before (False sorts first): its nodes have
            # moved there. Else it is one that it was on all the time.
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
        """The addresses that no container has, but whose containers may come back or have moved."""
        return frozenset(self._at[place] for place in self._absent) | self._moves.keys()

    @property
    def next_expiry(self) -> float | None:
        """When the first of them is given up; None if there is none."""
        times = [since + AWAY for since in self._absent.values()]
        times += [since + MOVING for _, since in self._moves.values()]
        return min(times, default=None)

    def moved(self, nodes: Collection[str]) -> dict[str, str]:
        """Old address to new one, of those where the proxy still believes its ``nodes`` to be."""
        return {old: new for old, (new, _) in self._moves.items() if old in nodes}


class ProxyUpdate:
    """What one run of a proxy has yet to be told. ``policy`` is all of its policy."""

    def __init__(self) -> None:
        self.facts = NetworkFacts()
        self.policy: tuple[PolicyLayer, ...] = ()
        self._layers = RecentLayers()
        self._subnets: set[IPv4Network] = set()
        self._places = AddressHistory()
        self._due: dict[ContainerArrival, list[float]] = {}
        self._moving = False

    def look(self, latest: NetworkFacts, now: float) -> None:
        """Take note of what a look has found."""
        self.facts = latest
        common = tuple(layer for layer in latest.policy if layer.addresses is None)
        own = (layer for layer in latest.policy if layer.addresses is not None)
        self.policy = (*common, *self._layers.look(own, latest.taken, now))
        self._subnets |= set(latest.subnets)
        self._due = {
            arrival: self._due.get(arrival, [now + after for after in AGAIN])
            for arrival in latest.arrivals
        }

    def body(self, nodes: Collection[str], now: float) -> dict[str, Any]:
        """The body of ``POST /containers`` for a proxy with nodes at these addresses; or nothing.

        Addresses that are ``gone``, have ``moved`` or where containers have ``arrived``.
        """
        self._places.look(self.facts, now)
        body = {
            "gone": sorted(node for node in nodes if self._gone(node)),
            "moved": self._places.moved(nodes),
            "arrived": [
                {"address": arrival.address, "names": sorted(arrival.names)}
                for arrival, times in sorted(self._due.items(), key=lambda item: item[0].address)
                if times and times[0] <= now
            ],
        }
        self._moving = bool(body["moved"])
        return {key: value for key, value in body.items() if value}

    def _gone(self, node: str) -> bool:
        """Whether no container has a node's address any more.

        Only the engine can tell, so it must be in a network that the proxy is on or was on.
        """
        is_known = node in self.facts.taken or node in self._places.reserved_addresses
        return not is_known and is_inside(node, tuple(self._subnets))

    def mark_delivered(self, now: float) -> None:
        """Take note that the proxy has been told what was due until then."""
        self._due = {
            arrival: [when for when in times if when > now] for arrival, times in self._due.items()
        }

    def next_due(self, now: float) -> float | None:
        """Seconds until there is something to be told again; None if there is nothing."""
        times = [when for due in self._due.values() for when in due[:1]]
        times += [self._places.next_expiry] if self._places.next_expiry else []
        times += [now + AGAIN_MOVED] if self._moving else []
        return max(min(times) - now, 0.0) if times else None


def network_facts(
    observed: HostState,
    proxy: Proxy,
    members: Collection[Member],
    policy: tuple[PolicyLayer, ...] = (),
) -> NetworkFacts:
    """What a look says to a proxy. ``members`` are those of all, ``policy`` the administrator's.

    One for ROS 2 has no master, and hears by itself of containers that come.
    """
    host = master(proxy.key).host.lower() if proxy.key.ros == "1" else ""
    sandbox = observed.sandbox_of(proxy)
    joined = {a.network for a in sandbox.container.attachments if a.address} if sandbox else set()
    by_id = {container.id: container for container in observed.containers}
    running = [container for container in observed.containers if container.state in STARTED]
    own_members = [member for member in members if member.key == proxy.key]
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
            if proxy.key.ros == "1"
            for arrival in _arrivals(member, observed, by_id, joined)
        ),
        running=frozenset(container.id for container in running),
        selected=frozenset(
            a.address
            for member in own_members
            if member.container.alive
            for a in _attachments(network_owner(member.container, by_id), joined)
        ),
        policy=(*policy, *label_layers(own_members, by_id, joined)),
    )


def _attachments(container: Container, networks: Collection[str]) -> list[Attachment]:
    return [a for a in container.attachments if a.network in networks and a.address]


def _arrivals(
    member: Member, observed: HostState, by_id: Mapping[str, Container], joined: set[str]
) -> list[ContainerArrival]:
    """A container's arrivals: where it, or the container whose network it shares, is attached."""
    container = member.container
    host = network_owner(container, by_id)
    if container.state not in STARTED or host.state not in STARTED:
        return []
    own = {container.name, container.hostname, container.id[:12], host.hostname}
    # Until the redirect is there, nodes reach the real master by its address, and register around
    # the proxy with the host that these variables name.
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
            redirect_record_name(observed, member.key, host),
        )
        for attachment in _attachments(host, joined)
    ]
