"""Keeps the state of the cluster from watches, and notes what has changed since the last look.

The event loop makes all calls: reflectors write (`changed`, `listed`, `failed`), the controller
reads (`snapshot`, `take_changes`). The state may lag behind the API server, or lack an event that a
watch has lost. The next list corrects the state, and a later look corrects the consequences. Before
the operator deletes an object, it reads the facts from the API server again (`confirm_deletion`).
"""

import asyncio
import logging
import time
from collections import defaultdict
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

from msgspec.structs import replace

from rosproxy.shared.addresses import is_address, plain_address
from rosproxy_operator.common.problem import Fault
from rosproxy_operator.kubernetes.api.api_client import (
    ApiError,
    ApiNotFound,
    ApiUnavailable,
    crd_missing,
)
from rosproxy_operator.kubernetes.planner.pods.selection import selects, wants_proxy
from rosproxy_operator.kubernetes.resources.cluster import (
    ClusterSnapshot,
    HelperPod,
    MasterService,
    OwnPod,
    ProxyPod,
    ProxyPolicy,
    ProxyService,
    ServiceRole,
)
from rosproxy_operator.kubernetes.resources.model import (
    ClusterNode,
    InvalidRosProxy,
    Name,
    Pod,
    ProxyPlace,
    RosProxy,
)
from rosproxy_operator.kubernetes.resources.names import IMAGE_CHECK, LAN_RELAY, PLURAL
from rosproxy_operator.kubernetes.resources.records import POLICIES, Change, Record

log = logging.getLogger(__name__)

R = TypeVar("R", bound=Record)
WatchKey = tuple[str, str]
"""A kind, and a namespace. An empty namespace stands for all."""
MOST_VANISHED = 4096
"""Places of vanished proxy pods at most; for a further place the store forgets the oldest."""


@dataclass(slots=True)
class StoreChanges:
    """The namespaces and the nodes of changed objects that matter to a RosProxy."""

    namespaces: set[str] = field(default_factory=set)
    nodes: set[str] = field(default_factory=set)


class ClusterStore:
    """The records of all ``watches``. The operator manages ``namespaces``; all if ("",).

    The store calls ``wake`` when a look is due, and ``recovered`` when a failed watch works again.
    ``corrected`` gets the number of objects in which a new list differs from the store. ``now``
    gives seconds of a monotonic clock.
    """

    def __init__(
        self,
        watches: Iterable[WatchKey],
        namespaces: tuple[str, ...],
        wake: Callable[[], None],
        recovered: Callable[[], None],
        corrected: Callable[[int], None] = lambda _: None,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self._wake = wake
        self._recovered = recovered
        self._corrected = corrected
        self._now = now
        self._namespaces = namespaces
        self._tables: dict[WatchKey, dict[str, Record]] = {watch: {} for watch in watches}
        self._errors: dict[WatchKey, ApiError] = {}
        self._listed: set[WatchKey] = set()
        self._pending = set(self._tables)
        self._all_tried = asyncio.Event()
        self._pods: dict[str, dict[str, Pod]] = defaultdict(dict)
        self._own_pods: dict[str, dict[str, OwnPod]] = defaultdict(dict)
        self._labelled: dict[str, dict[str, Pod]] = defaultdict(dict)
        self._misspelt: dict[str, dict[str, Pod]] = defaultdict(dict)
        self._pods_with_ports: dict[str, dict[str, Pod]] = defaultdict(dict)
        self._rosproxies: dict[str, dict[str, RosProxy]] = defaultdict(dict)
        self._vanished: dict[ProxyPlace, float] = {}
        self._touched = StoreChanges()

    # For reflectors:

    def changed(self, kind: str, place: str, changes: Sequence[Change]) -> None:
        """Apply changes in this order. None: the object is gone, or has no record.

        Each call shows that the watch works, also a call without changes.
        """
        watch = kind, place
        self._note_tried(watch)
        if self._errors.pop(watch, None):
            self._recovered()
        for key, record in changes:
            self._put(watch, key, record)

    def listed(self, kind: str, place: str, records: Mapping[str, Record]) -> None:
        """Replace all records of a kind in a namespace.

        This call does not show that the watch works: the watch starts after the list.
        """
        watch = (kind, place)
        former = dict(self._tables[kind, place])
        gone = dict.fromkeys(former.keys() - records.keys())
        kept = {key: self._without_foreign_ownership(record) for key, record in records.items()}
        differ = [key for key, record in kept.items() if former.get(key) != record]
        for key, record in {**gone, **kept}.items():
            self._put(watch, key, record)
        if watch in self._listed and (gone or differ):
            log.info(
                "watch corrected: %s, a new list differs from the watched state in %d objects",
                kind,
                len(gone) + len(differ),
            )
            self._corrected(len(gone) + len(differ))
        self._listed.add(watch)

    def failed(self, kind: str, place: str, error: ApiError) -> None:
        """Note an error of a list or watch; `check` raises the error while the watch fails."""
        if isinstance(error, ApiNotFound) and (text := crd_missing(kind)):
            error = ApiNotFound(text)
        is_first = (kind, place) not in self._errors
        self._errors[kind, place] = error
        self._note_tried((kind, place))
        if is_first:
            self._wake()

    def _note_tried(self, watch: WatchKey) -> None:
        self._pending.discard(watch)
        if not self._pending:
            self._all_tried.set()

    # For the controller:

    async def check(self) -> None:
        """Wait until each watch has started or failed once. Raises ApiError if a watch fails now.

        NetworkPolicies are an exception: the operator may lack the right to read NetworkPolicies,
        and works without. Only ApiUnavailable counts there.
        """
        await self._all_tried.wait()
        # RosProxies first: if the CRD is missing, this error has the fix.
        for (kind, _), error in sorted(self._errors.items(), key=lambda pair: pair[0][0] != PLURAL):
            if kind != POLICIES or isinstance(error, ApiUnavailable):
                raise error

    def take_changes(self) -> StoreChanges:
        """Return the changes since the last call, and start anew."""
        touched = self._touched
        self._touched = StoreChanges()
        return touched

    def snapshot(self, key: bytes = b"") -> ClusterSnapshot:
        """The present state of the cluster. ``key`` is the key of the proxies' tokens."""
        rosproxies = tuple(self._records_of(PLURAL, RosProxy))
        masters = self._masters(rosproxies)
        services = [
            service
            for service in self._records_of("services", ProxyService)
            if self._is_managed(service.of.namespace)
        ]
        snapshot = ClusterSnapshot(
            rosproxies=rosproxies,
            unusable={r.id: r for r in self._records_of(PLURAL, InvalidRosProxy)},
            nodes={node.name: node for node in self._records_of("nodes", ClusterNode)},
            services={s.of: s for s in services if s.role is ServiceRole.PODS},
            hub_services={s.of: s for s in services if s.role is ServiceRole.HUBS},
            outside_services={s.of: s for s in services if s.role is ServiceRole.OUTSIDE},
            masters={id: read_master(s, id, ports) for id, (s, ports) in masters.items()},
            consents={id: s.allowed if s else frozenset() for id, (s, _) in masters.items()},
            misspelt_services={id: s.misspelt for id, (s, _) in masters.items() if s},
            policies={policy.id: policy for policy in self._records_of(POLICIES, ProxyPolicy)},
            policies_error=next((str(error) for error in self._errors_of(POLICIES)), ""),
            vanished=dict(self._vanished),
            key=key,
        )
        return self._with_pods(snapshot)

    def pod_names(self) -> dict[str, str]:
        """The names of pods by address, in namespaces with a RosProxy.

        Ended pods and pods in the host's network are left out.
        """
        return {
            plain_address(address): pod.id.name
            for namespace in self._rosproxies
            for pod in self._pods.get(namespace, {}).values()
            if not (pod.host_network or pod.ended)
            for address in pod.ips or (pod.ip,)
            if address
        }

    def _with_pods(self, snapshot: ClusterSnapshot) -> ClusterSnapshot:
        own = [own_pod for group in self._own_pods.values() for own_pod in group.values()]
        helpers = [own_pod for own_pod in own if isinstance(own_pod, HelperPod)]
        namespaces = {*self._rosproxies, *self._own_pods}
        namespaces |= {id.namespace for id in snapshot.unusable}
        candidates = [pod for name in namespaces for pod in self._pods.get(name, {}).values()]
        selected = [p for p in candidates if self._is_selected(p)]
        nodes = {p.node for p in selected} | {node for p in own for node in (p.node, p.pod.node)}
        pods = {p.uid: p for p in candidates if p.node in nodes}
        pods |= {pod.uid: pod for pod in selected}
        for node in nodes & self._pods_with_ports.keys():
            pods |= self._pods_with_ports[node]
        pods |= {p.pod.uid: p.pod for p in own}
        return replace(
            snapshot,
            pods=tuple(pods.values()),
            proxies=tuple(own_pod for own_pod in own if isinstance(own_pod, ProxyPod)),
            lan_relays=tuple(h for h in helpers if h.component == LAN_RELAY),
            image_checks=tuple(h for h in helpers if h.component == IMAGE_CHECK),
            selected=frozenset(pod.uid for pod in selected if not pod.ended),
            unselected_pods=tuple(self._unselected({pod.uid for pod in selected})),
            misspelt_pods=tuple(p for group in self._misspelt.values() for p in group.values()),
        )

    def _unselected(self, selected: Container[str]) -> Iterator[Pod]:
        for group in self._labelled.values():
            for pod in group.values():
                if not (pod.uid in selected or pod.ended or pod.deleting):
                    yield pod

    def _masters(
        self, rosproxies: Iterable[RosProxy]
    ) -> dict[Name, tuple[MasterService | None, set[int]]]:
        """The Services that RosProxies name as the master, each with the named ports.

        None stands for a Service that does not exist.
        """
        ports: dict[Name, set[int]] = defaultdict(set)
        for rosproxy in rosproxies:
            if rosproxy.spec.master.service is not None:
                ports[rosproxy.spec.master.service].add(rosproxy.spec.master.service_port)
        if not ports:
            return {}
        services = {service.id: service for service in self._records_of("services", MasterService)}
        return {id: (services.get(id), numbers) for id, numbers in ports.items()}

    def _errors_of(self, kind: str) -> list[ApiError]:
        return [error for watch, error in self._errors.items() if watch[0] == kind]

    def _records_of(self, kind: str, record_type: type[R]) -> Iterator[R]:
        for watch, table in self._tables.items():
            if watch[0] == kind:
                yield from (record for record in table.values() if isinstance(record, record_type))

    def _is_managed(self, namespace: str) -> bool:
        return self._namespaces == ("",) or namespace in self._namespaces

    def _is_selected(self, pod: Pod) -> bool:
        rosproxies = self._rosproxies.get(pod.id.namespace)
        return rosproxies is not None and any(selects(r, pod) for r in rosproxies.values())

    # Changes:

    def _put(self, watch: WatchKey, key: str, record: Record | None) -> None:
        table = self._tables[watch]
        former = table.get(key)
        record = self._without_foreign_ownership(record)
        if former == record:
            return
        if record is None:
            del table[key]
        else:
            table[key] = record
        # Touch the former record, then the new record: a pod with a changed label may leave one
        # RosProxy for another. An update of a proxy's pod must end with add=True: see
        # `_note_vanished`.
        self._index(former, key, add=False)
        self._touch(former, record)
        self._index(record, key, add=True)
        self._touch(record, former)

    def _without_foreign_ownership(self, record: Record | None) -> Record | None:
        """Treat a pod of another operator, which manages other namespaces, as an ordinary pod."""
        if isinstance(record, OwnPod) and not self._is_managed(record.of.namespace):
            return record.pod
        return record

    def _index(self, record: Record | None, key: str, add: bool) -> None:
        if isinstance(record, RosProxy):
            _set(self._rosproxies, record.id.namespace, key, record if add else None)
        elif isinstance(record, OwnPod):
            _set(self._own_pods, record.of.namespace, key, record if add else None)
            if isinstance(record, ProxyPod):
                self._note_vanished(record, add)
        elif isinstance(record, Pod):
            self._index_pod(record, key, record if add else None)

    def _note_vanished(self, proxy: ProxyPod, is_there: bool) -> None:
        """Note the time when a proxy's pod vanishes and the store has not seen the container end.

        Such a container may still run and hold ports. A new pod at the place clears the note.
        """
        place = ProxyPlace(proxy.of, proxy.node)
        self._vanished.pop(place, None)
        if not is_there and proxy.runs:
            self._vanished[place] = self._now()
            if len(self._vanished) > MOST_VANISHED:
                del self._vanished[next(iter(self._vanished))]

    def _index_pod(self, pod: Pod, key: str, kept: Pod | None) -> None:
        _set(self._pods, pod.id.namespace, key, kept)
        if self._is_managed(pod.id.namespace):
            if wants_proxy(pod):
                _set(self._labelled, pod.id.namespace, key, kept)
            if pod.misspelt:
                _set(self._misspelt, pod.id.namespace, key, kept)
        if pod.every_port and pod.node:
            _set(self._pods_with_ports, pod.node, key, kept)

    def _touch(self, record: Record | None, counterpart: Record | None) -> None:
        """Note the namespaces and nodes that a record concerns, and wake the controller.

        ``counterpart`` is the record of the same object on the other side of the change.
        """
        match record:
            case None:
                return
            case RosProxy() | InvalidRosProxy():
                if _requested(record) == _requested(counterpart):
                    return  # only the status differs, which the operator writes
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
                if counterpart is None and isinstance(record, OwnPod):
                    self._touched.nodes.add(record.node)  # another proxy may wait for these ports
        self._wake()

    def _touch_pod(self, pod: Pod) -> None:
        """Note a pod that a RosProxy selects, or that asks for a proxy or takes ports of a node."""
        selected = self._is_selected(pod)
        is_meant = wants_proxy(pod) or bool(pod.misspelt)
        if selected or (is_meant and self._is_managed(pod.id.namespace)):
            self._touched.namespaces.add(pod.id.namespace)
            self._wake()
        if selected or pod.every_port:
            self._touched.nodes.add(pod.node)
            self._wake()

    def _touch_users(self, service: Name) -> None:
        """Note the namespaces of the RosProxies that name the Service as the master."""
        for namespace, rosproxies in self._rosproxies.items():
            if any(rosproxy.spec.master.service == service for rosproxy in rosproxies.values()):
                self._touched.namespaces.add(namespace)
                self._wake()


def _requested(record: Record | None) -> object:
    """The parts of a RosProxy that do not come from its status; None for other records."""
    if isinstance(record, RosProxy):
        asked = record.uid, record.generation, record.deleting, record.spec, record.remakes
        return *asked, record.misspelt
    if isinstance(record, InvalidRosProxy):
        return record.uid, record.generation, record.text, record.fix
    return None


def _set(index: dict[str, dict[str, R]], name: str, key: str, record: R | None) -> None:
    if record is not None:
        index[name][key] = record
        return
    index[name].pop(key, None)
    if not index[name]:
        del index[name]


def read_master(
    service: MasterService | None, id: Name, ports: Iterable[int]
) -> tuple[str, Fault | None]:
    """Return the address of a master's Service, and the fault of the Service.

    Exactly one of the two is there. ``ports`` are the ports that RosProxies name. The Service needs
    at least one of these ports.
    """
    fault = None
    if service is None:
        fix = "Create the Service, or correct spec.master.service"
        return "", Fault("does not exist", fix)
    if service.address == "None":
        fault = Fault("is headless", "Delete the Service, and create it without clusterIP: None")
    elif not is_address(service.address):
        text = f"has no cluster IP (type {service.type})"
        fault = Fault(text, "Use a Service of type ClusterIP")
    elif service.ports.isdisjoint(ports):
        has, wanted = (
            ", ".join(sorted(map(str, numbers))) or "none" for numbers in (service.ports, ports)
        )
        text = f"has no port {wanted} (its ports: {has})"
        fault = Fault(text, "Set spec.master.service.port")
    return ("", fault) if fault else (service.address, None)
