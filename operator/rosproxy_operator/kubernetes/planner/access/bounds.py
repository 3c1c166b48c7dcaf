"""What RosProxies may not ask for: beyond the administrator's bounds, or another's master.

Whoever may write RosProxies gets hostPorts, pods and a way to a master by it, so whoever runs the
operator has the last word (`Bounds`), and whoever owns a namespace says who may name its masters:
by an annotation on the Service, which only they can write, as a ReferenceGrant does in the Gateway
API. A RosProxy that asks for more is treated as one that can't be read: what it has stays as it
is, and nothing is made or changed for it; its condition says what would allow it.
"""

import re
from collections.abc import Iterator, Mapping
from fnmatch import fnmatchcase

from msgspec.structs import replace

from rosproxy.net.addresses import HostPort, is_address
from rosproxy.ros1.protocol.uris import parse_slave_uri, slave_uri
from rosproxy.settings import read_peer
from rosproxy_operator.common.allocation import within
from rosproxy_operator.kubernetes.resources.cluster import ClusterSnapshot
from rosproxy_operator.kubernetes.resources.model import (
    InvalidRosProxy,
    Name,
    Ros2Spec,
    RosProxy,
    RosProxySpec,
)
from rosproxy_operator.kubernetes.resources.names import ALLOW_FROM
from rosproxy_operator.kubernetes.resources.values import quoted
from rosproxy_operator.kubernetes.settings import Bounds, ClusterSettings

NOT_ALLOWED = "NotAllowed"
Consents = Mapping[Name, frozenset[str]]
"""By a master's Service, the namespaces whose RosProxies may name it, besides its own."""
_EVERYBODY = "*"
_NUMERIC = re.compile(r"http://([0-9.*?]*[0-9][0-9.*?]*|\[.*\])(:[0-9*?]*)?")
"""A pattern whose host has digits and no letters: it is meant for addresses."""


def within_bounds(observed: ClusterSnapshot, settings: ClusterSettings) -> ClusterSnapshot:
    """What is seen, with the RosProxies that ask for more than they may among the unusable ones.

    One that is being deleted asks for nothing.
    """
    refused: dict[str, InvalidRosProxy] = {}
    for one in observed.rosproxies:
        text = "" if one.deleting else objection(one, observed.consents, settings)
        if text:
            refused[one.uid] = InvalidRosProxy(
                one.id, one.uid, one.generation, text, one.status, NOT_ALLOWED
            )
    if not refused:
        return observed
    return replace(
        observed,
        rosproxies=tuple(one for one in observed.rosproxies if one.uid not in refused),
        unusable={**observed.unusable, **{one.id: one for one in refused.values()}},
    )


def objection(of: RosProxy, consents: Consents, settings: ClusterSettings) -> str:
    """What a RosProxy asks for that it may not have: field, value, what to do. Empty if nothing."""
    every = (
        *_beyond(of.spec, settings),
        _unasked(of, consents),
    )
    return next(filter(None, every), "")


def may_name(master: str, allowed: tuple[str, ...]) -> bool:
    """Whether a master's URI, without its path, fits one of some patterns.

    A pattern of digits and stars fits addresses only: in 192.0.2.* the star is no 7.example.com.
    """
    where = parse_slave_uri(master)
    if where is None:
        return False
    bare = slave_uri(where).rstrip("/")
    fits = (one for one in allowed if _fits(bare, one.rstrip("/")))
    return any(is_address(where.host) or not _NUMERIC.fullmatch(one) for one in fits)


def _beyond(spec: RosProxySpec, settings: ClusterSettings) -> Iterator[str]:
    """What goes beyond the administrator's bounds."""
    bounds = settings.bounds
    if bounds.masters and spec.ros1:
        for uri in _masters(spec):
            if not may_name(uri, bounds.masters):
                field = "spec.master.uri" if spec.master.uri else "spec.master.service"
                yield _refused(field, uri, "choose an allowed master", "allow.masters")
    if spec.ros2:
        yield from _beyond_ros2(spec.ros2, bounds)
    yield from _beyond_ports(spec, bounds)
    if spec.data_plane not in bounds.data_planes:
        others = " or ".join(one.capitalize() for one in bounds.data_planes)
        value = spec.data_plane.capitalize()
        yield _refused("spec.dataPlane", value, f"choose {others}", "allow.dataPlanes")
    if spec.pod_egress == "proxy" and not settings.network_policy:
        yield _refused("spec.podEgress", "Proxy", "choose Any", "proxy.networkPolicy.enabled")
    known = (settings.image, *bounds.images)
    if spec.image and not any(_fits(spec.image, one) for one in known):
        yield _refused("spec.image", spec.image, "leave it out", "allow.images")


def _beyond_ros2(spec: Ros2Spec, bounds: Bounds) -> Iterator[str]:
    """The same of what it asks for of ROS 2."""
    for peer in spec.peers if bounds.peers else ():
        uri = slave_uri(HostPort(read_peer(peer).host, 1))
        if not may_name(uri, tuple(f"http://{one}:1" for one in bounds.peers)):
            yield _refused("spec.peers", peer, "choose an allowed peer", "allow.peers")
    if spec.multicast and not bounds.multicast:
        fix = "leave it out, and name who is outside in spec.peers"
        yield _refused("spec.multicast", True, fix, "allow.multicast")


def _beyond_ports(spec: RosProxySpec, bounds: Bounds) -> Iterator[str]:
    """The same of its hostPorts."""
    if spec.ports > bounds.max_ports:
        fewer = f"ask for {bounds.max_ports} at most"
        yield _refused("spec.ports", spec.ports, fewer, "allow.maxPorts")
    if not within(spec.window, bounds.window):
        inside = f"choose one within {bounds.window}"
        yield _refused("spec.portWindow", str(spec.window), inside, "allow.portWindow")
    if spec.master.publish and spec.master.publish not in bounds.window:
        inside = f"choose one of {bounds.window}"
        yield _refused("spec.master.publish", spec.master.publish, inside, "allow.portWindow")


def _refused(field: str, value: object, fix: str, allowing: str) -> str:
    return (
        f"{field}: {quoted(value)} is not what the operator allows: {fix}, or have its "
        f"administrator allow it (chart value {allowing})"
    )


def _masters(spec: RosProxySpec) -> Iterator[str]:
    """The URIs where the master is really looked for.

    Where the RosProxy says itself to which address its host's name leads, the name says nothing.
    """
    master = spec.master
    if master.service is not None:
        host = f"{master.service.name}.{master.service.namespace}.svc"
        yield slave_uri(HostPort(host, master.service_port))
        return
    where = parse_slave_uri(master.uri)
    if where is None:
        yield master.uri
        return
    aliases = (one["ip"] for one in spec.host_aliases if where.host in one.get("hostnames", ()))
    for host in [*filter(None, (master.address, *aliases))] or [where.host]:
        yield slave_uri(HostPort(host, where.port))


def _fits(text: str, pattern: str) -> bool:
    """Whether a text fits a pattern of ``*`` and ``?``; brackets are those of IPv6 addresses."""
    return fnmatchcase(text, pattern.replace("[", "[[]"))


def _unasked(of: RosProxy, consents: Consents) -> str:
    """The command that gives the consent that a RosProxy lacks, where its master is another's.

    Whether that Service exists is not told: that is the other namespace's to know.
    """
    service, own = of.spec.master.service, of.id.namespace
    if service is None or service.namespace == own:
        return ""
    allowed = consents.get(service, frozenset())
    if allowed & {own, _EVERYBODY}:
        return ""
    value = ",".join(sorted({*allowed, own}))
    return (
        f"spec.master.service.namespace: {quoted(service.namespace)} is not this RosProxy's "
        "namespace, and has not agreed: whoever may change the Service allows it with: kubectl "
        f"-n {service.namespace} annotate --overwrite service {service.name} {ALLOW_FROM}={value}"
    )
