"""Whether outside can reach a proxy with its settings: advertised host, range, free ports.

These rules serve ``rosproxy doctor``, the log and the status of the proxy, and
``rosproxy run --check --deep`` before a start. Findings name the first cause, not the consequences.
"""

from collections.abc import Collection, Iterable, Iterator, Sequence

from rosproxy.shared.addresses import is_loopback
from rosproxy.shared.documents.doctor_finding import DoctorFinding, error, note, ok, warning
from rosproxy.shared.documents.requests import PortProbe, RangeProbe
from rosproxy.shared.documents.status_document import PortsStatus, RangeProbeStatus
from rosproxy.shared.fixes import how_to
from rosproxy.shared.output.text import listed, plural, quoted

LOOPBACK_MEANING = "Other machines reach only themselves at this address"
"""The reason why a loopback address is wrong, for findings."""
LEAST_FREE_SHARE = 0.1
"""The smallest share of free ports in the range without a warning."""

HOST = "advertised host"
RANGE = "published range"
"""HOST and RANGE: the checks of findings, and also their subjects."""
_NO_WAY_BACK = ("refused", "silent", "unreachable")
"""Failures of the proxy's own try that prove no fault: NAT without hairpin causes the same."""
TEXT_BY_OUTCOME = {
    "refused": (
        "connection refused. The range is not published, or the address is not that of this host"
    ),
    "silent": ("no answer. A firewall drops the packets, or the address is not that of this host"),
    "unreachable": "there is no route to this address",
    "unresolvable": "the host name can't be resolved here",
    "closed": (
        "the connection is accepted, but does not reach the proxy. The port is published to "
        "another port or container"
    ),
    "stranger": "another program accepts the connection, not this proxy",
}
"""What a failure in `PortProbe.from_proxy` means, for findings."""


def _fix_by_address() -> str:
    """The fix for a host name that can't be resolved, or that leads to loopback here."""
    return f"give an address instead of the name: {how_to('advertised host')}"


def _fix_by_own_address() -> str:
    """The fix for an advertised host that is a loopback address."""
    address = how_to("advertised host")
    return f"give the address of this host in the network of the robots: {address}"


def is_all_here(outside: Iterable[Collection[str]], lan_relay: bool) -> bool:
    """Whether all nodes outside are on this machine, as in a trial.

    ``outside``: for the master and each peer, its names and addresses. A loopback address among
    them means this machine. ``lan_relay``: whether participants on the LAN are outside, too. False
    if there is neither a master nor a peer, because nothing tells where outside is.
    """
    is_here = [any(map(is_loopback, names)) for names in outside]
    return bool(is_here) and all(is_here) and not lan_relay


def advertised_host(host: str, addresses: Sequence[str], all_here: bool) -> Iterator[DoctorFinding]:
    """The findings about an advertised host that resolves to these addresses on this machine.

    ``all_here``: all nodes outside are on this machine, too.
    """
    loopback = [address for address in addresses if is_loopback(address)]
    if is_loopback(host) and not all_here:
        text = f"{host} is a loopback address. {LOOPBACK_MEANING}"
        yield error(HOST, HOST, text, _fix_by_own_address())
    elif not addresses:
        yield error(HOST, HOST, f"the host name {host} can't be resolved here", _fix_by_address())
    elif len(loopback) == len(addresses) and not all_here:
        text = (
            f"{host} leads to {listed(loopback)} here, a loopback address (in /etc/hosts, many "
            "systems give their own name such an address). Outside must resolve the name to "
            "another address"
        )
        yield warning(HOST, HOST, text, _fix_by_address())


def published_range(probe: RangeProbe, host: str, ports: PortsStatus) -> Iterator[DoctorFinding]:
    """The findings from tries at some ports of the range."""
    outcomes: dict[tuple[str, str, str], list[str]] = {}
    for trial in probe.probes:
        port = trial.advertised.rpartition(":")[2]
        outcomes.setdefault((trial.transport, trial.from_proxy, trial.from_master), []).append(port)
    for (transport, from_proxy, from_master), tried_ports in outcomes.items():
        target = f"{host}, port {' and '.join(tried_ports)}"
        # If all tries ended alike, the whole range is out of reach, not only a part.
        is_uniform = len({key for key in outcomes if key[0] == transport}) == 1
        if transport == "udp":
            yield _by_udp(host, ports, from_proxy, target)
        elif from_proxy == "ok" or from_master == "ok":
            yield _reached(host, from_proxy, from_master, target)
        else:
            yield _not_reached(host, ports, from_proxy, from_master, target, is_uniform)


def probe_result(probe: RangeProbe) -> RangeProbeStatus | None:
    """The worst result of the tries at some ports of the range; None without tries.

    `published_range` makes findings from the same results.
    """
    results = [
        RangeProbeStatus(_is_reached(p), p.from_proxy, p.from_master, p.transport)
        for p in probe.probes
    ]
    return min(results, key=lambda r: (False, None, True).index(r.reached), default=None)


def _is_reached(trial: PortProbe) -> bool | None:
    """Whether outside reaches a port; None if unknown: only the proxy tried, and NAT may fail."""
    if trial.from_master != "unknown":
        return trial.from_master == "ok"
    if trial.from_proxy == "ok":
        return True
    return None if trial.transport == "udp" or trial.from_proxy in _NO_WAY_BACK else False


def free_ports(ports: PortsStatus) -> Iterator[DoctorFinding]:
    """The findings about free ports, and about ports that other programs hold."""
    used = ports.used
    free = ports.free
    blocked = ports.blocked
    larger_range = (
        f"{how_to('larger range')}. To see which nodes and participants got no port, "
        f"{how_to('status')}"
    )
    if blocked:
        first, _, last = ports.listen.partition("-")
        text = f"other programs hold {plural(blocked, 'port')} of the range {ports.listen}"
        if ports.held_by:
            text += f": {'; '.join(ports.held_by)}"
            fix = f"for one of the proxies, {how_to('other range')}"
        else:
            sockets = quoted(f"sport >= :{first} and sport <= :{last}")
            fix = f"find the programs: ss -ltnp {sockets}; or {how_to('other range')}"
        yield warning("ports", "ports", text, fix)
    if not free:
        text = f"no port is free, {used} used. Further nodes get no port"
        fix = f"{larger_range}. Then restart the ROS 1 nodes that got no port"
        yield error("ports", "ports", text, fix)
    elif free < LEAST_FREE_SHARE * (used + free + blocked):
        yield warning("ports", "ports", f"only {free} free, {used} used", larger_range)
    else:
        text = f"{ports.listen}, advertised as {ports.advertise}: {used} used, {free} free"
        yield ok("ports", "ports", text)


def _reached(host: str, from_proxy: str, from_master: str, target: str) -> DoctorFinding:
    """The finding if the proxy or the master has reached the ports."""
    if from_master == "ok":
        aside = (
            "" if from_proxy == "ok" else f" (the proxy does not: {from_proxy}. This is no fault)"
        )
        return ok(RANGE, RANGE, f"the master reaches {target}{aside}")
    if from_master == "unknown":
        return ok(RANGE, RANGE, f"the proxy reaches {target}. The master could not be asked to try")
    text = (
        f"{target}: reached by the proxy, but not from the master's machine. There this host has "
        "another address, or the name leads to another machine, or a firewall blocks the connection"
    )
    fix = (
        "give the address of this host as the master's machine sees it: "
        f"{how_to('advertised host')}. Test on the master's machine: nc -vz"
    )
    # `target` ends with the last port that was tried.
    return error(RANGE, RANGE, text, f"{fix} {quoted(host)} {target.rpartition(' ')[2]}")


def _not_reached(
    host: str, ports: PortsStatus, from_proxy: str, from_master: str, target: str, is_uniform: bool
) -> DoctorFinding:
    published = quoted(f"{ports.advertise}:{ports.listen}")
    ports_name = "range" if is_uniform else "whole range"
    publish = how_to("publish", ports=ports_name, published=published)
    if from_proxy == "unresolvable":
        fix = _fix_by_address()
    elif is_uniform:
        address = how_to("advertised host")
        fix = f"{publish}; or correct the advertised host, now {quoted(host)}: {address}"
    else:
        fix = publish
    text = f"{target}: {TEXT_BY_OUTCOME.get(from_proxy, from_proxy)}"
    if from_master == "missed":
        return error(RANGE, RANGE, f"{text}. A call from the master does not arrive either", fix)
    if from_proxy in _NO_WAY_BACK:
        text += ". Or only the proxy can't reach its own published ports, as with some NAT. "
        text += "The master could not be asked to try"
        return warning(RANGE, RANGE, text, fix)
    return error(RANGE, RANGE, text, fix)


def _by_udp(host: str, ports: PortsStatus, from_proxy: str, target: str) -> DoctorFinding:
    """The finding from a try by UDP. A failure proves no fault: NAT without hairpin fails, too.

    If a participant outside does not reach the range, `domain_problems` reports the participant
    after its first announcement.
    """
    if from_proxy == "ok":
        return ok(RANGE, RANGE, f"the proxy reaches {target} by UDP")
    text = (
        f"{target}: datagrams from the proxy to this address do not arrive at the proxy. The "
        "range is not published for UDP, or a firewall drops the datagrams. Or only the proxy "
        "can't reach its own published ports, as with some NAT"
    )
    published = quoted(f"{ports.advertise}:{ports.listen}/udp")
    publish = how_to("publish", ports="range", published=published)
    fix = (
        f"if no participant outside is heard, {publish}; and check that the advertised host "
        f"{quoted(host)} is this host"
    )
    return note(RANGE, RANGE, text, fix)
