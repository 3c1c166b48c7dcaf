"""The last Warning Events of RosProxies and their pods, for the doctor: the newest first.

The conditions hold the present problems; an Event of the operator that no condition repeats is
over. Events of the kubelet and the scheduler about a proxy's pod matter until that pod is ready.
"""

from collections.abc import Collection, Iterable, Iterator
from datetime import datetime

import msgspec

from rosproxy.admin.doctor_finding import DoctorFinding, note, warning
from rosproxy.telemetry.text import brief, duration, quoted
from rosproxy_operator.kubernetes.resources.checks import int_at, submap, submaps, text_at
from rosproxy_operator.kubernetes.resources.model import Json, Name
from rosproxy_operator.kubernetes.resources.names import KIND
from rosproxy_operator.kubernetes.status.events import COMPONENT

MOST = 10
"""Events that are told."""
LONGEST = 400
"""Characters of a message."""
_CHECK = "events"


class RecentEvent(msgspec.Struct, frozen=True):
    """A Warning Event: about what, how many seconds ago, and how often.

    ``own``: the operator has made it; else it is about a pod of the operator's.
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
    """The Events about these RosProxies, the operator's pods, and users' pods, the newest first.

    Of users' pods those of the operator alone, and only beside a RosProxy: where there is none, the
    doctor reports the pods that are there now. Of several that are alike it is the last one;
    without those that a condition tells. ``now`` is in seconds of Unix time.
    """
    uids = {text_at(submap(obj, "metadata"), "uid") for obj in rosproxies}
    namespaces = {text_at(submap(obj, "metadata"), "namespace") for obj in rosproxies}
    pod_uids = {text_at(submap(obj, "metadata"), "uid") for obj in pods}
    told = [*_messages(rosproxies)]
    newest: dict[tuple[str, str, str], RecentEvent] = {}
    for event in sorted((_read(e, now) for e in events), key=lambda e: e.age):
        ours = uids if event.kind == KIND else pod_uids
        is_users = event.kind == "Pod" and event.own and event.id.namespace in namespaces
        matters = event.uid in ours or is_users
        if matters and not (event.own and _is_told(event, told)):
            message = event.message if event.own else ""
            newest.setdefault((event.uid, event.reason, message), event)
    return [*newest.values()]


def event_findings(
    events: Iterable[RecentEvent], ready: Collection[str]
) -> Iterator[DoctorFinding]:
    """Findings about the first few; ``ready`` are the uids of pods that are."""
    for event in [*events][:MOST]:
        subject = f"{event.kind.lower()} {event.id}"
        often = f", {event.count} times" if event.count > 1 else ""
        text = f"{event.reason} {duration(event.age)} ago{often}: {brief(event.message, LONGEST)}"
        if event.own:
            yield note(_CHECK, subject, f"{text} (no condition reports this now)")
        elif event.uid in ready:
            yield note(_CHECK, subject, f"{text} (the pod is ready now)")
        else:
            # The name in an Event is any text that the author of the Event has chosen.
            namespace = quoted(event.id.namespace)
            fix = f"read kubectl -n {namespace} describe pod {quoted(event.id.name)}"
            yield warning(_CHECK, subject, text, fix)


def _messages(rosproxies: Iterable[Json]) -> Iterator[str]:
    for rosproxy in rosproxies:
        for condition in submaps(submap(rosproxy, "status"), "conditions"):
            yield text_at(condition, "message")


def _is_told(event: RecentEvent, messages: Iterable[str]) -> bool:
    text = event.message.removesuffix("…")
    return any(text in message for message in messages)


def _read(event: Json, now: float) -> RecentEvent:
    about = submap(event, "involvedObject")
    series = submap(event, "series")
    source = text_at(submap(event, "source"), "component")
    return RecentEvent(
        kind=text_at(about, "kind"),
        id=Name(text_at(about, "namespace"), text_at(about, "name")),
        uid=text_at(about, "uid"),
        reason=brief(text_at(event, "reason"), LONGEST),
        message=text_at(event, "message"),
        age=max(now - _time(event, series), 0.0),
        count=int_at(series, "count") or int_at(event, "count") or 1,
        own=COMPONENT in (source, text_at(event, "reportingComponent")),
    )


def _time(event: Json, series: Json) -> float:
    """When it was seen last, in seconds of Unix time: the fields differ by who has made it."""
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
