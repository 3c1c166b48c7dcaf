"""Which events of a cluster are worth a look: a busy one tells of something every moment.

kopf's watches hand every event to `handlers`, which ask here. An event matters if the object is new
or gone, or if what a look would read of it has changed. What the last look has found says which
pods and Services are of interest at all.
"""

import logging
from collections.abc import Callable
from typing import Any

from rosproxy_operator.kubernetes.planner.selection import chosen
from rosproxy_operator.kubernetes.resources.model import ClusterSnapshot, Json, Name
from rosproxy_operator.kubernetes.resources.names import is_own
from rosproxy_operator.kubernetes.resources.objects import node as parse_node
from rosproxy_operator.kubernetes.resources.objects import pod as parse_pod
from rosproxy_operator.kubernetes.resources.objects import proxy_pod as parse_proxy_pod

log = logging.getLogger(__name__)

MOST = 20_000
"""Objects that are remembered."""
_RESOURCE = ("uid", "generation", "deletionTimestamp", "labels", "annotations")


class EventFilter:
    """Tells whether an event says anything new about anything that a look would read.

    In doubt it does. What is thrown away here by mistake is seen with the next look all the same.
    """

    def __init__(self) -> None:
        self._last: ClusterSnapshot | None = None
        self._seen: dict[tuple[str, str], Any] = {}

    def learn(self, snapshot: ClusterSnapshot) -> None:
        """Take note of what the last look has found."""
        self._last = snapshot

    def rosproxy(self, type: str | None, body: Json) -> bool:
        """Whether an event of a RosProxy matters: not if only its status has changed."""
        meta = body.get("metadata") or {}
        return self._new("rosproxy", type, body, lambda: [meta.get(key) for key in _RESOURCE])

    def node(self, type: str | None, body: Json) -> bool:
        """Whether an event of a node matters."""
        return self._new("node", type, body, lambda: parse_node(body))

    def pod(self, type: str | None, body: Json) -> bool:
        """Whether an event of a pod matters: of a proxy's, or one that a RosProxy selects."""
        if _own(body):
            return self._new("pod", type, body, lambda: (parse_proxy_pod(body), parse_pod(body)))
        return self._selected(body) and self._new("pod", type, body, lambda: parse_pod(body))

    def service(self, type: str | None, body: Json) -> bool:
        """Whether an event of a Service matters: of the operator's own, or a master's."""
        if not _own(body) and (self._last is None or _id(body) not in self._last.masters):
            return False
        return self._new("service", type, body, lambda: body.get("spec"))

    def _selected(self, body: Json) -> bool:
        """Whether a RosProxy selects a pod now, or did at the last look."""
        last = self._last
        if last is None:
            return True
        pod = parse_pod(body)
        namespace = [one for one in last.rosproxies if one.id.namespace == pod.id.namespace]
        choice = chosen(pod, namespace)
        return bool(choice.rosproxy or choice.finding) or pod.uid in last.selected

    def _new(self, kind: str, type: str | None, body: Json, read: Callable[[], Any]) -> bool:
        key = kind, str((body.get("metadata") or {}).get("uid"))
        if type == "DELETED":
            self._seen.pop(key, None)
            return True
        found = read()
        if key in self._seen and self._seen[key] == found:
            return False
        if len(self._seen) >= MOST:
            self._seen.clear()  # deletions that nobody told of
        self._seen[key] = found
        return True


def _own(body: Json) -> bool:
    return is_own((body.get("metadata") or {}).get("labels") or {})


def _id(body: Json) -> Name:
    meta = body.get("metadata") or {}
    return Name(str(meta.get("namespace") or ""), str(meta.get("name") or ""))
