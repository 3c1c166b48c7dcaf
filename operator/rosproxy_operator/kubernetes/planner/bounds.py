"""Checks what RosProxies ask for: the administrator's bounds, and masters of other namespaces.

A user with the right to write RosProxies gets hostPorts, pods and a way to a master. So the
operator's administrator sets bounds (`Bounds`). The owners of a namespace decide which other
namespaces may name a master there. An annotation on the master's Service says so, as a
ReferenceGrant does in the Gateway API. Only users that may change the Service can write the
annotation.

The operator treats a RosProxy that asks for more like an unreadable RosProxy: existing proxies go
on, and the operator makes and changes nothing. The condition says what would allow the RosProxy.
"""

import re
from collections.abc import Iterable, Iterator, Mapping
from fnmatch import fnmatchcase
from itertools import islice

from msgspec.structs import replace

from rosproxy.shared.addresses import HostPort, is_address, parse_address
from rosproxy.shared.setting_kinds import read_peer, read_site_link
from rosproxy.shared.uris import parse_slave_uri, slave_uri
from rosproxy.shared.zenoh_rules.name_sets import check_layers
from rosproxy_operator.common.port_ranges import within
from rosproxy_operator.common.problem import NOT_ALLOWED, Fault
from rosproxy_operator.kubernetes.resources.checks import quoted
from rosproxy_operator.kubernetes.resources.cluster import ClusterSnapshot
from rosproxy_operator.kubernetes.resources.model import (
    InvalidRosProxy,
    Name,
    Ros2Spec,
    RosProxy,
    RosProxySpec,
    ZenohSpec,
)
from rosproxy_operator.kubernetes.resources.names import ALLOW_FROM
from rosproxy_operator.kubernetes.settings import Bounds, ClusterSettings

Consents = Mapping[Name, frozenset[str]]
"""The other namespaces whose RosProxies may name a master's Service, by that Service."""
MOST_PATTERNS = 5
"""Most allowed patterns that a refusal names."""
_ANY_NAMESPACE = "*"
_ADDRESS_PATTERN = re.compile(r"http://([0-9.*?]*[0-9][0-9.*?]*|\[.*\])(:[0-9*?]*)?")
"""Matches a pattern for addresses: the host has digits, but no letters, or is in brackets."""


def within_bounds(observed: ClusterSnapshot, settings: ClusterSettings) -> ClusterSnapshot:
    """Return the snapshot, with each RosProxy that violates a bound moved to ``unusable``.

    A RosProxy that is being deleted violates no bound.
    """
    refused: dict[str, InvalidRosProxy] = {}
    for rosproxy in observed.rosproxies:
        fault = bounds_violation(rosproxy, observed.consents, settings)
        if fault and not rosproxy.deleting:
            of = (rosproxy.id, rosproxy.uid, rosproxy.generation)
            status = rosproxy.status
            refused[rosproxy.uid] = InvalidRosProxy(*of, *fault, status, NOT_ALLOWED)
    if not refused:
        return observed
    return replace(
        observed,
        rosproxies=tuple(r for r in observed.rosproxies if r.uid not in refused),
        unusable={**observed.unusable, **{r.id: r for r in refused.values()}},
    )


def bounds_violation(
    rosproxy: RosProxy, consents: Consents, settings: ClusterSettings
) -> Fault | None:
    """Return the first violation of a RosProxy: field, value and fix; None if there is none."""
    objections = (
        *_violations(rosproxy.spec, settings),
        _missing_consent(rosproxy, consents),
    )
    return next(filter(None, objections), None)


def is_allowed_master(master: str, allowed: tuple[str, ...]) -> bool:
    """Whether a master's URI, without the path, fits a pattern of ``allowed``.

    A pattern without letters in the host fits only addresses: ``http://192.0.2.*`` does not fit
    ``http://192.0.2.7.example.com``.
    """
    host_port = parse_slave_uri(master)
    if host_port is None:
        return False
    bare = slave_uri(host_port).rstrip("/")
    matching = (p for p in allowed if _fits(bare, p.rstrip("/")))
    return any(is_address(host_port.host) or not _ADDRESS_PATTERN.fullmatch(p) for p in matching)


def _violations(spec: RosProxySpec, settings: ClusterSettings) -> Iterator[Fault]:
    """Yield the violations of the administrator's bounds."""
    bounds = settings.bounds
    if bounds.masters and spec.ros1:
        for uri in _masters(spec):
            if not is_allowed_master(uri, bounds.masters):
                field = "spec.master.uri" if spec.master.uri else "spec.master.service"
                fix = f"Choose a master that fits {_any_of(bounds.masters)}"
                yield _refusal(field, uri, fix, "allow.masters")
    yield from _violations_of_versions(spec, settings)
    if spec.pod_egress == "proxy" and not settings.network_policy:
        yield _refusal("spec.podEgress", "Proxy", "Choose Any", "proxy.networkPolicy.enabled")
    patterns = (settings.image, *bounds.images)
    if spec.image and not any(_fits(spec.image, p) for p in patterns):
        choice = f", or choose an image that fits {_any_of(bounds.images)}" if bounds.images else ""
        yield _refusal("spec.image", spec.image, f"Remove the field{choice}", "allow.images")


def _violations_of_versions(spec: RosProxySpec, settings: ClusterSettings) -> Iterator[Fault]:
    """Yield the violations in the fields for DDS, for rmw_zenoh, and for all but rmw_zenoh."""
    if spec.ros2:
        yield from _peer_violations("spec.peers", spec.ros2.peers, spec, settings.bounds)
        yield from _ros2_violations(spec.ros2, settings.bounds)
    if spec.zenoh:  # has neither hostPorts nor a data plane
        yield from _peer_violations("spec.peers", spec.zenoh.peers, spec, settings.bounds)
        links = spec.zenoh.link.to if spec.zenoh.link else ()
        sites = [str(read_site_link(link).peer) for link in links]
        yield from _peer_violations("spec.link.to", sites, spec, settings.bounds)
        yield from _zenoh_violations(spec.zenoh, settings)
        return
    yield from _port_violations(spec, settings.bounds)
    yield from _data_plane_violations(spec, settings.bounds)


def _ros2_violations(spec: Ros2Spec, bounds: Bounds) -> Iterator[Fault]:
    """Yield the violation in the multicast of ROS 2."""
    if spec.multicast and not bounds.multicast:
        fix = "Remove the field, and name the hosts outside in spec.peers"
        yield _refusal("spec.multicast", True, fix, "allow.multicast")


def _zenoh_violations(spec: ZenohSpec, settings: ClusterSettings) -> Iterator[Fault]:
    """Yield the violation in listen, and rules of the administrator that zenoh can't hold."""
    if spec.listen and spec.listen.type not in settings.bounds.listen:
        others = " or ".join(settings.bounds.listen)
        fix = f"Choose {others}" if others else "Remove spec.listen"
        yield _refusal("spec.listen.type", spec.listen.type, fix, "allow.listen")
    try:
        check_layers(settings.policy)
    except ValueError as error:
        yield Fault(
            f"spec.ros: rmw_zenoh can't hold the operator's policy: {error}",
            "Ask the operator's administrator to change the rules (chart value policy.rules)",
        )


def _peer_violations(
    field: str, peers: Iterable[str], spec: RosProxySpec, bounds: Bounds
) -> Iterator[Fault]:
    """Yield the violations in ``spec.peers``, or in the hosts of ``spec.link.to``.

    If the RosProxy itself gives addresses for a host name, these count instead of the host name.
    """
    patterns = tuple(f"http://{_bracketed(pattern)}:1" for pattern in bounds.peers)
    for peer in peers if bounds.peers else ():
        name = read_peer(peer).host
        hosts = _aliased(name, spec) or [name]
        # Each address in one form: fd00:0::7 and fd00::7 are the same.
        uris = [slave_uri(HostPort(parse_address(host) or host, 1)) for host in hosts]
        if not all(is_allowed_master(uri, patterns) for uri in uris):
            fix = f"Choose a peer that fits {_any_of(bounds.peers)}"
            yield _refusal(field, peer, fix, "allow.peers")


def _bracketed(pattern: str) -> str:
    """A pattern of hosts, with brackets if the pattern is for IPv6 addresses."""
    return f"[{pattern}]" if ":" in pattern and not pattern.startswith("[") else pattern


def _data_plane_violations(spec: RosProxySpec, bounds: Bounds) -> Iterator[Fault]:
    if spec.proxy.data_plane not in bounds.data_planes:
        choices = " or ".join(p.capitalize() for p in bounds.data_planes)
        value = spec.proxy.data_plane.capitalize()
        yield _refusal("spec.dataPlane", value, f"Choose {choices}", "allow.dataPlanes")


def _port_violations(spec: RosProxySpec, bounds: Bounds) -> Iterator[Fault]:
    """Yield the violations in the hostPorts."""
    if spec.ports > bounds.max_ports:
        fix = f"Ask for {bounds.max_ports} at most"
        yield _refusal("spec.ports", spec.ports, fix, "allow.maxPorts")
    if not within(spec.window, bounds.window):
        fix = f"Choose a window within {bounds.window}"
        yield _refusal("spec.portWindow", str(spec.window), fix, "allow.portWindow")
    if spec.master.publish and spec.master.publish not in bounds.window:
        fix = f"Choose a port in {bounds.window}"
        yield _refusal("spec.master.publish", spec.master.publish, fix, "allow.portWindow")


def _any_of(patterns: Iterable[str]) -> str:
    return " or ".join(map(quoted, islice(patterns, MOST_PATTERNS)))


def _refusal(field: str, value: object, fix: str, allowing: str) -> Fault:
    return Fault(
        f"{field}: the operator does not allow {quoted(value)}",
        f"{fix}, or ask the operator's administrator to allow the value (chart value {allowing})",
    )


def _masters(spec: RosProxySpec) -> Iterator[str]:
    """Yield the URIs at which the proxy really looks for the master.

    If the RosProxy itself gives addresses for the master's host name, yield these instead of the
    host name.
    """
    master = spec.master
    if master.service is not None:
        host = f"{master.service.name}.{master.service.namespace}.svc"
        yield slave_uri(HostPort(host, master.service_port))
        return
    host_port = parse_slave_uri(master.uri)
    if host_port is None:
        yield master.uri
        return
    aliases = _aliased(host_port.host, spec)
    for host in [*filter(None, (master.address, *aliases))] or [host_port.host]:
        yield slave_uri(HostPort(host, host_port.port))


def _aliased(host: str, spec: RosProxySpec) -> list[str]:
    """The addresses that a RosProxy itself gives for a host name."""
    return [alias["ip"] for alias in spec.host_aliases if host in alias.get("hostnames", ())]


def _fits(text: str, pattern: str) -> bool:
    """Whether a text fits a pattern of ``*`` and ``?``. Brackets mean themselves (IPv6)."""
    return fnmatchcase(text, pattern.replace("[", "[[]"))


def _missing_consent(rosproxy: RosProxy, consents: Consents) -> Fault | None:
    """Return the missing consent for a master in another namespace, with the fix; else None.

    The text does not tell whether the Service exists: only the other namespace may know that.
    """
    service = rosproxy.spec.master.service
    namespace = rosproxy.id.namespace
    if service is None or service.namespace == namespace:
        return None
    allowed = consents.get(service, frozenset())
    if allowed & {namespace, _ANY_NAMESPACE}:
        return None
    value = ",".join(sorted({*allowed, namespace}))
    return Fault(
        f"spec.master.service.namespace: namespace {quoted(service.namespace)} does not allow "
        f"RosProxies of namespace {quoted(namespace)} to use this master",
        f"Ask a user that may change the Service to run kubectl -n {service.namespace} annotate "
        f"--overwrite service {service.name} {ALLOW_FROM}={value}",
    )
