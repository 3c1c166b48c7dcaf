"""The doctor's findings from the last Warning Events of RosProxies and pods, newest first.

Conditions report the present problems. So if no condition repeats an Event of the operator, the
problem of the Event is over. Events of the kubelet and the scheduler about a pod of the operator
matter until the pod is ready.
"""

from collections.abc import Collection, Iterable, Iterator
from datetime import datetime

import msgspec

from rosproxy.shared.documents.doctor_finding import DoctorFinding, note, warning
from rosproxy.shared.output.text import brief, duration, quoted
from rosproxy_operator.kubernetes.resources.checks import int_at, submap, submaps, text_at
from rosproxy_operator.kubernetes.resources.model import Json, Name
from rosproxy_operator.kubernetes.resources.names import KIND
from rosproxy_operator.kubernetes.status.events import COMPONENT

MOST_EVENTS = 10
"""Events that the doctor reports at most."""
MOST_TEXT_CHARACTERS = 400
"""Characters of a reason or a message at most."""
_CHECK = "events"


class RecentEvent(msgspec.Struct, frozen=True):
    """A Warning Event.

    ``kind``, ``id`` and ``uid`` name the object of the Event. ``age`` is in seconds since the last
    time, ``count`` is the number of times. ``own``: an operator has created the Event.
    """

    kind: str
    id: Name
    uid: str
    reason: str
    message: str
    age: float
    count: int
    own: bool


def recent_events(
    events: Iterable[Json], rosproxies: Collection[Json], pods: Iterable[Json], now: float
) -> list[RecentEvent]:
    """The Events about these RosProxies, about ``pods`` of the operator, and about users' pods.

    The newest Event comes first. About users' pods, only the Events of the operator count, and only
    in a namespace with a RosProxy. In other namespaces the doctor reports the pods themselves. Of
    several Events with the same object and reason, the newest counts; Events of the operator are
    the same only with the same message. An Event of the operator is left out if a condition
    contains the message. ``now`` is in seconds of Unix time.
    """
    uids = {text_at(submap(obj, "metadata"), "uid") for obj in rosproxies}
    namespaces = {text_at(submap(obj, "metadata"), "namespace") for obj in rosproxies}
    pod_uids = {text_at(submap(obj, "metadata"), "uid") for obj in pods}
    messages = [*_messages(rosproxies)]
    newest: dict[tuple[str, str, str], RecentEvent] = {}
    for event in sorted((_read(e, now) for e in events), key=lambda e: e.age):
        ours = uids if event.kind == KIND else pod_uids
        is_users = event.kind == "Pod" and event.own and event.id.namespace in namespaces
        matters = event.uid in ours or is_users
        if matters and not (event.own and _is_in_condition(event, messages)):
            # The scheduler repeats a reason with other texts, such as other counts of nodes.
            message = event.message if event.own else ""
            newest.setdefault((event.uid, event.reason, message), event)
    return [*newest.values()]


def event_findings(
    events: Iterable[RecentEvent], ready: Collection[str]
) -> Iterator[DoctorFinding]:
    """Findings about the first `MOST_EVENTS` Events; ``ready`` are the uids of ready pods."""
    for event in [*events][:MOST_EVENTS]:
        subject = f"{event.kind.lower()} {event.id}"
        often = f", {event.count} times" if event.count > 1 else ""
        message = brief(event.message, MOST_TEXT_CHARACTERS)
        text = f"{event.reason} {duration(event.age)} ago{often}: {message}"
        if event.own:
            yield note(_CHECK, subject, f"{text} (no condition reports this now)")
        elif event.uid in ready:
            yield note(_CHECK, subject, f"{text} (the pod is ready now)")
        else:
            # The author of an Event may write any text as the name.
            namespace = quoted(event.id.namespace)
            fix = f"read kubectl -n {namespace} describe pod {quoted(event.id.name)}"
            yield warning(_CHECK, subject, text, fix)


def _messages(rosproxies: Iterable[Json]) -> Iterator[str]:
    for rosproxy in rosproxies:
        for condition in submaps(submap(rosproxy, "status"), "conditions"):
            yield text_at(condition, "message")


def _is_in_condition(event: RecentEvent, messages: Iterable[str]) -> bool:
    # An ellipsis stands for the end of what is wrong, before the fix.
    parts = event.message.split("…")
    return any(all(part in message for part in parts) for message in messages)


def _read(event: Json, now: float) -> RecentEvent:
    about = submap(event, "involvedObject")
    series = submap(event, "series")
    source = text_at(submap(event, "source"), "component")
    return RecentEvent(
        kind=text_at(about, "kind"),
        id=Name(text_at(about, "namespace"), text_at(about, "name")),
        uid=text_at(about, "uid"),
        reason=brief(text_at(event, "reason"), MOST_TEXT_CHARACTERS),
        message=text_at(event, "message"),
        age=max(now - _last_time(event, series), 0.0),
        count=int_at(series, "count") or int_at(event, "count") or 1,
        own=COMPONENT in (source, text_at(event, "reportingComponent")),
    )


def _last_time(event: Json, series: Json) -> float:
    """When an Event last happened, in seconds of Unix time; 0 if no field is readable.

    Clients of core/v1 write lastTimestamp, clients of events.k8s.io/v1 write eventTime and series.
    """
    times = (
        text_at(series, "lastObservedTime"),
        *(text_at(event, key) for key in ("lastTimestamp", "eventTime", "firstTimestamp")),
        text_at(submap(event, "metadata"), "creationTimestamp"),
    )
    for time in filter(None, times):
        try:
            return datetime.fromisoformat(time).timestamp()
        except (ValueError, OverflowError):
            continue
    return 0.0
