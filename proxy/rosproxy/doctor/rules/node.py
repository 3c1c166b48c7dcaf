"""Rules about nodes: the nodes behind the proxy, and the nodes at the master."""

import re
from collections.abc import Iterator, Sequence
from ipaddress import ip_network

from msgspec.structs import replace

from rosproxy.doctor.facts import DoctorFacts, NodeFacts, ReachOutcome
from rosproxy.doctor.rules.proxy import local_master
from rosproxy.shared.addresses import HostPort, is_inside, is_loopback, parse_host_port
from rosproxy.shared.documents.doctor_finding import (
    DoctorFinding,
    Severity,
    error,
    note,
    ok,
    warning,
)
from rosproxy.shared.documents.setup_rules import LOOPBACK_MEANING
from rosproxy.shared.documents.status_document import EndpointStatus
from rosproxy.shared.fixes import how_to
from rosproxy.shared.output.text import plural, quoted
from rosproxy.shared.uris import parse_service_uri, parse_slave_uri

INSIDE = "inside node"
OUTSIDE = "node"
STALE = "stale registration"
TWO_PROXIES = "two proxies"
_ENDED = ("refused", "silent", "failing", "cleaned")
FIRST_NODE_TIMEOUT_S = 10.0
"""Seconds after the start in which a proxy without nodes is no fault.

An operator starts the proxy and the nodes at the same time.
"""
CLEANUP = "run rosnode cleanup (answer y)"
"""The fix that unregisters all nodes that do not answer."""
# The default host name of a container (moby daemon/container.go).
_CONTAINER_ID = re.compile(r"[0-9a-f]{12}")


def check(facts: DoctorFacts) -> Iterator[DoctorFinding]:
    """All findings about nodes; with names, only the findings about the nodes in the scope."""
    findings = _cause_first(
        [*_inside(facts), *_registered(facts), *_services(facts), *_clock(facts)]
    )
    if not facts.names:
        yield from _counts(facts, findings)
    if facts.untried:
        text = f"{facts.untried} nodes are not tried: too many are registered at the master"
        fix = "run the doctor with the name of a node or topic; rosnode list -a shows the "
        fix += "addresses of all nodes"
        yield note(OUTSIDE, "nodes at the master", text, fix)
    wanted = facts.scope.nodes
    yield from (f for f in findings if not facts.names or not f.subject or f.subject in wanted)


def _cause_first(findings: list[DoctorFinding]) -> list[DoctorFinding]:
    """Put findings about two proxies first, and remove CLEANUP from the fixes of the others.

    If two proxies share host and ports, a clean-up would unregister nodes that are alive. Without
    such a finding, nothing changes.
    """
    first = [f for f in findings if f.check == TWO_PROXIES]
    if not first:
        return findings
    rest = [f for f in findings if f.check != TWO_PROXIES]
    wait = "separate the two proxies first, then run the doctor again"
    return first + [replace(f, fix=wait) if CLEANUP in f.fix else f for f in rest]


def _counts(facts: DoctorFacts, findings: list[DoctorFinding]) -> Iterator[DoctorFinding]:
    present, ended = _present_and_ended(facts.proxy.nodes)
    if present or ended:
        answering = sum(node.state == "ok" for node in present)
        text = f"{answering} of {len(present)} answer"
        if ended:
            ports = f"{plural(len(ended), 'port')} for up to {facts.proxy.settings.linger:g} s"
            text += f"; ended nodes still hold {ports}"
        report = ok if answering == len(present) else note
        yield report(INSIDE, "inside nodes", text)
    elif facts.status is not None:
        text = "no node has registered through the proxy"
        report = warning if facts.proxy.uptime >= FIRST_NODE_TIMEOUT_S else note
        yield report(INSIDE, "inside nodes", text, _start_inside(facts, "the nodes"))
    if facts.graph is not None:
        faulty = {f.subject for f in findings if f.severity is Severity.ERROR}
        faults = len(faulty & set(facts.nodes))
        text = f"{len(facts.nodes)} registered, {faults or 'none'} with faults"
        yield (note if faults else ok)(OUTSIDE, "nodes at the master", text)


def _present_and_ended(
    nodes: Sequence[EndpointStatus],
) -> tuple[list[EndpointStatus], list[EndpointStatus]]:
    """The nodes that are present or should be, and the nodes whose end is no fault.

    A node has ended if its container is gone, if the node has no registrations any more, or if a
    node with the same name answers at another address. An ended node keeps its port for a while.
    """
    answering = {name for node in nodes if node.state in ("ok", "new") for name in node.nodes}
    present = list[EndpointStatus]()
    ended = list[EndpointStatus]()
    for node in nodes:
        is_replaced = node.state in _ENDED and answering.issuperset(node.nodes)
        (ended if node.has_ended or is_replaced else present).append(node)
    return present, ended


def _inside(facts: DoctorFacts) -> Iterator[DoctorFinding]:
    present, _ = _present_and_ended(facts.proxy.nodes)
    for node in present:
        for name in node.nodes:
            yield from _inside_node(facts, node, name)


def _inside_node(facts: DoctorFacts, node: EndpointStatus, name: str) -> Iterator[DoctorFinding]:
    state = node.state
    address = node.address
    if state in ("refused", "silent", "failing", "ok") and _only_on_loopback(node):
        text = (
            f"registered as {node.uri}, so the node listens on loopback only. Nodes in other "
            "containers or on other machines can't connect"
        )
        host, _ = _host_and_port(address)
        fix = f"where the node runs: unset ROS_IP ROS_HOSTNAME, or set ROS_IP={host}; "
        fix += "then restart the node"
        yield error(INSIDE, name, text, fix)
    elif state == "refused":
        after = facts.proxy.settings.cleanup_after
        cleanup = f"the proxy unregisters the node after {after:g} s" if after else CLEANUP
        text = f"has ended without unregistering: {address} refuses connections"
        yield error(INSIDE, name, text, f"restart the node; without a restart, {cleanup}")
    elif state == "failing":
        text = f"did not answer the last probe at {address}"
        yield warning(INSIDE, name, text, "run the doctor again in some seconds")
    elif state == "silent":
        text = f"does not answer at {address}: the node hangs, or the network drops the packets"
        host, port = _host_and_port(address)
        fix = f"restart the node; test from the proxy: nc -vz {host} {port}"
        yield error(INSIDE, name, text, fix)
    elif state == "unverified":
        text = f"was found at the master when the proxy started; {address} has not answered yet"
        yield warning(INSIDE, name, text, "wait some seconds, then restart the node")
    elif state == "cleaned":
        text = (
            f"did not answer at {address}, so the proxy unregistered the node. If the node "
            "answers, the proxy registers it again"
        )
        yield warning(INSIDE, name, text, "restart the node")
    elif state == "ok":
        yield from _namesakes(facts, node, name)


def _host_and_port(address: str) -> tuple[str, str]:
    """The host (IPv6 without brackets) and the port of an address, each as a word of a shell."""
    host, _, port = address.rpartition(":")
    return quoted(host.strip("[]")), quoted(port)


def _only_on_loopback(node: EndpointStatus) -> bool:
    """Whether a node states a loopback address, but the proxy reaches the node at another one."""
    claimed = parse_slave_uri(node.uri)
    actual = parse_host_port(node.address)
    return bool(claimed and actual and is_loopback(claimed.host) and not is_loopback(actual.host))


def _namesakes(facts: DoctorFacts, node: EndpointStatus, name: str) -> Iterator[DoctorFinding]:
    """The finding if another node of the same name is registered at the master."""
    registered = facts.nodes.get(name)
    if registered and registered.uri and registered.uri != node.advertised_uri:
        text = (
            f"two nodes have this name: one is registered at the master as {registered.uri}, the "
            f"other runs behind the proxy as {node.uri}"
        )
        yield error(INSIDE, name, text, "start one of the two with another name: __name:=OTHER")


def _registered(facts: DoctorFacts) -> Iterator[DoctorFinding]:
    for node in facts.nodes.values():
        yield from (_leased if facts.is_ours(node.slave) else _elsewhere)(facts, node)


def _leased(facts: DoctorFacts, node: NodeFacts) -> Iterator[DoctorFinding]:
    """The findings about a node whose address is in the range of this proxy."""
    lease = facts.lease(node.slave)
    if lease is None and _is_of_another_proxy(facts, node):
        text = (
            f"is alive as {node.uri}, but this proxy knows no such node: another rosproxy "
            "advertises the same host and ports. Outside reaches sometimes this proxy, sometimes "
            "the other"
        )
        fix = (
            f"stop one of the two proxies; or, for one of them, {how_to('other range')}. Do not "
            "run rosnode cleanup: it unregisters nodes that are alive"
        )
        yield error(TWO_PROXIES, node.name, text, fix)
    elif lease is None:
        text = f"registered as {node.uri}, a port that no node holds any more"
        yield error(STALE, node.name, text, CLEANUP)
    elif node.name not in lease.nodes:
        holder = ", ".join(lease.nodes) or lease.uri
        text = f"registered as {node.uri}, a port that {holder} holds now"
        yield error(STALE, node.name, text, f"restart the node, or {CLEANUP}")


def _is_of_another_proxy(facts: DoctorFacts, node: NodeFacts) -> bool:
    """Whether a node answers at a port of this proxy that no node here holds."""
    answered = node.attempt.reach is ReachOutcome.ANSWERED
    return answered and facts.is_ours(node.slave) and facts.lease(node.slave) is None


def _elsewhere(facts: DoctorFacts, node: NodeFacts) -> Iterator[DoctorFinding]:
    slave = node.slave
    reach = node.attempt.reach
    if slave is None:
        text = f"the master gives no usable address for this node: {node.uri!r}"
        yield error(OUTSIDE, node.name, text, "restart the node")
    elif node.attempt.failed and node.inside:
        text = f"registered through a rosproxy as {node.uri}: {reach.value}"
        yield error(OUTSIDE, node.name, text, _fix_proxied(facts, node, slave))
    # A loopback address is right if the master is on loopback, too: all nodes are on this machine.
    elif is_loopback(slave.host) and not (local_master(facts) and not node.attempt.failed):
        text = f"registered as {node.uri}, a loopback address. {LOOPBACK_MEANING}"
        fix = (
            "where the node runs: set ROS_IP=ADDRESS, the address of that machine in the network "
            "of the master, and unset ROS_HOSTNAME; then restart the node"
        )
        yield error(OUTSIDE, node.name, text, fix)
    elif reach is ReachOutcome.UNRESOLVABLE:
        yield _unresolvable(facts, node, slave)
    elif reach is ReachOutcome.SILENT:
        text = (
            f"no answer at {node.uri}{node.attempt.why}: the node hangs, its machine is off or cut "
            "off, a firewall is in the way, or the address is of a network that is not reached "
            "from here"
        )
        fix = (
            f"test from here: nc -vz {quoted(slave.host)} {slave.port}; where the node runs, set "
            "ROS_IP to an address that is reached from here, and restart the node; only if the "
            f"node is gone, {CLEANUP}"
        )
        yield error(OUTSIDE, node.name, text, fix)
    elif node.attempt.failed:
        text = f"registered as {node.uri}, but gone: {reach.value}{node.attempt.why}"
        yield error(STALE, node.name, text, CLEANUP)
    elif _past_the_proxy(facts, node):
        text = (
            f"registered as {node.uri}, an address in an inside network, but not through the "
            "proxy. If the node belongs behind the proxy, outside can't reach it"
        )
        yield warning(OUTSIDE, node.name, text, _start_inside(facts))


def _unresolvable(facts: DoctorFacts, node: NodeFacts, slave: HostPort) -> DoctorFinding:
    text = f"registered as {node.uri}; the host name {slave.host} can't be resolved here"
    if _CONTAINER_ID.fullmatch(slave.host):
        text += ". It looks like a container that uses the real master instead of the proxy"
        return error(OUTSIDE, node.name, text, _start_inside(facts))
    host = quoted(slave.host)
    fix = "where the node runs: set ROS_IP=ADDRESS, then restart the node; or " + how_to(
        "node's name", host=host
    )
    return error(OUTSIDE, node.name, text, fix)


def _fix_proxied(facts: DoctorFacts, node: NodeFacts, slave: HostPort) -> str:
    """The fix for a node that is registered through a proxy, but does not answer.

    A clean-up is the last resort: a proxy that starts again takes its nodes back.
    """
    host = quoted(slave.host)
    if node.attempt.reach is ReachOutcome.UNRESOLVABLE:
        address = how_to("advertised host")
        return f"give the node's proxy an address instead of the name {host}: {address}"
    if facts.status is None:
        return (
            f"run the doctor on {host}. Check that the proxy runs there, and that the "
            "firewall accepts its ports. A proxy that starts again with the same ports takes its "
            "nodes back"
        )
    return (
        f"if this proxy had {quoted(str(slave))} before, give the proxy its old advertised host "
        "and range again, or restart the node. If the node belongs to another proxy, check that "
        f"proxy. Else {CLEANUP}"
    )


def _past_the_proxy(facts: DoctorFacts, node: NodeFacts) -> bool:
    """Whether a node's address is in an inside network, and the master is not in that network."""
    if facts.master is None:
        return False
    networks = [ip_network(text) for text in facts.proxy.settings.inside_networks]
    # If the master is in an inside network, nodes there may be outside nodes on purpose.
    apart = [n for n in networks if not any(is_inside(a, [n]) for a in facts.master.addresses)]
    return any(is_inside(address, apart) for address in node.addresses)


def _start_inside(facts: DoctorFacts, nodes: str = "the node") -> str:
    return how_to("nodes inside", nodes=nodes, port=facts.proxy.settings.master_port)


def _services(facts: DoctorFacts) -> Iterator[DoctorFinding]:
    """The findings about services at a port of this proxy that no node holds."""
    for service, uri in facts.service_uris.items():
        provider = parse_service_uri(uri)
        if facts.is_ours(provider) and not facts.lease(provider):
            subject = next(iter(facts.system.services.get(service, ())), service)
            # `_leased` has reported the other proxy.
            if subject in facts.nodes and _is_of_another_proxy(facts, facts.nodes[subject]):
                continue
            text = f"the service {service} is registered as {uri}, a port that no node holds"
            yield error(STALE, subject, text, f"restart the node, or {CLEANUP}")


def _clock(facts: DoctorFacts) -> Iterator[DoctorFinding]:
    if facts.uses_simulated_time and facts.graph and not facts.graph.publishers.get("/clock"):
        text = "/use_sim_time is true, but no node publishes /clock. The nodes wait for the time"
        fix = "start the node that publishes /clock; or run rosparam set /use_sim_time false, and "
        fix += "restart the nodes"
        yield warning("time", "", text, fix)
