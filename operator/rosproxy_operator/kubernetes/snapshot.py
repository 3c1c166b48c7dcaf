"""A look at the cluster: everything that matters is listed anew, so that nothing is ever missed.

First the RosProxies, then side by side nodes, the operator's own pods and Services, masters'
Services and selected pods, then all pods on the nodes that matter. All of it or nothing.
"""

import asyncio
import re
from collections.abc import Awaitable, Callable, Collection, Iterable
from dataclasses import replace
from functools import partial
from ipaddress import ip_address
from typing import TypeVar

from rosproxy.telemetry.text import clean
from rosproxy_operator.common.threads import in_thread
from rosproxy_operator.kubernetes.api import Api, Found
from rosproxy_operator.kubernetes.errors import ApiError, ErrorKind
from rosproxy_operator.kubernetes.planner.selection import label_selector
from rosproxy_operator.kubernetes.resources.fields import InvalidField
from rosproxy_operator.kubernetes.resources.model import (
    ClusterSnapshot,
    InvalidRosProxy,
    Name,
    Pod,
    ProxyPod,
    ProxyService,
    RosProxy,
)
from rosproxy_operator.kubernetes.resources.objects import node as parse_node
from rosproxy_operator.kubernetes.resources.objects import pod as parse_pod
from rosproxy_operator.kubernetes.resources.objects import proxy_pod as parse_proxy_pod
from rosproxy_operator.kubernetes.resources.objects import service as parse_service
from rosproxy_operator.kubernetes.resources.pod_failures import stuck_by_event
from rosproxy_operator.kubernetes.resources.spec import invalid, rosproxy

T = TypeVar("T")
AT_ONCE = 8
"""Lists that are asked for at the same time."""
SANDBOX_FAILED = "FailedCreatePodSandBox"
"""The reason of the kubelet's Event, which alone says that a hostPort could not be had."""
_IDS = re.compile(r"\b[0-9a-f]{32,64}\b")
_LONGEST = 300


class SnapshotReader:
    """Lists what matters in a cluster."""

    def __init__(self, api: Api) -> None:
        self._api = api
        self._room = asyncio.Semaphore(AT_ONCE)

    async def read(self) -> ClusterSnapshot:
        """List everything; all of it or nothing. Raises ApiError.

        RosProxies come first and from the API server's store: a proxy that belongs to none of them
        is taken for a leftover.
        """
        usable, unusable = await self._ask(self._rosproxies)
        api = self._api
        nodes, proxies, services, masters, selected = await asyncio.gather(
            self._ask(lambda: {node.name: node for node in map(parse_node, api.nodes())}),
            self._ask(self._proxies),
            self._ask(self._services),
            self._masters(usable),
            self._selected(usable),
        )
        refused = {id: each for id, each in selected.items() if isinstance(each, InvalidRosProxy)}
        found = [pod for each in selected.values() if isinstance(each, list) for pod in each]
        others = await self._on_nodes({*(pod.node for pod in found), *(p.on for p in proxies)})
        return ClusterSnapshot(
            rosproxies=tuple(each for each in usable if each.id not in refused),
            unusable={**unusable, **refused},
            nodes=nodes,
            pods=_newest(found, others, [proxy.pod for proxy in proxies]),
            proxies=tuple(await self._explained(proxies)),
            services=services,
            masters=masters,
            selected=frozenset(pod.uid for pod in found if not pod.ended),
        )

    async def _ask(self, question: Callable[[], T]) -> T:
        """Ask the API server, and read what it answers, in a thread."""
        async with self._room:
            return await in_thread(question)

    def _rosproxies(self) -> tuple[list[RosProxy], dict[Name, InvalidRosProxy]]:
        usable: list[RosProxy] = []
        unusable: dict[Name, InvalidRosProxy] = {}
        for found in self._listed_rosproxies():
            try:
                usable.append(rosproxy(found))
            except InvalidField as error:
                what = invalid(found, error)
                unusable[what.id] = what
        return usable, unusable

    def _listed_rosproxies(self) -> list[Found]:
        try:
            return self._api.rosproxies()
        except ApiError as error:
            if error.kind is not ErrorKind.GONE:
                raise
            raise ApiError(
                ErrorKind.GONE,
                "the cluster has no RosProxies: install the CustomResourceDefinition "
                "rosproxies.rosproxy.io (it comes with the chart and with manifests/)",
            ) from None

    def _proxies(self) -> list[ProxyPod]:
        found = map(parse_proxy_pod, self._api.own("pods"))
        return [proxy for proxy in found if proxy]

    def _services(self) -> dict[Name, ProxyService]:
        found = map(parse_service, self._api.own("services"))
        return {service.of: service for service in found if service}

    async def _masters(self, rosproxies: Iterable[RosProxy]) -> dict[Name, tuple[str, str]]:
        ports: dict[Name, set[int]] = {}
        for each in rosproxies:
            if each.spec.master.service is not None:
                ports.setdefault(each.spec.master.service, set()).add(each.spec.master.service_port)
        found = await _all(
            self._ask(partial(master_service, self._api, id, some)) for id, some in ports.items()
        )
        return dict(zip(ports, found, strict=True))

    async def _selected(
        self, rosproxies: Iterable[RosProxy]
    ) -> dict[Name, list[Pod] | InvalidRosProxy]:
        """By RosProxy the pods that its selector fits, or why the API server refuses that."""
        of = list(rosproxies)
        found = await _all(self._ask(partial(self._pods_of, one)) for one in of)
        return {one.id: pods for one, pods in zip(of, found, strict=True)}

    def _pods_of(self, of: RosProxy) -> list[Pod] | InvalidRosProxy:
        try:
            found = self._api.pods(of.id.namespace, label_selector(of.spec, of.id.name))
        except ApiError as error:
            if error.kind is not ErrorKind.INVALID:
                raise
            text = f"spec.podSelector: {error}"
            return InvalidRosProxy(of.id, of.uid, of.generation, text, of.status)
        return [parse_pod(each) for each in found]

    async def _on_nodes(self, nodes: set[str]) -> list[Pod]:
        names = sorted(nodes - {""})
        found = await _all(self._ask(partial(self._pods_on, name)) for name in names)
        return [pod for each in found for pod in each]

    def _pods_on(self, node: str) -> list[Pod]:
        return [parse_pod(each) for each in self._api.pods_on(node)]

    async def _explained(self, proxies: Iterable[ProxyPod]) -> list[ProxyPod]:
        """The proxies, also those that the kubelet can't set up, of which only an Event tells."""
        return await _all(map(self._with_event, proxies))

    async def _with_event(self, proxy: ProxyPod) -> ProxyPod:
        waits = proxy.pod.phase == "Pending" and proxy.pod.node and not proxy.pod.deleting
        if not waits or proxy.stuck or proxy.pod.ip:
            return proxy
        question = partial(self._api.events_of, proxy.pod.id, proxy.pod.uid, SANDBOX_FAILED)
        events = await self._ask(question)
        if not events:
            return proxy
        message = str(max(events, key=_when).get("message") or "")
        return replace(proxy, stuck=stuck_by_event(message), message=_steady(message))


async def _all(work: Iterable[Awaitable[T]]) -> list[T]:
    return list(await asyncio.gather(*work))


def _newest(*groups: Iterable[Pod]) -> tuple[Pod, ...]:
    """Every pod once; of those that were listed more than once, what was listed last."""
    return tuple({pod.uid: pod for group in groups for pod in group}.values())


def _steady(message: str) -> str:
    """What an Event says, without the sandbox's id: that is another one with each try."""
    return clean(_IDS.sub("…", " ".join(message.split())))[:_LONGEST]


def _when(event: Found) -> str:
    return str(event.get("lastTimestamp") or event.get("eventTime") or "")


def master_service(api: Api, id: Name, ports: Collection[int]) -> tuple[str, str]:
    """A Service's cluster IP and what is wrong with it; one of them is empty. Raises ApiError.

    ``ports`` are those that RosProxies name; one of them has to be there.
    """
    try:
        return read_master(api.get("services", id), id, ports)
    except ApiError as error:
        if error.kind is not ErrorKind.GONE:
            raise
        return "", f"there is no Service {id.name} in the namespace {id.namespace}: create it"


def read_master(service: Found, id: Name, ports: Collection[int]) -> tuple[str, str]:
    """The same, from a Service as the API server gives it."""
    spec = service.get("spec") or {}
    address = str(spec.get("clusterIP") or "")
    if not _is_address(address):
        return "", (
            f"the Service {id} has no cluster IP ({spec.get('type') or 'headless'}): "
            "make it one of type ClusterIP with an address of its own"
        )
    offered = {port.get("port") for port in spec.get("ports") or () if isinstance(port, dict)}
    if not offered & set(ports):
        has, wanted = (", ".join(sorted(map(str, some))) or "none" for some in (offered, ports))
        return (
            "",
            f"the Service {id} has no port {wanted} (it has {has}): set spec.master.service.port",
        )
    return address, ""


def _is_address(text: str) -> bool:
    try:
        ip_address(text)
    except ValueError:
        return False
    return True
