"""The Kubernetes Events (core/v1) of the operator.

Warning Events report problems, once for a problem and not in each plan. Normal Events report
actions.
"""

import hashlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from datetime import UTC, datetime

import msgspec

from rosproxy_operator.common.problem import Fault
from rosproxy_operator.kubernetes.planner.actions import (
    Action,
    CreateHelper,
    CreateProxy,
    CreateService,
    DeleteHelper,
    DeleteProxy,
    DeleteService,
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
    outside_service_id,
)

EVENT_REPEAT_QUIET_S = 60.0
"""Seconds without a problem after which the same problem gets an Event again."""
MOST_WARNINGS = 50
"""Warning Events of a plan at most; the next plan has the rest."""
MOST_TEXTS = 10
"""Texts at most that come and go in `EVENT_REPEAT_QUIET_S` seconds, for a reason and an object.

Further texts wait. A hostile proxy or master chooses the texts of its errors, and could cause any
number of Events.
"""
MOST_RESULTS = 20
"""Normal Events of a reason at most, for the actions of a plan for a RosProxy.

One more Event counts the rest.
"""
MOST_MESSAGE_BYTES = 1024
"""Bytes of the message of an Event at most."""
COUNT_INTERVAL_S = 60.0
"""Least seconds between two counts of the same Event."""
COMPONENT = "rosproxy-operator"
"""The source that the Events name."""
_MOST_NAME_CHARACTERS = 200
_ENDED: Mapping[type, tuple[str, str]] = {
    DeleteProxy: ("ProxyDeleted", "deleted"),
    EvictPod: ("PodEvicted", "evicted"),
}
"""Reason and verb of the Event about a removed pod, by the action."""
_HELPERS = {LAN_RELAY: "LanRelay", IMAGE_CHECK: "ImageCheck"}
"""The first part of the reasons of Events about pods beside a proxy."""


class NewEvents(msgspec.Struct, frozen=True):
    """The Events to create, and when the operator last saw each problem.

    The times in ``reported`` are in seconds of a monotonic clock.
    """

    emits: tuple[Emit, ...] = ()
    reported: Mapping[ClusterFinding, float] = {}


def warnings(
    problems: Iterable[ClusterFinding], reported: Mapping[ClusterFinding, float], now: float
) -> NewEvents:
    """Return Warning Events for new problems that name an object in ``about``.

    A problem that comes and goes gets a second Event only after `EVENT_REPEAT_QUIET_S` seconds
    without the problem. If the text of a problem keeps changing, further texts wait (`MOST_TEXTS`).

    After a restart of the operator all problems are new. The API server then has the Events, and
    `count_patch` counts each Event once more. ``reported`` is from the plan before, and empty at
    first; ``now`` is in seconds of the same clock.
    """
    findings = dict.fromkeys(f for f in problems if f.about)
    recent = {f: then for f, then in reported.items() if now - then < EVENT_REPEAT_QUIET_S}
    gone = Counter(_cause_key(f) for f in recent if f not in findings)
    new = [f for f in findings if f not in reported]
    changing = {f for f in new if gone[_cause_key(f)] >= MOST_TEXTS}
    announced = [f for f in new if f not in changing][:MOST_WARNINGS]
    deferred = {*new}.difference(announced)
    current = {f: now for f in findings if f not in deferred}
    return NewEvents(tuple(map(_warning, announced)), {**recent, **current})


def _cause_key(finding: ClusterFinding) -> tuple[object, ...]:
    """The key that findings with the same cause and different texts share."""
    return finding.of, finding.about, finding.subject, finding.reason


def results(rosproxy: RosProxy, actions: Iterable[Action]) -> Iterator[Emit]:
    """Normal Events for actions of a RosProxy, to create after the actions have succeeded."""
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
    """The reason and the text of the Event about an action; empty for an action without Event."""
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
            return _service_result(action)


def _service_result(action: Action) -> tuple[str, str]:
    """The same for an action about a Service: an Event about the Service for outside."""
    match action:
        case CreateService(body={"metadata": meta, "spec": {"type": kind}}) if kind != "ClusterIP":
            text = f"created Service {meta['name']} of type {kind} for outside"
            return "ServiceCreated", f"{text}. The condition Listening has the address"
        case DeleteService(of=of, id=id, why=why) if id == outside_service_id(of):
            return "ServiceDeleted", f"deleted Service {id.name}: {why}"
        case _:
            return "", ""


def event_body(event: Emit, now: float) -> Json:
    """The Event as JSON. Equal Events about an object have the same name.

    So the API server refuses the second Event, and the operator counts the first Event once more.
    ``now`` is in seconds of Unix time.
    """
    about = event.about
    identity = "\n".join([about.uid, event.type, event.reason, event.message])
    digest = hashlib.sha256(identity.encode()).hexdigest()[:16]
    # The part before the dot must not end in a dot or a hyphen (RFC 1123 subdomain).
    name = f"{about.id.name[:_MOST_NAME_CHARACTERS].rstrip('.-')}.{digest}"
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
    """The JSON patch that counts an Event once more.

    Empty if the last count is less than `COUNT_INTERVAL_S` seconds old. ``now`` is in seconds of
    Unix time.
    """
    try:
        last = datetime.fromisoformat(text_at(event, "lastTimestamp")).timestamp()
    except (ValueError, OverflowError):
        last = now - COUNT_INTERVAL_S
    if now - last < COUNT_INTERVAL_S:
        return []
    return [
        {"op": "add", "path": "/count", "value": (int_at(event, "count") or 1) + 1},
        {"op": "add", "path": "/lastTimestamp", "value": stamp(now)},
    ]


def stamp(now: float) -> str:
    """Format a Unix time by RFC 3339, in whole seconds as Kubernetes does."""
    return datetime.fromtimestamp(now, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def _warning(finding: ClusterFinding) -> Emit:
    """The Event of a finding. The text names the subject unless the Event is about the subject."""
    reference = finding.about
    assert reference is not None  # noqa: S101 - `warnings` skips findings without `about`
    itself = finding.subject == f"{reference.kind.lower()} {reference.id}"
    text = finding.text if itself else f"{finding.subject}: {finding.text}"
    message = str(Fault(text, finding.fix).shortened(MOST_MESSAGE_BYTES, _bounded))
    return Emit(finding.of, reference, "Warning", finding.reason, message)


def _bounded(text: str, most: int = MOST_MESSAGE_BYTES) -> str:
    """Return the text, cut to ``most`` bytes at most. A cut text ends in an ellipsis."""
    if len(text.encode()) <= most:
        return text
    # The ellipsis has three bytes. `ignore` drops a character that the bound cuts.
    return text.encode()[: most - 3].decode(errors="ignore") + "…"
