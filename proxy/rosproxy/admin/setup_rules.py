"""Whether outside can reach a proxy as it was set up: its advertised host, its range, its ports.

The same rules serve ``rosproxy doctor``, the proxy itself for its log and its status, and
``rosproxy run --check --deep`` before anything runs. The first cause comes first, and what follows
from it is not reported.
"""

from collections.abc import Iterator, Sequence

from rosproxy.admin.doctor_finding import DoctorFinding, error, note, ok, warning
from rosproxy.admin.requests import PortProbe, RangeProbe
from rosproxy.admin.status_document import PortsStatus, RangeProbeStatus
from rosproxy.net.addresses import is_loopback
from rosproxy.telemetry.text import listed, plural, quoted

FEW_FREE = 0.1
"""Share of the range that should be free at least."""

HOST = "advertised host"
RANGE = "published range"
BY_ADDRESS = "--advertise-host ADDRESS instead of a name (ROSPROXY_ADVERTISE_HOST)"
_OF_THIS_HOST = (
    "--advertise-host ADDRESS, the address of this host in the network of the robots "
    "(ROSPROXY_ADVERTISE_HOST)"
)
_NO_WAY_BACK = ("refused", "silent", "unreachable")
"""How the proxy's own try may end although outside gets through: NAT has no hairpin."""
TEXT_BY_OUTCOME = {
    "refused": "nothing listens there: the range is not published, or the host is another machine",
    "silent": "no answer: a firewall drops it, or the host is not this one",
    "unreachable": "there is no route to it",
    "unresolvable": "the host name is unknown here",
    "closed": "something takes the connection and drops it: published to another port or container",
    "stranger": "something else answers there, not this proxy",
}


def advertised_host(host: str, addresses: Sequence[str], all_here: bool) -> Iterator[DoctorFinding]:
    """What is wrong with an advertised host that leads to these addresses here.

    ``all_here``: all that is outside is on this machine as well.
    """
    loopback = [address for address in addresses if is_loopback(address)]
    if is_loopback(host) and not all_here:
        text = f"{host} is a loopback address: to every other machine it means that machine itself"
        yield error(HOST, HOST, text, _OF_THIS_HOST)
    elif not addresses:
        yield error(HOST, HOST, f"the host name {host} can't be resolved here", BY_ADDRESS)
    elif len(loopback) == len(addresses) and not all_here:
        text = (
            f"{host} leads to {listed(loopback)} here, a loopback address (/etc/hosts of many "
            "systems gives that to the host's own name): fine only if outside finds another address"
        )
        yield warning(HOST, HOST, text, BY_ADDRESS)


def published_range(probe: RangeProbe, host: str, ports: PortsStatus) -> Iterator[DoctorFinding]:
    """The findings from tries at some ports of the range."""
    outcomes: dict[tuple[str, str, str], list[str]] = {}
    for trial in probe.probes:
        port = trial.advertised.rpartition(":")[2]
        outcomes.setdefault((trial.transport, trial.from_proxy, trial.from_master), []).append(port)
    for (transport, from_proxy, from_master), tried_ports in outcomes.items():
        target = f"{host}, port {' and '.join(tried_ports)}"
        # If all tries ended alike, the whole range is out of reach, and not only a part of it.
        is_uniform = len({key for key in outcomes if key[0] == transport}) == 1
        if transport == "udp":
            yield _by_udp(host, ports, from_proxy, target)
        elif from_proxy == "ok" or from_master == "ok":
            yield _reached(host, from_proxy, from_master, target)
        else:
            yield _not_reached(host, ports, from_proxy, from_master, target, is_uniform)


def probe_result(probe: RangeProbe) -> RangeProbeStatus | None:
    """What tries at some ports of the range prove, in the sense of `published_range`.

    It is the worst of them; None if none was tried.
    """
    results = [
        RangeProbeStatus(_is_reached(p), p.from_proxy, p.from_master, p.transport)
        for p in probe.probes
    ]
    return min(results, key=lambda r: (False, None, True).index(r.reached), default=None)


def _is_reached(trial: PortProbe) -> bool | None:
    """Whether outside reaches a port; None where the proxy alone has tried and NAT may be why."""
    if trial.from_master != "unknown":
        return trial.from_master == "ok"
    if trial.from_proxy == "ok":
        return True
    return None if trial.transport == "udp" or trial.from_proxy in _NO_WAY_BACK else False


def few_ports(ports: PortsStatus) -> Iterator[DoctorFinding]:
    """How many ports are left, and who else has some."""
    used = ports.used
    free = ports.free
    blocked = ports.blocked
    larger_range = (
        "a larger --port-range (ROSPROXY_PORT_RANGE), published as well; rosproxy status tells who "
        "was refused"
    )
    if blocked:
        first, _, last = ports.listen.partition("-")
        text = f"{plural(blocked, 'port')} of the range {ports.listen} held by other programs"
        if ports.held_by:
            text += f": {'; '.join(ports.held_by)}"
            fix = "give one of the two another --port-range (ROSPROXY_PORT_RANGE), published too"
        else:
            sockets = quoted(f"sport >= :{first} and sport <= :{last}")
            fix = f"ss -ltnp {sockets}; or another --port-range"
        yield warning("ports", "ports", text, fix)
    if not free:
        text = f"none is free, {used} used: no further node gets in"
        yield error("ports", "ports", text, larger_range)
    elif free < FEW_FREE * (used + free + blocked):
        yield warning("ports", "ports", f"only {free} left, {used} used", larger_range)
    else:
        text = f"{ports.listen} as {ports.advertise}, {used} used, {free} free"
        yield ok("ports", "ports", text)


def _reached(host: str, from_proxy: str, from_master: str, target: str) -> DoctorFinding:
    """The finding where a try at free ports came through, the proxy's own or the master's."""
    if from_master == "ok":
        aside = "" if from_proxy == "ok" else f" (the proxy itself does not, {from_proxy}: no harm)"
        return ok(RANGE, RANGE, f"the master reaches {target}{aside}")
    if from_master == "unknown":
        return ok(RANGE, RANGE, f"the proxy reaches {target}; the master could not be asked to try")
    text = (
        f"{target}: reached from here, but not from the master's machine. There this host is known "
        "as another machine or by another address, or a firewall is in between"
    )
    fix = (
        "--advertise-host ADDRESS: this host as the master's machine knows it "
        "(ROSPROXY_ADVERTISE_HOST). To try there: nc -vz"
    )
    # `target` ends with the last port that was tried.
    return error(RANGE, RANGE, text, f"{fix} {quoted(host)} {target.rpartition(' ')[2]}")


def _not_reached(
    host: str, ports: PortsStatus, from_proxy: str, from_master: str, target: str, is_uniform: bool
) -> DoctorFinding:
    published = quoted(f"{ports.advertise}:{ports.listen}")
    fix = f"docker run -p {published}"
    if from_proxy == "unresolvable":
        fix = BY_ADDRESS
    elif is_uniform:
        fix += f", and let it through the firewall; or correct --advertise-host, now {quoted(host)}"
    else:
        fix = f"publish the whole range: {fix}"
    text = f"{target}: {TEXT_BY_OUTCOME.get(from_proxy, from_proxy)}"
    if from_master == "missed":
        return error(RANGE, RANGE, f"{text}. The master does not get through either", fix)
    if from_proxy in _NO_WAY_BACK:
        text += ". Or only the way back is missing; the master could not be asked to try"
        return warning(RANGE, RANGE, text, fix)
    return error(RANGE, RANGE, text, fix)


def _by_udp(host: str, ports: PortsStatus, from_proxy: str, target: str) -> DoctorFinding:
    """The finding from a try by UDP; failing proves nothing where NAT has no way back.

    Who outside does not get through is reported once somebody there is heard (`domain_problems`).
    """
    if from_proxy == "ok":
        return ok(RANGE, RANGE, f"the proxy reaches {target} by UDP")
    text = (
        f"{target}: what the proxy sends there by UDP does not come back to it. Perhaps only the "
        "way back is missing; perhaps the range is not published for UDP, or a firewall drops it"
    )
    published = quoted(f"{ports.advertise}:{ports.listen}/udp")
    fix = f"if nobody outside is heard: docker run -p {published}; is "
    return note(RANGE, RANGE, text, f"{fix}--advertise-host {quoted(host)} this host?")
