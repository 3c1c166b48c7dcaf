"""Findings about the routers for rmw_zenoh, made from the status of the routers.

The proxy reports these findings by itself, and the doctor reports them, too.
"""

from collections.abc import Iterator

from rosproxy.admin.doctor_finding import DoctorFinding, error, ok, warning
from rosproxy.admin.status_document import (
    MismatchStatus,
    ZenohLinkStatus,
    ZenohNodeStatus,
    ZenohStatus,
)
from rosproxy.fixes import how_to
from rosproxy.net.addresses import parse_host_port
from rosproxy.telemetry.text import brief, listed, plural, quoted
from rosproxy.zenoh.links import LinkFault
from rosproxy.zenoh.matching import DURABILITY, TYPE, TYPE_HASH

ROUTERS = "zenoh routers"
PEER = "peer"
"""The mode of a session whose router passes no data on to other peers of this router."""
LINK_GRACE_S = 5.0
"""Seconds in which a link has to come up before it counts as a fault."""
NO_TYPE_HASH = "TypeHashNotSupported"
"""The type hash of all types on Humble."""
LONGEST_HASH = 24
"""Characters of a type hash in a text."""
_MISMATCH_FIXES = {
    TYPE: "use the same type in both programs, or remap the name in one of them",
    TYPE_HASH: "build both programs with the same definition of the type: the same version of its "
    "package",
    DURABILITY: "make the publisher TRANSIENT_LOCAL (latched) if the subscription needs messages "
    "from before its start",
}
_CHECK_PEER = "check the address, the port and the firewall of the peer"
_LINK_FAULTS = {
    LinkFault.UNRESOLVABLE: (
        "the host name can't be resolved here",
        "give the address of the router instead of the name",
    ),
    LinkFault.REFUSED: (
        "connection refused: no router listens there",
        "start a router at the peer: ros2 run rmw_zenoh_cpp rmw_zenohd",
    ),
    LinkFault.SILENT: (
        "no answer: a firewall drops the packets, or the machine is off",
        _CHECK_PEER,
    ),
    LinkFault.UNREACHABLE: ("there is no route to this address", _CHECK_PEER),
    LinkFault.NO_SESSION: (
        "a program accepts connections there, but zenoh opens no session. The program is no zenoh "
        "router, or two peers lead to the same router",
        "check the port, and give each router once",
    ),
}


def faults(zenoh: ZenohStatus) -> Iterator[DoctorFinding]:
    """Yield the faults that keep nodes apart. If the routers do not run, this is the only fault."""
    if zenoh.failure:
        text = f"do not run: {zenoh.failure}"
        fix = "wait some seconds, since the proxy starts the routers again. If the finding stays, "
        fix += "restart the proxy"
        yield error("routers", ROUTERS, text, fix)
        return
    for link in zenoh.links:
        is_tried = link.error != LinkFault.NOT_TRIED.value
        if not link.up and not link.hub and is_tried and link.since >= LINK_GRACE_S:
            yield _link_fault(link)
    yield from shared_ports(zenoh).values()


def _link_fault(link: ZenohLinkStatus) -> DoctorFinding:
    known = {fault.value: texts for fault, texts in _LINK_FAULTS.items()}
    text, fix = known.get(link.error, (link.error or "no session", _CHECK_PEER))
    return error("link", f"zenoh peer {link.peer}", f"{text}. The hub tries again", fix)


def shared_ports(zenoh: ZenohStatus) -> dict[int | None, DoctorFinding]:
    """A warning for each router with peers at several addresses, by port; None is the hub.

    A router does not pass data between its peers.
    """
    hosts_by_port: dict[int | None, set[str]] = {}
    for session in zenoh.sessions:
        remote = parse_host_port(session.remote)
        if session.mode == PEER and remote:
            hosts_by_port.setdefault(session.port, set()).add(remote.host)
    return {
        port: _shared_port(zenoh, port, hosts)
        for port, hosts in hosts_by_port.items()
        if len(hosts) > 1
    }


def _shared_port(zenoh: ZenohStatus, port: int | None, hosts: set[str]) -> DoctorFinding:
    at_port = f"port {zenoh.listen if port is None else port}"
    text = f"nodes at {listed(sorted(hosts))} are peers of the same router. Messages "
    text += "between these hosts do not pass"
    fix = 'set mode="client" in ZENOH_CONFIG_OVERRIDE of the nodes'
    if port is not None:
        fix = f"give each container a port of its own ({quoted(zenoh.ports)}); or {fix}"
    return warning("shared port", f"zenoh {at_port}", text, fix)


def place(node: ZenohNodeStatus) -> str:
    """The name of a node, with the address or the side."""
    return f"{node.name} ({node.address or 'outside'})"


def incomplete(zenoh: ZenohStatus) -> Iterator[DoctorFinding]:
    """Yield what the proxy does not know about the graph, because the graph is too large."""
    if zenoh.left_out:
        text = "liveliness tokens, nodes or sessions left out of the status: "
        text += f"{zenoh.left_out}. Nodes, topics and services may be missing"
        fix = f"stop programs that have thousands of topics. To see the nodes, {how_to('status')}"
        yield warning("nodes", ROUTERS, text, fix)
    if not_known := zenoh.mismatches_left_out + zenoh.not_compared:
        text = f"{plural(not_known, 'pair')} of nodes with the same topic or service not compared "
        text += "or not listed"
        fix = "first correct the pairs that other findings name, and stop programs that have "
        yield warning("type", ROUTERS, text, f"{fix}thousands of topics")


def mismatch_findings(zenoh: ZenohStatus) -> Iterator[tuple[MismatchStatus, DoctorFinding]]:
    """Yield each pair of nodes that do not match, with the finding.

    If only the durability differs, the finding is OK: later messages pass.
    """
    places = {node.key: place(node) for node in zenoh.nodes}
    for pair in zenoh.mismatches:
        sides = ("publisher", "subscription") if pair.kind == "topic" else ("server", "client")
        writer = f"the {sides[0]} {places.get(pair.writer, pair.writer)}"
        reader = f"the {sides[1]} {places.get(pair.reader, pair.reader)}"
        yield pair, _mismatch(pair, writer, reader)


def _mismatch(pair: MismatchStatus, writer: str, reader: str) -> DoctorFinding:
    offered = brief(pair.offered, LONGEST_HASH) if pair.policy == TYPE_HASH else pair.offered
    requested = brief(pair.requested, LONGEST_HASH) if pair.policy == TYPE_HASH else pair.requested
    text = f"{pair.policy} differs: {writer} offers {offered}, {reader} requests {requested}"
    fix = _MISMATCH_FIXES.get(pair.policy, f"set the same {pair.policy} on both sides")
    if pair.policy == TYPE_HASH and NO_TYPE_HASH in (pair.offered, pair.requested):
        fix = "use the same ROS distribution for both programs: on Humble, types have no hash"
    subject = f"{pair.kind} {pair.name}"
    if pair.policy == DURABILITY:
        text += ". The subscription gets no messages from before its start"
        return ok("qos", subject, text, fix)
    return error("type", subject, text, fix)
