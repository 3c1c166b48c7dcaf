"""What only an Event tells: that the kubelet can't set a proxy's pod up, for a port for one.

As long as proxies have been waiting for a while, the Events with that reason are asked for, in one
request for a namespace and never often.
"""

import asyncio
import re
import time
from collections.abc import Sequence
from typing import Any

from msgspec.structs import replace

from rosproxy.telemetry.text import clean
from rosproxy_operator.common.threads import in_thread
from rosproxy_operator.kubernetes.api.client import Api
from rosproxy_operator.kubernetes.resources.cluster import ClusterSnapshot, ProxyPod
from rosproxy_operator.kubernetes.resources.model import Json
from rosproxy_operator.kubernetes.resources.pod_failures import stuck_by_event
from rosproxy_operator.kubernetes.resources.values import part, word

FAILED = "FailedCreatePodSandBox"
"""The reason of the kubelet's Event, which alone says that a hostPort could not be had."""
PATIENCE = 2.0
"""Seconds for which a proxy's pod may wait on its node without anybody asking why."""
EVERY = 3.0
"""Seconds between two questions about a namespace."""
_IDS = re.compile(r"\b[0-9a-f]{32,64}\b")
_LONGEST = 300


class SandboxFailures:
    """What the Events say of proxies that wait. Every method belongs to the event loop."""

    def __init__(self, api: Api) -> None:
        self._api = api
        self._since: dict[str, float] = {}
        self._asked: dict[str, float] = {}
        self._messages: dict[str, str] = {}

    async def read(self, observed: ClusterSnapshot) -> set[str]:
        """Ask where it is time to; the namespaces of which something new is known."""
        now, waiting = time.monotonic(), [one for one in observed.proxies if _waits(one)]
        uids = {one.pod.uid for one in waiting}
        self._since = {uid: self._since.get(uid, now) for uid in uids}
        self._messages = {uid: text for uid, text in self._messages.items() if uid in uids}
        late = {one.of.namespace for one in waiting if now - self._since[one.pod.uid] >= PATIENCE}
        due = [name for name in late if now - self._asked.get(name, -EVERY) >= EVERY]
        self._asked = {name: at for name, at in self._asked.items() if name in late}
        self._asked |= dict.fromkeys(due, now)
        found = await asyncio.gather(*(in_thread(self._events, name) for name in due))
        new: set[str] = set()
        for name, events in zip(due, found, strict=True):
            for uid, text in _latest(events).items():
                if uid in uids and self._messages.get(uid) != text:
                    self._messages[uid] = text
                    new.add(name)
        return new

    def _events(self, namespace: str) -> list[dict[str, Any]]:
        return self._api.fresh("events", namespace, f"reason={FAILED}")

    def shown(self, observed: ClusterSnapshot) -> ClusterSnapshot:
        """What is seen, with what is known of its proxies."""
        if not self._messages:
            return observed
        return replace(observed, proxies=tuple(map(self._shown, observed.proxies)))

    def again_in(self) -> float | None:
        """In how many seconds there is something to be asked; None: never."""
        return EVERY if self._since else None

    def _shown(self, proxy: ProxyPod) -> ProxyPod:
        message = self._messages.get(proxy.pod.uid, "")
        if not message or not _waits(proxy):
            return proxy
        # Without the sandbox's id, which is another one with each try.
        steady = clean(_IDS.sub("…", " ".join(message.split())))[:_LONGEST]
        return replace(proxy, stuck=stuck_by_event(message), message=steady)


def _waits(proxy: ProxyPod) -> bool:
    """Whether a proxy's pod is on its node, and nothing more is heard of it."""
    pod = proxy.pod
    there = pod.phase == "Pending" and bool(pod.node) and not pod.deleting
    return there and not (proxy.stuck or pod.ip)


def _latest(events: Sequence[Json]) -> dict[str, str]:
    """What the last Event about each pod says, by the pod's uid."""
    found: dict[str, Json] = {}
    for event in sorted(events, key=_when):
        found[word(part(event, "involvedObject"), "uid")] = event
    return {uid: word(event, "message") for uid, event in found.items()}


def _when(event: Json) -> str:
    return word(event, "lastTimestamp") or word(event, "eventTime")
