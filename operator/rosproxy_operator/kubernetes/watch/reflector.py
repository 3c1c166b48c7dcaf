"""Follows one kind of object, in a thread: lists it, then watches what happens to it.

A watch that ends, after a while or because the API server is started anew, goes on from where it
was; one that can't (410 Gone) begins with a new list. Now and then everything is listed anew in any
case, to see whether something was missed. Lists come in pages. Whatever goes wrong, it is tried
again, with pauses that grow and differ, so that not all watches come back at once.

kopf's indices keep whole objects, in a task for each; the Kubernetes client's SharedInformer keeps
them whole as well, lists them in one piece and can't be stopped while nothing happens. So these few
lines are the operator's own. `records` reads the objects, and `store`, which is called in the event
loop, keeps them.
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

PAUSES = (0.5, 1.0, 2.0, 5.0, 10.0)
"""Seconds until the API server is asked again, the last one repeated."""
WELL = 10.0
"""Seconds after which the loss of a watch counts as the first failure in a row."""
CHECKED = 1800.0
"""Seconds after which everything is listed anew though nothing seems to be missing."""
DOUBTED = 60.0
"""Least seconds between two lists that are made because the watched state was wrong."""
SHORT = 1.0
"""Least seconds that a watch without events must last: it would be started in a loop otherwise."""
STOPPING = 3.0
"""Seconds that a thread has to end."""


class Listener(Protocol):
    """Gets lists and changes, in the event loop. ``place`` is a namespace, empty for all."""

    def changed(self, kind: str, place: str, changes: Sequence[Change]) -> None:
        """These objects have changed, in this order; None: gone."""

    def listed(self, kind: str, place: str, records: Mapping[str, Record]) -> None:
        """These are all objects of the kind."""

    def failed(self, kind: str, place: str, error: ApiError) -> None:
        """The kind can't be listed or watched."""


class Reflector:
    """Follows a kind in a namespace. ``call_soon`` lets a function run in the event loop."""

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
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """Let it end. `join` waits for that."""
        self._ending.set()
        if self._watch is not None:
            self._watch.stop()

    def relist(self) -> None:
        """List everything anew soon: the watched state is wrong."""
        if time.monotonic() - self._listed_at > DOUBTED:
            self._listed_at = -CHECKED  # too long ago, however little the clock has counted
            if self._watch is not None:
                self._watch.stop()

    def join(self) -> None:
        """Wait until it has ended, but not long."""
        self._thread.join(STOPPING)

    def _run(self) -> None:
        failures = 0
        while not self._ending.is_set():
            began = time.monotonic()
            try:
                if not self._version or began - self._listed_at > CHECKED:
                    self._version = self._list()
                self._follow()
                failures = 0
            except ApiError as error:
                failures = 1 if time.monotonic() - began > WELL else failures + 1
                # A version that the API server does not know is one of before its store was lost.
                if isinstance(error, ApiExpired) or "resource version" in str(error).lower():
                    self._version = ""
                self._complain(error)
                if not isinstance(error, ApiLost) or failures > 1:
                    self._pause(failures)
            except Exception as error:  # a mistake of ours must not blind the operator
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
        longest = PAUSES[min(failures, len(PAUSES)) - 1]
        self._ending.wait(longest * random.uniform(0.5, 1.0))  # noqa: S311 - no secret

    def _list(self) -> str:
        """List all objects. Returns the list's version."""
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
        """Pass on events until the watch ends, and keep the version that it has got to.

        Also for a watch that is lost: else all its events would come again from the beginning, and
        set objects back to what they were then.
        """
        began = time.monotonic()
        heard = False
        self._watch = watch = self._api.watch(self._kind, self._place, self._version)
        self._tell(self._listener.changed, ())  # it works again, if it did not
        if self._ending.is_set():
            watch.stop()  # `stop` may have come before there was a watch to end
        for events in watch:
            if self._ending.is_set():
                break
            if changes := self._changes(events):
                self._tell(self._listener.changed, changes)
            self._version = _version(events) or self._version
            heard = True
        if not heard and time.monotonic() - began < SHORT:
            raise ApiLost("the watch ended at once")

    def _changes(self, events: Iterable[Event]) -> list[Change]:
        """The objects that have changed, by their keys. Raises ApiError for an ERROR event."""
        changes = list[Change]()
        for event in events:
            if event.type == "ERROR":
                raise _error(event.object)
            if event.type == "BOOKMARK":
                continue
            key = key_of(event.object)
            changes.append((key, self._read(event.object)))
            if event.type == "DELETED":  # the object is as it was at its end
                changes.append((key, None))
        return changes

    def _read(self, obj: Json) -> Record | None:
        return READERS[self._kind](obj)

    def _tell(self, function: Callable[..., None], payload: object) -> None:
        if not self._ending.is_set():
            self._call_soon(function, self._kind, self._place, payload)


def _version(events: Iterable[Event]) -> str:
    """The last resourceVersion among events, empty if there is none."""
    versions = (text_at(submap(event.object, "metadata"), "resourceVersion") for event in events)
    return ([version for version in versions if version] or [""])[-1]


def _error(status: Json) -> ApiError:
    """The error with which a watch has ended."""
    text = text_at(status, "message") or "the watch ended"
    return ApiExpired(text) if status.get("code") == 410 else ApiLost(text)


def watched_collections(api: Api) -> list[tuple[str, str]]:
    """The kinds to be followed, each with a namespace (empty for all); RosProxies first."""
    return [(kind, place) for kind in READERS for place in api.namespaces_of(kind)]
