"""The facts that the doctor gathers, before the rules judge.

`rosproxy.doctor.collect` makes a `DoctorFacts`, which the rules read. A fact is None, empty or
``UNTRIED`` if unknown, and then the rules make no finding. The functions here drop malformed parts
of replies. `scope` resolves the names in the user's question to nodes, services, and pairs of
publisher and subscriber.
"""

from collections.abc import Container, Iterator, Mapping, Sequence
from enum import Enum
from functools import cached_property
from itertools import islice
from operator import itemgetter
from typing import Any

import msgspec

from rosproxy.ros1.protocol.bus_stats import read_bus_stats
from rosproxy.ros1.registry.graph import read_types
from rosproxy.ros2.registry.matching import in_turn
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.documents.requests import RangeProbe
from rosproxy.shared.documents.status_document import EndpointStatus, HiddenStatus, ProxyStatus
from rosproxy.shared.uris import parse_slave_uri

MOST_PAIRS = 5000
"""Pairs that the doctor examines at most: a topic with 1,000 subscribers of 5 publishers."""


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
        """Whether the attempt was made, and got no proper answer."""
        return self.reach not in (ReachOutcome.ANSWERED, ReachOutcome.UNTRIED)

    @property
    def why(self) -> str:
        """The reason in brackets, after a space; empty without a reason."""
        return f" ({self.reason})" if self.reason else ""


class MasterFacts(msgspec.Struct, frozen=True):
    """The facts about the master.

    ``addresses``: the addresses of the host in ``uri``. ``at_root``: the master answers at the path
    ``/``, although not at the path of ``uri``. ``is_this_proxy``: ``uri`` leads back to the proxy.
    ``round_trip``: seconds until the call ended; None without a call.
    """

    uri: str
    attempt: Attempt = Attempt()
    addresses: tuple[str, ...] = ()
    at_root: bool = False
    is_this_proxy: bool = False
    round_trip: float | None = None


class SlaveReport(msgspec.Struct, frozen=True):
    """The topics of a node with types, and the connections of the node.

    ``peers``: the open connections as (direction, topic, peer). For direction ``o`` (outgoing) the
    peer is the name of a node, for ``i`` (incoming) a slave URI. ``counts``: bytes and messages of
    the connections for which the node counts both. ``at``: monotonic seconds of the counts.
    ``unnamed``: the published topics for which the node does not name the subscribers: rosnodejs
    gives the addresses of connections, and foxglove/ros1 gives no connections.
    """

    publishes: Mapping[str, str] = {}
    subscribes: Mapping[str, str] = {}
    peers: frozenset[tuple[str, str, str]] = frozenset()
    counts: Mapping[tuple[str, str, str], tuple[int, int]] = {}
    at: float = 0.0
    unnamed: frozenset[str] = frozenset()

    @property
    def characters(self) -> int:
        """The characters of all texts, with 200 for each row: the memory of a short row."""
        topics = [*self.publishes.items(), *self.subscribes.items()]
        return sum(200 + sum(map(len, row)) for row in (*topics, *self.peers))


def slave_report(
    publications: Any,
    subscriptions: Any,
    bus: Any,
    stats: Any = None,
    at: float = 0.0,
    topics: Container[str] | None = None,
) -> SlaveReport:
    """Read the replies to getPublications, getSubscriptions, getBusInfo and getBusStats.

    ``topics``: all other topics are left out; None: no topic is left out.

    A row of ``getBusInfo`` is ``[id, peer, direction, transport, topic, connected, ...]``. Booleans
    of XML-RPC arrive as text. The rows of rosjava end after the topic.
    """

    def is_wanted(topic: str) -> bool:
        return topics is None or topic in topics

    rows = [row for row in _items(bus) if isinstance(row, list) and len(row) > 4]
    rows = [row for row in rows if row[5:6] not in ([0], ["0"]) and is_wanted(str(row[4]))]
    counted = read_bus_stats(stats)
    links = {(str(row[2]), str(row[4]), str(row[1])): row[0] for row in rows}
    counts = {
        link: counted[link[:2]][number]
        for link, number in links.items()
        if isinstance(number, int) and number in counted.get(link[:2], {})
    }
    types = [read_types(value) for value in (publications, subscriptions)]
    published, subscribed = ({t: k for t, k in rows.items() if is_wanted(t)} for rows in types)
    unnamed = {topic for way, topic, peer in links if way == "o" and not peer.startswith("/")}
    if not isinstance(bus, list):
        unnamed = {*published}
    return SlaveReport(published, subscribed, frozenset(links), counts, at, frozenset(unnamed))


def data_port(answer: Any) -> HostPort | None:
    """Read the TCPROS address in the reply to ``requestTopic``; None for another reply."""
    match answer:
        case ["TCPROS", str(host), int(port)] if 0 < port < 65536:
            return HostPort(host, port)
    return None


def _items(value: Any) -> list[Any]:
    return value if isinstance(value, list) else []


class NodeFacts(msgspec.Struct, frozen=True):
    """A node that the master knows.

    ``uri``: the slave URI at the master; empty if unknown. ``inside``: the inside address of a node
    behind any rosproxy, which that proxy stores at the master. ``addresses``: the addresses of the
    host in ``uri``. ``report``: only for a node in the scope that has answered.
    """

    name: str
    uri: str = ""
    inside: HostPort | None = None
    addresses: tuple[str, ...] = ()
    attempt: Attempt = Attempt()
    report: SlaveReport | None = None

    @property
    def slave(self) -> HostPort | None:
        """Host and port of the slave URI; None if the URI is empty or malformed."""
        return parse_slave_uri(self.uri)


class SystemState(msgspec.Struct, frozen=True):
    """The state of the master: publishers and subscribers by topic, providers by service."""

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
        """The names of all nodes."""
        tables = (self.publishers, self.subscribers, self.services)
        return {name for table in tables for names in table.values() for name in names}


def system_state(state: Any) -> SystemState:
    """Read the reply to ``getSystemState``: publishers, subscribers, services."""
    system = SystemState()
    tables = (system.publishers, system.subscribers, system.services)
    for table, rows in zip(tables, _items(state), strict=False):
        for row in _items(rows):
            match row:
                case [str(name), list(nodes)]:
                    table[name] = [str(node) for node in nodes]
    return system


class Scope(msgspec.Struct, frozen=True):
    """The objects to examine for the names in the user's question.

    ``named_nodes``: the nodes among the names. ``nodes``: all nodes to examine. ``pairs``: (topic,
    publisher, subscriber), MOST_PAIRS at most. ``one_sided_topics``: topics without publisher or
    without subscriber. ``unknown``: names without node, topic or service. ``has_more_pairs``: there
    are more pairs than ``pairs`` has.
    """

    named_nodes: Sequence[str] = ()
    pairs: Sequence[tuple[str, str, str]] = ()
    one_sided_topics: Sequence[str] = ()
    services: Sequence[str] = ()
    unknown: Sequence[str] = ()
    nodes: frozenset[str] = frozenset()
    has_more_pairs: bool = False


def scope(graph: SystemState, names: Sequence[str]) -> Scope:
    """Resolve names of nodes, topics and services.

    - A single node stands for all topics of the node, except ``/rosout``, which every node has.
    - Several nodes stand for the topics between these nodes.
    - A topic stands for all publishers and subscribers of the topic.
    - A name of both a node and a topic stands for the topic.
    """
    all_topics = graph.topics
    all_nodes = graph.names()
    topics = [name for name in names if name in all_topics]
    nodes = [name for name in names if name in all_nodes and name not in all_topics]
    services = [name for name in names if name in graph.services]
    candidates = sorted(topics or (all_topics - {"/rosout"} if nodes else ()))
    # In turn, so that no topic hides the pairs of the others.
    every = in_turn(_pairs(graph, topic, {*nodes}) for topic in candidates)
    pairs = sorted(islice(every, MOST_PAIRS), key=itemgetter(0))
    one_sided = [
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
    return Scope(
        nodes,
        pairs,
        one_sided,
        services,
        unknown,
        frozenset(asked_nodes | sides),
        next(every, None) is not None,
    )


def _pairs(graph: SystemState, topic: str, nodes: set[str]) -> Iterator[tuple[str, str, str]]:
    """The pairs of a topic that the user asks for by ``nodes``; without nodes, all pairs.

    Of several nodes both ends of a pair must be among these; a single node must be one end.
    """
    publishers = graph.publishers.get(topic, [])
    subscribers = graph.subscribers.get(topic, [])
    asked = [node for node in subscribers if node in nodes]
    for publisher in publishers:
        if not nodes or (len(nodes) == 1 and publisher in nodes):
            ends = subscribers
        else:
            ends = asked if len(nodes) == 1 or publisher in nodes else []
        yield from ((topic, publisher, subscriber) for subscriber in ends)


class HeardParticipant(msgspec.Struct, frozen=True):
    """A participant of ROS 2 on a network inside that has answered the doctor."""

    domain: int
    guid_prefix: str
    address: str
    vendor: str


class DoctorFacts(msgspec.Struct, frozen=True, dict=True):
    """All facts.

    ``admin``: the URL of the admin endpoint. ``admin_error``: why the endpoint gave no answer.
    ``status`` and ``probe``: the answers of the endpoint; ``probe_error``: why there is no probe.
    ``advertised_addresses``: the addresses of the advertised host, resolved here.
    ``published_master``: the attempt to reach the master at ``--publish-master``.
    ``service_uris``: URIs at the master by service. ``services``: attempts by service.
    ``uses_simulated_time``: the parameter /use_sim_time is true. ``names``: the nodes, topics and
    services in the user's question. ``data_ports``: by publisher and topic, the TCPROS address for
    subscribers, and the attempt to reach this address. ``untried``: how many nodes the doctor has
    not tried, because there are too many. ``heard_participants``: participants on the networks
    inside.
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
    untried: int = 0
    heard_participants: tuple[HeardParticipant, ...] = ()

    @property
    def proxy(self) -> ProxyStatus:
        """The status of the proxy; defaults if the proxy gave no answer."""
        return self.status or ProxyStatus()

    @property
    def system(self) -> SystemState:
        """The state of the master; empty if the master gave no answer."""
        return self.graph or SystemState()

    @cached_property
    def hidden(self) -> dict[str, HiddenStatus]:
        """What the policy hides from outside, by topic or service: the first entry of each name."""
        hidden = self.proxy.policy.hidden if self.proxy.policy else ()
        return {entry.name: entry for entry in reversed(hidden)}

    @cached_property
    def scope(self) -> Scope:
        """The scope of ``names``."""
        return scope(self.system, self.names)

    @cached_property
    def leases(self) -> dict[int, EndpointStatus]:
        """The endpoints of ROS 1 in ``status``, by advertised port."""
        slaves = ((parse_slave_uri(n.advertised_uri), n) for n in self.proxy.nodes)
        return {slave.port: node for slave, node in slaves if slave}

    def lease(self, host_port: HostPort | None) -> EndpointStatus | None:
        """The endpoint of this proxy at an address from the master; None if there is none."""
        return self.leases.get(host_port.port) if host_port and self.is_ours(host_port) else None

    def is_ours(self, host_port: HostPort | None) -> bool:
        """Whether an address has the advertised host and an advertised port of this proxy."""
        first, _, last = self.proxy.ports.advertise.partition("-")
        if host_port is None or not (first.isdecimal() and last.isdecimal()):
            return False
        return host_port.host == self.advertise_host and int(first) <= host_port.port <= int(last)
