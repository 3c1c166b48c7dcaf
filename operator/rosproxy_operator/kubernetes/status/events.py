"""Which Kubernetes Events (core/v1) are made: each of them once, however often it is planned."""

import hashlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from datetime import UTC, datetime

import msgspec

from rosproxy_operator.kubernetes.planner.actions import (
    Action,
    CreateHelper,
    CreateProxy,
    DeleteHelper,
    DeleteProxy,
    Emit,
    EvictPod,
    SetImage,
)
from rosproxy_operator.kubernetes.resources.checks import int_at, text_at
from rosproxy_operator.kubernetes.resources.model import ClusterFinding, Json, Reference, RosProxy
from rosproxy_operator.kubernetes.resources.names import (
    API_VERSION,
    IMAGE_CHECK,
    KIND,
    LAN_RELAY,
    NODE,
    PORT_RANGE,
)

QUIET = 60.0
"""Seconds that a problem must have been away before it is told again."""
MOST = 50
"""Warnings that are made at once; the others have their turn at the next look."""
MOST_TEXTS = 10
"""Texts of one reason about one thing that came and went in `QUIET` seconds; others have to wait.

A proxy in hostile hands chooses what its errors say, and so does a master.
"""
MOST_RESULTS = 20
"""Events of one kind about what is done to a RosProxy's proxies at once; one more sums up."""
LONGEST = 1024
"""Bytes of an Event's message."""
COUNT_EVERY = 60.0
"""Seconds in which the same Event is counted once at most."""
COMPONENT = "rosproxy-operator"
"""Who makes the Events, as they name it."""
_LONGEST_NAME = 200
_ENDED: Mapping[type, tuple[str, str]] = {
    DeleteProxy: ("ProxyDeleted", "deleted"),
    EvictPod: ("PodEvicted", "evicted"),
}
"""Reason and verb of the Events about what goes."""
_HELPERS = {LAN_RELAY: "LanRelay", IMAGE_CHECK: "ImageCheck"}
"""What the reasons of Events about pods beside a proxy begin with."""


class NewEvents(msgspec.Struct, frozen=True):
    """Events to make, and when which problem was seen last, on a monotonic clock in seconds."""

    emits: tuple[Emit, ...] = ()
    reported: Mapping[ClusterFinding, float] = {}


def warnings(
    problems: Iterable[ClusterFinding], reported: Mapping[ClusterFinding, float], now: float
) -> NewEvents:
    """Warning Events for problems that were not there before.

    One that comes and goes all the time is told once, and one whose text changes all the time
    MOST_TEXTS times in QUIET seconds. After a restart of the operator all are
    told again: who makes the Events counts those that are there already.

    Only findings that are about an object become Events. ``reported`` is that of the last look, or
    nothing; ``now`` is on its clock, in seconds.
    """
    findings = dict.fromkeys(f for f in problems if f.about)
    recent = {f: then for f, then in reported.items() if now - then < QUIET}
    gone = Counter(_kind(f) for f in recent if f not in findings)
    new = [f for f in findings if f not in reported]
    changing = {f for f in new if gone[_kind(f)] >= MOST_TEXTS}
    told = [f for f in new if f not in changing][:MOST]
    late = {*new}.difference(told)
    current = {f: now for f in findings if f not in late}
    return NewEvents(tuple(map(_warning, told)), {**recent, **current})


def _kind(finding: ClusterFinding) -> tuple[object, ...]:
    """What findings have in common that tell of the same thing in other words."""
    return finding.of, finding.about, finding.subject, finding.reason


def results(rosproxy: RosProxy, actions: Iterable[Action]) -> Iterator[Emit]:
    """Normal Events for what is done to a RosProxy's proxies, to be made once it was done."""
    reference = Reference(KIND, rosproxy.id, rosproxy.uid)
    texts: dict[str, list[str]] = {}
    for reason, text in map(_result, actions):
        texts.setdefault(reason, []).append(text)
    texts.pop("", None)
    for reason, lines in texts.items():
        for text in lines[:MOST_RESULTS]:
            yield Emit(rosproxy.id, reference, "Normal", reason, _bounded(text))
        if len(lines) > MOST_RESULTS:
            text = f"and {len(lines) - MOST_RESULTS} more at the same time. Read the operator's log"
            yield Emit(rosproxy.id, reference, "Normal", reason, text)


def _result(action: Action) -> tuple[str, str]:
    """The reason and the text of an Event about an action; empty if there is to be none."""
    match action:
        case CreateProxy(body={"metadata": {"name": name, "annotations": notes}}):
            place = f"on node {notes[NODE]} with ports {notes[PORT_RANGE]}"
            return "ProxyCreated", f"created pod {name} {place}"
        case SetImage(id=id, image=image):
            return "ImageSet", f"set the image of pod {id.name} to {image}"
        case DeleteProxy(id=id, why=why) | EvictPod(id=id, why=why):
            reason, verb = _ENDED[type(action)]
            return reason, f"{verb} pod {id.name}: {why}"
        case CreateHelper(component=component, body=body):
            meta = body["metadata"]
            text = f"created pod {meta['name']} on node {meta['annotations'][NODE]}"
            return f"{_HELPERS[component]}Created", text
        case DeleteHelper(component=component, id=id, why=why):
            return f"{_HELPERS[component]}Deleted", f"deleted pod {id.name}: {why}"
        case _:
            return "", ""


def event_body(event: Emit, now: float) -> Json:
    """An Event. The same thing that happens to the same object gets the same name.

    ``now`` is in seconds of Unix time.
    """
    about = event.about
    identity = "\n".join([about.uid, event.type, event.reason, event.message])
    digest = hashlib.sha256(identity.encode()).hexdigest()[:16]
    # Before the dot a name must not end in a dot or a hyphen (RFC 1123, as Kubernetes wants names).
    name = f"{about.id.name[:_LONGEST_NAME].rstrip('.-')}.{digest}"
    return {
        "apiVersion": "v1",
        "kind": "Event",
        "metadata": {"name": name, "namespace": about.id.namespace},
        "involvedObject": {
            "apiVersion": API_VERSION if about.kind == KIND else "v1",
            "kind": about.kind,
            "namespace": about.id.namespace,
            "name": about.id.name,
            "uid": about.uid,
        },
        "type": event.type,
        "reason": event.reason,
        "message": event.message,
        "source": {"component": COMPONENT},
        "reportingComponent": COMPONENT,
        "reportingInstance": COMPONENT,
        "firstTimestamp": stamp(now),
        "lastTimestamp": stamp(now),
        "count": 1,
    }


def count_patch(event: Json, now: float) -> list[Json]:
    """The JSON patch that counts an Event once more; empty if it was counted a moment ago."""
    try:
        last = datetime.fromisoformat(text_at(event, "lastTimestamp")).timestamp()
    except (ValueError, OverflowError):
        last = now - COUNT_EVERY
    if now - last < COUNT_EVERY:
        return []
    return [
        {"op": "add", "path": "/count", "value": (int_at(event, "count") or 1) + 1},
        {"op": "add", "path": "/lastTimestamp", "value": stamp(now)},
    ]


def stamp(now: float) -> str:
    """A time in seconds of Unix time in RFC 3339, in whole seconds as Kubernetes has it."""
    return datetime.fromtimestamp(now, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def _warning(finding: ClusterFinding) -> Emit:
    """A problem of the object itself needs no name there."""
    reference = finding.about
    assert reference is not None  # noqa: S101 - `warnings` takes no others
    itself = finding.subject == f"{reference.kind.lower()} {reference.id}"
    text = finding.text if itself else f"{finding.subject}: {finding.text}"
    return Emit(finding.of, reference, "Warning", finding.reason, _bounded(text))


def _bounded(text: str) -> str:
    if len(text.encode()) <= LONGEST:
        return text
    # The ellipsis has three bytes; a character that is cut through is left out.
    return text.encode()[: LONGEST - 3].decode(errors="ignore") + "…"
