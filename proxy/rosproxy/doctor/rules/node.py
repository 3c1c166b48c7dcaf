"""The nodes: those behind the proxy, and those that the master knows."""

import re
from collections.abc import Iterator
from ipaddress import ip_address, ip_network

from rosproxy.admin.status_document import EndpointStatus
from rosproxy.doctor.facts import DoctorFacts, NodeFacts, Reach
from rosproxy.doctor.findings import DoctorFinding, Severity
from rosproxy.doctor.rules.proxy import local_master
from rosproxy.net.addresses import HostPort, is_address, is_loopback, parse_host_port
from rosproxy.ros1.protocol.uris import parse_inside_path, parse_service_uri, parse_slave_uri

INSIDE, OUTSIDE, STALE = "inside node", "node", "stale registration"
CLEANUP = "rosnode cleanup (answer y)"
_CONTAINER_ID = re.compile(r"[0-9a-f]{12}")


def check(facts: DoctorFacts) -> Iterator[DoctorFinding]:
    """All findings about nodes; about those asked for only, if there are names."""
    found = [*_inside(facts), *_registered(facts), *_services(facts), *_clock(facts)]
    if not facts.names:
        yield from _counts(facts, found)
    wanted = facts.scope.nodes
    yield from (f for f in found if not facts.names or not f.subject or f.subject in wanted)


def _counts(facts: DoctorFacts, found: list[DoctorFinding]) -> Iterator[DoctorFinding]:
    if facts.status is not None and not facts.status.nodes:
        port = facts.status.settings.master_port
        text = "none has registered through the proxy"
        fix = f"start them with ROS_MASTER_URI=http://PROXY:{port}, the proxy's address inside"
        yield DoctorFinding(Severity.WARNING, INSIDE, "inside nodes", text, fix)
    elif facts.status is not None:
        count = len(facts.status.nodes)
        sound = sum(node.state == "ok" for node in facts.status.nodes)
        yield DoctorFinding(Severity.OK, INSIDE, "inside nodes", f"{sound} of {count} answer")
    if facts.graph is not None:
        bad = {f.subject for f in found if f.severity is Severity.ERROR}
        faults = len(bad & set(facts.nodes))
        text = f"{len(facts.nodes)} registered, {faults or 'none'} with faults"
        severity = Severity.INFO if faults else Severity.OK
        yield DoctorFinding(severity, OUTSIDE, "nodes at the master", text)


def _inside(facts: DoctorFacts) -> Iterator[DoctorFinding]:
    for node in facts.status.nodes if facts.status else ():
        for name in node.nodes:
            yield from _inside_node(facts, node, name)


def _inside_node(facts: DoctorFacts, node: EndpointStatus, name: str) -> Iterator[DoctorFinding]:
    state, address = node.state, node.address
    after = facts.status.settings.cleanup_after if facts.status else 0
    if state in ("refused", "silent", "failing", "ok") and _only_on_loopback(node):
        yield DoctorFinding(
            Severity.ERROR,
            INSIDE,
            name,
            f"calls itself {node.uri} and so listens on loopback only: nobody can reach it",
            f"where it runs: unset ROS_IP ROS_HOSTNAME, or ROS_IP={address.rpartition(':')[0]}; "
            "then restart it",
        )
    elif state == "refused":
        own = f"the proxy unregisters it {after:g} s after that" if after else CLEANUP
        text = f"has ended without unregistering: {address} refuses connections"
        yield DoctorFinding(Severity.ERROR, INSIDE, name, text, f"restart it; {own}")
    elif state == "failing":
        text = f"did not answer the last probe at {address}"
        yield DoctorFinding(Severity.WARNING, INSIDE, name, text, "look again in some seconds")
    elif state == "silent":
        text = f"does not answer at {address}: it hangs, or something drops the packets"
        fix = f"restart it; from the proxy: nc -vz {address.replace(':', ' ')}"
        yield DoctorFinding(Severity.ERROR, INSIDE, name, text, fix)
    elif state == "unverified":
        text = f"was found at the master when the proxy started; {address} has not answered yet"
        yield DoctorFinding(
            Severity.WARNING, INSIDE, name, text, "wait some seconds, then restart it"
        )
    elif state == "cleaned":
        text = f"did not answer at {address} and was unregistered; it is taken back if it answers"
        yield DoctorFinding(Severity.WARNING, INSIDE, name, text, "restart it")
    elif state == "ok":
        yield from _namesakes(facts, node, name)


def _only_on_loopback(node: EndpointStatus) -> bool:
    """Whether a node gives a loopback address, and is somewhere else than the proxy."""
    named, placed = parse_slave_uri(node.uri), parse_host_port(node.address)
    return bool(named and placed and is_loopback(named.host) and not is_loopback(placed.host))


def _namesakes(facts: DoctorFacts, node: EndpointStatus, name: str) -> Iterator[DoctorFinding]:
    """Another node of the same name took over at the master."""
    known = facts.nodes.get(name)
    if known and known.uri and known.uri != node.advertised_uri:
        text = f"two nodes have this name: the master has {known.uri}, behind the proxy {node.uri}"
        yield DoctorFinding(
            Severity.ERROR, INSIDE, name, text, "give one another name: __name:=OTHER"
        )


def _registered(facts: DoctorFacts) -> Iterator[DoctorFinding]:
    for node in facts.nodes.values():
        if facts.ours(node.where):
            yield from _leased(facts, node)
        else:
            yield from _elsewhere(facts, node)


def _leased(facts: DoctorFacts, node: NodeFacts) -> Iterator[DoctorFinding]:
    """A node whose address is in this proxy's range."""
    lease = facts.leases.get(node.where.port) if node.where else None
    if lease is None:
        text = f"registered as {node.uri}, a port that no node holds any more"
        yield DoctorFinding(Severity.ERROR, STALE, node.name, text, CLEANUP)
    elif lease.advertised_uri != node.uri and node.name not in lease.nodes:
        holder = ", ".join(lease.nodes) or lease.uri
        text = f"registered as {node.uri}, a port that {holder} holds by now"
        yield DoctorFinding(Severity.ERROR, STALE, node.name, text, "restart it, or " + CLEANUP)


def _elsewhere(facts: DoctorFacts, node: NodeFacts) -> Iterator[DoctorFinding]:
    where = node.where
    if where is None:
        text = f"the master gives no usable address for it: {node.uri!r}"
        yield DoctorFinding(Severity.ERROR, OUTSIDE, node.name, text, "restart it")
    elif node.attempt.failed and parse_inside_path(node.uri):
        text = f"registered through a rosproxy as {node.uri}: {node.attempt.reach.value}"
        yield DoctorFinding(
            Severity.ERROR, OUTSIDE, node.name, text, _fix_proxied(facts, node, where)
        )
    elif is_loopback(where.host) and not (local_master(facts) and not node.attempt.failed):
        yield DoctorFinding(
            Severity.ERROR,
            OUTSIDE,
            node.name,
            f"registered as {node.uri}: to every other machine that is the machine itself",
            "where it runs: ROS_IP=ADDRESS with its address in the network of the master "
            "(and no ROS_HOSTNAME=localhost), then restart it",
        )
    elif node.attempt.reach is Reach.UNRESOLVABLE:
        yield _unresolvable(facts, node, where)
    elif node.attempt.failed:
        yield _unanswering(facts, node, where)
    elif _past_the_proxy(facts, node):
        yield DoctorFinding(
            Severity.WARNING,
            OUTSIDE,
            node.name,
            f"registered as {node.uri}, in an inside network: if it is meant to be behind the "
            "proxy, it has registered past it, and outside can't reach it",
            f"start it with {_inside_uri(facts)}",
        )


def _unresolvable(facts: DoctorFacts, node: NodeFacts, where: HostPort) -> DoctorFinding:
    text = f"registered as {node.uri}; the host name {where.host} can't be resolved here"
    if _CONTAINER_ID.fullmatch(where.host):
        text += ". It looks like a container that uses the real master, past the proxy"
        return DoctorFinding(
            Severity.ERROR, OUTSIDE, node.name, text, f"start it with {_inside_uri(facts)}"
        )
    fix = (
        f"where it runs: ROS_IP=ADDRESS, then restart it; or make {where.host} known to proxy and "
        f"inside nodes: docker run --add-host {where.host}:ADDRESS"
    )
    return DoctorFinding(Severity.ERROR, OUTSIDE, node.name, text, fix)


def _unanswering(facts: DoctorFacts, node: NodeFacts, where: HostPort) -> DoctorFinding:
    if node.attempt.reach is Reach.SILENT:
        text = f"no answer at {node.uri}: it hangs, or its machine is off or cut off"
        fix = f"from here: nc -vz {where.host} {where.port}; if it is gone: {CLEANUP}"
        return DoctorFinding(Severity.ERROR, OUTSIDE, node.name, text, fix)
    who = f" ({node.attempt.reason})" if node.attempt.reason else ""
    text = f"registered as {node.uri}, but gone: {node.attempt.reach.value}{who}"
    return DoctorFinding(Severity.ERROR, STALE, node.name, text, CLEANUP)


def _fix_proxied(facts: DoctorFacts, node: NodeFacts, where: HostPort) -> str:
    """Cleaning up would lose nodes that a proxy takes back when it starts again."""
    if node.attempt.reach is Reach.UNRESOLVABLE:
        return f"start its proxy with --advertise-host ADDRESS instead of the name {where.host}"
    if facts.status is None:
        return (
            f"on {where.host}: rosproxy doctor. Does the proxy run there, does the firewall let "
            "its ports through? Started again with the same ports it takes its nodes back"
        )
    return (
        f"if this proxy had {where} before, start it with its old --advertise-host and "
        f"--port-range, or restart the node; if it is of another proxy, look there; else {CLEANUP}"
    )


def _past_the_proxy(facts: DoctorFacts, node: NodeFacts) -> bool:
    """Whether a node's address is in an inside network that the master is not in."""
    if facts.status is None or facts.master is None:
        return False
    networks = [ip_network(text) for text in facts.status.settings.inside_networks]
    masters = [ip_address(text) for text in facts.master.addresses]
    return any(
        ip_address(address) in network and not any(master in network for master in masters)
        for address in node.addresses
        for network in networks
        if is_address(address)
    )


def _inside_uri(facts: DoctorFacts) -> str:
    port = facts.status.settings.master_port if facts.status else 11311
    return f"ROS_MASTER_URI=http://PROXY:{port}, the proxy's address inside"


def _services(facts: DoctorFacts) -> Iterator[DoctorFinding]:
    """Services that are registered with a port of this proxy which nobody holds."""
    for service, uri in facts.service_uris.items():
        where = parse_service_uri(uri)
        if facts.ours(where) and where and where.port not in facts.leases:
            providers = facts.graph.services.get(service, ()) if facts.graph else ()
            subject = next(iter(providers), service)
            text = f"its service {service} is registered as {uri}, a port that no node holds"
            yield DoctorFinding(Severity.ERROR, STALE, subject, text, f"restart it, or {CLEANUP}")


def _clock(facts: DoctorFacts) -> Iterator[DoctorFinding]:
    if facts.clock and facts.graph and not facts.graph.publishers.get("/clock"):
        text = "/use_sim_time is true and nobody publishes /clock: nodes wait for the time"
        fix = "rosparam set /use_sim_time false and restart them; or start what gives the clock"
        yield DoctorFinding(Severity.WARNING, "time", "", text, fix)
