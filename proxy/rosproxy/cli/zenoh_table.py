"""The routers for rmw_zenoh in ``rosproxy status``: links, sessions, nodes, topics and services."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

from rosproxy.shared.addresses import parse_host_port
from rosproxy.shared.documents.status_document import (
    ZenohLinkStatus,
    ZenohNodeStatus,
    ZenohQosStatus,
    ZenohSessionStatus,
    ZenohStatus,
)
from rosproxy.shared.output.tables import GAP, besides_first, table
from rosproxy.shared.output.text import clean, duration, listed, plural, shorten, wrap

SESSIONS_HEADING = ("REMOTE", "MODE", "LOCAL", "ROUTER")
NODES_HEADING = ("NODE", "DOMAIN", "ADDRESS", "PUB", "SUB", "SRV")
MOST_LINES = 3
"""Lines for the topics of a node at most; the same for services."""
TOPICS_HEADING = ("TOPIC", "DOMAIN", "TYPE", "PUB", "SUB")
SERVICES_HEADING = ("SERVICE", "DOMAIN", "TYPE", "SRV", "CLI")
MOST_NAMES = 100
"""Topics in the table at most; the same for services."""
MOST_TYPE_COLUMNS = 40
MOST_QOS = 3
"""Different QoS of a topic's publishers at most; the same for subscriptions."""
OF_EACH_NODE = (
    "/describe_parameters",
    "/get_parameter_types",
    "/get_parameters",
    "/get_type_description",
    "/list_parameters",
    "/set_parameters",
    "/set_parameters_atomically",
)
"""The ends of the services that each node has. They are in the table only if they have clients."""
INDENT = "    "


@dataclass(slots=True)
class _Name:
    """A topic or service: its types, and the numbers of nodes on both sides.

    ``offered`` and ``requested`` are the QoS of publishers and of subscriptions, as text.
    """

    types: set[str] = field(default_factory=set)
    writers: int = 0
    readers: int = 0
    offered: set[str] = field(default_factory=set)
    requested: set[str] = field(default_factory=set)


_Names = Mapping[tuple[str, int], _Name]
"""Topics or services by name and domain."""


def zenoh_lines(zenoh: ZenohStatus, columns: int) -> Iterator[str]:
    """The routers, with each session and each node."""
    yield ""
    yield from wrap(_summary(zenoh), columns, INDENT)
    if zenoh.sessions:
        rows = [
            (
                clean(session.remote),
                clean(session.mode),
                clean(session.local),
                _router(session, zenoh),
            )
            for session in zenoh.sessions
        ]
        yield from _table([SESSIONS_HEADING, *rows], 4, columns)
    if zenoh.nodes:
        heading, *lines = _table([NODES_HEADING, *map(_node, zenoh.nodes)], 3, columns)
        yield heading
        for node, line in zip(zenoh.nodes, lines, strict=True):
            yield line
            yield from _details(node, columns)
    yield from _topics(zenoh, columns)
    yield from _services(zenoh, columns)


def _summary(zenoh: ZenohStatus) -> str:
    ended = f", ended {plural(zenoh.restarts, 'time')}" if zenoh.restarts else ""
    state = f"do not run: {clean(zenoh.failure)}" if zenoh.failure else f"run{ended}"
    listens = "" if zenoh.listen is None else f"; port {zenoh.listen} for outside"
    if zenoh.link_listen:
        listens += f"; port {clean(zenoh.link_listen)} for other sites"
    if zenoh.hub_listen is not None:
        listens += f"; port {zenoh.hub_listen} for proxies on other hosts"
    links = listed(_link(link) for link in zenoh.links if not link.hub) or "none"
    hubs = listed(_link(link) for link in zenoh.links if link.hub)
    ports = f"ports {clean(zenoh.ports)} for containers{listens}"
    text = f"zenoh routers {state}; {ports}; links to outside: {links}"
    return f"{text}; proxies on other hosts: {hubs}" if hubs else text


def _router(session: ZenohSessionStatus, zenoh: ZenohStatus) -> str:
    """The router of a session: the hub, the router of links to other sites, or that at a port."""
    if session.link:
        return "link"
    local = parse_host_port(session.local)
    for_outside = zenoh.listen if local and local.port == zenoh.listen else None
    port = session.port or for_outside
    return f"port {port}" if port else "hub"


def _link(link: ZenohLinkStatus) -> str:
    state = "up" if link.up else f"DOWN ({clean(link.error)})"
    return f"{clean(link.title)} {state} for {duration(link.since)}"


def _table(rows: list[tuple[str, ...]], left: int, columns: int) -> list[str]:
    return table(rows, left, max(columns - besides_first(rows), len(rows[0][0])))


def _node(node: ZenohNodeStatus) -> tuple[str, ...]:
    names = (node.publishes, node.subscribes, node.services)
    counts = (str(len(listed_names)) for listed_names in names)
    return (clean(node.name), str(node.domain), clean(node.address) or "outside", *counts)


def _details(node: ZenohNodeStatus, columns: int) -> Iterator[str]:
    for label, text in (
        ("publishes", GAP.join(map(clean, node.publishes))),
        ("subscribes", GAP.join(map(clean, node.subscribes))),
        ("services", GAP.join(map(clean, node.services))),
        ("calls", GAP.join(map(clean, node.calls))),
        ("not shown", plural(node.left_out, "name") if node.left_out else ""),
    ):
        lead = f"{INDENT}{label:<11}"
        yield from wrap(text, columns, " " * len(lead), lead, MOST_LINES)


def _topics(zenoh: ZenohStatus, columns: int) -> Iterator[str]:
    """The topics with types and QoS, and the numbers of publishing and subscribing nodes."""
    topics = _names(zenoh, lambda node: node.publishes, lambda node: node.subscribes)
    for node in zenoh.nodes:
        for qos in node.qos:
            if topic := topics.get((qos.name, node.domain)):
                texts = topic.offered if qos.kind == "publisher" else topic.requested
                texts.add(_qos(qos))
    yield from _name_table(TOPICS_HEADING, topics, columns)
    yield from _not_shown(len(topics) - MOST_NAMES, "topic")


def _services(zenoh: ZenohStatus, columns: int) -> Iterator[str]:
    """The services with types, and the numbers of nodes with a server and with a client."""
    every = _names(zenoh, lambda node: node.services, lambda node: node.calls)
    services = {
        key: service
        for key, service in every.items()
        if service.readers or not key[0].endswith(OF_EACH_NODE)
    }
    yield from _name_table(SERVICES_HEADING, services, columns)
    yield from _not_shown(len(services) - MOST_NAMES, "service")
    yield from _not_shown(len(every) - len(services), "service", " of parameters and types")


def _names(
    zenoh: ZenohStatus,
    writes: Callable[[ZenohNodeStatus], tuple[str, ...]],
    reads: Callable[[ZenohNodeStatus], tuple[str, ...]],
) -> dict[tuple[str, int], _Name]:
    """The topics or services of all nodes, sorted. ``writes``: what a node publishes or serves."""
    names: dict[tuple[str, int], _Name] = {}
    for node in zenoh.nodes:
        for name in writes(node):
            names.setdefault((name, node.domain), _Name()).writers += 1
        for name in reads(node):
            names.setdefault((name, node.domain), _Name()).readers += 1
        for known in node.types:
            if of_name := names.get((known.name, node.domain)):
                of_name.types.add(known.type)
    return dict(sorted(names.items()))


def _name_table(heading: tuple[str, ...], names: _Names, columns: int) -> Iterator[str]:
    shown = [*names.items()][:MOST_NAMES]
    if not shown:
        return
    rows = [
        (
            clean(name),
            str(domain),
            shorten(clean(listed(sorted(of_name.types))), MOST_TYPE_COLUMNS),
            str(of_name.writers),
            str(of_name.readers),
        )
        for (name, domain), of_name in shown
    ]
    first, *lines = _table([heading, *rows], 3, columns)
    yield first
    for (_, of_name), line in zip(shown, lines, strict=True):
        yield line
        yield from _qos_lines(of_name, columns)


def _qos_lines(topic: _Name, columns: int) -> Iterator[str]:
    """The QoS of publishers and subscriptions: one line if both are the same, or one is missing."""
    offered = listed(sorted(topic.offered), MOST_QOS)
    requested = listed(sorted(topic.requested), MOST_QOS)
    texts = [("PUB", offered), ("SUB", requested)]
    if offered == requested:
        texts = [("QoS", offered)]
    for label, text in texts:
        lead = f"{INDENT}{label:<11}"
        yield from wrap(text, columns, " " * len(lead), lead, MOST_LINES)


def _qos(qos: ZenohQosStatus) -> str:
    """The QoS, as in ``RELIABLE VOLATILE KEEP_LAST(10)``."""
    depth = "" if qos.history == "KEEP_ALL" else f"({qos.depth})"
    return clean(f"{qos.reliability} {qos.durability} {qos.history}{depth}")


def _not_shown(count: int, noun: str, which: str = "") -> Iterator[str]:
    if count > 0:
        yield f"{INDENT}{'not shown':<11}{plural(count, noun)}{which}"
