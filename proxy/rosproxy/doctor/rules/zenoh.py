"""Rules about rmw_zenoh: the routers of the proxy, and the names in the user's question."""

from collections.abc import Iterator

from rosproxy.admin.doctor_finding import UNKNOWN_NAME, DoctorFinding, error, note, ok, warning
from rosproxy.admin.status_document import ZenohNodeStatus, ZenohStatus
from rosproxy.doctor.facts import DoctorFacts
from rosproxy.fixes import how_to
from rosproxy.telemetry.text import listed, plural
from rosproxy.zenoh.findings import ROUTERS, faults
from rosproxy.zenoh.links import LinkFault


def check(facts: DoctorFacts) -> Iterator[DoctorFinding]:
    """All findings about rmw_zenoh; none if the proxy has no routers."""
    zenoh = facts.proxy.zenoh
    if zenoh is None:
        return
    yield from faults(zenoh)
    if zenoh.failure:
        return
    yield from _outside(zenoh)
    yield from _nodes(zenoh)
    is_alone = not facts.proxy.settings.for_ros1 and not facts.proxy.domains
    for name in facts.names:
        about_name = [*_about(zenoh, name)]
        yield from about_name
        if not about_name and is_alone:
            text = "no node has this name, and no node has a topic or service of this name"
            fix = f"compare with the names in the status: {how_to('status')}"
            yield error(UNKNOWN_NAME, name, text, fix)


def _outside(zenoh: ZenohStatus) -> Iterator[DoctorFinding]:
    for link in zenoh.links:
        kind = "hub" if link.hub else "peer"
        if link.up:
            yield ok("link", f"zenoh {kind} {link.peer}", "linked")
        elif link.hub and link.error != LinkFault.NOT_TRIED.value:
            text = f"not linked ({link.error}). The hub tries again"
            yield note("link", f"zenoh hub {link.peer}", text, how_to("zenoh hub"))
    if not zenoh.links and zenoh.listen is None:
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
    publishers = [_place(node) for node in zenoh.nodes if name in node.publishes]
    subscribers = [_place(node) for node in zenoh.nodes if name in node.subscribes]
    servers = [_place(node) for node in zenoh.nodes if name in node.services]
    if publishers or subscribers:
        text = f"published by {listed(publishers) or 'no node'}; "
        text += f"subscribed to by {listed(subscribers) or 'no node'}"
        if publishers and subscribers:
            yield ok("topic", name, text)
        else:
            yield note("topic", name, text, "check the name; check that the other program runs")
    if servers:
        yield ok("service", name, f"served by {listed(servers)}")


def _place(node: ZenohNodeStatus) -> str:
    return f"{node.name} ({node.address or 'outside'})"
