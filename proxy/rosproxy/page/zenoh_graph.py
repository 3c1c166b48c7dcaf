"""rmw_zenoh in the document of a proxy: nodes of both sides, routers outside, topics and services.

The liveliness tokens tell which nodes there are. No router counts messages, so the links have no
measures. If the hub has sessions with several routers, no token tells behind which router a node
is.
"""

from collections.abc import Iterable

from msgspec.structs import replace

from rosproxy.doctor.facts import DoctorFacts
from rosproxy.doctor.rules.zenoh import check
from rosproxy.page.domain_graph import is_quiet_ros2_service
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
    PageLink,
    PageNode,
    shown_name,
    shown_text,
)
from rosproxy.shared.addresses import is_loopback, parse_host_port
from rosproxy.shared.documents.doctor_finding import DoctorFinding, Severity
from rosproxy.shared.documents.status_document import (
    ProxyStatus,
    ZenohLinkStatus,
    ZenohNodeStatus,
    ZenohStatus,
)
from rosproxy.shared.output.text import listed
from rosproxy.zenoh.findings import PEER, link_subject
from rosproxy.zenoh.pairs import MATCH, SERVICE, Graph, Pair, is_inside

NODE = "zenoh node"
ROUTER = "router"
HUB = "hub"
"""Kinds of nodes on the page (`PageNode.kind`). Their keys are the same at all proxies."""
CARRIED = "router"
"""The value of `PageLink.carried` if the routers of the proxy carry the link."""
_STATES = {
    Severity.OK: OK,
    Severity.INFO: UNKNOWN,
    Severity.WARNING: WARNING,
    Severity.ERROR: BROKEN,
}
_ALONE_IS_OK = frozenset({(SERVICE, "alone")})
"""Kind and check of findings that need no mark: a service without a client is usual."""


def graph(
    status: ProxyStatus, now: float, epoch: float
) -> tuple[dict[str, PageNode], list[PageLink], int]:
    """The nodes, the routers outside, the links, and the number of links that are left out.

    ``now`` and ``epoch`` as for `rosproxy.page.graph_document.graph_document`.
    """
    zenoh = status.zenoh
    if zenoh is None:
        return {}, [], 0
    nodes = _router_nodes(status, zenoh, epoch + now)
    behind = _routers(zenoh)
    nodes |= {node.key: _node(node, zenoh, behind) for node in zenoh.nodes}
    links, left_out = _links(Graph(zenoh, status.policy))
    return nodes, links, left_out


def findings(status: ProxyStatus, rows: Iterable[PageNode | PageLink]) -> list[DoctorFinding]:
    """The doctor's warnings and errors about rmw_zenoh that no node and no link shows."""
    shown = {(row.text, row.fix) for row in rows}
    return [
        f
        for f in check(DoctorFacts(status=status))
        if f.severity >= Severity.WARNING and (shown_text(f.text), shown_text(f.fix)) not in shown
    ]


def _router_nodes(status: ProxyStatus, zenoh: ZenohStatus, now: float) -> dict[str, PageNode]:
    """The routers outside and the hubs of other proxies, by key; ``now`` is the Unix time.

    If the routers of the proxy do not run, nothing is known about the links.
    """
    if zenoh.failure:
        return {}
    about = {f.subject: f for f in check(DoctorFacts(status=status)) if f.check == "link"}
    nodes = {}
    for link in zenoh.links:
        kind = HUB if link.hub else ROUTER
        finding = about.get(link_subject(link))
        nodes[router_key(link)] = _router(link, kind, finding, now)
    return nodes


def router_key(link: ZenohLinkStatus) -> str:
    """The key of the router outside, or of the hub of another proxy, at the end of a link."""
    return f"{HUB if link.hub else ROUTER} {link.title}"


def _router(
    link: ZenohLinkStatus, kind: str, finding: DoctorFinding | None, now: float
) -> PageNode:
    """A router, with the state of the link. Without a ``finding`` it is too early to tell."""
    node = PageNode(
        _lane(link.peer),
        kind,
        shown_name(link.title),
        UNKNOWN,
        address=shown_name(link.title),
        detail=f"{'linked' if link.up else 'not linked'} with the hub of the proxy",
        since=round(now - link.since),
    )
    if finding is None:
        return node
    is_ok = finding.severity is Severity.OK
    text, fix = ("", "") if is_ok else (shown_text(finding.text), shown_text(finding.fix))
    return replace(node, state=_STATES[finding.severity], text=text, fix=fix)


def _lane(address: str) -> str:
    """The lane of an outside address: the machine of the proxy, or another."""
    host_port = parse_host_port(address)
    return HOST if is_loopback(host_port.host if host_port else address) else ROBOT


def _routers(zenoh: ZenohStatus) -> list[str]:
    """The routers outside that may have nodes behind them; by link if there is only one."""
    remotes = [session.remote for session in zenoh.sessions if session.mode == "router"]
    linked = [link.title for link in zenoh.links if link.up]
    return linked if len(remotes) == len(linked) == 1 else remotes


def _node(node: ZenohNodeStatus, zenoh: ZenohStatus, behind: list[str]) -> PageNode:
    domain = f"domain {node.domain}"
    if is_inside(node):
        detail = f"{domain}; {node.mode} at port {node.port} of the proxy"
        ports = str(node.port)
        return _named(node, CONTAINER, node.address, detail, ports)
    if node.address:
        detail = f"{domain}; {node.mode} at port {zenoh.listen} of the proxy"
        return _named(node, _lane(node.address), node.address, detail, str(zenoh.listen or ""))
    if len(behind) == 1:
        address = f"{behind[0]}, behind this router"
        return _named(node, _lane(behind[0]), address, f"{domain}; behind router {behind[0]}")
    of_which = f"one of the routers {listed(behind)}" if behind else "a router outside"
    return _named(node, ROBOT, "", f"{domain}; behind {of_which}")


def _named(
    node: ZenohNodeStatus, lane: str, address: str, detail: str, ports: str = ""
) -> PageNode:
    return PageNode(
        lane,
        NODE,
        shown_name(node.name),
        detail=shown_text(detail),
        address=shown_name(address),
        ports=ports,
    )


def _links(known: Graph) -> tuple[list[PageLink], int]:
    """The links, and the number of links that are left out.

    The bound is 2 * MOST_LINKS. A name whose links exceed the rest of the bound is left out.
    """
    links: list[PageLink] = []
    left_out = 0
    for names in sorted(known.by_name, key=lambda names: (_is_quiet(names[0], names[2]), names)):
        if len(links) + known.size(names) > 2 * MOST_LINKS:
            left_out += known.size(names)
            continue
        links += (_link(known, pair) for pair in known.pairs(names))
    return links, left_out


def _is_quiet(kind: str, name: str) -> bool:
    return is_quiet_ros2_service(name) if kind == SERVICE else name in QUIET


def _link(known: Graph, pair: Pair) -> PageLink:
    source, target = _ends(pair)
    finding = known.judge(pair)
    is_ok = (pair.kind, finding.check) in _ALONE_IS_OK or finding.severity is Severity.OK
    is_direct = target is not None and _is_direct(source, target)
    inside = target if target is not None and is_inside(target) else source
    carried = ("direct" if is_direct else CARRIED) if target and is_ok else ""
    needs_text = finding.check != MATCH and (pair.kind, finding.check) not in _ALONE_IS_OK
    return PageLink(
        pair.kind,
        shown_name(pair.name),
        source.key,
        target.key if target else "",
        carried=carried,
        port=None if is_direct else inside.port,
        state=OK if is_ok else _STATES[finding.severity],
        text=shown_text(finding.text) if needs_text else "",
        fix=shown_text(finding.fix) if needs_text else "",
        quiet=_is_quiet(pair.kind, pair.name),
        type=shown_name(_type(source, pair.name)),
    )


def _ends(pair: Pair) -> tuple[ZenohNodeStatus, ZenohNodeStatus | None]:
    """Both ends. If only one end is known, this end is the source."""
    if pair.source is None:
        return pair.target or ZenohNodeStatus(), None
    return pair.source, pair.target


def _is_direct(source: ZenohNodeStatus, target: ZenohNodeStatus) -> bool:
    """Whether nodes reach each other without a router: both are peers in the same container."""
    is_same = (source.port, source.address) == (target.port, target.address)
    return is_same and source.mode == target.mode == PEER


def _type(node: ZenohNodeStatus, name: str) -> str:
    return ", ".join(known.type for known in node.types if known.name == name)
