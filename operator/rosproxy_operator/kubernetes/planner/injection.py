"""How a pod is wired to its proxy at admission, and whether it is.

Wired is a pod whose containers have ROS_MASTER_URI, which leads to its RosProxy's Service and so to
the proxy on its own node, and ROS_IP. `wire` is for the webhook, `unwired` for the planner, which
finds pods that no webhook has seen.
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


def wire(pod: Json, uri: str, host_aliases: Iterable[Json] = ()) -> Wiring:
    """Wire a pod, as it is at admission, to the proxy that answers at ``uri``.

    Every container and init container that does not set them gets ROS_MASTER_URI, and ROS_IP where
    it sets no ROS_HOSTNAME either. They come first, so that variables of the template can use them
    (``$(ROS_MASTER_URI)``). A ROS_MASTER_URI that this webhook has set before, as in a copy of a
    wired pod, is set anew. Wiring a wired pod changes nothing.

    A pod in its node's own network must not be given here: see `selection.chosen`.
    """
    notes = words(pod, "metadata", "annotations")
    if MIRROR in notes:
        static = (
            "is a static pod, made from a file on its node, which can't be wired: set "
            "ROS_MASTER_URI and ROS_IP in that file, or run it as an ordinary pod"
        )
        return Wiring(warnings=(static,))
    spec = part(pod, "spec")
    wired: dict[str, Any] = {
        kind: [_wired(one, uri, notes.get(MASTER_URI, "")) for one in parts(spec, kind)]
        for kind in _KINDS
        if spec.get(kind)
    }
    aliases = _merged(parts(spec, "hostAliases"), host_aliases)
    if aliases:
        wired["hostAliases"] = aliases
    changed = any(spec.get(key) != value for key, value in wired.items())
    ours = any(_master(one) == uri for kind in _KINDS for one in wired.get(kind, ()))
    return Wiring({**spec, **wired} if changed else None, {MASTER_URI: uri} if ours else {})


def unwired(pod: Pod, rosproxy: RosProxy, cluster_ip: str) -> ClusterFinding | None:
    """What is wrong with a selected pod's ROS_MASTER_URI (reason NotWired); None if nothing is.

    ``cluster_ip`` is that of the RosProxy's Service.
    """
    text = _wrong_master(pod, rosproxy.id, cluster_ip)
    return pod_finding(pod, rosproxy, "NotWired", text, fatal=False) if text else None


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
    text = "has no ROS_MASTER_URI of its proxy"
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


def _wired(container: Json, uri: str, former: str) -> Json:
    variables = list(parts(container, "env"))
    for place, one in enumerate(variables):
        if one.get("name") == VARIABLE and former and one.get("value") == former:
            variables[place] = {**one, "value": uri}
    there = {word(one, "name") for one in variables}
    first: list[Json] = []
    if VARIABLE not in there:
        first.append({"name": VARIABLE, "value": uri})
    if not there & {"ROS_IP", "ROS_HOSTNAME"}:
        source = {"fieldRef": {"apiVersion": "v1", "fieldPath": "status.podIP"}}
        first.append({"name": "ROS_IP", "valueFrom": source})
    env = [*first, *variables]
    return {**container, "env": env} if env else container


def _master(container: Json) -> str:
    """The ROS_MASTER_URI of a container; of several that count it is the last."""
    env = parts(container, "env")
    return next((word(one, "value") for one in reversed(env) if one.get("name") == VARIABLE), "")


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
