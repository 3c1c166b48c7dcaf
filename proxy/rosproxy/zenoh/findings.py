"""Findings about the routers for rmw_zenoh, made from the status of the routers.

The proxy reports these findings by itself, and the doctor reports them, too.
"""

from collections.abc import Iterator

from rosproxy.admin.doctor_finding import DoctorFinding, error, warning
from rosproxy.admin.status_document import ZenohLinkStatus, ZenohStatus
from rosproxy.net.addresses import parse_host_port
from rosproxy.telemetry.text import listed, quoted
from rosproxy.zenoh.links import LinkFault

ROUTERS = "zenoh routers"
LINK_GRACE_S = 5.0
"""Seconds in which a link has to come up before it counts as a fault."""
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
    yield from _shared_routers(zenoh)


def _link_fault(link: ZenohLinkStatus) -> DoctorFinding:
    known = {fault.value: texts for fault, texts in _LINK_FAULTS.items()}
    text, fix = known.get(link.error, (link.error or "no session", _CHECK_PEER))
    return error("link", f"zenoh peer {link.peer}", f"{text}. The hub tries again", fix)


def _shared_routers(zenoh: ZenohStatus) -> Iterator[DoctorFinding]:
    """Yield a warning for each router with peers at several addresses.

    A router does not pass data between its peers.
    """
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
