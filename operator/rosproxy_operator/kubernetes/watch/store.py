"""The cluster as its watches tell it: what a look sees, and what has changed since the last one.

All of it lives in the event loop: reflectors tell (`changed`, `listed`, `failed`), the controller
asks (`snapshot`, `touched`). It may lag behind, and be wrong where a watch has lost something: a
later look puts right what follows from that, and nothing is deleted by it alone (`confirm`).
"""

import asyncio
import logging
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TypeVar

from msgspec.structs import replace

from rosproxy.net.addresses import is_address
from rosproxy_operator.kubernetes.api.client import ApiAway, ApiError, ApiGone
from rosproxy_operator.kubernetes.planner.pods.selection import selects
from rosproxy_operator.kubernetes.resources.cluster import (
    ClusterSnapshot,
    EarPod,
    MasterService,
    ProxyPod,
    ProxyPolicy,
    ProxyService,
    own_pods,
)
from rosproxy_operator.kubernetes.resources.model import (
    ClusterNode,
    InvalidRosProxy,
    Name,
    Pod,
    RosProxy,
)
from rosproxy_operator.kubernetes.resources.names import PLURAL
from rosproxy_operator.kubernetes.resources.records import POLICIES, Record
from rosproxy_operator.kubernetes.watch.reflector import crd_missing

log = logging.getLogger(__name__)

R = TypeVar("R", bound=Record)
Where = tuple[str, str]
"""A kind, and a namespace, empty for all."""


@dataclass(slots=True)
class Touched:
    """What has changed: something of these namespaces, or on these nodes."""

    namespaces: set[str] = field(default_factory=set)
    nodes: set[str] = field(default_factory=set)


class ClusterStore:
    """What is known. ``kinds`` are what is to be known, ``places`` the namespaces looked after.

    ``wake`` is called when a look is due, ``back`` when something is kept up with again.
    """

    def __init__(
        self,
        kinds: Iterable[Where],
        places: tuple[str, ...],
        wake: Callable[[], None],
        back: Callable[[], None],
        corrected: Callable[[int], None] = lambda _: None,
    ) -> None:
        self._wake, self._back, self._corrected = wake, back, corrected
        self._places = places
        self._tables: dict[Where, dict[str, Record]] = {where: {} for where in kinds}
        self._errors: dict[Where, ApiError] = {}
        self._listed: set[Where] = set()
        self._pending, self._told = set(self._tables), asyncio.Event()
        self._pods: dict[str, dict[str, Pod]] = defaultdict(dict)
        self._own: dict[str, dict[str, ProxyPod]] = defaultdict(dict)
        self._ears: dict[str, dict[str, EarPod]] = defaultdict(dict)
        self._with_ports: dict[str, dict[str, Pod]] = defaultdict(dict)
        self._rosproxies: dict[str, dict[str, RosProxy]] = defaultdict(dict)
        self._touched = Touched()

    # what reflectors tell

    def changed(self, kind: str, place: str, changes: Mapping[str, Record | None]) -> None:
        """Some objects are so now, by their keys; None: gone. And the watch works."""
        where = kind, place
        self._heard(where)
        if self._errors.pop(where, None):
            self._back()
        for key, record in changes.items():
            self._put(where, key, record)

    def listed(self, kind: str, place: str, records: Mapping[str, Record]) -> None:
        """These are all objects of a kind; the watch is yet to begin."""
        where, before = (kind, place), dict(self._tables[kind, place])
        gone = dict.fromkeys(before.keys() - records.keys())
        differ = [key for key, one in records.items() if before.get(key) != one]
        for key, record in {**gone, **records}.items():
            self._put(where, key, record)
        if where in self._listed and (gone or differ):
            log.info("a list of the %s corrects %d", kind, len(gone) + len(differ))
            self._corrected(len(gone) + len(differ))
        self._listed.add(where)

    def failed(self, kind: str, place: str, error: ApiError) -> None:
        """A kind can't be kept up with for now."""
        if isinstance(error, ApiGone) and (text := crd_missing(kind)):
            error = ApiGone(text)
        fresh = (kind, place) not in self._errors
        self._errors[kind, place] = error
        self._heard((kind, place))
        if fresh:
            self._wake()

    def _heard(self, where: Where) -> None:
        self._pending.discard(where)
        if not self._pending:
            self._told.set()

    # what the controller asks

    async def check(self) -> None:
        """Wait until all has been listed once; ApiError if something can't be kept up with.

        Without NetworkPolicies all else goes on, where the operator has no right to them.
        """
        await self._told.wait()
        for (kind, _), error in sorted(self._errors.items(), key=lambda one: one[0][0] != PLURAL):
            if kind != POLICIES or isinstance(error, ApiAway):
                raise error

    def touched(self) -> Touched:
        """What has changed since this was asked last."""
        found, self._touched = self._touched, Touched()
        return found

    def snapshot(self, key: bytes = b"") -> ClusterSnapshot:
        """The cluster as it is known."""
        rosproxies = tuple(self._of(PLURAL, RosProxy))
        masters, own = self._masters(rosproxies), self._of("services", ProxyService)
        seen = ClusterSnapshot(
            rosproxies=rosproxies,
            unusable={one.id: one for one in self._of(PLURAL, InvalidRosProxy)},
            nodes={one.name: one for one in self._of("nodes", ClusterNode)},
            services={one.of: one for one in own if self._looked_after(one.of.namespace)},
            masters={id: read_master(one, id, ports) for id, (one, ports) in masters.items()},
            consents={id: one.allowed if one else frozenset() for id, (one, _) in masters.items()},
            policies={one.id: one for one in self._of(POLICIES, ProxyPolicy)},
            no_policies=next((str(one) for one in self._refused(POLICIES)), ""),
            key=key,
        )
        return self._with_pods(seen)

    def _with_pods(self, seen: ClusterSnapshot) -> ClusterSnapshot:
        proxies = [one for some in self._own.values() for one in some.values()]
        ears = [one for some in self._ears.values() for one in some.values()]
        namespaces = {*self._rosproxies, *self._own, *self._ears}
        namespaces |= {id.namespace for id in seen.unusable}
        others = [pod for name in namespaces for pod in self._pods.get(name, {}).values()]
        found, own = [pod for pod in others if self._is_selected(pod)], own_pods(proxies, ears)
        on = {pod.node for pod in found} | {node for one in own for node in (one.on, one.pod.node)}
        pods = {pod.uid: pod for pod in others if pod.node in on}
        pods |= {pod.uid: pod for pod in found}
        for node in on & self._with_ports.keys():
            pods |= self._with_ports[node]
        pods |= {one.pod.uid: one.pod for one in own}
        return replace(
            seen,
            pods=tuple(pods.values()),
            proxies=tuple(proxies),
            ears=tuple(ears),
            selected=frozenset(pod.uid for pod in found if not pod.ended),
        )

    def _masters(
        self, rosproxies: Iterable[RosProxy]
    ) -> dict[Name, tuple[MasterService | None, set[int]]]:
        """The Services that RosProxies name as their masters, and the ports that they name."""
        ports: dict[Name, set[int]] = defaultdict(set)
        for each in rosproxies:
            if each.spec.master.service is not None:
                ports[each.spec.master.service].add(each.spec.master.service_port)
        if not ports:
            return {}
        there = {one.id: one for one in self._of("services", MasterService)}
        return {id: (there.get(id), some) for id, some in ports.items()}

    def _refused(self, kind: str) -> list[ApiError]:
        return [error for where, error in self._errors.items() if where[0] == kind]

    def _of(self, kind: str, wanted: type[R]) -> Iterator[R]:
        for where, table in self._tables.items():
            if where[0] == kind:
                yield from (one for one in table.values() if isinstance(one, wanted))

    def _looked_after(self, namespace: str) -> bool:
        return self._places == ("",) or namespace in self._places

    def _is_selected(self, pod: Pod) -> bool:
        there = self._rosproxies.get(pod.id.namespace)
        return there is not None and any(selects(one, pod) for one in there.values())

    # what a change means

    def _put(self, where: Where, key: str, record: Record | None) -> None:
        table = self._tables[where]
        before = table.get(key)
        record = self._as_others(record)
        if before == record:
            return
        if record is None:
            del table[key]
        else:
            table[key] = record
        self._index(before, key, add=False)
        self._touch(before, record)
        self._index(record, key, add=True)
        self._touch(record, before)

    def _as_others(self, record: Record | None) -> Record | None:
        """Pods of another operator, which looks after other namespaces, are like anybody's."""
        if isinstance(record, ProxyPod | EarPod) and not self._looked_after(record.of.namespace):
            return record.pod
        return record

    def _index(self, record: Record | None, key: str, add: bool) -> None:
        if isinstance(record, RosProxy):
            _set(self._rosproxies, record.id.namespace, key, record if add else None)
        elif isinstance(record, ProxyPod):
            _set(self._own, record.of.namespace, key, record if add else None)
        elif isinstance(record, EarPod):
            _set(self._ears, record.of.namespace, key, record if add else None)
        elif isinstance(record, Pod):
            _set(self._pods, record.id.namespace, key, record if add else None)
            if record.every_port and record.node:
                _set(self._with_ports, record.node, key, record if add else None)

    def _touch(self, record: Record | None, other: Record | None) -> None:
        """Note whom it concerns that a record has come, or is another one, or is gone."""
        match record:
            case None:
                return
            case RosProxy() | InvalidRosProxy():
                if _asked(record) == _asked(other):
                    return  # its status alone: the operator's own words
                self._touched.namespaces.add(record.id.namespace)
            case ClusterNode():
                self._touched.nodes.add(record.name)
            case MasterService():
                self._touch_users(record.id)
                return
            case Pod():
                self._touch_pod(record)
                return
            case _:
                self._touched.namespaces.add(record.of.namespace)
                if other is None and isinstance(record, ProxyPod | EarPod):
                    self._touched.nodes.add(record.on)  # others may wait for its ports
        self._wake()

    def _touch_pod(self, pod: Pod) -> None:
        """One of others matters if a RosProxy selects it, or if it takes ports."""
        selected = self._is_selected(pod)
        if selected:
            self._touched.namespaces.add(pod.id.namespace)
        if selected or pod.every_port:
            self._touched.nodes.add(pod.node)
            self._wake()

    def _touch_users(self, service: Name) -> None:
        """A Service matters if a RosProxy names it as its master."""
        for namespace, there in self._rosproxies.items():
            if any(one.spec.master.service == service for one in there.values()):
                self._touched.namespaces.add(namespace)
                self._wake()


def _asked(record: Record | None) -> object:
    """What a RosProxy asks for, without its status."""
    if isinstance(record, RosProxy):
        return record.uid, record.generation, record.deleting, record.spec, record.remakes
    if isinstance(record, InvalidRosProxy):
        return record.uid, record.generation, record.text
    return None


def _set(index: dict[str, dict[str, R]], name: str, key: str, record: R | None) -> None:
    if record is not None:
        index[name][key] = record
        return
    index[name].pop(key, None)
    if not index[name]:
        del index[name]


def read_master(service: MasterService | None, id: Name, ports: Iterable[int]) -> tuple[str, str]:
    """The address of a master's Service, and what is wrong with it, one of them empty.

    ``ports`` are those that RosProxies name; one of them has to be there.
    """
    if service is None:
        text = f"there is no Service {id.name} in the namespace {id.namespace}: create it"
        return "", text
    if not is_address(service.address):
        return "", (
            f"the Service {id} has no cluster IP ({service.type or 'headless'}): "
            "make it one of type ClusterIP with an address of its own"
        )
    if service.ports.isdisjoint(ports):
        has, wanted = (
            ", ".join(sorted(map(str, some))) or "none" for some in (service.ports, ports)
        )
        text = f"has no port {wanted} (it has {has}): set spec.master.service.port"
        return "", f"the Service {id} {text}"
    return service.address, ""
