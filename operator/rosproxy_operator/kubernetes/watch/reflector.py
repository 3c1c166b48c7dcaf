"""Follows objects of a kind in a thread: lists the objects, then watches changes.

When a watch ends, the reflector starts the next watch at the last version. If the API server no
longer has this version (410 Gone), the reflector lists all objects again. After `RELIST_INTERVAL_S`
seconds the reflector lists again in any case, to find missed changes. Lists come in pages. After an
error the reflector tries again. The pauses grow, and are random so that not all watches return at
once.

kopf's indices and the SharedInformer of the Kubernetes client keep whole objects, which takes too
much memory. kopf also needs a task for each object. The SharedInformer lists without pages, and
can't stop before the next event. `records` reduces each object, and `store` keeps the records.
"""

import logging
import random
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Protocol

from rosproxy_operator.kubernetes.api.api_client import (
    Api,
    ApiError,
    ApiExpired,
    ApiLost,
    ApiUnavailable,
    Event,
    Watch,
)
from rosproxy_operator.kubernetes.resources.checks import submap, text_at
from rosproxy_operator.kubernetes.resources.model import Json
from rosproxy_operator.kubernetes.resources.records import READERS, Change, Record, key_of

log = logging.getLogger(__name__)

RETRY_PAUSES_S = (0.5, 1.0, 2.0, 5.0, 10.0)
"""Longest pauses in seconds after the first error, the second, and so on; the last repeats.

Each pause is random, between half and all of this time. A first lost watch has no pause.
"""
STABLE_AFTER_S = 10.0
"""A watch that lasted longer, in seconds, resets the failure count."""
RELIST_INTERVAL_S = 1800.0
"""Seconds from a list to the next list. The next list starts once the present watch has ended."""
LEAST_RELIST_INTERVAL_S = 60.0
"""Least seconds from a list to a further list because the watched state was wrong (`relist`)."""
LEAST_WATCH_S = 1.0
"""A shorter watch without events, in seconds, is an error: else the reflector would loop fast."""
STOP_TIMEOUT_S = 3.0
"""Seconds that the thread of a reflector has to end."""


class Listener(Protocol):
    """Gets lists and changes in the event loop. ``place`` is a namespace, empty for all."""

    def changed(self, kind: str, place: str, changes: Sequence[Change]) -> None:
        """Take changes of objects, in this order. None: the object is gone, or has no record.

        A call without changes means that the watch works.
        """

    def listed(self, kind: str, place: str, records: Mapping[str, Record]) -> None:
        """Take all objects of the kind."""

    def failed(self, kind: str, place: str, error: ApiError) -> None:
        """Take the error: the API server did not list or watch the kind."""


class Reflector:
    """Follows the objects of ``collection``: a kind, and a namespace (empty for all).

    ``call_soon`` runs a function in the event loop. The thread of the reflector calls ``lost`` at
    each error.
    """

    def __init__(
        self,
        api: Api,
        collection: tuple[str, str],
        listener: Listener,
        call_soon: Callable[..., object],
        lost: Callable[[], None],
    ) -> None:
        self._api = api
        self._listener = listener
        self._call_soon = call_soon
        self._lost = lost
        self._kind, self._place = collection
        self._ending = threading.Event()
        self._watch: Watch | None = None
        self._listed_at = 0.0
        self._version = ""
        self._thread = threading.Thread(target=self._run, daemon=True, name=f"watch {self._kind}")

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Stop the watch and the thread. `join` waits for the end."""
        self._ending.set()
        if self._watch is not None:
            self._watch.stop()

    def relist(self) -> None:
        """List all objects again soon, because the watched state is wrong.

        Within `LEAST_RELIST_INTERVAL_S` seconds after a list, the call does nothing.
        """
        if time.monotonic() - self._listed_at > LEAST_RELIST_INTERVAL_S:
            self._listed_at = -RELIST_INTERVAL_S  # old enough even if the monotonic clock is near 0
            if self._watch is not None:
                self._watch.stop()

    def join(self) -> None:
        """Wait until the thread has ended, for `STOP_TIMEOUT_S` seconds at most."""
        self._thread.join(STOP_TIMEOUT_S)

    def _run(self) -> None:
        failures = 0
        while not self._ending.is_set():
            began = time.monotonic()
            try:
                if not self._version or began - self._listed_at > RELIST_INTERVAL_S:
                    self._version = self._list()
                self._follow()
                failures = 0
            except ApiError as error:
                failures = 1 if time.monotonic() - began > STABLE_AFTER_S else failures + 1
                # After a loss of etcd the API server refuses a former version as too large.
                if isinstance(error, ApiExpired) or "resource version" in str(error).lower():
                    self._version = ""
                self._complain(error)
                if not isinstance(error, ApiLost) or failures > 1:
                    self._pause(failures)
            except Exception as error:  # a bug of ours must not end the watch
                text = "watch failed by an internal error, the operator tries again: %s"
                log.exception(text, self._kind)
                self._version = ""
                failures = failures + 1
                self._complain(ApiUnavailable(f"the watch of {self._kind} failed: {error!r}"))
                self._pause(failures)

    def _complain(self, error: ApiError) -> None:
        log.debug("watch ended: %s %s: %s", self._kind, self._place, error)
        self._lost()
        if not isinstance(error, ApiExpired | ApiLost):
            self._tell(self._listener.failed, error)

    def _pause(self, failures: int) -> None:
        longest = RETRY_PAUSES_S[min(failures, len(RETRY_PAUSES_S)) - 1]
        self._ending.wait(longest * random.uniform(0.5, 1.0))  # noqa: S311 - no secret

    def _list(self) -> str:
        """List all objects. Returns the version of the list, at which the watch starts."""
        records: dict[str, Record] = {}
        token = ""
        while True:
            page = self._api.page(self._kind, self._place, token)
            for obj in page.items:
                record = self._read(obj)
                if record is not None:
                    records[key_of(obj)] = record
            token = page.continue_token
            if not token or self._ending.is_set():
                break
        self._listed_at = time.monotonic()
        self._tell(self._listener.listed, records)
        return page.version

    def _follow(self) -> None:
        """Pass on events until the watch ends. Raises ApiError.

        Note the version after each group of events, so that the next watch goes on there. A watch
        from an older version would repeat events, and set objects back to former states.
        """
        began = time.monotonic()
        heard = False
        self._watch = watch = self._api.watch(self._kind, self._place, self._version)
        self._tell(self._listener.changed, ())  # the watch works
        if self._ending.is_set():
            watch.stop()  # an earlier `stop` had no watch to stop
        for events in watch:
            if self._ending.is_set():
                break
            if changes := self._changes(events):
                self._tell(self._listener.changed, changes)
            self._version = _version(events) or self._version
            heard = True
        if not heard and time.monotonic() - began < LEAST_WATCH_S:
            raise ApiLost("the watch ended at once")

    def _changes(self, events: Iterable[Event]) -> list[Change]:
        """The changes in events. Raises ApiError for an ERROR event."""
        changes = list[Change]()
        for event in events:
            if event.type == "ERROR":
                raise _error(event.object)
            if event.type == "BOOKMARK":
                continue
            key = key_of(event.object)
            changes.append((key, self._read(event.object)))
            if event.type == "DELETED":  # the event has the last state: pass on the state first
                changes.append((key, None))
        return changes

    def _read(self, obj: Json) -> Record | None:
        return READERS[self._kind](obj)

    def _tell(self, function: Callable[..., None], payload: object) -> None:
        if not self._ending.is_set():
            self._call_soon(function, self._kind, self._place, payload)


def _version(events: Iterable[Event]) -> str:
    """The last resourceVersion in events; empty without events."""
    versions = (text_at(submap(event.object, "metadata"), "resourceVersion") for event in events)
    return ([version for version in versions if version] or [""])[-1]


def _error(status: Json) -> ApiError:
    """The error in an ERROR event (``metav1.Status``)."""
    text = text_at(status, "message") or "the watch ended"
    return ApiExpired(text) if status.get("code") == 410 else ApiLost(text)


def watched_collections(api: Api) -> list[tuple[str, str]]:
    """The kinds to watch, each with a namespace (empty for all); RosProxies come first."""
    return [(kind, place) for kind in READERS for place in api.namespaces_of(kind)]
