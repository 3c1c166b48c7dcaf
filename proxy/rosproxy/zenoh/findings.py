"""Findings about the routers for rmw_zenoh, made from the status of the routers.

The proxy reports these findings by itself, and the doctor reports them, too.
"""

from collections.abc import Iterator

from rosproxy.shared.addresses import parse_host_port
from rosproxy.shared.documents.doctor_finding import (
    DoctorFinding,
    Severity,
    error,
    note,
    ok,
    warning,
)
from rosproxy.shared.documents.status_bounds import fair_choice
from rosproxy.shared.documents.status_document import (
    MismatchStatus,
    ZenohApartStatus,
    ZenohCertificateStatus,
    ZenohFullStatus,
    ZenohLinkStatus,
    ZenohNodeStatus,
    ZenohStatus,
    ZenohUnlinkedStatus,
)
from rosproxy.shared.fixes import how_to
from rosproxy.shared.output.text import brief, listed, plural, quoted
from rosproxy.shared.policy.rules import matches
from rosproxy.zenoh.links import CERTIFICATE_FAULTS, LinkFault
from rosproxy.zenoh.matching import DURABILITY, TYPE, TYPE_HASH

ROUTERS = "zenoh routers"
PEER = "peer"
"""The mode of a session whose router passes no data on to other peers of this router."""
ROUTER = "router"
HUB_GRACE_S = 10.0
"""Seconds in which the hub has to link to a router. The hub dials again at least each 4 s."""
LINK_GRACE_S = 5.0
"""Seconds in which a link has to come up before it counts as a fault."""
NODE_GRACE_S = 10.0
"""Seconds in which a session of a node has to announce the node."""
APART_GRACE_S = 15.0
"""Seconds in which peers of a router outside may find each other, and answer the hub."""
GRAPH_GRACE_S = 30.0
"""Seconds in which a node behind a router should be known."""
WARNING_DAYS = (1, 3, 7, 14)
"""Days before the end of a certificate at which a warning begins, or changes."""
MOST_LIMIT_COMPARISONS = 20_000
"""Pairs of a topic and a limit that are compared. A pair takes half a microsecond."""
NO_TYPE_HASH = "TypeHashNotSupported"
"""The type hash of all types on Humble."""
LONGEST_NODE = 60
"""Characters of a node's name in a text that names several."""
LONGEST_HASH = 24
"""Characters of a type hash in a text."""
MOST_REPORTED_MISMATCHES = 20
"""Topics and services with a mismatch that the proxy reports by itself. The doctor reports all."""
_MISMATCH_FIXES = {
    TYPE: "use the same type in both programs, or remap the name in one of them",
    TYPE_HASH: "build both programs with the same definition of the type: the same version of its "
    "package",
    DURABILITY: "make the publisher TRANSIENT_LOCAL (latched) if the subscription needs messages "
    "from before its start",
}
_LOST_TOKENS = (
    "a router of zenoh 1.9 or later loses the liveliness tokens of nodes with 1.8 or earlier when "
    "it restarts, or if nodes start before it"
)
_SAME_VERSION = (
    "run the rmw_zenohd of the nodes' own distribution (Kilted: zenoh 1.6.2, Lyrical: 1.8.0), and "
    "restart the nodes"
)
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
    LinkFault.ITSELF: (
        "the address leads to a router of this proxy, where the rules for containers would not "
        "hold. The proxy does not connect there",
        "give the address of a router outside",
    ),
    LinkFault.NO_SESSION: (
        "a program accepts connections there, but zenoh opens no session. The program is no zenoh "
        "router, or two peers lead to the same router",
        "check the port, and give each router once",
    ),
    LinkFault.MOVED: (
        "the host name leads to another address than before, and the router there opens no session "
        "yet. A router that has moved waits until its former session ends",
        "wait some seconds. If the finding stays, check that the name leads to the router",
    ),
    LinkFault.NO_QUIC_SESSION: (
        "no session over UDP. Either no proxy listens there for QUIC, a firewall drops UDP, or one "
        "side refuses the certificate of the other",
        "check these three; a link with tls/ in place of quic/ tells the cause",
    ),
    LinkFault.NO_TLS: (
        "a program accepts connections there, but does not speak TLS",
        "give the port at which the other proxy listens for links between sites",
    ),
    LinkFault.PEER_EXPIRED: (
        "the certificate of the other proxy, or its CA, has expired",
        "renew the files there; if they are new, check the clock of this host",
    ),
    LinkFault.PEER_TOO_EARLY: (
        "the certificate of the other proxy, or its CA, is not valid yet",
        "check the clocks of both hosts",
    ),
    LinkFault.PEER_FOREIGN: (
        "the certificate of the other proxy is of a CA that this proxy does not trust",
        "if the host is the right one, add its CA to the CA file",
    ),
    LinkFault.PEER_OTHER_NAME: (
        "the certificate of the other proxy is for another host name",
        "give the host name of the certificate in the link, or add the host name of the link to "
        "the certificate (subjectAltName)",
    ),
    LinkFault.PEER_INVALID: (
        "the certificate of the other proxy is not valid for a TLS server",
        "make a certificate with extendedKeyUsage serverAuth, or without extendedKeyUsage",
    ),
    LinkFault.OWN_EXPIRED: (
        "the other proxy refuses the certificate of this proxy as expired",
        "renew certificate and key of this proxy; if they are new, check the clock of the other "
        "host",
    ),
    LinkFault.OWN_FOREIGN: (
        "the other proxy refuses the certificate of this proxy: it is of a CA that the other proxy "
        "does not trust",
        "give this proxy a certificate of that CA, or add its CA to the CA file there",
    ),
    LinkFault.OWN_REFUSED: (
        "the other proxy refuses the certificate of this proxy",
        "see rosproxy status there for the reason, and check the certificate of this proxy",
    ),
}
_SITE_FAULTS = {
    LinkFault.REFUSED.value: (
        "connection refused: no proxy listens there",
        "let the other proxy listen for links between sites, and publish the port",
    ),
    LinkFault.NO_SESSION.value: (
        "the program there accepts the certificate of this proxy, but zenoh opens no session",
        "give each site once, and use keys with RSA, P-256, P-384 or Ed25519",
    ),
}
"""Texts for links to other sites that differ from those for other links."""


def faults(zenoh: ZenohStatus) -> Iterator[DoctorFinding]:
    """Yield the faults that keep nodes apart. If the routers do not run, this is the only fault."""
    if zenoh.failure:
        text = f"do not run: {zenoh.failure}"
        fix = "wait some seconds, since the proxy starts the routers again. If the finding stays, "
        fix += "restart the proxy"
        yield error("routers", ROUTERS, text, fix)
        return
    yield from filter(None, map(_certificate, zenoh.certificates))
    if not zenoh.link_listens and not any(file.error for file in zenoh.certificates):
        text = "accepts no connections. Another program has the port, or zenoh can't use the key: "
        text += "zenoh knows RSA from 2,048 bits on, ECDSA with P-256 and P-384, and Ed25519"
        fix = "ss -ltunp shows whether another program has the port. Otherwise make another key"
        yield error("link", f"zenoh port {zenoh.link_listen}", text, fix)
    for link in zenoh.links:
        is_tried = link.error != LinkFault.NOT_TRIED.value
        # A hub that is away is no fault.
        is_fault = not link.hub or link.error in CERTIFICATE_FAULTS
        if not link.up and is_fault and is_tried and link.since >= LINK_GRACE_S:
            yield _link_fault(link)
    yield from map(_full_router, zenoh.full)
    yield from (_unlinked(router) for router in zenoh.unlinked if router.since >= HUB_GRACE_S)
    yield from shared_ports(zenoh).values()
    yield from _peers_apart(zenoh)
    yield from _sessions_without_node(zenoh)


def _certificate(certificate: ZenohCertificateStatus) -> DoctorFinding | None:
    """What is wrong with a file for links to other sites, or with the certificate of hubs.

    None if it is right.
    """
    subject = "zenoh certificate of hubs" if certificate.hub else f"zenoh file {certificate.file}"
    left = certificate.ends_in
    renew = how_to("zenoh certificate" if certificate.hub else "zenoh files")
    if certificate.error:
        return error("certificate", subject, certificate.error, renew)
    if certificate.starts_in:
        return error("certificate", subject, "is not valid yet", "check the clock of this host")
    if left is not None and left <= 0:
        return error("certificate", subject, "has expired", renew)
    # The text changes seldom: each new text is another line of the log.
    days = next((d for d in WARNING_DAYS if left is not None and left < d * 86400.0), None)
    if days is not None:
        return warning("certificate", subject, f"expires within {plural(days, 'day')}", renew)
    return None


def _full_router(router: ZenohFullStatus) -> DoctorFinding:
    text = f"has {plural(router.sessions, 'session')} with {listed(router.addresses)}, and accepts "
    text += "no more. New nodes there reach no other container"
    fix = "stop the program that opens these sessions, or its container: a node needs one session"
    if router.few_files:
        fix += f". If all these are nodes, {how_to('open files')}"
    return error("sessions", f"zenoh router at port {router.port}", text, fix)


def _unlinked(router: ZenohUnlinkedStatus) -> DoctorFinding:
    text = (
        "has no link to the hub of the proxy, so its nodes reach no other container, and nothing "
    )
    text += "outside"
    fix = "restart the proxy"
    return error("routers", f"zenoh router at port {router.port}", text, fix)


def link_subject(link: ZenohLinkStatus) -> str:
    """The subject of findings about a link."""
    kind = "hub" if link.hub else "link" if link.is_to_site else "peer"
    return f"zenoh {kind} {link.title}"


def _link_fault(link: ZenohLinkStatus) -> DoctorFinding:
    known = {fault.value: texts for fault, texts in _LINK_FAULTS.items()}
    text, fix = known.get(link.error, (link.error or "no session", _CHECK_PEER))
    if link.is_to_site:
        text, fix = _SITE_FAULTS.get(link.error, (text, fix))
    elif link.hub:
        fix = how_to("zenoh certificate")
    return error("link", link_subject(link), f"{text}. The proxy tries again", fix)


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


def _peers_apart(zenoh: ZenohStatus) -> Iterator[DoctorFinding]:
    """Yield a warning for each router outside with peers that do not reach each other."""
    by_router: dict[str, list[ZenohApartStatus]] = {}
    for peers in zenoh.apart:
        if peers.since >= APART_GRACE_S:
            by_router.setdefault(peers.router, []).append(peers)
    for router, apart in by_router.items():
        named = [
            f"{p.address} ({listed([brief(name, LONGEST_NODE) for name in p.nodes])})"
            if p.nodes
            else p.address
            for p in apart
        ]
        text = f"nodes at {listed(named)} are connected to this router as peers. They exchange no "
        text += "messages with its peers at other addresses, such as the nodes on its own machine: "
        text += "rmw_zenohd passes none between its own peers, and zenohd only up to 1.8"
        if own := [peers.address for peers in apart if peers.own_address]:
            text += f". {listed(own)} is also the address of this proxy as the router sees it, so "
            text += "these nodes run on this host or in its containers"
        fix = how_to("zenoh peers", ports=zenoh.ports)
        yield warning("peers apart", f"zenoh peers of router {router}", text, fix)


def _sessions_without_node(zenoh: ZenohStatus) -> Iterator[DoctorFinding]:
    """Yield a warning for each port for containers with sessions that announce no node.

    A status with parts left out may lack the nodes.
    """
    hosts_by_port: dict[int, set[str]] = {}
    for session in () if zenoh.left_out else zenoh.sessions:
        remote = parse_host_port(session.remote)
        is_silent = session.mode != ROUTER and session.without_node > NODE_GRACE_S
        if session.port is not None and remote and is_silent:
            hosts_by_port.setdefault(session.port, set()).add(remote.host)
    for port, hosts in hosts_by_port.items():
        text = f"programs at {listed(sorted(hosts))} are connected, but announce no node. A node "
        text += "that still starts, or a program other than a node of rmw_zenoh, is no fault. "
        text += f"Otherwise liveliness tokens are lost: {_LOST_TOKENS}"
        fix = "if the program is a node, restart the node. If a router is between the node and the "
        fix += f"proxy, {_SAME_VERSION}"
        yield warning("nodes", f"zenoh sessions at port {port}", text, fix)


def routers_without_node(zenoh: ZenohStatus) -> dict[str, DoctorFinding]:
    """A note for each router behind which no node is known, by subject.

    The proxy knows which nodes are behind routers, but not behind which router. So a node behind
    any router, also behind another hub, counts for all.
    """
    addresses = {node.address for node in zenoh.nodes}
    if zenoh.left_out or "" in addresses:
        return {}
    silent = [
        link_subject(link)
        for link in zenoh.links
        if link.up and not link.hub and link.since > GRAPH_GRACE_S
    ]
    silent += [
        f"zenoh router {session.remote}"
        for session in zenoh.sessions
        if session.mode == ROUTER and session.without_node > GRAPH_GRACE_S
    ]
    text = "linked, but no node is known behind this router. If nodes run there, their liveliness "
    text += f"tokens are lost: {_LOST_TOKENS}"
    fix = f"if nodes run there, {_SAME_VERSION}"
    return {subject: note("nodes", subject, text, fix) for subject in silent}


def shared_limits(zenoh: ZenohStatus) -> Iterator[DoctorFinding]:
    """Yield each limit of links to other sites that several topics of nodes inside share.

    zenoh counts the messages of all topics of a limit together, so frequent topics may displace
    others.
    """
    if not zenoh.limits:
        return
    globs = {limit: limit.rpartition("=")[0] for limit in zenoh.limits}
    names = sorted({n for node in zenoh.nodes if node.port is not None for n in node.publishes})
    topics_by_limit: dict[str, list[str]] = {}
    for name in names[: MOST_LIMIT_COMPARISONS // len(globs)]:
        limit = next((limit for limit, glob in globs.items() if matches(glob, name)), None)
        if limit is not None:
            topics_by_limit.setdefault(limit, []).append(name)
    for limit, topics in topics_by_limit.items():
        if len(topics) > 1:
            text = f"{listed(topics)} share this rate. Some of them may never pass the links"
            fix = "give each of these topics a limit of its own, before this limit"
            yield note("limit", f"zenoh limit {limit}", text, fix)


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


def first_mismatches(zenoh: ZenohStatus) -> dict[str, DoctorFinding]:
    """The first error of each topic and service whose nodes do not match, by subject.

    At most MOST_REPORTED_MISMATCHES, with fair shares by the address inside.
    """
    addresses = {node.key: node.address for node in zenoh.nodes if node.port is not None}
    first: dict[str, tuple[str, DoctorFinding]] = {}
    for pair, finding in mismatch_findings(zenoh):
        if finding.severity is Severity.ERROR:
            owner = addresses.get(pair.writer, addresses.get(pair.reader, ""))
            first.setdefault(finding.subject, (owner, finding))
    chosen = fair_choice(first.values(), lambda one: one[0], MOST_REPORTED_MISMATCHES)
    return {finding.subject: finding for _, finding in chosen}


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
