"""What the doctor has gathered, before any judgement.

`rosproxy.doctor.collect` fills in a `DoctorFacts`, and the rules read it. What could not be found
out is None, empty or ``UNTRIED``: rules say nothing about it. What does not fit in the replies of
the master and of nodes is dropped. `scope` finds out which nodes and which pairs of publisher and
subscriber the names mean that the user asked for.
"""

from collections.abc import Mapping, Sequence
from enum import Enum
from functools import cached_property
from typing import Any

import msgspec

from rosproxy.admin.requests import RangeProbe
from rosproxy.admin.status_document import EndpointStatus, ProxyStatus
from rosproxy.net.addresses import HostPort
from rosproxy.ros1.protocol.bus_stats import read_bus_stats
from rosproxy.ros1.protocol.uris import parse_slave_uri
from rosproxy.ros1.registry.graph import read_types


class ReachOutcome(Enum):
    """How an attempt to reach a node, service or master ended."""

    ANSWERED = "answers"
    REFUSED = "connection refused"
    SILENT = "no answer"
    STRANGER = "unexpected answer"
    UNRESOLVABLE = "the host name can't be resolved here"
    UNTRIED = "not tried"


class Attempt(msgspec.Struct, frozen=True):
    """An attempt to reach a node, service or master: how it ended and, if known, why."""

    reach: ReachOutcome = ReachOutcome.UNTRIED
    reason: str = ""

    @property
    def failed(self) -> bool:
        """Whether it was tried in vain."""
        return self.reach not in (ReachOutcome.ANSWERED, ReachOutcome.UNTRIED)


class MasterFacts(msgspec.Struct, frozen=True):
    """The master as the doctor found it.

    ``at_root``: it does answer at the path ``/``. ``is_this_proxy``: what answers is this very
    proxy.
    """

    uri: str
    attempt: Attempt = Attempt()
    addresses: tuple[str, ...] = ()
    at_root: bool = False
    is_this_proxy: bool = False
    round_trip: float | None = None


class SlaveReport(msgspec.Struct, frozen=True):
    """What a node says of itself: topics with types, and its connections.

    ``peers`` are (direction, topic, peer) of open connections, the direction ``i`` or ``o``; the
    peer of an outgoing one is a node's name, of an incoming one a slave URI. ``counts`` are the
    bytes and messages of those for which the node counts them, ``at`` (monotonic seconds).
    """

    publishes: Mapping[str, str] = {}
    subscribes: Mapping[str, str] = {}
    peers: frozenset[tuple[str, str, str]] = frozenset()
    counts: Mapping[tuple[str, str, str], tuple[int, int]] = {}
    at: float = 0.0


def slave_report(
    publications: Any, subscriptions: Any, bus: Any, stats: Any = None, at: float = 0.0
) -> SlaveReport:
    """The replies to ``getPublications``, ``getSubscriptions``, ``getBusInfo``, ``getBusStats``.

    A row of ``getBusInfo`` is ``[id, peer, direction, transport, topic, connected, ...]``; booleans
    of XML-RPC are read as their text.
    """
    rows = [row for row in _items(bus) if isinstance(row, list) and len(row) > 5]
    rows = [row for row in rows if row[5] not in (0, "0")]
    counted = read_bus_stats(stats)
    links = {(str(row[2]), str(row[4]), str(row[1])): row[0] for row in rows}
    counts = {
        link: counted[link[:2]][number]
        for link, number in links.items()
        if isinstance(number, int) and number in counted.get(link[:2], {})
    }
    return SlaveReport(
        read_types(publications), read_types(subscriptions), frozenset(links), counts, at
    )


def data_port(answer: Any) -> HostPort | None:
    """The reply to ``requestTopic``: where to connect to, None if that is no TCPROS address."""
    match answer:
        case ["TCPROS", str(host), int(port)] if 0 < port < 65536:
            return HostPort(host, port)
    return None


def _items(value: Any) -> list[Any]:
    return value if isinstance(value, list) else []


class NodeFacts(msgspec.Struct, frozen=True):
    """A node that the master knows.

    ``uri`` is what the master says, empty if it says nothing. ``inside`` is where the node is, if
    it registered through a rosproxy, as that one has the master remember it. A ``report`` is only
    there for nodes that were asked for and could be asked.
    """

    name: str
    uri: str = ""
    inside: HostPort | None = None
    addresses: tuple[str, ...] = ()
    attempt: Attempt = Attempt()
    report: SlaveReport | None = None

    @property
    def slave(self) -> HostPort | None:
        """Host and port of its URI."""
        return parse_slave_uri(self.uri)


class SystemState(msgspec.Struct, frozen=True):
    """The master's state: the publishers, subscribers and providers by name."""

    publishers: dict[str, list[str]] = {}
    subscribers: dict[str, list[str]] = {}
    services: dict[str, list[str]] = {}

    @property
    def topics(self) -> set[str]:
        """All topics with a publisher or a subscriber."""
        return {*self.publishers, *self.subscribers}

    def sides(self, topic: str) -> list[str]:
        """The publishers and the subscribers of a topic."""
        return [*self.publishers.get(topic, ()), *self.subscribers.get(topic, ())]

    def names(self) -> set[str]:
        """All nodes."""
        tables = (self.publishers, self.subscribers, self.services)
        return {name for table in tables for names in table.values() for name in names}


def system_state(state: Any) -> SystemState:
    """The reply to ``getSystemState``: publishers, subscribers, services."""
    system = SystemState()
    tables = (system.publishers, system.subscribers, system.services)
    for table, rows in zip(tables, _items(state), strict=False):
        for row in _items(rows):
            match row:
                case [str(name), list(nodes)]:
                    table[name] = [str(node) for node in nodes]
    return system


class Scope(msgspec.Struct, frozen=True):
    """What the names that the user asked for lead to.

    ``named_nodes`` are the nodes among the names, ``nodes`` all that have to be looked at;
    ``pairs`` are (topic, publisher, subscriber), ``one_sided_topics`` topics that lack one side.
    """

    named_nodes: Sequence[str] = ()
    pairs: Sequence[tuple[str, str, str]] = ()
    one_sided_topics: Sequence[str] = ()
    services: Sequence[str] = ()
    unknown: Sequence[str] = ()
    nodes: frozenset[str] = frozenset()


def scope(graph: SystemState, names: Sequence[str]) -> Scope:
    """Resolve names of nodes, topics and services.

    One node means all of its topics (without ``/rosout``, which every node has), several nodes
    what they have in common, topics their publishers and subscribers. A name that is both a
    node's and a topic's means the topic.
    """
    all_topics = graph.topics
    all_nodes = graph.names()
    topics = [name for name in names if name in all_topics]
    nodes = [name for name in names if name in all_nodes and name not in all_topics]
    services = [name for name in names if name in graph.services]
    candidates = sorted(topics or (all_topics - {"/rosout"} if nodes else ()))
    pairs = [
        (topic, publisher, subscriber)
        for topic in candidates
        for publisher in graph.publishers.get(topic, ())
        for subscriber in graph.subscribers.get(topic, ())
        if _is_asked_for({publisher, subscriber}, {*nodes})
    ]
    lonely = [
        topic
        for topic in candidates
        if not (graph.publishers.get(topic) and graph.subscribers.get(topic))
        and (topics or {*nodes} & {*graph.sides(topic)})
    ]
    matched = {*nodes, *topics, *services}
    unknown = [name for name in names if name not in matched]
    asked_nodes = {*nodes, *(node for name in services for node in graph.services[name])}
    sides = {node for _, *ends in pairs for node in ends}
    sides |= {node for topic in topics for node in graph.sides(topic)}
    return Scope(nodes, pairs, lonely, services, unknown, frozenset(asked_nodes | sides))


def _is_asked_for(pair: set[str], nodes: set[str]) -> bool:
    """Whether a pair is asked for: both its ends, or one of them if only one node is named."""
    return pair <= nodes if len(nodes) > 1 else nodes <= pair


class HeardParticipant(msgspec.Struct, frozen=True):
    """A participant of ROS 2 on a network inside that has answered when it was asked."""

    domain: int
    guid_prefix: str
    address: str
    vendor: str


class DoctorFacts(msgspec.Struct, frozen=True, dict=True):
    """Everything gathered.

    ``admin`` is the admin endpoint's URL, ``admin_error`` why it could not be asked; ``status`` and
    ``probe`` are what it said. ``advertised_addresses`` is what the advertised host resolves to
    here. ``service_uris`` are the master's, by service. ``uses_simulated_time``: nodes are told to
    use simulated time. ``names`` are the nodes, topics and services that the user asked for;
    ``data_ports`` tells, by publisher and topic, where its subscribers have to connect to and
    whether that was reached from here. ``heard_participants`` are participants on the networks
    inside. ``is_all_local``: all participants outside are on this machine.
    """

    admin: str = ""
    admin_error: str = ""
    status: ProxyStatus | None = None
    probe: RangeProbe | None = None
    probe_error: str = ""
    master: MasterFacts | None = None
    advertise_host: str = ""
    advertised_addresses: tuple[str, ...] = ()
    published_master: Attempt = Attempt()
    graph: SystemState | None = None
    nodes: Mapping[str, NodeFacts] = {}
    service_uris: Mapping[str, str] = {}
    services: Mapping[str, Attempt] = {}
    uses_simulated_time: bool = False
    names: tuple[str, ...] = ()
    data_ports: Mapping[tuple[str, str], tuple[str, Attempt]] = {}
    heard_participants: tuple[HeardParticipant, ...] = ()
    is_all_local: bool = False

    @property
    def proxy(self) -> ProxyStatus:
        """What the proxy said, and its defaults where it could not be asked."""
        return self.status or ProxyStatus()

    @property
    def system(self) -> SystemState:
        """What the master said, and an empty state where it did not say any."""
        return self.graph or SystemState()

    @cached_property
    def scope(self) -> Scope:
        """What the names asked for lead to."""
        return scope(self.system, self.names)

    @cached_property
    def leases(self) -> dict[int, EndpointStatus]:
        """The nodes of ``status`` by the port that outside sees."""
        slaves = ((parse_slave_uri(n.advertised_uri), n) for n in self.proxy.nodes)
        return {slave.port: node for slave, node in slaves if slave}

    def lease(self, host_port: HostPort | None) -> EndpointStatus | None:
        """The node behind an address from the master, if this proxy gave that address."""
        return self.leases.get(host_port.port) if host_port and self.is_ours(host_port) else None

    def is_ours(self, host_port: HostPort | None) -> bool:
        """Whether an address from the master is one that this proxy gives to inside nodes."""
        first, _, last = self.proxy.ports.advertise.partition("-")
        if host_port is None or not (first.isdecimal() and last.isdecimal()):
            return False
        return host_port.host == self.advertise_host and int(first) <= host_port.port <= int(last)
