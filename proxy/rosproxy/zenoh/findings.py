"""What is wrong with the routers for rmw_zenoh: rules from their status to findings.

The proxy reports the faults by itself; the doctor reports all findings.
"""

from collections.abc import Iterator

from rosproxy.admin.doctor_finding import DoctorFinding, error, note, ok, warning
from rosproxy.admin.status_document import ZenohLinkStatus, ZenohStatus
from rosproxy.net.addresses import parse_host_port
from rosproxy.telemetry.text import listed, plural, quoted
from rosproxy.zenoh.links import LinkFault

ROUTERS = "zenoh routers"
LINK_GRACE_S = 5.0
"""Time that a link has to come up before it counts as a fault."""
_REMOTE = "check the address, the port and the firewall of the peer"
_LINK_FAULTS = {
    LinkFault.UNRESOLVABLE: (
        "the host name can't be resolved here",
        "give the address of the router instead of the name: --zenoh-peer ADDRESS",
    ),
    LinkFault.REFUSED: (
        "connection refused: no router listens there",
        "start a router at the peer: ros2 run rmw_zenoh_cpp rmw_zenohd",
    ),
    LinkFault.SILENT: ("no answer: a firewall drops the packets, or the machine is off", _REMOTE),
    LinkFault.UNREACHABLE: ("there is no route to this address", _REMOTE),
    LinkFault.NO_SESSION: (
        "a program accepts connections there, but zenoh opens no session. The program is no zenoh "
        "router, or another --zenoh-peer leads to the same router",
        "check the port, and give each router once",
    ),
}


def faults(zenoh: ZenohStatus) -> Iterator[DoctorFinding]:
    """What keeps nodes apart, the first cause first."""
    if zenoh.failure:
        text = f"do not run: {zenoh.failure}"
        fix = "the proxy starts the routers again each second; if that does not help, restart it"
        yield error("routers", ROUTERS, text, fix)
        return
    for link in zenoh.links:
        is_tried = link.error != LinkFault.NOT_TRIED.value
        if not link.up and is_tried and link.since >= LINK_GRACE_S:
            yield _link_fault(link)
    yield from _shared_routers(zenoh)


def check(zenoh: ZenohStatus) -> Iterator[DoctorFinding]:
    """All findings."""
    yield from faults(zenoh)
    if zenoh.failure:
        return
    for link in zenoh.links:
        if link.up:
            yield ok("link", f"zenoh peer {link.peer}", "linked")
    if not zenoh.links and zenoh.listen is None:
        text = "no router outside is set, and the proxy listens for none. Nodes in containers "
        text += "reach only each other"
        fix = "set --zenoh-peer HOST to connect to a router, or --zenoh-listen 7447 to be reached"
        yield warning("link", ROUTERS, text, fix)
    if not any(session.port is not None for session in zenoh.sessions):
        port = zenoh.ports.partition("-")[0]
        text = f"no node has connected to a port of {zenoh.ports}"
        fix = "set for the nodes in containers: RMW_IMPLEMENTATION=rmw_zenoh_cpp and ZENOH_CONFIG_"
        fix += f"""OVERRIDE='mode="client";connect/endpoints=["tcp/PROXY:{port}"]'"""
        yield note("nodes", ROUTERS, text, fix)
    inside = sum(1 for node in zenoh.nodes if node.address)
    text = f"{plural(inside, 'node')} connected here, {len(zenoh.nodes) - inside} outside"
    yield ok("nodes", ROUTERS, text)


def _link_fault(link: ZenohLinkStatus) -> DoctorFinding:
    known = {fault.value: texts for fault, texts in _LINK_FAULTS.items()}
    text, fix = known.get(link.error, (link.error or "no session", _REMOTE))
    return error("link", f"zenoh peer {link.peer}", f"{text}. The hub tries again", fix)


def _shared_routers(zenoh: ZenohStatus) -> Iterator[DoctorFinding]:
    """Routers with peers of several containers: a router does not pass data between its peers."""
    hosts_by_port: dict[int | None, set[str]] = {}
    for session in zenoh.sessions:
        remote = parse_host_port(session.remote)
        if session.mode == "peer" and remote:
            hosts_by_port.setdefault(session.port, set()).add(remote.host)
    for port, hosts in hosts_by_port.items():
        if len(hosts) > 1:
            at_port = f"port {zenoh.listen if port is None else port}"
            text = f"nodes at {listed(sorted(hosts))} are peers of the same router. Messages "
            text += "between these hosts do not pass"
            fix = 'set mode="client" in ZENOH_CONFIG_OVERRIDE of the nodes'
            if port is not None:
                fix = f"give each container a port of its own ({quoted(zenoh.ports)}); or {fix}"
            yield warning("shared port", f"zenoh {at_port}", text, fix)
