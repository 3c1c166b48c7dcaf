"""Which Kubernetes Events are made."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field

from rosproxy_operator.common.problem import Problem
from rosproxy_operator.kubernetes.planner.actions import (
    Action,
    CreateProxy,
    DeleteProxy,
    Emit,
    SetImage,
)
from rosproxy_operator.kubernetes.planner.model import Finding, Json, Reference, RosProxy
from rosproxy_operator.kubernetes.planner.names import API_VERSION, KIND, PORT_RANGE
from rosproxy_operator.kubernetes.planner.values import part, word

QUIET = 60.0
"""Seconds that a problem must have been away before it is told again."""
MOST = 50
"""Warnings that are made at once; the others have their turn at the next look."""
LONGEST = 1024
"""Bytes of an Event's message."""


@dataclass(frozen=True, slots=True)
class Told:
    """Events to make, and when which problem was seen last, on a monotonic clock in seconds."""

    emits: tuple[Emit, ...] = ()
    seen: Mapping[Finding, float] = field(default_factory=dict)


def news(problems: Iterable[Problem], seen: Mapping[Finding, float], now: float) -> Told:
    """Warning Events for problems that were not there before.

    One that comes and goes all the time is told once. After a restart of the controller all are
    told again: who makes the Events counts those that are there already.

    Args:
        problems: Those of all objects; only Findings that are about an object become Events.
        seen: That of the last look, or nothing.
        now: The time, on the clock of ``seen``, in seconds.
    """
    found = dict.fromkeys(one for one in problems if isinstance(one, Finding) and one.about)
    new = [one for one in found if one not in seen]
    late = set(new[MOST:])
    recent = {one: then for one, then in seen.items() if now - then < QUIET}
    current = {one: now for one in found if one not in late}
    return Told(tuple(_warning(one) for one in new[:MOST]), {**recent, **current})


def done(rosproxy: RosProxy, actions: Iterable[Action]) -> tuple[Emit, ...]:
    """Normal Events for what is done to a RosProxy's proxies, to be made once it was done."""
    of = about(Reference(KIND, rosproxy.id, rosproxy.uid))
    return tuple(
        Emit(rosproxy.id, of, "Normal", reason, _bounded(text))
        for action in actions
        if action.of == rosproxy.id
        for reason, text in _news_of(action)
    )


def about(reference: Reference) -> Json:
    """An Event's ``involvedObject``."""
    return {
        "apiVersion": API_VERSION if reference.kind == KIND else "v1",
        "kind": reference.kind,
        "namespace": reference.id.namespace,
        "name": reference.id.name,
        "uid": reference.uid,
    }


def _warning(finding: Finding) -> Emit:
    """A problem of the object itself needs no name there."""
    reference = finding.about
    assert reference is not None  # noqa: S101 - `news` takes no others
    itself = finding.subject == f"{reference.kind.lower()} {reference.id}"
    text = finding.text if itself else f"{finding.subject}: {finding.text}"
    return Emit(finding.of, about(reference), "Warning", finding.reason, _bounded(text))


def _news_of(action: Action) -> Iterator[tuple[str, str]]:
    match action:
        case CreateProxy(node=node, body=body):
            meta = part(body, "metadata")
            ports = word(part(meta, "annotations"), PORT_RANGE)
            text = f"created pod {word(meta, 'name')} on node {node} with ports {ports}"
            yield "ProxyCreated", text
        case SetImage(id=id, image=image):
            yield "ImageSet", f"gave pod {id.name} the image {image}"
        case DeleteProxy(id=id, why=why):
            yield "ProxyDeleted", f"deleted pod {id.name}: {why}"


def _bounded(text: str) -> str:
    if len(text.encode()) <= LONGEST:
        return text
    return text.encode()[: LONGEST - 3].decode(errors="ignore") + "…"
