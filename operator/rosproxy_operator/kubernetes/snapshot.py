"""A look at the cluster: everything that matters is listed anew, so that nothing is ever missed.

First the RosProxies, then side by side nodes, the operator's own pods, Services, NetworkPolicies
and key, masters' Services and selected pods, then all pods on the nodes that matter. All of it or
nothing.
"""

import asyncio
import re
from collections.abc import Callable, Collection, Iterable
from typing import TypeVar

from msgspec.structs import replace

from rosproxy.net.addresses import is_address
from rosproxy.telemetry.text import clean
from rosproxy_operator.common.threads import in_thread
from rosproxy_operator.kubernetes.api import (
    POLICIES,
    Api,
    ApiAway,
    ApiError,
    ApiGone,
    ApiInvalid,
)
from rosproxy_operator.kubernetes.planner.selection import label_selector
from rosproxy_operator.kubernetes.resources import objects
from rosproxy_operator.kubernetes.resources.model import (
    ClusterSnapshot,
    InvalidRosProxy,
    Json,
    Name,
    Pod,
    ProxyPod,
    ProxyPolicy,
    RosProxy,
)
from rosproxy_operator.kubernetes.resources.pod_failures import stuck_by_event
from rosproxy_operator.kubernetes.resources.spec import rosproxies
from rosproxy_operator.kubernetes.resources.values import part, parts, word
from rosproxy_operator.kubernetes.token_key import TokenKey

K = TypeVar("K")
T = TypeVar("T")
AT_ONCE = 8
"""Lists that are asked for at the same time."""
SANDBOX_FAILED = "FailedCreatePodSandBox"
"""The reason of the kubelet's Event, which alone says that a hostPort could not be had."""
_IDS = re.compile(r"\b[0-9a-f]{32,64}\b")
_LONGEST = 300


class SnapshotReader:
    """Lists what matters in a cluster."""

    def __init__(self, api: Api, key: TokenKey) -> None:
        self._api, self._key = api, key
        self._room = asyncio.Semaphore(AT_ONCE)

    async def read(self) -> ClusterSnapshot:
        """List everything; all of it or nothing. Raises ApiError.

        RosProxies come first and from the API server's store: a proxy that belongs to none of them
        is taken for a leftover.
        """
        usable, unusable = await self._ask(self._rosproxies)
        api, ports = self._api, _master_ports(usable.values())
        nodes, proxies, services, (policies, key), masters, selected = await asyncio.gather(
            self._ask(lambda: [*map(objects.node, api.nodes())]),
            self._ask(lambda: [*filter(None, map(objects.proxy_pod, api.own("pods")))]),
            self._ask(lambda: [*filter(None, map(objects.service, api.own("services")))]),
            asyncio.gather(self._ask(self._policies), self._ask(self._key.read)),
            self._each(ports, lambda id: master_service(api, id, ports[id])),
            self._each(usable, lambda id: self._selected(usable[id])),
        )
        refused = {id: each for id, each in selected.items() if isinstance(each, InvalidRosProxy)}
        found = [pod for each in selected.values() if isinstance(each, list) for pod in each]
        on = sorted({*(pod.node for pod in found), *(proxy.on for proxy in proxies)} - {""})
        others = await self._each(on, lambda name: [*map(objects.pod, api.pods_on(name))])
        # Every pod once; of those that were listed more than once, what was listed last.
        listed = (found, *others.values(), (proxy.pod for proxy in proxies))
        pods = {pod.uid: pod for some in listed for pod in some}
        return ClusterSnapshot(
            rosproxies=tuple(each for id, each in usable.items() if id not in refused),
            unusable={**unusable, **refused},
            nodes={node.name: node for node in nodes},
            pods=tuple(pods.values()),
            proxies=tuple(await asyncio.gather(*map(self._with_event, proxies))),
            services={service.of: service for service in services},
            masters={id: found for id, (found, _) in masters.items()},
            consents={id: allowed for id, (_, allowed) in masters.items()},
            selected=frozenset(pod.uid for pod in found if not pod.ended),
            policies=policies if isinstance(policies, dict) else {},
            no_policies=policies if isinstance(policies, str) else "",
            key=key,
        )

    async def _ask(self, question: Callable[..., T], *about: object) -> T:
        """Ask the API server, and read what it answers, in a thread."""
        async with self._room:
            return await in_thread(question, *about)

    async def _each(self, keys: Collection[K], question: Callable[[K], T]) -> dict[K, T]:
        """The answers to the same question about each of some."""
        found = await asyncio.gather(*(self._ask(question, key) for key in keys))
        return dict(zip(keys, found, strict=True))

    def _rosproxies(self) -> tuple[dict[Name, RosProxy], dict[Name, InvalidRosProxy]]:
        try:
            return rosproxies(self._api.rosproxies())
        except ApiGone:
            raise ApiGone(
                "the cluster has no RosProxies: install the CustomResourceDefinition "
                "rosproxies.rosproxy.io (it comes with the chart and with manifests/)"
            ) from None

    def _policies(self) -> dict[Name, ProxyPolicy] | str:
        """The operator's NetworkPolicies, or why it may not list them.

        The right came late: where a role lacks it, all else goes on.
        """
        try:
            found = filter(None, map(objects.policy, self._api.own(POLICIES)))
            return {one.id: one for one in found}
        except ApiAway:
            raise
        except ApiError as error:
            return str(error)

    def _selected(self, of: RosProxy) -> list[Pod] | InvalidRosProxy:
        """The pods that a RosProxy's selector fits, or why the API server refuses that."""
        try:
            found = self._api.pods(of.id.namespace, label_selector(of.spec, of.id.name))
        except ApiInvalid as error:
            text = f"spec.podSelector: {error}"
            return InvalidRosProxy(of.id, of.uid, of.generation, text, of.status)
        return [objects.pod(each) for each in found]

    async def _with_event(self, proxy: ProxyPod) -> ProxyPod:
        """A proxy, also one that the kubelet can't set up, of which only an Event tells."""
        waits = proxy.pod.phase == "Pending" and proxy.pod.node and not proxy.pod.deleting
        if not waits or proxy.stuck or proxy.pod.ip:
            return proxy
        id, uid = proxy.pod.id, proxy.pod.uid
        events = await self._ask(self._api.events_of, id, uid, SANDBOX_FAILED)
        if not events:
            return proxy
        message = word(max(events, key=_when), "message")
        # Without the sandbox's id, which is another one with each try.
        steady = clean(_IDS.sub("…", " ".join(message.split())))[:_LONGEST]
        return replace(proxy, stuck=stuck_by_event(message), message=steady)


def _when(event: Json) -> str:
    return word(event, "lastTimestamp") or word(event, "eventTime")


def _master_ports(rosproxies: Iterable[RosProxy]) -> dict[Name, set[int]]:
    """The ports that RosProxies name of the Services that are their masters."""
    ports: dict[Name, set[int]] = {}
    for each in rosproxies:
        master = each.spec.master
        if master.service is not None:
            ports.setdefault(master.service, set()).add(master.service_port)
    return ports


def master_service(
    api: Api, id: Name, ports: Collection[int]
) -> tuple[tuple[str, str], frozenset[str]]:
    """A Service's cluster IP and what is wrong with it, one of them empty; and who may name it.

    ``ports`` are those that RosProxies name; one of them has to be there. Raises ApiError.
    """
    try:
        found = api.get("services", id)
    except ApiGone:
        text = f"there is no Service {id.name} in the namespace {id.namespace}: create it"
        return ("", text), frozenset()
    return read_master(found, id, ports), objects.allowed_from(found)


def read_master(service: Json, id: Name, ports: Collection[int]) -> tuple[str, str]:
    """The first of it, from a Service as the API server gives it."""
    spec = part(service, "spec")
    address = word(spec, "clusterIP")
    if not is_address(address):
        return "", (
            f"the Service {id} has no cluster IP ({word(spec, 'type') or 'headless'}): "
            "make it one of type ClusterIP with an address of its own"
        )
    offered = {port.get("port") for port in parts(spec, "ports")}
    if offered.isdisjoint(ports):
        has, wanted = (", ".join(sorted(map(str, some))) or "none" for some in (offered, ports))
        text = f"has no port {wanted} (it has {has}): set spec.master.service.port"
        return "", f"the Service {id} {text}"
    return address, ""
