"""The proxy itself: its admin endpoint, its master, its advertised address and its ports."""

from collections.abc import Iterator
from urllib.parse import urlsplit

from rosproxy.admin.status_document import MasterStatus, PortsStatus
from rosproxy.doctor.facts import DoctorFacts, MasterFacts, Reach
from rosproxy.doctor.findings import DoctorFinding, Severity
from rosproxy.net.addresses import is_loopback
from rosproxy.telemetry.text import duration, plural

FEW_FREE = 0.1
"""Share of the range that should be free at least."""

RANGE = "published range"
_BY_ADDRESS = "--advertise-host ADDRESS instead of a name (ROSPROXY_ADVERTISE_HOST)"
_NO_WAY_BACK = ("refused", "silent", "unreachable")
"""How the proxy's own try may end although outside gets through: NAT has no hairpin."""
_TRIES = {
    "refused": "nothing listens there: the range is not published, or the host is another machine",
    "silent": "no answer: a firewall drops it, or the host is not this one",
    "unreachable": "no way leads there",
    "unresolvable": "the host name is unknown here",
    "closed": "something takes the connection and drops it: published to another port or container",
    "stranger": "something else answers there, not this proxy",
}


def check(facts: DoctorFacts) -> Iterator[DoctorFinding]:
    """All findings about the proxy."""
    for rule in (_admin, _master, _advertised_host, _range, _ports, _published_master):
        yield from rule(facts)


def _admin(facts: DoctorFacts) -> Iterator[DoctorFinding]:
    if facts.status is not None:
        status = facts.status
        text = f"rosproxy {status.version} at {facts.admin}, up {duration(status.uptime)}"
        yield DoctorFinding(Severity.OK, "admin", "proxy", text)
    elif facts.admin_error:
        text = f"{facts.admin_error}. What else is said here was found without it"
        fix = "docker ps; docker logs CONTAINER; docker exec CONTAINER rosproxy doctor"
        yield DoctorFinding(Severity.ERROR, "admin", "proxy", text, fix)


def _master(facts: DoctorFacts) -> Iterator[DoctorFinding]:
    master = facts.master
    if master is None:
        text = "not checked: no address is known"
        yield DoctorFinding(
            Severity.INFO, "master", "master", text, "give --master-uri (ROS_MASTER_URI)"
        )
        return
    if master.looped:
        text = f"{master.uri} leads back to this proxy itself"
        yield _error_of_master(text, _other_uri())
    elif master.attempt.reach is Reach.ANSWERED:
        trip = f" in {master.round_trip * 1000:.1f} ms" if master.round_trip else ""
        yield DoctorFinding(Severity.OK, "master", "master", f"{master.uri} answers{trip}")
        yield from _master_elsewhere(facts, master)
        if facts.graph is None:
            yield _error_of_master(
                f"{master.uri} answers, but does not tell its state", "rosnode list"
            )
    else:
        yield _error_of_master(*_unanswered(master))


def _master_elsewhere(facts: DoctorFacts, master: MasterFacts) -> Iterator[DoctorFinding]:
    """The master answers the doctor: does it answer the proxy as well?"""
    seen = facts.status.master if facts.status else MasterStatus(up=True)
    if not seen.up and seen.error:
        text = f"{master.uri} answers here, but the proxy says: {seen.error}"
        fix = "wait some seconds; if it stays, run this where the proxy runs"
        yield DoctorFinding(Severity.WARNING, "master", "master", text, fix)


def _unanswered(master: MasterFacts) -> tuple[str, str]:
    parts = urlsplit(master.uri)
    host, port = parts.hostname or "", parts.port
    match master.attempt.reach:
        case Reach.UNRESOLVABLE:
            return (
                f"{master.uri}: the host name {host} can't be resolved here",
                f"docker run --add-host {host}:ADDRESS, in Kubernetes hostAliases; or "
                f"--master-uri http://ADDRESS:{port}",
            )
        case Reach.STRANGER if master.at_root:
            return (
                f"{master.uri}: a master answers there, but not at the path {parts.path} (it "
                "knows only / and /RPC2)",
                f"--master-uri http://{parts.netloc}/",
            )
        case Reach.STRANGER:
            return (
                f"{master.uri}: what answers there is no ROS master ({master.attempt.reason})",
                _other_uri(),
            )
        case Reach.REFUSED if is_loopback(host):
            return (
                f"{master.uri} refuses connections. In a container {host} is the container itself",
                f"--master-uri http://ADDRESS:{port} with an address of the master's machine",
            )
        case Reach.REFUSED:
            return (
                f"{master.uri} refuses connections: no roscore runs there",
                f"on {host}: roscore -p {port}; or {_other_uri()}",
            )
    return (
        f"{master.uri} does not answer: its machine is down or cut off, a firewall drops it, or "
        "the address is wrong",
        f"from here: nc -vz {host} {port}; on {host}: rosnode list",
    )


def _other_uri() -> str:
    return "give the real master's address: --master-uri http://HOST:11311 (ROS_MASTER_URI)"


def _error_of_master(text: str, fix: str) -> DoctorFinding:
    return DoctorFinding(Severity.ERROR, "master", "master", text, fix)


def _advertised_host(facts: DoctorFacts) -> Iterator[DoctorFinding]:
    host, check = facts.advertise_host, "advertised host"
    if not host:
        if facts.admin_error:
            fix = "give --advertise-host (ROSPROXY_ADVERTISE_HOST)"
            yield DoctorFinding(Severity.INFO, check, check, "not checked: it is not known", fix)
    elif is_loopback(host) and facts.master and not local_master(facts):
        text = f"{host} is a loopback address: to every other machine it means that machine itself"
        fix = "--advertise-host ADDRESS, the address of this host in the network of the robots"
        yield DoctorFinding(Severity.ERROR, check, check, text, f"{fix} (ROSPROXY_ADVERTISE_HOST)")
    elif not facts.advertised_addresses and facts.status is None:
        text = f"the host name {host} can't be resolved here"
        yield DoctorFinding(Severity.ERROR, check, check, text, _BY_ADDRESS)


def local_master(facts: DoctorFacts) -> bool:
    """Whether the master is on loopback, so that all of ROS is on this machine."""
    if facts.master is None:
        return False
    host = urlsplit(facts.master.uri).hostname or ""
    return is_loopback(host) or any(map(is_loopback, facts.master.addresses))


def _range(facts: DoctorFacts) -> Iterator[DoctorFinding]:
    if facts.status is None:
        return
    if facts.probe is None:
        text = f"not tried: {facts.probe_error}"
        yield DoctorFinding(Severity.WARNING, RANGE, RANGE, text)
        return
    outcomes: dict[tuple[str, str], list[str]] = {}
    for probe in facts.probe.probes:
        port = probe.advertised.rpartition(":")[2]
        outcomes.setdefault((probe.from_proxy, probe.from_master), []).append(port)
    for (mine, masters), ports in outcomes.items():
        at = f"{facts.advertise_host}, port {' and '.join(ports)}"
        yield _tried(facts, mine, masters, at, len(outcomes) == 1)


def _tried(facts: DoctorFacts, mine: str, masters: str, at: str, whole: bool) -> DoctorFinding:
    """What tries at free ports mean: one by the proxy itself and one by the master."""
    if masters == "ok":
        back = "" if mine == "ok" else f" (the proxy itself does not, {mine}: no harm)"
        return DoctorFinding(Severity.OK, RANGE, RANGE, f"the master reaches {at}{back}")
    if mine == "ok" and masters == "unknown":
        text = f"the proxy reaches {at}; the master could not be asked to try"
        return DoctorFinding(Severity.OK, RANGE, RANGE, text)
    if mine == "ok":
        text = (
            f"{at}: reached from here, but not from the master's machine. For that it is another "
            "machine, an address that only this side has, or behind a firewall"
        )
        return DoctorFinding(Severity.ERROR, RANGE, RANGE, text, _fix_host(facts, at))
    text, severity = f"{at}: {_TRIES.get(mine, mine)}", Severity.ERROR
    if masters == "missed":
        text += ". The master does not get through either"
    elif mine in _NO_WAY_BACK:
        severity = Severity.WARNING
        text += ". Or only the way back is missing; the master, which could tell, is not there"
    return DoctorFinding(severity, RANGE, RANGE, text, _fix_range(facts, mine, whole))


def _fix_host(facts: DoctorFacts, at: str) -> str:
    port = at.rpartition(" ")[2]
    return (
        "--advertise-host ADDRESS: this host as the master's machine knows it "
        f"(ROSPROXY_ADVERTISE_HOST). To try there: nc -vz {facts.advertise_host} {port}"
    )


def _fix_range(facts: DoctorFacts, mine: str, whole: bool) -> str:
    if mine == "unresolvable":
        return _BY_ADDRESS
    ports = facts.status.ports if facts.status else PortsStatus()
    publish = f"docker run -p {ports.advertise}:{ports.listen}"
    if not whole:
        return f"publish the whole range: {publish}"
    return (
        f"{publish}, and let it through the firewall; or correct --advertise-host, now "
        f"{facts.advertise_host}"
    )


def _ports(facts: DoctorFacts) -> Iterator[DoctorFinding]:
    if facts.status is None:
        return
    ports = facts.status.ports
    used, free, blocked = ports.used, ports.free, ports.blocked
    larger = (
        "a larger --port-range (ROSPROXY_PORT_RANGE), published as well; rosproxy status tells who "
        "was refused"
    )
    if blocked:
        first, _, last = ports.listen.partition("-")
        text = f"{plural(blocked, 'port')} of the range {ports.listen} held by other programs"
        look = f"ss -ltnp 'sport >= :{first} and sport <= :{last}'"
        yield _of_ports(Severity.WARNING, text, f"{look}; or another --port-range")
    if not free:
        yield _of_ports(
            Severity.ERROR, f"none is free, {used} used: no further node gets in", larger
        )
    elif free < FEW_FREE * (used + free + blocked):
        yield _of_ports(Severity.WARNING, f"only {free} left, {used} used", larger)
    else:
        mapped = f"{ports.listen} as {ports.advertise}"
        yield _of_ports(Severity.OK, f"{mapped}, {used} used, {free} free")


def _of_ports(severity: Severity, text: str, fix: str = "") -> DoctorFinding:
    return DoctorFinding(severity, "ports", "ports", text, fix)


def _published_master(facts: DoctorFacts) -> Iterator[DoctorFinding]:
    port = facts.status.settings.publish_master if facts.status else None
    if port is None:
        return
    check, attempt = "published master", facts.published_master
    text = f"http://{facts.advertise_host}:{port} for nodes outside: {attempt.reach.value}"
    if not attempt.failed:
        yield DoctorFinding(Severity.OK, check, check, text)
    elif facts.probe and any(probe.from_proxy == "ok" for probe in facts.probe.probes):
        yield DoctorFinding(Severity.ERROR, check, check, text, f"docker run -p {port}:{port}")
    else:
        text += ". From here that proves little: no port of this host was reached"
        fix = f"docker run -p {port}:{port}; to try outside: nc -vz {facts.advertise_host} {port}"
        yield DoctorFinding(Severity.WARNING, check, check, text, fix)
