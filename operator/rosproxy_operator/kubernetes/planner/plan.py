"""From what is seen in a cluster to what is to be done there."""

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace

from rosproxy_operator.common.moves import RETRY_FOR
from rosproxy_operator.common.problem import Problem
from rosproxy_operator.kubernetes.planner import departures, events, transitions
from rosproxy_operator.kubernetes.planner import status as statuses
from rosproxy_operator.kubernetes.planner.actions import Action, PatchStatus
from rosproxy_operator.kubernetes.planner.allocation import allocate, refused
from rosproxy_operator.kubernetes.planner.injection import unwired
from rosproxy_operator.kubernetes.planner.model import (
    Finding,
    InvalidRosProxy,
    Json,
    NodeState,
    Observed,
    RosProxy,
)
from rosproxy_operator.kubernetes.planner.reconcile import (
    Case,
    advertise_host,
    ends,
    obstacle,
    orphan_steps,
    proxy_steps,
    service_of,
    service_steps,
    states_by,
    upstream,
)
from rosproxy_operator.kubernetes.planner.retries import Retries, Task
from rosproxy_operator.kubernetes.planner.settings import ClusterSettings
from rosproxy_operator.kubernetes.planner.state import Memory, Place
from rosproxy_operator.kubernetes.planner.view import finding, view


@dataclass(frozen=True, slots=True)
class Plan:
    """What to do, in this order, and what to remember.

    One action that fails keeps none of the others from being done. ``gone`` are, by the uid of a
    proxy's pod, the addresses of pods that are no more: the proxy is to be told. ``again_in`` is
    in how many seconds to look again even if nothing happens; None: no need.
    """

    actions: tuple[Action, ...] = ()
    problems: tuple[Problem, ...] = ()
    memory: Memory = field(default_factory=Memory)
    gone: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    again_in: float | None = None


def plan(
    observed: Observed, settings: ClusterSettings, memory: Memory, now: float, stamp: str
) -> Plan:
    """The next actions, from everything that is seen; none if all is as it ought to be.

    ``memory`` is that of the plan before, or an empty one. ``now`` is in seconds of a monotonic
    clock that goes on as long as the memory does; ``stamp`` is the time of day in RFC 3339.
    """
    seen = view(observed)
    memory = refused(seen, transitions.looked(seen, memory, now), now)
    ranges = allocate(seen, settings, memory)
    memory = transitions.given(memory, ranges.given, now)
    case = Case(seen, settings, memory, ranges, Retries(memory.tries, observed.failures, now), now)
    actions = list(orphan_steps(case))
    problems: list[Problem] = [*seen.findings]
    nodes = states_by(case)
    moves = tuple(transitions.moves(seen, memory, ranges.given))
    for of, rosproxy in sorted(seen.rosproxies.items()):
        own = _steps(case, rosproxy, nodes[of])
        told = _told(case, rosproxy, nodes[of], moves)
        problems += told.problems
        patch = _patch(case, rosproxy, told.status(stamp))
        actions += [*own, *patch, *events.done(rosproxy, own)]
    for bad in observed.unusable.values():
        problems.append(statuses.invalid_finding(bad))
        actions += _patch(case, bad, statuses.status_of_invalid(bad, stamp))
    return _plan(case, actions, tuple(dict.fromkeys(problems)))


def _plan(case: Case, actions: list[Action], problems: tuple[Problem, ...]) -> Plan:
    told = events.news(problems, case.memory.seen, case.now)
    found = departures.gone(case.observed, case.memory, case.now)
    memory = replace(found.memory, tries=case.tries.noted, seen=told.seen)
    return Plan(
        actions=(*actions, *told.emits),
        problems=problems,
        memory=memory,
        gone=found.gone,
        again_in=min((*_waits(case, memory), *departures.waits(found, case.now)), default=None),
    )


def _waits(case: Case, memory: Memory) -> Iterator[float]:
    """In how many seconds there is something to be done or decided."""
    yield from ends(case)
    yield from case.tries.waits()
    refused_for = (at + RETRY_FOR - case.now for at in memory.refused.values())
    yield from (left for left in refused_for if left > 0)


def _steps(case: Case, rosproxy: RosProxy, nodes: Iterable[str]) -> list[Action]:
    actions = list(service_steps(case, rosproxy))
    for place in sorted(case.view.places()):
        if place.of == rosproxy.id:
            actions += proxy_steps(case, place)
    return actions


@dataclass(frozen=True, slots=True)
class _Told:
    """What is told of a RosProxy."""

    case: Case
    rosproxy: RosProxy
    states: tuple[NodeState, ...]
    problems: tuple[Problem, ...]

    def status(self, stamp: str) -> Json:
        """Its status."""
        observed = self.case.observed
        master, _ = upstream(self.rosproxy, observed)
        there = service_of(observed, self.rosproxy.id)
        mine = there if there and there.owner == self.rosproxy.uid else None
        uri = master.uri if master else ""
        return statuses.status_of(self.rosproxy, self.states, self.problems, mine, uri, stamp)


def _told(case: Case, rosproxy: RosProxy, nodes: Iterable[str], moves: Iterable[Finding]) -> _Told:
    states = tuple(_state(case, Place(rosproxy.id, node)) for node in nodes)
    failures = case.tries.failures(rosproxy.id)
    flaws = (
        finding(rosproxy, reason, text)
        for place, some in sorted(case.ranges.flaws.items())
        if place.of == rosproxy.id
        for reason, text in some
    )
    problems = (
        *statuses.findings(rosproxy, states, failures),
        *(one for one in (*case.view.findings, *moves) if one.of == rosproxy.id),
        *flaws,
        *_unwired(case, rosproxy),
    )
    return _Told(case, rosproxy, states, problems)


def _state(case: Case, place: Place) -> NodeState:
    of, node = case.view.rosproxies[place.of], case.observed.nodes[place.node]
    current, wanted = case.view.current(place), place in case.view.wanted
    reason, problem = obstacle(case, place) if wanted else ("", "")
    former = case.memory.given.get(place) or of.former.get(place.node)
    kept = current.range if current else former
    host, _ = advertise_host(of, node)
    return NodeState(
        name=place.node,
        advertise_host=host,
        range=case.ranges.given.get(place) if wanted else kept,
        proxy=current,
        pods=case.view.wanted.get(place, ()),
        answer=case.observed.answers.get(current.pod.uid) if current else None,
        problem=problem,
        reason=reason,
    )


def _unwired(case: Case, rosproxy: RosProxy) -> Iterator[Finding]:
    there = service_of(case.observed, rosproxy.id)
    if there is not None and there.owner == rosproxy.uid and there.cluster_ip:
        for pod in case.view.taken.get(rosproxy.id, ()):
            found = unwired(pod, rosproxy, there.cluster_ip)
            if found is not None:
                yield found


def _patch(case: Case, of: RosProxy | InvalidRosProxy, status: Json) -> Iterator[Action]:
    """Write a status if it is another one; not over and over again if that does not help."""
    if status != of.status:
        task = Task(of.id, "status", str(of.id), _digest(status))
        if case.tries.ask(task):
            yield PatchStatus(of.id, status)


def _digest(status: Json) -> str:
    """What a status says, without its times."""
    said = [
        {key: value for key, value in one.items() if key != "lastTransitionTime"}
        for one in status.get("conditions", ())
    ]
    text = json.dumps({**status, "conditions": said}, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
