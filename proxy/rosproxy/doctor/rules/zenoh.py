"""Rules about rmw_zenoh: the routers of the proxy, and the names in the user's question."""

from collections.abc import Iterator

from rosproxy.doctor.facts import DoctorFacts
from rosproxy.shared.documents.doctor_finding import (
    UNKNOWN_NAME,
    DoctorFinding,
    Severity,
    error,
    note,
    ok,
    warning,
)
from rosproxy.shared.documents.status_document import ZenohStatus
from rosproxy.shared.fixes import how_to
from rosproxy.shared.output.text import listed, plural
from rosproxy.zenoh.findings import (
    ROUTERS,
    faults,
    incomplete,
    link_subject,
    mismatch_findings,
    place,
    routers_without_node,
    shared_limits,
)
from rosproxy.zenoh.links import CERTIFICATE_FAULTS, LinkFault
from rosproxy.zenoh.pairs import Graph, troubles

_NOT_NOTED = CERTIFICATE_FAULTS | {LinkFault.NOT_TRIED.value}
"""Errors of hubs that are unknown yet, or that `faults` reports."""


def check(facts: DoctorFacts) -> Iterator[DoctorFinding]:
    """All findings about rmw_zenoh; none if the proxy has no routers."""
    zenoh = facts.proxy.zenoh
    if zenoh is None:
        return
    lasting = [*faults(zenoh)]
    yield from lasting
    if zenoh.failure:
        return
    yield from _outside(zenoh)
    yield from _nodes(zenoh)
    yield from shared_limits(zenoh)
    mismatches = [f for _, f in mismatch_findings(zenoh) if f.severity > Severity.OK]
    yield from mismatches
    yield from incomplete(zenoh)
    graph = Graph(zenoh if facts.names else ZenohStatus(), facts.proxy.policy)
    for name in facts.names:
        about_name = [*_about(zenoh, name)]
        yield from about_name
        yield from (f for f in troubles(graph, name) if f not in (*lasting, *mismatches))
        if not about_name:
            text = "no node has this name, and no node has a topic or service of this name"
            fix = f"compare with the names in the status: {how_to('status')}"
            yield error(UNKNOWN_NAME, name, text, fix)


def _outside(zenoh: ZenohStatus) -> Iterator[DoctorFinding]:
    without_node = routers_without_node(zenoh)
    yield from without_node.values()
    for link in zenoh.links:
        if link.up and link_subject(link) not in without_node:
            yield ok("link", link_subject(link), "linked")
        elif not link.up and link.hub and link.error not in _NOT_NOTED:
            text = f"not linked ({link.error}). The hub tries again"
            yield note("link", link_subject(link), text, how_to("zenoh hub"))
    listens = zenoh.listen is not None or zenoh.hub_listen is not None or zenoh.link_listen
    if not zenoh.links and not listens:
        text = "no router outside is set, and the proxy listens for none. Nodes in containers "
        text += "reach only each other"
        yield warning("link", ROUTERS, text, how_to("zenoh outside"))


def _nodes(zenoh: ZenohStatus) -> Iterator[DoctorFinding]:
    if not any(session.port is not None for session in zenoh.sessions):
        port = zenoh.ports.partition("-")[0]
        text = f"no node has connected to a port of {zenoh.ports}"
        yield note("nodes", ROUTERS, text, how_to("zenoh nodes", port=port))
    inside = sum(1 for node in zenoh.nodes if node.address)
    text = f"{plural(inside, 'node')} connected here, {len(zenoh.nodes) - inside} outside"
    yield ok("nodes", ROUTERS, text)


def _about(zenoh: ZenohStatus, name: str) -> Iterator[DoctorFinding]:
    """Findings about the nodes with a name, and about the topic or service with this name."""
    for node in zenoh.nodes:
        if node.name == name:
            yield ok("node", name, f"connected from {node.address or 'outside'}")
    publishers = [place(node) for node in zenoh.nodes if name in node.publishes]
    subscribers = [place(node) for node in zenoh.nodes if name in node.subscribes]
    servers = [place(node) for node in zenoh.nodes if name in node.services]
    clients = [place(node) for node in zenoh.nodes if name in node.calls]
    if publishers or subscribers:
        text = f"published by {listed(publishers) or 'no node'}; "
        text += f"subscribed to by {listed(subscribers) or 'no node'}"
        if publishers and subscribers:
            yield ok("topic", name, text)
        else:
            yield note("topic", name, text, "check the name; check that the other program runs")
    if servers:
        called = f"; called by {listed(clients)}" if clients else ""
        yield ok("service", name, f"served by {listed(servers)}{called}")
    elif clients:
        text = f"called by {listed(clients)}, and served by no node"
        yield note("service", name, text, "check the name; check that the other program runs")
