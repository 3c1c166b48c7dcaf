"""Makes the document of a proxy from the status, the doctor's findings and the counts.

A broken link shows only the first of these causes: a fault of a node at either end, the doctor's
finding on the pair, a connection on which nothing arrives. The document has no links between two
nodes outside, because these links do not concern the proxy.
"""

from collections.abc import Iterator, Sequence
from itertools import product

import msgspec

from rosproxy.doctor.facts import DoctorFacts, NodeFacts, SystemState
from rosproxy.page import domain_graph, zenoh_graph
from rosproxy.page.judgement import JudgedFacts, inside_nodes, without_ended
from rosproxy.page.measures import Key, Measures
from rosproxy.page.page_document import (
    BROKEN,
    CONTAINER,
    HOST,
    MOST_LINKS,
    OK,
    QUIET,
    ROBOT,
    UNKNOWN,
    WARNING,
    Json,
    PageLink,
    PageNode,
    document,
    is_quiet_service,
    rounded,
    shown_name,
    shown_text,
)
from rosproxy.shared.addresses import is_loopback
from rosproxy.shared.documents.doctor_finding import DoctorFinding, Severity, error
from rosproxy.shared.documents.status_document import EndpointStatus, ProxyStatus, StandInStatus
from rosproxy.shared.output.text import quoted
from rosproxy.shared.uris import parse_slave_uri

MASTER = "master"
PROXY = "rosproxy"
"""Keys of master and proxy. No node has such a key: names of nodes begin with a slash."""
_STATES = {Severity.ERROR: BROKEN, Severity.WARNING: WARNING}


def relayed(status: ProxyStatus, graph: SystemState) -> dict[Key, int]:
    """The bytes that the proxy has relayed from publishers inside, by the link of a topic."""
    sizes: dict[Key, int] = {}
    for endpoint in status.nodes:
        for connection in endpoint.connections:
            if connection.kind == "topic":
                publisher = _owner(endpoint, graph.publishers.get(connection.name, ()))
                key = connection.name, publisher, connection.caller_id
                sizes[key] = sizes.get(key, 0) + connection.sent
    return sizes


def graph_document(
    status: ProxyStatus,
    judged: JudgedFacts | None,
    measures: Measures,
    own_findings: Sequence[DoctorFinding],
    now: float,
    epoch: float,
) -> Json:
    """The document of a proxy. ``own_findings``: the findings of the proxy about its own setup.

    ``now``: monotonic seconds, as the times of the counters. ``epoch``: the Unix time in seconds at
    which the monotonic clock was 0.
    """
    judged = without_ended(judged or JudgedFacts(DoctorFacts(status=status)), status)
    present = tuple(endpoint for endpoint in status.nodes if not endpoint.has_ended)
    status = msgspec.structs.replace(status, nodes=present)
    nodes, links = domain_graph.graph(status, measures, now, epoch)
    zenoh_nodes, zenoh_links, left_out = zenoh_graph.graph(status, now, epoch)
    if status.settings.for_ros1:
        nodes |= _Ros1Graph(status, judged).nodes()
        ros1 = _Ros1Links(status, judged, measures, now, epoch)
        links += ros1.all()
        left_out += ros1.left_out
    findings = [*own_findings, *judged.rest, *domain_graph.findings(status)]
    findings += zenoh_graph.findings(status, (*zenoh_nodes.values(), *zenoh_links))
    nodes = {PROXY: _proxy_node(status), **nodes, **zenoh_nodes}
    links += zenoh_links
    return document(_about(status), nodes, links, findings, left_out)


def _about(status: ProxyStatus) -> Json:
    return {
        "version": status.version,
        "instance": status.instance,
        "ros": list(status.settings.ros),
        "host": shown_name(status.settings.advertise_host),
        "ports": status.ports.advertise,
        "used": status.ports.used,
        "free": status.ports.free,
        "plane": status.data_plane.plane if status.data_plane else "",
        "master": shown_name(status.master.uri),
        "master_up": status.master.up,
    }


def _proxy_node(status: ProxyStatus) -> PageNode:
    ports = []
    if status.ports.advertise:  # rmw_zenoh alone has no range
        ports.append(
            f"{status.ports.advertise}, {status.ports.used} used, {status.ports.free} free"
        )
    if status.zenoh:
        ports.append(f"{status.zenoh.ports} for containers of rmw_zenoh")
    return PageNode(
        HOST,
        "proxy",
        "rosproxy",
        address=shown_name(status.settings.advertise_host),
        ports="; ".join(ports),
        detail="; ".join(_versions(status)),
    )


def _versions(status: ProxyStatus) -> Iterator[str]:
    """The versions of ROS that a proxy serves, with the domains of ROS 2."""
    if status.settings.for_ros1:
        yield "ROS 1"
    if "2" in status.settings.ros:
        domains = ", ".join(str(domain.domain) for domain in status.domains)
        word = "domains" if len(status.domains) > 1 else "domain"
        yield f"ROS 2, {word} {domains}" if domains else "ROS 2"
    if "zenoh" in status.settings.ros:
        yield "rmw_zenoh"


class _Ros1Graph:
    """The nodes of ROS 1."""

    def __init__(self, status: ProxyStatus, judged: JudgedFacts) -> None:
        self._status = status
        self._judged = judged
        self._facts = judged.facts
        self._inside = inside_nodes(status)

    def nodes(self) -> dict[str, PageNode]:
        master = self._status.master
        state = OK if master.up else BROKEN if master.error else UNKNOWN
        text = "" if master.up else shown_text(master.error)
        nodes = {
            MASTER: PageNode(ROBOT, "master", "master", state, text, "", shown_name(master.uri))
        }
        nodes |= {name: self._inside_node(name, e) for name, e in self._inside.items()}
        # Callers of relayed connections. The master may not know a caller, or the first round of
        # questions may not have ended.
        nodes |= {
            c.caller_id: PageNode(ROBOT, address=shown_name(c.peer))
            for endpoint in self._status.nodes
            for c in endpoint.connections
            # A caller chooses the caller_id. Without the test for a slash, a caller could replace
            # MASTER or PROXY.
            if c.caller_id not in self._inside and c.caller_id.startswith("/")
        }
        return nodes | {
            name: self._outside_node(name, facts)
            for name, facts in self._facts.nodes.items()
            if name not in self._inside
        }

    def _inside_node(self, name: str, endpoint: EndpointStatus) -> PageNode:
        plane = endpoint.data_plane
        advertised = parse_slave_uri(endpoint.advertised_uri)
        ports = [advertised.port if advertised else endpoint.port, plane.port if plane else None]
        rate = plane.sent_rate + plane.received_rate if plane and plane.connections else None
        node = PageNode(
            CONTAINER,
            address=shown_name(endpoint.address),
            ports=", ".join(str(port) for port in ports if port),
            rate=None if rate is None else rounded(rate),
        )
        return self._marked(name, node)

    def _outside_node(self, name: str, facts: NodeFacts) -> PageNode:
        own_addresses = {*self._facts.advertised_addresses}
        is_here = any(a in own_addresses or is_loopback(a) for a in facts.addresses)
        node = PageNode(HOST if is_here else ROBOT, address=shown_name(facts.uri))
        return self._marked(name, node)

    def _marked(self, name: str, node: PageNode) -> PageNode:
        finding = self._judged.nodes.get(name)
        if finding is None:
            return node
        text = shown_text(finding.text)
        fix = shown_text(finding.fix)
        return msgspec.structs.replace(node, state=_STATES[finding.severity], text=text, fix=fix)


class _Ros1Links:
    """The links of ROS 1."""

    def __init__(
        self, status: ProxyStatus, judged: JudgedFacts, measures: Measures, now: float, epoch: float
    ) -> None:
        self._status = status
        self._judged = judged
        self._measures = measures
        self._now = now
        self._epoch = epoch
        self.left_out = 0
        self._inside = inside_nodes(status)
        self._graph = judged.facts.system
        self._relayed = relayed(status, self._graph)
        self._stand_ins = {s.uri: s for s in status.stand_ins}
        self._udpros = {(u.topic, u.caller_id): u.port for u in status.udpros}
        hidden = status.policy.hidden if status.policy else ()
        self._hidden = {(h.name, h.node): h.reason for h in hidden}

    def all(self) -> list[PageLink]:
        return [*self._topics(), *self._services(), *self._parameters()]

    def _topics(self) -> Iterator[PageLink]:
        pairs = self._pairs()
        yield from (self._topic(key) for key in pairs if key[1])
        paired = {(topic, name) for topic, *ends in pairs for name in ends}
        for name, endpoint in self._inside.items():
            for topic in {*endpoint.publishes, *endpoint.subscribes}:
                if (topic, name) not in paired and self._has_topic(name, endpoint, topic):
                    yield self._alone(topic, name)

    def _alone(self, topic: str, name: str) -> PageLink:
        """The link of a topic without a node at the other end.

        If the policy hides the topic, the text has the reason.
        """
        reason = self._hidden.get((topic, name))
        text = "" if reason is None else shown_text(f"hidden from outside by the policy: {reason}")
        return PageLink("topic", shown_name(topic), name, text=text, quiet=topic in QUIET)

    def _pairs(self) -> set[Key]:
        """The links (topic, publisher, subscriber) with an inside node, and all relayed links.

        The bound is 2 * MOST_LINKS. A topic whose links exceed the rest of the bound is left out:
        /tf may have very many links. ``left_out`` counts these links.
        """
        pairs = {*self._relayed}
        for topic in sorted(self._graph.topics, key=lambda topic: (topic in QUIET, topic)):
            publishers = self._graph.publishers.get(topic, ())
            subscribers = self._graph.subscribers.get(topic, ())
            inside = [name for name in publishers if name in self._inside]
            outside = [name for name in publishers if name not in self._inside]
            inside_subscribers = [name for name in subscribers if name in self._inside]
            count = len(inside) * len(subscribers) + len(outside) * len(inside_subscribers)
            if len(pairs) + count > 2 * MOST_LINKS:
                self.left_out += count
                continue
            pairs.update(product((topic,), inside, subscribers))
            pairs.update(product((topic,), outside, inside_subscribers))
        return pairs

    def _has_topic(self, name: str, endpoint: EndpointStatus, topic: str) -> bool:
        """Whether a node publishes or subscribes to a topic of the endpoint.

        If several nodes share the address, the graph of the master decides.
        """
        return len(endpoint.nodes) == 1 or name in self._graph.sides(topic)

    def _topic(self, key: Key) -> PageLink:
        topic, publisher, subscriber = key
        link = self._measures.get(key)
        finding = self._problem(key)
        carried, port = self._way(key)
        judged = key in self._judged.pairs or key in self._relayed
        state = _STATES[finding.severity] if finding else OK if judged else UNKNOWN
        last = link.last(self._now)
        byte_rate = link.byte_rate(self._now)
        message_rate = link.message_rate(self._now)
        flows = link.flows(self._now) and state != BROKEN
        return PageLink(
            "topic",
            shown_name(topic),
            publisher,
            subscriber,
            carried="" if state == BROKEN else carried,
            port=port,
            rate=None if byte_rate is None else rounded(byte_rate),
            hz=None if message_rate is None else rounded(message_rate),
            since=None if last is None or flows else round(self._epoch + last),
            flows=flows,
            state=state,
            text=shown_text(finding.text) if finding else "",
            fix=shown_text(finding.fix) if finding else "",
            quiet=topic in QUIET,
        )

    def _problem(self, key: Key) -> DoctorFinding | None:
        """The first cause why a link is broken; None without a cause."""
        for name in key[1:]:
            finding = self._judged.nodes.get(name)
            if finding and finding.severity is Severity.ERROR:
                text = f"{name}: {finding.text}"
                return msgspec.structs.replace(finding, text=text)
        finding = self._judged.pairs.get(key)
        if finding and finding.severity is Severity.ERROR and key not in self._relayed:
            return finding
        if self._measures.get(key).is_stalled(self._now):
            return self._stalled(key)
        return None

    def _stalled(self, key: Key) -> DoctorFinding:
        topic, publisher, subscriber = key
        text = (
            f"connected, but no message of {publisher} arrives at {subscriber}: "
            "packets are dropped on the way"
        )
        _, port = self._way(key)
        host = self._status.settings.advertise_host
        fix = f"look at the network of {quoted(subscriber)}"
        if subscriber in self._inside:
            fix = f"restart {quoted(subscriber)}"
        elif port:
            fix = (
                f"test on the machine of {quoted(subscriber)}: nc -vz {quoted(host)} {port}. If "
                "nc fails, let the firewalls on the way accept the port"
            )
        return error("pair", f"{topic} from {publisher} to {subscriber}", text, fix)

    def _way(self, key: Key) -> tuple[str, int | None]:
        """How a link is carried (`PageLink.carried`), and the port of the proxy, if any."""
        topic, publisher, subscriber = key
        if (topic, subscriber) in self._udpros:
            return "UDPROS", self._udpros[topic, subscriber]
        endpoint = self._inside.get(publisher)
        is_relayed = key in self._relayed
        if endpoint and subscriber in self._inside and not is_relayed:
            return "direct", None
        if endpoint:
            slave = parse_slave_uri(endpoint.advertised_uri)
            return self._way_of(endpoint, slave.port if slave else endpoint.port, is_relayed)
        outside = self._judged.facts.nodes.get(publisher)
        stand_in = self._stand_ins.get(outside.uri) if outside else None
        if stand_in:
            by_kernel = stand_in.data_plane.connections if stand_in.data_plane else 0
            return self._way_of(stand_in, stand_in.port, stand_in.connections > by_kernel)
        return ("" if self._status.settings.direction == "both" else "direct"), None

    def _way_of(
        self, holder: EndpointStatus | StandInStatus, port: int, is_relayed: bool
    ) -> tuple[str, int | None]:
        """The same as `_way`, for a link through the ports of an endpoint or stand-in."""
        plane = holder.data_plane
        if plane and plane.plane == "kernel" and plane.port and not is_relayed:
            return "kernel", plane.port
        return (self._user_plane() if is_relayed else ""), port

    def _user_plane(self) -> str:
        mode = self._status.data_plane.mode if self._status.data_plane else ""
        return "copy" if mode == "copy" else "splice"

    def _services(self) -> Iterator[PageLink]:
        graph = self._graph
        for endpoint in self._status.nodes:
            for service in endpoint.services:
                name = _owner(endpoint, graph.services.get(service, ()))
                finding = self._judged.nodes.get(name)
                state = _STATES[finding.severity] if finding else OK
                slave = parse_slave_uri(endpoint.advertised_uri)
                clients = [
                    c for c in endpoint.connections if (c.kind, c.name) == ("service", service)
                ]
                yield PageLink(
                    "service",
                    shown_name(service),
                    name,
                    carried=self._user_plane() if clients else "",
                    port=slave.port if slave else endpoint.port,
                    rate=rounded(sum(c.sent_rate + c.received_rate for c in clients))
                    if clients
                    else None,
                    state=state,
                    text=shown_text(f"{name}: {finding.text}") if finding else "",
                    fix=shown_text(finding.fix) if finding else "",
                    quiet=is_quiet_service(service),
                )

    def _parameters(self) -> Iterator[PageLink]:
        for endpoint in self._status.nodes:
            for name in endpoint.parameters:
                for node in endpoint.nodes[:1]:
                    yield PageLink(
                        "parameter", shown_name(name), MASTER, node, state=OK, quiet=True
                    )


def _owner(endpoint: EndpointStatus, holders: Sequence[str]) -> str:
    """The first node of an endpoint that is among ``holders``, the nodes that the master lists.

    If none is, the first node of the endpoint; empty if the endpoint has no node.
    """
    matches = [name for name in endpoint.nodes if name in holders]
    return next(iter([*matches, *endpoint.nodes]), "")
