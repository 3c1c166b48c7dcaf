"""What the proxy knows: endpoints, the ports they hold, and what is registered for them.

Plain state without I/O. It is changed in place rather than copied: with a thousand nodes of ten
topics each a copy per call would make registration quadratic.
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace

from rosproxy.fixes import how_to_in_a_sentence
from rosproxy.leases.ports import PortPool, PortRange
from rosproxy.net.addresses import HostPort
from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.protocol.uris import parse_service_uri, service_uri
from rosproxy.ros1.registry.endpoint import (
    LONGEST_REGISTRATION,
    Endpoint,
    EndpointRegistration,
    NodeLocation,
    Registration,
)

MOST_ADMISSIONS = 16
"""Hosts with ports, and sources, remembered for one endpoint. A node gives one, from one address
or, on a machine that is in several networks, from a few."""
UNPROVEN_SHARE = 4
"""One part in so many of the range is for nodes of one source that have never answered. A node
that is well answers within milliseconds of its first registration."""

_NO_HOLDERS: Mapping[str, Endpoint] = {}


class RangeExhausted(Exception):
    """No port of the range is left for another node; the message is meant for the node's user."""


class Registry:
    """All endpoints, found by port, by address, by URI, by service and by node name.

    ``by_port``, ``by_slave``, ``by_caller`` and ``services`` are for others to read only.
    ``changes`` grows with each registration that comes or goes, ``lease_changes`` with whatever is
    to be remembered of leases.
    """

    def __init__(self, ports: PortRange) -> None:
        self.pool = PortPool(ports)
        self.by_port: dict[int, Endpoint] = {}
        self.by_slave: dict[HostPort, Endpoint] = {}
        self.by_caller: dict[str, Endpoint] = {}
        self.services: dict[str, tuple[Endpoint, Registration]] = {}
        self._hidden: dict[tuple[Kind, str], dict[str, Endpoint]] = {}
        """The endpoints of hidden registrations, by kind and name, then by caller."""
        self.changes = self.lease_changes = 0
        self._by_node: dict[HostPort, dict[int, Endpoint]] = {}
        self._admitted: dict[tuple[HostPort, str], Endpoint] = {}
        self._last_port: dict[HostPort, int] = {}
        self._former: dict[int, Endpoint] = {}
        self._unproven: dict[str, dict[Endpoint, None]] = {}
        """The endpoints of each source that had not answered when that was last asked."""

    def __iter__(self) -> Iterator[Endpoint]:
        """All endpoints; safe against changes while iterating."""
        return iter(list(self.by_port.values()))

    def __len__(self) -> int:
        """How many ports are held."""
        return len(self.by_port)

    def admitted(self, node: HostPort | None, source: str) -> Endpoint | None:
        """The endpoint that a URI was found to mean when ``source`` registered it before.

        URIs are told apart by host and port: some client libraries end them with a slash, some
        don't, and what the master had of them is known without.
        """
        return self._admitted.get((node, source)) if node else None

    def admit(self, uri: str, node: HostPort, location: NodeLocation, source: str) -> Endpoint:
        """The endpoint of a slave URI that ``source`` registers; made if there is none.

        One that is there already takes on what came from the node's own address: nobody can rename
        somebody else's. Raises RangeExhausted if it needs a port and none can be had.
        """
        slave = HostPort(location.address, node.port)
        endpoint = self.by_slave.get(slave)
        if endpoint is None:
            port = self.pool.take(prefer=self._last_port.get(slave))
            if port is None:
                raise RangeExhausted(
                    f"rosproxy: all ports of the range {self.pool.range} are in use ({len(self)} "
                    f"leases held, {len(self.pool.blocked)} taken by other programs). "
                    + how_to_in_a_sentence("larger range")
                )
            endpoint = self._add(uri, node, location, port, source)
        elif location.confirmed or not endpoint.location.confirmed:
            self._forget_node(endpoint)
            endpoint.uri = uri
            endpoint.node = node
            endpoint.location = location
            self._by_node.setdefault(node, {})[endpoint.port] = endpoint
            self.lease_changes += 1
        self._admit(endpoint, node, source)
        return endpoint

    def restore(
        self, uri: str, node: HostPort, location: NodeLocation, port: int
    ) -> Endpoint | None:
        """Rebuild an endpoint on the port that it had; None if either is taken."""
        if HostPort(location.address, node.port) in self.by_slave or not self.pool.claim(port):
            return None
        endpoint = self._add(uri, node, location, port, location.address)
        endpoint.trusted = False
        endpoint.restored = True
        self._admit(endpoint, node, location.address)
        return endpoint

    def remove(self, endpoint: Endpoint) -> None:
        """Forget an endpoint with all its registrations and give its port back."""
        for key in list(endpoint.registrations):
            self._drop(endpoint, key)
        self.lease_changes += 1
        del self.by_port[endpoint.port], self.by_slave[endpoint.slave]
        for admission in endpoint.admissions:
            del self._admitted[admission]
        self._former[endpoint.port] = endpoint
        self.pool.give_back(endpoint.port)
        unproven = self._unproven.get(endpoint.source, {})
        unproven.pop(endpoint, None)
        if not unproven:
            self._unproven.pop(endpoint.source, None)

    def move(self, locations: Mapping[Endpoint, NodeLocation]) -> list[Endpoint]:
        """Note that nodes are at other addresses now; ports and registrations stay.

        What came from the old address means the node at the new one from now on, and what it
        calls itself too. Those whose new address and port another endpoint holds are left where
        they are; the others are returned.
        """
        moved = self._movable(locations)
        self.lease_changes += 1
        # All leave before the first one arrives: two containers may have swapped their addresses.
        for endpoint in moved:
            del self.by_slave[endpoint.slave], self._last_port[endpoint.slave]
        admissions = [(e, a) for e in moved for a in self._take_admissions(e)]
        for endpoint in moved:
            endpoint.location = locations[endpoint]
            self.by_slave[endpoint.slave] = endpoint
            self._remember(endpoint)
        for endpoint, node in admissions:
            self._admit(endpoint, node, endpoint.location.address)
        return moved

    def longest_idle(self) -> Endpoint | None:
        """The endpoint to give up first when the range is short: idle for the longest time.

        One that has just been admitted is not idle: the master's reply is still on its way.
        """
        idle = [e for e in self if e.unused and e.idle_since is not None]
        return min(idle, key=lambda e: e.idle_since or 0.0, default=None)

    def dead_endpoint(self) -> Endpoint | None:
        """The endpoint to give up first for a node that lives; None if no node is dead.

        Those that never answered go first, of the source that has most of them; then those that
        refuse, which have ended; then those that are silent, for the longest time.
        """
        expendable = [e for e in self if e.expendable]
        crowds = Counter(e.source for e in expendable if not e.proven)

        def order(endpoint: Endpoint) -> tuple[bool, int, bool, float]:
            health = endpoint.health
            proven = endpoint.proven
            crowd = 0 if proven else crowds[endpoint.source]
            return proven, -crowd, not health.refused, health.failing_since or 0.0

        return min(expendable, key=order, default=None)

    def unproven(self, source: str) -> list[Endpoint]:
        """The endpoints that a source has registered whose nodes have never answered."""
        unproven = self._unproven.get(source, {})
        for endpoint in list(unproven):
            if endpoint.proven or self.by_port.get(endpoint.port) is not endpoint:
                del unproven[endpoint]
        return list(unproven)

    @property
    def most_unproven(self) -> int:
        """How many such endpoints one source may have."""
        return max(1, len(self.pool.range) // UNPROVEN_SHARE)

    def register(self, endpoint: Endpoint, registration: Registration) -> None:
        """Note what the master has accepted.

        As the master does, a service has one provider, and a name that registers from another
        URI loses all that it had at the old one (rosmaster/registrations.py). What is over a bound
        is left out: a node that registers it is refused before; what is read from the master or
        from a node may be anything.
        """
        self.changes += 1
        former = endpoint.registrations.get(registration.key)
        if registration.characters > LONGEST_REGISTRATION or (
            endpoint.reason_full and former is None
        ):
            return
        owner = self.by_caller.get(registration.caller_id)
        if owner and owner is not endpoint:
            self.drop_caller(owner, registration.caller_id)
        if registration.kind is Kind.SERVICE:
            provider = self.services.get(registration.name)
            if provider and provider[1].key != registration.key:
                self._drop(provider[0], provider[1].key)
            self.services[registration.name] = (endpoint, registration)
            service = parse_service_uri(registration.service_api or "")
            if service is not None and endpoint.note_service_port(service.port):
                self.lease_changes += 1
        if registration.key not in endpoint.registrations:
            endpoint.callers[registration.caller_id] = (
                endpoint.callers.get(registration.caller_id, 0) + 1
            )
        endpoint.characters += registration.characters - (former.characters if former else 0)
        endpoint.registrations[registration.key] = registration
        self._index_hidden(endpoint, registration)
        self.by_caller[registration.caller_id] = endpoint
        endpoint.idle_since = None

    def unregister(self, kind: Kind, name: str, caller_id: str) -> None:
        """Note that a registration has ended, whoever ended it."""
        endpoint = self.by_caller.get(caller_id)
        if endpoint:
            self._drop(endpoint, (kind, name, caller_id))

    def drop_caller(self, endpoint: Endpoint, caller_id: str) -> None:
        """Note that a node is no longer registered at an endpoint at all."""
        for key in [key for key in endpoint.registrations if key[2] == caller_id]:
            self._drop(endpoint, key)

    def by_node(self, node: HostPort) -> list[Endpoint]:
        """The endpoints that call themselves so; several only for host names reused.

        Those removed come last, until somebody else has their port: a node that was handed their
        URI may still send it back.
        """
        endpoints = self._by_node.get(node, {}).values()
        return sorted(endpoints, key=lambda endpoint: endpoint.port in self._former)

    def service_port(self, endpoint: Endpoint, name: str) -> int | None:
        """The TCPROS port that an endpoint's node gave for a service; None if it is not known."""
        provider = self.services.get(name)
        if provider is None or provider[0] is not endpoint:
            return None
        service = parse_service_uri(provider[1].service_api or "")
        return service.port if service else None

    def note_service_port(self, endpoint: Endpoint, name: str, port: int) -> None:
        """Note the TCPROS port at which an endpoint's node has answered for a service."""
        provider = self.services.get(name)
        if provider is not None and provider[0] is endpoint:
            uri = service_uri(HostPort(endpoint.node.host, port))
            self.register(endpoint, replace(provider[1], service_api=uri))

    def registrations(self) -> list[EndpointRegistration]:
        """Everything that is registered, with its endpoint."""
        return [(e, r) for e in self for r in e.registrations.values()]

    def subscriptions(self, topic: str) -> list[EndpointRegistration]:
        """The subscriptions of all nodes inside to a topic."""
        return [
            (e, r) for e, r in self.registrations() if r.kind is Kind.SUBSCRIBER and r.name == topic
        ]

    @property
    def hides(self) -> bool:
        """Whether there is a hidden registration, of which the master knows nothing."""
        return bool(self._hidden)

    def hidden_holders(self, kind: Kind, name: str) -> Mapping[str, Endpoint]:
        """The endpoints of the hidden registrations of a kind and name, by caller."""
        return self._hidden.get((kind, name), _NO_HOLDERS)

    def hidden_registrations(self) -> list[EndpointRegistration]:
        """All hidden registrations, with their endpoints."""
        return [
            (endpoint, endpoint.registrations[kind, name, caller_id])
            for (kind, name), holders in self._hidden.items()
            for caller_id, endpoint in holders.items()
        ]

    def _movable(self, locations: Mapping[Endpoint, NodeLocation]) -> list[Endpoint]:
        """Those whose new addresses are free, or will be; of two for the same one the first."""
        moved = list(locations)
        while True:
            taken = {slave for slave, e in self.by_slave.items() if e not in moved}
            kept = []
            for endpoint in moved:
                slave = HostPort(locations[endpoint].address, endpoint.node.port)
                if slave not in taken:
                    taken.add(slave)
                    kept.append(endpoint)
            if len(kept) == len(moved):
                return kept
            moved = kept

    def _take_admissions(self, endpoint: Endpoint) -> list[HostPort]:
        """End the admissions of an endpoint's own address; their hosts and ports, and its own."""
        address = endpoint.location.address
        nodes = [node for node, source in endpoint.admissions if source == address]
        for node in nodes:
            del endpoint.admissions[node, address]
            del self._admitted[node, address]
        return [*nodes, endpoint.node]

    def _add(
        self, uri: str, node: HostPort, location: NodeLocation, port: int, source: str
    ) -> Endpoint:
        endpoint = Endpoint(uri, node, location, port, source=source)
        self.lease_changes += 1
        self._unproven.setdefault(source, {})[endpoint] = None
        self.by_port[port] = self.by_slave[endpoint.slave] = endpoint
        self._remember(endpoint)
        self._by_node.setdefault(node, {})[port] = endpoint
        return endpoint

    def _admit(self, endpoint: Endpoint, node: HostPort, source: str) -> None:
        # It may have been another endpoint's before, and counts as this one's newest from now on.
        previous = self._admitted.get((node, source), endpoint)
        previous.admissions.pop((node, source), None)
        self._admitted[node, source] = endpoint
        endpoint.admissions[node, source] = None
        if len(endpoint.admissions) > MOST_ADMISSIONS:
            oldest = next(iter(endpoint.admissions))
            del endpoint.admissions[oldest], self._admitted[oldest]

    def _remember(self, endpoint: Endpoint) -> None:
        """Note who has a port now, in place of who had it last."""
        former = self._former.pop(endpoint.port, None)
        if former is not None:
            self._forget_node(former)
        former = former or endpoint
        # Only the last holder of a port gets it again. Otherwise `_last_port` would grow with each
        # node that comes and goes.
        if self._last_port.get(former.slave) == endpoint.port:
            del self._last_port[former.slave]
        self._last_port[endpoint.slave] = endpoint.port

    def _forget_node(self, endpoint: Endpoint) -> None:
        endpoints = self._by_node[endpoint.node]
        del endpoints[endpoint.port]
        if not endpoints:
            del self._by_node[endpoint.node]

    def _index_hidden(self, endpoint: Endpoint, registration: Registration) -> None:
        """Note by kind and name that a registration is hidden, or no longer."""
        endpoints = self._hidden.setdefault((registration.kind, registration.name), {})
        if registration.hidden:
            endpoints[registration.caller_id] = endpoint
        elif endpoints.get(registration.caller_id) is endpoint:
            del endpoints[registration.caller_id]
        if not endpoints:
            del self._hidden[registration.kind, registration.name]

    def _drop(self, endpoint: Endpoint, key: tuple[Kind, str, str]) -> None:
        registration = endpoint.registrations.pop(key, None)
        if registration is None:
            return
        self.changes += 1
        endpoint.characters -= registration.characters
        self._index_hidden(endpoint, replace(registration, hidden=False))
        kind, name, caller_id = key
        if kind is Kind.SERVICE:
            self.services.pop(name, None)
        elif kind is Kind.PUBLISHER:
            endpoint.topic_ports.pop(name, None)  # it may have another one if it is back
        endpoint.callers[caller_id] -= 1
        if not endpoint.callers[caller_id]:
            del endpoint.callers[caller_id], self.by_caller[caller_id]
            endpoint.note_former_caller(caller_id)
