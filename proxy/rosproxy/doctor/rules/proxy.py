"""The proxy itself: its admin endpoint, its master, its advertised address and its ports."""

from collections.abc import Iterator
from urllib.parse import urlsplit

from rosproxy.doctor.facts import DoctorFacts, MasterFacts, Reach
from rosproxy.doctor.findings import DoctorFinding, error, note, ok, warning
from rosproxy.net.addresses import is_loopback
from rosproxy.telemetry.text import duration, plural

FEW_FREE = 0.1
"""Share of the range that should be free at least."""

RANGE = "published range"
_BY_ADDRESS = "--advertise-host ADDRESS instead of a name (ROSPROXY_ADVERTISE_HOST)"
_OTHER_URI = "give the real master's address: --master-uri http://HOST:11311 (ROS_MASTER_URI)"
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
        up = duration(facts.status.uptime)
        yield ok("admin", "proxy", f"rosproxy {facts.status.version} at {facts.admin}, up {up}")
    elif facts.admin_error:
        text = f"{facts.admin_error}. What else is said here was found without it"
        fix = "docker ps; docker logs CONTAINER; docker exec CONTAINER rosproxy doctor"
        yield error("admin", "proxy", text, fix)


def _master(facts: DoctorFacts) -> Iterator[DoctorFinding]:
    master = facts.master
    if master is None:
        text = "not checked: no address is known"
        yield note("master", "master", text, "give --master-uri (ROS_MASTER_URI)")
    elif master.looped:
        text = f"{master.uri} leads back to this proxy itself"
        yield error("master", "master", text, _OTHER_URI)
    elif master.attempt.reach is not Reach.ANSWERED:
        yield error("master", "master", *_unanswered(master))
    else:
        trip = f" in {master.round_trip * 1000:.1f} ms" if master.round_trip else ""
        yield ok("master", "master", f"{master.uri} answers{trip}")
        seen = facts.proxy.master
        if not seen.up and seen.error:
            text = f"{master.uri} answers here, but the proxy says: {seen.error}"
            fix = "wait some seconds; if it stays, run this where the proxy runs"
            yield warning("master", "master", text, fix)
        if facts.graph is None:
            text = f"{master.uri} answers, but does not tell its state"
            yield error("master", "master", text, "rosnode list")


def _unanswered(master: MasterFacts) -> tuple[str, str]:
    """What is wrong with a master that does not answer as one, and what mends it."""
    uri, parts = master.uri, urlsplit(master.uri)
    host, port = parts.hostname or "", parts.port
    by_address = f"--master-uri http://ADDRESS:{port}"
    match master.attempt.reach:
        case Reach.UNRESOLVABLE:
            text = f"{uri}: the host name {host} can't be resolved here"
            add_host = f"docker run --add-host {host}:ADDRESS, in Kubernetes hostAliases"
            return text, f"{add_host}; or {by_address}"
        case Reach.STRANGER if master.at_root:
            text = f"a master answers there, but not at the path {parts.path}"
            return (
                f"{uri}: {text} (it knows only / and /RPC2)",
                f"--master-uri http://{parts.netloc}/",
            )
        case Reach.STRANGER:
            text = f"{uri}: what answers there is no ROS master ({master.attempt.reason})"
            return text, _OTHER_URI
        case Reach.REFUSED if is_loopback(host):
            text = f"{uri} refuses connections. In a container {host} is the container itself"
            return text, f"{by_address} with an address of the master's machine"
        case Reach.REFUSED:
            text = f"{uri} refuses connections: no roscore runs there"
            return text, f"on {host}: roscore -p {port}; or {_OTHER_URI}"
    text = "its machine is down or cut off, a firewall drops it, or the address is wrong"
    fix = f"from here: nc -vz {host} {port}; on {host}: rosnode list"
    return f"{uri} does not answer: {text}", fix


def _advertised_host(facts: DoctorFacts) -> Iterator[DoctorFinding]:
    host, check = facts.advertise_host, "advertised host"
    if not host:
        if facts.admin_error:
            fix = "give --advertise-host (ROSPROXY_ADVERTISE_HOST)"
            yield note(check, check, "not checked: it is not known", fix)
    elif is_loopback(host) and facts.master and not local_master(facts):
        text = f"{host} is a loopback address: to every other machine it means that machine itself"
        fix = "--advertise-host ADDRESS, the address of this host in the network of the robots"
        yield error(check, check, text, f"{fix} (ROSPROXY_ADVERTISE_HOST)")
    elif not facts.advertised_addresses and facts.status is None:
        yield error(check, check, f"the host name {host} can't be resolved here", _BY_ADDRESS)


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
        yield warning(RANGE, RANGE, f"not tried: {facts.probe_error}")
        return
    outcomes: dict[tuple[str, str], list[str]] = {}
    for probe in facts.probe.probes:
        port = probe.advertised.rpartition(":")[2]
        outcomes.setdefault((probe.from_proxy, probe.from_master), []).append(port)
    for (mine, masters), ports in outcomes.items():
        at = f"{facts.advertise_host}, port {' and '.join(ports)}"
        if mine == "ok" or masters == "ok":
            yield _reached(facts, mine, masters, at)
        else:
            yield _not_reached(facts, mine, masters, at, len(outcomes) == 1)


def _reached(facts: DoctorFacts, mine: str, masters: str, at: str) -> DoctorFinding:
    """What tries at free ports mean of which one came through, the proxy's own or the master's."""
    if masters == "ok":
        back = "" if mine == "ok" else f" (the proxy itself does not, {mine}: no harm)"
        return ok(RANGE, RANGE, f"the master reaches {at}{back}")
    if masters == "unknown":
        return ok(RANGE, RANGE, f"the proxy reaches {at}; the master could not be asked to try")
    text = (
        f"{at}: reached from here, but not from the master's machine. For that it is another "
        "machine, an address that only this side has, or behind a firewall"
    )
    fix = (
        "--advertise-host ADDRESS: this host as the master's machine knows it "
        "(ROSPROXY_ADVERTISE_HOST). To try there: nc -vz"
    )
    return error(RANGE, RANGE, text, f"{fix} {facts.advertise_host} {at.rpartition(' ')[2]}")


def _not_reached(
    facts: DoctorFacts, mine: str, masters: str, at: str, whole: bool
) -> DoctorFinding:
    ports = facts.proxy.ports
    fix = f"docker run -p {ports.advertise}:{ports.listen}"
    if mine == "unresolvable":
        fix = _BY_ADDRESS
    elif whole:
        fix += ", and let it through the firewall; or correct --advertise-host, now "
        fix += facts.advertise_host
    else:
        fix = f"publish the whole range: {fix}"
    text = f"{at}: {_TRIES.get(mine, mine)}"
    if masters == "missed":
        return error(RANGE, RANGE, f"{text}. The master does not get through either", fix)
    if mine in _NO_WAY_BACK:
        text += ". Or only the way back is missing; the master, which could tell, is not there"
        return warning(RANGE, RANGE, text, fix)
    return error(RANGE, RANGE, text, fix)


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
        fix = f"ss -ltnp 'sport >= :{first} and sport <= :{last}'; or another --port-range"
        yield warning("ports", "ports", text, fix)
    if not free:
        text = f"none is free, {used} used: no further node gets in"
        yield error("ports", "ports", text, larger)
    elif free < FEW_FREE * (used + free + blocked):
        yield warning("ports", "ports", f"only {free} left, {used} used", larger)
    else:
        text = f"{ports.listen} as {ports.advertise}, {used} used, {free} free"
        yield ok("ports", "ports", text)


def _published_master(facts: DoctorFacts) -> Iterator[DoctorFinding]:
    port = facts.proxy.settings.publish_master
    if port is None:
        return
    check, attempt = "published master", facts.published_master
    text = f"http://{facts.advertise_host}:{port} for nodes outside: {attempt.reach.value}"
    if not attempt.failed:
        yield ok(check, check, text)
    elif facts.probe and any(probe.from_proxy == "ok" for probe in facts.probe.probes):
        yield error(check, check, text, f"docker run -p {port}:{port}")
    else:
        text += ". From here that proves little: no port of this host was reached"
        fix = f"docker run -p {port}:{port}; to try outside: nc -vz {facts.advertise_host} {port}"
        yield warning(check, check, text, fix)
