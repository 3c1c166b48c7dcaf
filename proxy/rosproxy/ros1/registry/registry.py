"""The state of the proxy: endpoints, the ports of the endpoints, and their registrations.

Plain state without I/O. Methods change the state in place. With a thousand nodes of ten topics
each, a copy for each call would make the cost of registrations quadratic.
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace

from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.registry.endpoint import (
    LONGEST_REGISTRATION,
    Endpoint,
    EndpointRegistration,
    NodeLocation,
    Registration,
)
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.fixes import how_to_in_a_sentence
from rosproxy.shared.ports import PortPool, PortRange
from rosproxy.shared.uris import parse_service_uri, service_uri

MOST_ADMISSIONS = 16
"""Remembered pairs of host:port and source for an endpoint. A node gives one host, from a single
address, or from a few on a machine with several networks."""
MOST_REGISTRATIONS_IN_ALL = 45_000
"""The highest number of registrations of all endpoints; a source gets no more than it leaves to
others. With these, the state of the master fits into `OWN_REPLY`: a registration takes up to ten
elements and 170 bytes. A thousand nodes of a machine have twenty registrations each. In the
registry, each takes 600 bytes and the names."""
MOST_CHARACTERS_IN_ALL = 20_000_000
"""The highest number of characters of all names and types that are registered; a source gets no
more than it leaves to others. Of the 32 MiB of the master's state, 6 MB are left to nodes outside.
A thousand nodes with long namespaces have 3,000,000."""
UNPROVEN_DIVISOR = 4
"""Nodes of one source that have never answered may hold the range divided by this number. A healthy
node answers within milliseconds after its first registration."""

_NO_HOLDERS: Mapping[str, Endpoint] = {}


class RangeExhausted(Exception):
    """No port of the range is left for another node. The message is for the user of the node."""


class Registry:
    """All endpoints, by port, address, URI, service and node name.

    ``by_port``, ``by_slave``, ``by_caller`` and ``services`` are read-only for other modules.
    ``changes`` grows with each registration that begins or ends, ``lease_changes`` with each change
    of the remembered leases.
    """

    def __init__(self, ports: PortRange) -> None:
        self.pool = PortPool(ports)
        self.by_port: dict[int, Endpoint] = {}
        self.by_slave: dict[HostPort, Endpoint] = {}
        self.by_caller: dict[str, Endpoint] = {}
        self.services: dict[str, tuple[Endpoint, Registration]] = {}
        self._holders: dict[tuple[Kind, str], dict[str, Endpoint]] = {}
        """The endpoints of all registrations, by kind and name, then by caller."""
        self._hidden: dict[tuple[Kind, str], dict[str, Endpoint]] = {}
        """The endpoints of hidden registrations, by kind and name, then by caller."""
        self._registrations = self._characters = 0
        """The number of registrations and of characters, also of promised registrations."""
        self._registrations_of = Counter[str]()
        """The number of registrations, by source of the endpoint."""
        self._characters_of = Counter[str]()
        """The number of characters of the registrations, by source of the endpoint."""
        self._promised_of = Counter[str]()
        """The number of promised registrations, by source of the endpoint."""
        self._promised_characters_of = Counter[str]()
        """The number of characters of the promised registrations, by source of the endpoint."""
        self.changes = self.lease_changes = 0
        self._by_node: dict[HostPort, dict[int, Endpoint]] = {}
        self._admitted: dict[tuple[HostPort, str], Endpoint] = {}
        self._last_port: dict[HostPort, int] = {}
        """The last port of each slave address, also after the endpoint was removed."""
        self._former: dict[int, Endpoint] = {}
        """The last endpoint of each port that is free again."""
        self._unproven: dict[str, dict[Endpoint, None]] = {}
        """The endpoints of each source that had not answered at the last check."""

    def __iter__(self) -> Iterator[Endpoint]:
        """All endpoints; safe against changes during the iteration."""
        return iter(list(self.by_port.values()))

    def __len__(self) -> int:
        """The number of held ports."""
        return len(self.by_port)

    def admitted(self, node: HostPort | None, source: str) -> Endpoint | None:
        """The endpoint for which ``source`` registered the same host and port before.

        Host and port identify a URI: some client libraries end a URI with a slash, and some do not.
        What the master had before a recovery has no path either.
        """
        return self._admitted.get((node, source)) if node else None

    def admit(self, uri: str, node: HostPort, location: NodeLocation, source: str) -> Endpoint:
        """The endpoint of a slave URI that ``source`` registers; made if there is none.

        A registration from the node's own address may change the URI of an existing endpoint. Other
        registrations may do so only until then, so that no other node renames the endpoint. Raises
        RangeExhausted if no port is left.
        """
        slave = HostPort(location.address, node.port)
        endpoint = self.by_slave.get(slave)
        if endpoint is None:
            port = self.pool.take(prefer=self._last_port.get(slave))
            if port is None:
                raise RangeExhausted(
                    f"rosproxy: all ports of the range {self.pool.range} are in use ({len(self)} "
                    f"leases held, {len(self.pool.blocked)} taken by other programs). "
                    f"{how_to_in_a_sentence('larger range')}. Then restart the node"
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
        """Rebuild an endpoint on its former port; None if the port or the address is taken."""
        if HostPort(location.address, node.port) in self.by_slave or not self.pool.claim(port):
            return None
        endpoint = self._add(uri, node, location, port, location.address)
        endpoint.trusted = False
        endpoint.restored = True
        self._admit(endpoint, node, location.address)
        return endpoint

    def remove(self, endpoint: Endpoint) -> None:
        """Remove an endpoint with all its registrations, and give its port back."""
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
        """Record that nodes have moved to other addresses; ports and registrations stay.

        From now on the URIs that came from the old address mean the same endpoint when they come
        from the new address. An endpoint does not move if another endpoint has the new address and
        port. Returns the endpoints that have moved.
        """
        moved = self._movable(locations)
        self.lease_changes += 1
        # All leave before the first arrives, because two containers may have swapped addresses.
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
        """The endpoint that has been unused for the longest time; None if all are in use.

        An endpoint that was just admitted counts as used, because the reply of the master is still
        under way.
        """
        idle = [e for e in self if e.unused and e.idle_since is not None]
        return min(idle, key=lambda e: e.idle_since or 0.0, default=None)

    def dead_endpoint(self) -> Endpoint | None:
        """The endpoint whose port a live node gets first; None if no node is dead.

        First come endpoints that have never answered, from the source with the most such endpoints.
        Then come endpoints that refuse connections, then silent endpoints, longest first.
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
        """The endpoints that a source has registered and whose nodes have never answered."""
        unproven = self._unproven.get(source, {})
        for endpoint in list(unproven):
            if endpoint.proven or self.by_port.get(endpoint.port) is not endpoint:
                del unproven[endpoint]
        return list(unproven)

    @property
    def most_unproven(self) -> int:
        """The highest number of endpoints of one source that have never answered."""
        return max(1, len(self.pool.range) // UNPROVEN_DIVISOR)

    def reason_full(self, endpoint: Endpoint, registration: Registration) -> str | None:
        """Why an endpoint does not accept a registration; None if there is room.

        A registration that the endpoint has already is accepted, unless its names get longer: a
        node repeats all its registrations at a master that has restarted. Until a recovered
        endpoint is ``trusted``, only the total counts: the master lists nodes in any order, so the
        first source would get less than before.
        """
        former = endpoint.registrations.get(registration.key)
        if former is not None and registration.characters <= former.characters:
            return None
        source = endpoint.source
        registrations = self._registrations_of[source] + self._promised_of[source]
        characters = self._characters_of[source] + self._promised_characters_of[source]
        left = MOST_CHARACTERS_IN_ALL - self._characters
        rows = [(characters, left, "characters of names")]
        if former is None:
            left = MOST_REGISTRATIONS_IN_ALL - self._registrations
            rows.append((registrations, left, "registrations"))
        for count, left, label in rows:
            if left <= (count if endpoint.trusted else 0):
                return (
                    f"the nodes of {source} have {count} {label}, and leave {max(left, 0)} to "
                    "others. More are not accepted. Run some of these nodes at another address, "
                    "such as in another container"
                )
        return endpoint.reason_full(registration.caller_id, former is None)

    def promise(self, endpoint: Endpoint, registration: Registration) -> None:
        """Count a registration that is admitted, until `end_promise`.

        Otherwise the calls of a ``system.multicall`` would all find room for the last registration.
        """
        self._count_promised(endpoint, registration, 1)

    def end_promise(self, endpoint: Endpoint, registration: Registration) -> None:
        """Count an admitted registration no more: it is recorded now, or has failed."""
        self._count_promised(endpoint, registration, -1)

    def register(self, endpoint: Endpoint, registration: Registration) -> None:
        """Record what the master has accepted.

        As at the master, a service has a single provider, and a name that registers with another
        URI loses all its former registrations (rosmaster/registrations.py). A registration beyond a
        bound is left out. The proxy refuses such a registration from a node earlier, so this
        concerns data from the master or from a node's own lists. So is a registration at an
        endpoint that has been removed meanwhile: nothing would take it out again.
        """
        if self.by_port.get(endpoint.port) is not endpoint:
            return
        self.changes += 1
        former = endpoint.registrations.get(registration.key)
        has_room = former is not None or registration.caller_id in endpoint.promised
        if registration.characters > LONGEST_REGISTRATION or (
            not has_room and self.reason_full(endpoint, registration)
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
        key = registration.key
        endpoint.callers.setdefault(registration.caller_id, {})[key] = None
        if former:
            self._count(endpoint, former, -1)
        self._count(endpoint, registration, 1)
        endpoint.registrations[key] = registration
        _index(self._holders, endpoint, registration, True)
        _index(self._hidden, endpoint, registration, registration.hidden)
        self.by_caller[registration.caller_id] = endpoint
        endpoint.idle_since = None

    def unregister(self, kind: Kind, name: str, caller_id: str) -> None:
        """Record that a registration has ended, by any cause."""
        endpoint = self.by_caller.get(caller_id)
        if endpoint:
            self._drop(endpoint, (kind, name, caller_id))

    def drop_caller(self, endpoint: Endpoint, caller_id: str) -> None:
        """Record that a node has no registration at an endpoint any more."""
        for key in list(endpoint.callers.get(caller_id, ())):
            self._drop(endpoint, key)

    def by_node(self, node: HostPort) -> list[Endpoint]:
        """The endpoints whose URI has this host and port; several if host names are used again.

        Removed endpoints come last, until another endpoint gets the port, because a node may still
        send back their URI.
        """
        endpoints = self._by_node.get(node, {}).values()
        return sorted(endpoints, key=lambda endpoint: endpoint.port in self._former)

    def service_port(self, endpoint: Endpoint, name: str) -> int | None:
        """The TCPROS port that the node gave for a service; None if it is unknown."""
        provider = self.services.get(name)
        if provider is None or provider[0] is not endpoint:
            return None
        service = parse_service_uri(provider[1].service_api or "")
        return service.port if service else None

    def note_service_port(self, endpoint: Endpoint, name: str, port: int) -> None:
        """Record the TCPROS port at which the node has answered for a service."""
        provider = self.services.get(name)
        if provider is not None and provider[0] is endpoint:
            uri = service_uri(HostPort(endpoint.node.host, port))
            self.register(endpoint, replace(provider[1], service_api=uri))

    def registrations(self) -> list[EndpointRegistration]:
        """All registrations, each with its endpoint."""
        return [(e, r) for e in self for r in e.registrations.values()]

    def subscriptions(self, topic: str) -> list[EndpointRegistration]:
        """The subscriptions of all nodes inside to a topic."""
        kind = Kind.SUBSCRIBER
        holders = self.holders(kind, topic)
        return [(e, e.registrations[kind, topic, caller_id]) for caller_id, e in holders.items()]

    def holders(self, kind: Kind, name: str) -> Mapping[str, Endpoint]:
        """The endpoints of all registrations of a kind and name, by caller."""
        return self._holders.get((kind, name), _NO_HOLDERS)

    @property
    def has_hidden(self) -> bool:
        """Whether there is a hidden registration, which the master does not have."""
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
        """The endpoints whose new address is free, or will be; the first if two have the same."""
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
        """End the admissions from an endpoint's own address.

        Returns the hosts and ports of these admissions, and of the endpoint's URI.
        """
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
        # Another endpoint may have had the admission, which is the newest of this endpoint now.
        previous = self._admitted.get((node, source), endpoint)
        previous.admissions.pop((node, source), None)
        self._admitted[node, source] = endpoint
        endpoint.admissions[node, source] = None
        if len(endpoint.admissions) > MOST_ADMISSIONS:
            oldest = next(iter(endpoint.admissions))
            del endpoint.admissions[oldest], self._admitted[oldest]

    def _remember(self, endpoint: Endpoint) -> None:
        """Record the present holder of a port in place of the last holder."""
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

    def _count(self, endpoint: Endpoint, registration: Registration, step: int) -> None:
        """Count a registration that begins (``step`` 1) or ends (-1)."""
        source = endpoint.source
        characters = step * registration.characters
        self._registrations += step
        self._characters += characters
        self._registrations_of[source] += step
        self._characters_of[source] += characters
        endpoint.characters += characters
        if not self._registrations_of[source]:
            del self._registrations_of[source], self._characters_of[source]

    def _count_promised(self, endpoint: Endpoint, registration: Registration, step: int) -> None:
        source = endpoint.source
        caller_id = registration.caller_id
        characters = step * registration.characters
        self._registrations += step
        self._characters += characters
        self._promised_characters_of[source] += characters
        endpoint.promised_characters += characters
        for counter, key in ((self._promised_of, source), (endpoint.promised, caller_id)):
            counter[key] += step
            if not counter[key]:
                del counter[key]
        if source not in self._promised_of:
            del self._promised_characters_of[source]

    def _drop(self, endpoint: Endpoint, key: tuple[Kind, str, str]) -> None:
        registration = endpoint.registrations.pop(key, None)
        if registration is None:
            return
        self.changes += 1
        self._count(endpoint, registration, -1)
        for index in (self._holders, self._hidden):
            _index(index, endpoint, registration, False)
        kind, name, caller_id = key
        if kind is Kind.SERVICE:
            self.services.pop(name, None)
        elif kind is Kind.PUBLISHER:
            endpoint.topic_ports.pop(name, None)  # a node that is back may have another port
        del endpoint.callers[caller_id][key]
        if not endpoint.callers[caller_id]:
            del endpoint.callers[caller_id], self.by_caller[caller_id]
            endpoint.note_former_caller(caller_id)


def _index(
    index: dict[tuple[Kind, str], dict[str, Endpoint]],
    endpoint: Endpoint,
    registration: Registration,
    is_in: bool,
) -> None:
    """Put a registration into an index by kind, name and caller, or take it out."""
    endpoints = index.setdefault((registration.kind, registration.name), {})
    if is_in:
        endpoints[registration.caller_id] = endpoint
    elif endpoints.get(registration.caller_id) is endpoint:
        del endpoints[registration.caller_id]
    if not endpoints:
        del index[registration.kind, registration.name]
