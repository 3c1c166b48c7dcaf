"""Which events of a cluster are worth a look: a busy one tells of something every moment.

kopf's watches ask here about every event. An event matters if the object is new
or gone, or if what a look would read of it has changed. What the last look has found says which
pods and Services are of interest at all.
"""

from typing import Any

from rosproxy_operator.kubernetes.planner.selection import chosen
from rosproxy_operator.kubernetes.resources import objects
from rosproxy_operator.kubernetes.resources.model import ClusterSnapshot, Json
from rosproxy_operator.kubernetes.resources.names import is_own
from rosproxy_operator.kubernetes.resources.values import part, word, words

MOST = 20_000
"""Objects that are remembered."""
_RESOURCE = ("uid", "generation", "deletionTimestamp", "labels", "annotations")


class EventFilter:
    """Tells whether an event says anything new about anything that a look would read.

    In doubt it does. What is thrown away here by mistake is seen with the next look all the same.
    ``last`` is what the last look has found.
    """

    def __init__(self) -> None:
        self.last: ClusterSnapshot | None = None
        self._seen: dict[str, Any] = {}

    def rosproxy(self, type: str | None, body: Json) -> bool:
        """Whether an event of a RosProxy matters: not if only its status has changed."""
        meta = part(body, "metadata")
        return self._new(type, body, [meta.get(key) for key in _RESOURCE])

    def node(self, type: str | None, body: Json) -> bool:
        """Whether an event of a node matters."""
        return self._new(type, body, objects.node(body))

    def pod(self, type: str | None, body: Json) -> bool:
        """Whether an event of a pod matters: of a proxy, or one that a RosProxy selects or has."""
        last, pod = self.last, objects.pod(body)
        if is_own(pod.labels):
            return self._new(type, body, (objects.proxy_pod(body), pod))
        if last is not None and pod.uid not in last.selected and not chosen(pod, last.rosproxies):
            return False
        return self._new(type, body, pod)

    def service(self, type: str | None, body: Json) -> bool:
        """Whether an event of a Service matters: of the operator's own, or a master's."""
        masters = self.last.masters if self.last else {}
        meta = part(body, "metadata")
        matters = is_own(words(meta, "labels")) or objects.name_of(meta) in masters
        found = body.get("spec"), objects.allowed_from(body)
        return matters and self._new(type, body, found)

    def _new(self, type: str | None, body: Json, found: object) -> bool:
        """Whether what a look would read of an object is another than when it was told last."""
        uid = word(part(body, "metadata"), "uid")
        if type == "DELETED":
            self._seen.pop(uid, None)
            return True
        if uid in self._seen and self._seen[uid] == found:
            return False
        if len(self._seen) >= MOST:
            self._seen.clear()  # deletions that nobody told of
        self._seen[uid] = found
        return True
