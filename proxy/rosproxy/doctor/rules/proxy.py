"""Rules about the proxy itself: admin endpoint, master, advertised host, range and ports."""

from collections.abc import Iterator
from urllib.parse import urlsplit

from rosproxy.doctor.facts import DoctorFacts, MasterFacts, ReachOutcome
from rosproxy.shared.addresses import is_loopback, parse_host_port
from rosproxy.shared.documents.doctor_finding import (
    DoctorFinding,
    Severity,
    error,
    note,
    ok,
    warning,
)
from rosproxy.shared.documents.setup_rules import (
    HOST,
    RANGE,
    advertised_host,
    free_ports,
    is_all_here,
    published_range,
)
from rosproxy.shared.documents.status_bounds import left_out
from rosproxy.shared.fixes import how_to
from rosproxy.shared.output.text import duration, quoted


def _other_uri() -> str:
    return f"give the address of the real master: {how_to('master', uri='http://HOST:11311')}"


def check(facts: DoctorFacts) -> Iterator[DoctorFinding]:
    """All findings about the proxy."""
    yield from alive(facts)
    yield from setup(facts)
    yield from _published_master(facts)


def setup(facts: DoctorFacts) -> Iterator[DoctorFinding]:
    """Findings about the settings: master, advertised host, range and ports, first cause first."""
    if facts.proxy.settings.for_ros1:
        yield from _master(facts)
    for rule in (_advertised_host, _range, _ports):
        yield from rule(facts)


def running(facts: DoctorFacts) -> Iterator[DoctorFinding]:
    """Findings for the live page: master and ports. `rosproxy.app.self_check` tests the range."""
    yield from _master(facts)
    yield from _ports(facts)


def alive(facts: DoctorFacts) -> Iterator[DoctorFinding]:
    """The finding whether the proxy answers, and a note if the status is not complete.

    No finding if the doctor has asked no proxy.
    """
    if facts.status is not None:
        up = duration(facts.status.uptime)
        yield ok("admin", "proxy", f"rosproxy {facts.status.version} at {facts.admin}, up {up}")
        if missing := left_out(facts.status):
            text = f"the bounded status leaves out {missing} names and entries. The doctor does "
            text += "not check these"
            fix = f"{how_to('status')} to see which container has so many"
            yield note("admin", "proxy", text, fix)
    elif facts.admin_error:
        text = f"{facts.admin_error}. All other findings are made without the proxy"
        yield error("admin", "proxy", text, how_to("proxy runs"))


def _master(facts: DoctorFacts) -> Iterator[DoctorFinding]:
    master = facts.master
    if master is None:
        text = "not checked: the address of the master is unknown"
        yield note("master", "master", text, _other_uri())
    elif master.is_this_proxy:
        text = f"{master.uri} leads back to this proxy itself"
        yield error("master", "master", text, _other_uri())
    elif master.attempt.reach is not ReachOutcome.ANSWERED:
        yield error("master", "master", *_unanswered(master))
    else:
        trip = f" in {master.round_trip * 1000:.1f} ms" if master.round_trip else ""
        yield ok("master", "master", f"{master.uri} answers{trip}")
        status = facts.proxy.master
        if not status.up and status.error:
            text = f"{master.uri} answers the doctor, but the proxy reports: {status.error}"
            fix = "wait some seconds. If the finding stays, run the doctor where the proxy runs"
            yield warning("master", "master", text, fix)
        if facts.graph is None:
            text = f"{master.uri} answers, but does not list its nodes and topics"
            yield error("master", "master", text, "test the master: rosnode list")


def _unanswered(master: MasterFacts) -> tuple[str, str]:
    """Fault and fix of a master that does not answer, or does not answer as a master."""
    uri = master.uri
    split_uri = urlsplit(master.uri)
    host = split_uri.hostname or ""
    port = split_uri.port
    match master.attempt.reach:
        case ReachOutcome.UNRESOLVABLE:
            text = f"{uri}: the host name {host} can't be resolved here"
            return text, how_to("master's name", host=quoted(host), port=port)
        case ReachOutcome.STRANGER if master.at_root:
            text = f"a ROS master answers at this port, but not at the path {split_uri.path}"
            return (
                f"{uri}: {text}. A ROS master answers only / and /RPC2",
                how_to("master", uri=quoted(f"http://{split_uri.netloc}/")),
            )
        case ReachOutcome.STRANGER:
            text = f"{uri}: the program that answers is no ROS master{master.attempt.why}"
            return text, _other_uri()
        case ReachOutcome.REFUSED if is_loopback(host):
            text = f"{uri} refuses connections. In a container, {host} is the container itself"
            by_address = how_to("master", uri=f"http://ADDRESS:{port}")
            return text, f"give the address of the master's machine: {by_address}"
        case ReachOutcome.REFUSED:
            text = f"{uri} refuses connections: no roscore runs there"
            return text, f"start roscore on {quoted(host)}: roscore -p {port}; or {_other_uri()}"
    text = "the machine is off or cut off, a firewall drops the packets, or the address is wrong"
    fix = f"test from here: nc -vz {quoted(host)} {port}; test on {quoted(host)}: rosnode list"
    return f"{uri} does not answer{master.attempt.why}: {text}", fix


def _advertised_host(facts: DoctorFacts) -> Iterator[DoctorFinding]:
    host = facts.advertise_host
    if not host:
        if facts.admin_error:
            text = "not checked: the advertised host is unknown"
            yield note(HOST, HOST, text, how_to("advertised host"))
        return
    probes = facts.probe.probes if facts.probe else ()
    if not is_loopback(host) and any(probe.from_master == "ok" for probe in probes):
        return  # the master reaches the host by this name; here the name may mean another host
    # A loopback address is right if the master is on this machine. Without facts about the master
    # this is unknown.
    if facts.master or not facts.proxy.settings.for_ros1 or not is_loopback(host):
        yield from advertised_host(host, facts.advertised_addresses, _all_here(facts))


def _all_here(facts: DoctorFacts) -> bool:
    """Whether the master and all peers are on this machine, without a LAN relay."""
    domains = facts.proxy.domains
    peers = [peer for domain in domains for peer in domain.peers]
    targets = [(parse_host_port(peer), peer) for peer in peers]
    outside = [[target.host if target else peer] for target, peer in targets]
    if facts.proxy.settings.for_ros1:
        outside.append([*_master_hosts(facts)])
    return is_all_here(outside, any(domain.lan_relay for domain in domains))


def local_master(facts: DoctorFacts) -> bool:
    """Whether the master is on loopback, so that all of ROS is on this machine."""
    return any(map(is_loopback, _master_hosts(facts)))


def _master_hosts(facts: DoctorFacts) -> tuple[str, ...]:
    """The host name and the addresses of the master; empty without facts about the master."""
    if facts.master is None:
        return ()
    return (urlsplit(facts.master.uri).hostname or "", *facts.master.addresses)


def _range(facts: DoctorFacts) -> Iterator[DoctorFinding]:
    if facts.status is None:
        return
    if facts.probe is None:
        yield warning(RANGE, RANGE, f"not tried: {facts.probe_error}")
        return
    is_resolvable = bool(facts.advertised_addresses)
    for finding in published_range(facts.probe, facts.advertise_host, facts.proxy.ports):
        if is_resolvable or finding.severity is Severity.OK:  # else `_advertised_host` has reported
            yield finding


def _ports(facts: DoctorFacts) -> Iterator[DoctorFinding]:
    if facts.status is not None and facts.status.ports.listen:  # rmw_zenoh alone has no range
        yield from free_ports(facts.status.ports)


def _published_master(facts: DoctorFacts) -> Iterator[DoctorFinding]:
    port = facts.proxy.settings.publish_master
    if port is None:
        return
    check_name = "published master"
    attempt = facts.published_master
    text = f"http://{facts.advertise_host}:{port} for nodes outside: {attempt.reach.value}"
    fix = how_to("publish", ports="port", published=f"{port}:{port}")
    if not attempt.failed:
        yield ok(check_name, check_name, text)
    elif facts.probe and any(probe.from_proxy == "ok" for probe in facts.probe.probes):
        yield error(check_name, check_name, text, fix)
    else:
        text += ". This proves little, since no port of this host was reached from here"
        host = quoted(facts.advertise_host)
        fix += f"; test from outside: nc -vz {host} {port}"
        yield warning(check_name, check_name, text, fix)
