"""Making Kubernetes Events (core/v1), each of them once, however often the operator restarts."""

import hashlib
import time
from datetime import UTC, datetime
from typing import Any

from rosproxy_operator.kubernetes.api import Api, Found
from rosproxy_operator.kubernetes.errors import ApiError, ErrorKind
from rosproxy_operator.kubernetes.planner.actions import Emit
from rosproxy_operator.kubernetes.resources.model import Name

COMPONENT = "rosproxy-operator"
COUNT_EVERY = 60.0
"""Seconds in which the same Event is counted once at most."""
_MOST_MESSAGE = 1024
_MOST_NAME = 200
_NOWHERE = "default"
"""The namespace of Events about objects that have none (``GetReference`` in client-go)."""


def emit(api: Api, event: Emit) -> None:
    """Make an Event, or count it if it is there. Raises ApiError."""
    body = event_body(event, time.time())
    try:
        api.create("events", body)
    except ApiError as error:
        if error.kind is not ErrorKind.CONFLICT:
            raise
        _count(api, Name(body["metadata"]["namespace"], body["metadata"]["name"]), time.time())


def event_body(event: Emit, now: float) -> dict[str, Any]:
    """An Event. The same thing that happens to the same object gets the same name.

    ``now`` is in seconds of Unix time.
    """
    about = event.about
    namespace = str(about.get("namespace") or _NOWHERE)
    message = event.message[:_MOST_MESSAGE]
    what = "\n".join([str(about.get("uid") or ""), event.type, event.reason, message])
    digest = hashlib.sha256(what.encode()).hexdigest()[:16]
    name = f"{str(about.get('name') or '')[:_MOST_NAME].rstrip('.-')}.{digest}"
    return {
        "apiVersion": "v1",
        "kind": "Event",
        "metadata": {"name": name, "namespace": namespace},
        "involvedObject": dict(about),
        "type": event.type,
        "reason": event.reason,
        "message": message,
        "source": {"component": COMPONENT},
        "reportingComponent": COMPONENT,
        "reportingInstance": COMPONENT,
        "firstTimestamp": stamp(now),
        "lastTimestamp": stamp(now),
        "count": 1,
    }


def stamp(now: float) -> str:
    """A time in seconds of Unix time in RFC 3339, in whole seconds as Kubernetes has it."""
    return datetime.fromtimestamp(now, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def _count(api: Api, id: Name, now: float) -> None:
    there = api.get("events", id)
    if _seconds_since(there, now) < COUNT_EVERY:
        return
    count = there.get("count")
    api.patch(
        "events",
        id,
        [
            {"op": "add", "path": "/count", "value": count + 1 if isinstance(count, int) else 2},
            {"op": "add", "path": "/lastTimestamp", "value": stamp(now)},
        ],
    )


def _seconds_since(event: Found, now: float) -> float:
    try:
        last = datetime.fromisoformat(str(event.get("lastTimestamp")))
        return now - last.timestamp()
    except (ValueError, OverflowError):
        return COUNT_EVERY
