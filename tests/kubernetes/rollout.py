"""Rollouts: the proxies of a RosProxy that are away, by the events of the API server."""

import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import urllib3

from tests.docker.nodes import Log
from tests.kubernetes import api
from tests.kubernetes.api import Json
from tests.kubernetes.pods import ready
from tests.kubernetes.rosproxies import PROXY_OF, RosProxy, proxy


@dataclass(frozen=True)
class Sight:
    """The pod of a proxy at an event. ``gone``: the pod is deleted, or is being deleted."""

    at: float
    node: str
    uid: str
    image: str
    restarts: int
    ready: bool
    gone: bool


@dataclass(frozen=True)
class Absence:
    """The absence of a proxy: from the change of the pod until the proxy is ready again."""

    node: str
    begin: float
    end: float

    def numbers(self, log: Log, word: str) -> list[int]:
        """The numbers of the messages that a node received during the absence."""
        return [got.number for got in log.got(word) if self.begin <= got.at <= self.end]


@dataclass
class Rollout:
    """Collects the events of the proxies of a RosProxy."""

    made: RosProxy
    sights: list[Sight] = field(default_factory=list)

    def absences(self) -> list[Absence]:
        """All absences of proxies, ordered by begin. An absence that lasts has an infinite end."""
        return [*absences(self.sights)]

    @property
    def ended(self) -> list[Absence]:
        return [absence for absence in self.absences() if absence.end < float("inf")]

    def collect(self, ended: threading.Event) -> None:
        """Read events until ``ended``. A watch is short, so the method returns soon."""
        selector = f"{PROXY_OF}={self.made.name},app.kubernetes.io/component=proxy"
        version = ""
        while not ended.is_set():
            try:
                for event in api.watch("pods", self.made.namespace, selector, version, seconds=2):
                    is_error = event["type"] == "ERROR"  # the version is too old
                    version = "" if is_error else event["object"]["metadata"]["resourceVersion"]
                    if not is_error:
                        self.sights.append(sight(event, time.time()))
            except urllib3.exceptions.HTTPError:
                continue


def sight(event: Json, at: float) -> Sight:
    body = event["object"]
    seen = proxy(body)
    statuses = body.get("status", {}).get("containerStatuses", [])
    gone = event["type"] == "DELETED" or "deletionTimestamp" in body["metadata"]
    image = body["spec"]["containers"][0]["image"]
    restarts = sum(int(status["restartCount"]) for status in statuses)
    return Sight(at, seen.on, seen.uid_then, image, restarts, ready(body), gone)


def absences(sights: Iterable[Sight]) -> Iterator[Absence]:
    """The absences of proxies, ordered by begin.

    After a change of the image, the pod stays ready until the kubelet ends the former container. So
    a proxy is away until the new container is ready.
    """
    pods: dict[str, Sight] = {}
    restarts_needed: dict[str, int] = {}
    begun: dict[str, float] = {}
    found: list[Absence] = []
    for seen in sights:
        former = pods.get(seen.node)
        if seen.gone and former is not None and former.uid != seen.uid:
            continue
        if former is not None and former.uid == seen.uid and former.image != seen.image:
            restarts_needed[seen.uid] = former.restarts + 1
        pods[seen.node] = seen
        serves = seen.ready and seen.restarts >= restarts_needed.get(seen.uid, 0)
        if seen.gone or not serves:
            begun.setdefault(seen.node, seen.at)
        elif seen.node in begun:
            found.append(Absence(seen.node, begun.pop(seen.node), seen.at))
    found += [Absence(node, begin, float("inf")) for node, begin in begun.items()]
    yield from sorted(found, key=lambda absence: absence.begin)


@contextmanager
def watched(made: RosProxy) -> Iterator[Rollout]:
    """Watch the proxies of a RosProxy. All proxies have to be ready at the start."""
    rollout = Rollout(made)
    ended = threading.Event()
    thread = threading.Thread(target=rollout.collect, args=(ended,))
    thread.start()
    try:
        yield rollout
    finally:
        ended.set()
        thread.join()
