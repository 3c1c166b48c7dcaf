"""The routers for rmw_zenoh in ``rosproxy status``: links, sessions and nodes."""

from collections.abc import Iterator

from rosproxy.admin.status_document import (
    ZenohLinkStatus,
    ZenohNodeStatus,
    ZenohSessionStatus,
    ZenohStatus,
)
from rosproxy.net.addresses import parse_host_port
from rosproxy.telemetry.tables import GAP, besides_first, table
from rosproxy.telemetry.text import clean, duration, listed, plural, wrap

SESSIONS_HEADING = ("REMOTE", "MODE", "LOCAL", "ROUTER")
NODES_HEADING = ("NODE", "DOMAIN", "ADDRESS", "PUB", "SUB", "SRV")
MOST_LINES = 3
"""Lines for the topics of a node at most; the same for services."""
INDENT = "    "


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
        ("not shown", plural(node.left_out, "name") if node.left_out else ""),
    ):
        lead = f"{INDENT}{label:<11}"
        yield from wrap(text, columns, " " * len(lead), lead, MOST_LINES)
