"""Events that say why the kubelet can't set up a proxy's pod, for example for a taken hostPort.

The pod's status does not give this reason. The operator requests these Events while proxies wait
for more than `WAIT_BEFORE_REQUEST_S` seconds: one request for each namespace, at most every
`REQUEST_INTERVAL_S` seconds.
"""

import asyncio
import re
import time
from collections.abc import Sequence
from typing import Any

from msgspec.structs import replace

from rosproxy.shared.output.text import clean
from rosproxy_operator.common.threads import in_thread
from rosproxy_operator.kubernetes.api.api_client import Api
from rosproxy_operator.kubernetes.resources.checks import submap, text_at
from rosproxy_operator.kubernetes.resources.cluster import ClusterSnapshot, ProxyPod
from rosproxy_operator.kubernetes.resources.model import Json
from rosproxy_operator.kubernetes.resources.pod_failures import stuck_by_event

FAILED_REASON = "FailedCreatePodSandBox"
"""Reason of the kubelet's Event. Only this Event says that a hostPort was not free."""
WAIT_BEFORE_REQUEST_S = 2.0
"""Seconds for which a proxy's pod waits on its node before the operator requests Events."""
REQUEST_INTERVAL_S = 3.0
"""Seconds between two requests for a namespace's Events."""
_IDS = re.compile(r"\b[0-9a-f]{32,64}\b")
"""Ids of sandboxes, as container runtimes write them."""
_MOST_MESSAGE_CHARACTERS = 300
"""Characters that are kept of a message."""


class SandboxFailures:
    """The messages of Events about waiting proxies. Use all methods from the event loop only."""

    def __init__(self, api: Api) -> None:
        self._api = api
        self._waiting_since: dict[str, float] = {}
        self._asked_at: dict[str, float] = {}
        self._messages: dict[str, str] = {}

    async def read(self, observed: ClusterSnapshot) -> set[str]:
        """Request the Events that are due. Return the namespaces with new messages.

        Raises ApiError.
        """
        now = time.monotonic()
        waiting = [proxy for proxy in observed.proxies if _waits(proxy)]
        uids = {p.pod.uid for p in waiting}
        self._waiting_since = {uid: self._waiting_since.get(uid, now) for uid in uids}
        self._messages = {uid: text for uid, text in self._messages.items() if uid in uids}
        late = {
            p.of.namespace
            for p in waiting
            if now - self._waiting_since[p.pod.uid] >= WAIT_BEFORE_REQUEST_S
        }
        due = [
            name
            for name in late
            if now - self._asked_at.get(name, -REQUEST_INTERVAL_S) >= REQUEST_INTERVAL_S
        ]
        self._asked_at = {name: at for name, at in self._asked_at.items() if name in late}
        self._asked_at |= dict.fromkeys(due, now)
        event_lists = await asyncio.gather(*(in_thread(self._events, name) for name in due))
        new: set[str] = set()
        for name, events in zip(due, event_lists, strict=True):
            for uid, text in _latest(events).items():
                if uid in uids and self._messages.get(uid) != text:
                    self._messages[uid] = text
                    new.add(name)
        return new

    def _events(self, namespace: str) -> list[dict[str, Any]]:
        return self._api.list_fresh("events", namespace, f"reason={FAILED_REASON}")

    def with_messages(self, observed: ClusterSnapshot) -> ClusterSnapshot:
        """Return the snapshot, with ``stuck`` and ``message`` of waiting proxies from Events."""
        if not self._messages:
            return observed
        return replace(observed, proxies=tuple(map(self._with_message, observed.proxies)))

    def again_in(self) -> float | None:
        """Return the seconds after which to call `read` again, None if no proxy waits."""
        return REQUEST_INTERVAL_S if self._waiting_since else None

    def _with_message(self, proxy: ProxyPod) -> ProxyPod:
        message = self._messages.get(proxy.pod.uid, "")
        if not message or not _waits(proxy):
            return proxy
        # Each try has a new sandbox id. Without the id, the message stays the same.
        steady = clean(_IDS.sub("…", " ".join(message.split())))[:_MOST_MESSAGE_CHARACTERS]
        return replace(proxy, stuck=stuck_by_event(message), message=steady)


def _waits(proxy: ProxyPod) -> bool:
    """Whether a proxy's pod is pending on its node, without an address or a known failure."""
    pod = proxy.pod
    is_pending = pod.phase == "Pending" and bool(pod.node) and not pod.deleting
    return is_pending and not (proxy.stuck or pod.ip)


def _latest(events: Sequence[Json]) -> dict[str, str]:
    """Return the message of the last Event about each pod, by the pod's uid."""
    latest: dict[str, Json] = {}
    for event in sorted(events, key=_timestamp):
        latest[text_at(submap(event, "involvedObject"), "uid")] = event
    return {uid: text_at(event, "message") for uid, event in latest.items()}


def _timestamp(event: Json) -> str:
    return text_at(event, "lastTimestamp") or text_at(event, "eventTime")
