"""How a pod is wired to its proxy at admission, and whether it is.

Wired is a pod whose containers have ROS_MASTER_URI, which leads to its RosProxy's Service and so to
the proxy on its own node, and ROS_IP; for ROS 2 ROS_STATIC_PEERS leads there. `wire` is for the
webhook, `unwired` (and for ROS 2 `ros2_pods`) for the planner, which finds pods that no webhook has
seen.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import msgspec

from rosproxy.ros1.protocol.uris import parse_slave_uri
from rosproxy.telemetry.text import clean
from rosproxy_operator.kubernetes.resources.model import (
    ELSEWHERE,
    ClusterFinding,
    Json,
    Name,
    Pod,
    RosProxy,
)
from rosproxy_operator.kubernetes.resources.names import (
    INJECT,
    MASTER_PORT,
    MASTER_URI,
    STATIC_PEERS,
    master_uri,
    service_id,
)
from rosproxy_operator.kubernetes.resources.objects import VARIABLE
from rosproxy_operator.kubernetes.resources.values import part, parts, word, words
from rosproxy_operator.kubernetes.status.findings import pod_finding

MIRROR = "kubernetes.io/config.mirror"
"""Annotation of the API server's picture of a static pod: a change of it changes no container."""
_KINDS = ("initContainers", "containers")


class Wiring(msgspec.Struct, frozen=True):
    """What the webhook makes of a pod: its new ``spec``, None if it stays as it is."""

    spec: Json | None = None
    annotations: Mapping[str, str] = {}
    warnings: tuple[str, ...] = ()


class Target(msgspec.Struct, frozen=True):
    """What a pod is to be told: the master's URI, peers and domain; what is empty, it is not."""

    uri: str = ""
    static_peers: str = ""
    domain: int | None = None


def target_of(of: RosProxy, cluster_ip: str) -> Target:
    """What the pods of a RosProxy are told, by the address of its Service."""
    ros2 = of.spec.ros2
    return Target(
        master_uri(cluster_ip) if of.spec.ros1 else "",
        cluster_ip if ros2 else "",
        ros2.domain if ros2 else None,
    )


def wire(pod: Json, to: Target, host_aliases: Iterable[Json] = ()) -> Wiring:
    """Wire a pod, as it is at admission, to its proxy.

    Every container and init container that does not set them gets ROS_MASTER_URI, and ROS_IP where
    it sets no ROS_HOSTNAME either. They come first, so that variables of the template can use them
    (``$(ROS_MASTER_URI)``). For ROS 2 these are ROS_STATIC_PEERS, and ROS_DOMAIN_ID if the RosProxy
    names a domain. An address that this webhook has set before, as in a copy of a wired pod, is set
    anew. Wiring a wired pod changes nothing.

    A pod in its node's own network must not be given here: see `selection.chosen`.
    """
    notes = words(pod, "metadata", "annotations")
    if MIRROR in notes:
        static = (
            "is a static pod, made from a file on its node, which can't be wired: set "
            f"{'ROS_MASTER_URI and ROS_IP' if to.uri else 'ROS_STATIC_PEERS'} in that file, or run "
            "it as an ordinary pod"
        )
        return Wiring(warnings=(static,))
    spec = part(pod, "spec")
    wired: dict[str, Any] = {
        kind: [_wired(one, to, notes) for one in parts(spec, kind)]
        for kind in _KINDS
        if spec.get(kind)
    }
    aliases = _merged(parts(spec, "hostAliases"), host_aliases)
    if aliases:
        wired["hostAliases"] = aliases
    changed = any(spec.get(key) != value for key, value in wired.items())
    told = {
        note: value
        for note, name, value in _addresses(to)
        if any(_value(one, name) == value for kind in _KINDS for one in wired.get(kind, ()))
    }
    return Wiring({**spec, **wired} if changed else None, told)


def unwired(pod: Pod, rosproxy: RosProxy, cluster_ip: str) -> ClusterFinding | None:
    """What is wrong with a selected pod's ROS_MASTER_URI (reason NotWired); None if nothing is.

    ``cluster_ip`` is that of the RosProxy's Service.
    """
    text = _wrong_master(pod, rosproxy.id, cluster_ip)
    return pod_finding(pod, rosproxy, "NotWired", text, fatal=False) if text else None


def has_come_unwired(pod: Pod, cluster_ip: str) -> bool:
    """Whether a pod is not wired, or to another address, and would be wired if it were made anew.

    One whose template sets ROS_MASTER_URI itself would not, nor one without the label.
    """
    return INJECT in pod.labels and not pod.own_masters and pod.wired != master_uri(cluster_ip)


def _wrong_master(pod: Pod, of: Name, cluster_ip: str) -> str:
    others = [uri for uri in pod.own_masters if not _is_proxys(uri, of, cluster_ip)]
    if others:
        return (
            f"sets ROS_MASTER_URI={clean(others[0])[:200]} itself, which is not its proxy: take "
            "the variable out of its template, then create the pod anew"
        )
    if pod.wired and pod.wired != master_uri(cluster_ip):
        return (
            f"was wired to {clean(pod.wired)[:200]}, but its proxy is at {master_uri(cluster_ip)} "
            "now: create the pod anew"
        )
    if pod.wired or pod.own_masters:
        return ""
    return never_told("ROS_MASTER_URI", pod, of)


def never_told(variable: str, pod: Pod, of: Name) -> str:
    """Why a pod has not got a variable of its proxy, and what to do about it."""
    text = f"has no {variable} of its proxy"
    if INJECT not in pod.labels:
        label = f"{INJECT}={of.name}"
        return f"{text}: add the label {label} to its template, then create the pod anew"
    why = "since it was created while the webhook was not there or there was no RosProxy"
    return f"{text}, {why}: create the pod anew"


def _is_proxys(uri: str, of: Name, cluster_ip: str) -> bool:
    """Whether a ROS_MASTER_URI leads to a RosProxy's Service, by address or by name."""
    if uri == ELSEWHERE:
        return True
    where, service = parse_slave_uri(uri.strip()), service_id(of)
    if where is None or where.port != MASTER_PORT:
        return False
    host, name = where.host.lower().rstrip("."), f"{service.name}.{service.namespace}"
    return host in (cluster_ip.lower(), service.name, name) or f"{host}.".startswith(f"{name}.svc.")


def _addresses(to: Target) -> list[tuple[str, str, str]]:
    """The annotation, the variable and the value of each address that a pod is to be told."""
    every = ((MASTER_URI, VARIABLE, to.uri), (STATIC_PEERS, "ROS_STATIC_PEERS", to.static_peers))
    return [one for one in every if one[2]]


def _wired(container: Json, to: Target, notes: Mapping[str, str]) -> Json:
    variables = list(parts(container, "env"))
    there = {word(one, "name") for one in variables}
    first: list[Json] = []
    for note, name, value in _addresses(to):
        former = notes.get(note)
        for place, one in enumerate(variables):
            if one.get("name") == name and former and one.get("value") == former:
                variables[place] = {**one, "value": value}
        if name not in there:
            first.append({"name": name, "value": value})
    if to.uri and not there & {"ROS_IP", "ROS_HOSTNAME"}:
        source = {"fieldRef": {"apiVersion": "v1", "fieldPath": "status.podIP"}}
        first.append({"name": "ROS_IP", "valueFrom": source})
    if to.domain is not None and "ROS_DOMAIN_ID" not in there:
        first.append({"name": "ROS_DOMAIN_ID", "value": str(to.domain)})
    env = [*first, *variables]
    return {**container, "env": env} if env else container


def _value(container: Json, name: str) -> str:
    """A variable of a container; of several that count it is the last."""
    env = parts(container, "env")
    return next((word(one, "value") for one in reversed(env) if one.get("name") == name), "")


def _merged(own: Iterable[Json], more: Iterable[Json]) -> list[Json]:
    """Host aliases with others added: one entry per address, as the API server merges them."""
    merged = list(own)
    for alias in more:
        place = next((n for n, one in enumerate(merged) if one.get("ip") == alias.get("ip")), None)
        if place is None:
            merged.append(alias)
            continue
        there = list(merged[place].get("hostnames") or ())
        new = [name for name in alias.get("hostnames") or () if name not in there]
        if new:
            merged[place] = {**merged[place], "hostnames": [*there, *new]}
    return merged
