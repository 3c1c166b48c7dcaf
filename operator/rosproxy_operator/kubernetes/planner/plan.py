"""From what is seen in a cluster to what is to be done there: the way of a RosProxy.

`plan` is a function of what is seen, the state before and the time. `view` puts in order what is
seen: who is wanted where. `state.learn` draws conclusions from it, `allocation.allocate` gives each
wanted proxy its ports, `reconcile` says what is to be done to Services and proxies, `status` and
`events` what users are told of it, `departures` what proxies are told.
"""

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace

from rosproxy_operator.common.allocation import RETRY_FOR
from rosproxy_operator.common.problem import Problem
from rosproxy_operator.kubernetes.planner import departures
from rosproxy_operator.kubernetes.planner.actions import Action, PatchStatus
from rosproxy_operator.kubernetes.planner.allocation import allocate
from rosproxy_operator.kubernetes.planner.injection import unwired
from rosproxy_operator.kubernetes.planner.reconcile import (
    ClusterContext,
    advertise_host,
    ends,
    nodes_by_rosproxy,
    obstacle,
    reconcile_orphans,
    reconcile_proxy,
    reconcile_service,
    service_of,
    upstream,
)
from rosproxy_operator.kubernetes.planner.retries import Retries, Task
from rosproxy_operator.kubernetes.planner.settings import ClusterSettings
from rosproxy_operator.kubernetes.planner.state import ClusterState, decide, learn, moves
from rosproxy_operator.kubernetes.planner.view import finding, view
from rosproxy_operator.kubernetes.resources.model import (
    ClusterFinding,
    ClusterSnapshot,
    InvalidRosProxy,
    Json,
    NodeState,
    ProxyPlace,
    RosProxy,
)
from rosproxy_operator.kubernetes.status import events
from rosproxy_operator.kubernetes.status import status as statuses


@dataclass(frozen=True, slots=True)
class ClusterPlan:
    """What to do, in this order, and what to remember.

    One action that fails keeps none of the others from being done. ``gone`` are, by the uid of a
    proxy's pod, the addresses of pods that are no more: the proxy is to be told. ``again_in`` is
    in how many seconds to look again even if nothing happens; None: no need.
    """

    actions: tuple[Action, ...] = ()
    problems: tuple[Problem, ...] = ()
    state: ClusterState = field(default_factory=ClusterState)
    gone: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    again_in: float | None = None


def plan(
    observed: ClusterSnapshot,
    settings: ClusterSettings,
    state: ClusterState,
    now: float,
    stamp: str,
) -> ClusterPlan:
    """The next actions, from everything that is seen; none if all is as it ought to be.

    ``state`` is that of the plan before, or an empty one. ``now`` is in seconds of a monotonic
    clock that goes on as long as the state does; ``stamp`` is the time of day in RFC 3339.
    """
    seen = view(observed)
    learned = learn(seen, state, now)
    ranges = allocate(seen, settings, learned)
    decided = decide(learned, ranges.given, now)
    retries = Retries(decided.attempts, observed.failures, now)
    context = ClusterContext(seen, settings, decided, ranges, retries, now)
    actions = list(reconcile_orphans(context))
    problems: list[Problem] = [*seen.findings]
    moved = tuple(moves(seen, decided, ranges.given))
    nodes = nodes_by_rosproxy(context)
    for of, rosproxy in sorted(seen.rosproxies.items()):
        own = _reconciled(context, rosproxy)
        states = tuple(_state(context, ProxyPlace(of, node)) for node in nodes[of])
        found = _problems(context, rosproxy, states, moved)
        status = _status(context, rosproxy, states, found, stamp)
        problems += found
        actions += [*own, *_patch(context, rosproxy, status), *events.results(rosproxy, own)]
    for bad in observed.unusable.values():
        problems.append(statuses.invalid_finding(bad))
        actions += _patch(context, bad, statuses.status_of_invalid(bad, stamp))
    every = tuple(dict.fromkeys(problems))
    new = events.warnings(every, decided.reported, now)
    gone = departures.gone(observed, decided, now)
    return ClusterPlan(
        actions=(*actions, *new.emits),
        problems=every,
        state=replace(gone.state, attempts=retries.noted, reported=new.reported),
        gone=gone.gone,
        again_in=min((*_waits(context), *departures.waits(gone, now)), default=None),
    )


def _waits(context: ClusterContext) -> Iterator[float]:
    """In how many seconds there is something to be done or decided."""
    yield from ends(context)
    yield from context.retries.waits()
    refused_for = (at + RETRY_FOR - context.now for at in context.state.refused.values())
    yield from (left for left in refused_for if left > 0)


def _reconciled(context: ClusterContext, rosproxy: RosProxy) -> list[Action]:
    actions = list(reconcile_service(context, rosproxy))
    for place in sorted(context.view.places()):
        if place.of == rosproxy.id:
            actions += reconcile_proxy(context, place)
    return actions


def _problems(
    context: ClusterContext,
    rosproxy: RosProxy,
    states: tuple[NodeState, ...],
    moved: Iterable[ClusterFinding],
) -> tuple[Problem, ...]:
    """All that is wrong with a RosProxy."""
    flaws = (
        finding(rosproxy, reason, text)
        for place, some in sorted(context.ranges.flaws.items())
        if place.of == rosproxy.id
        for reason, text in some
    )
    return (
        *statuses.findings(rosproxy, states, context.retries.failures(rosproxy.id)),
        *(one for one in (*context.view.findings, *moved) if one.of == rosproxy.id),
        *flaws,
        *_unwired(context, rosproxy),
    )


def _status(
    context: ClusterContext,
    rosproxy: RosProxy,
    states: tuple[NodeState, ...],
    problems: tuple[Problem, ...],
    stamp: str,
) -> Json:
    master, _ = upstream(rosproxy, context.observed)
    there = service_of(context.observed, rosproxy.id)
    mine = there if there and there.owner == rosproxy.uid else None
    uri = master.uri if master else ""
    return statuses.status_of(rosproxy, states, problems, mine, uri, stamp)


def _state(context: ClusterContext, place: ProxyPlace) -> NodeState:
    of, node = context.view.rosproxies[place.of], context.observed.nodes[place.node]
    current, wanted = context.view.current(place), place in context.view.wanted
    reason, problem = obstacle(context, place) if wanted else ("", "")
    former = context.state.given.get(place) or of.former.get(place.node)
    kept = current.range if current else former
    host, _ = advertise_host(of, node)
    return NodeState(
        name=place.node,
        advertise_host=host,
        range=context.ranges.given.get(place) if wanted else kept,
        proxy=current,
        pods=context.view.wanted.get(place, ()),
        answer=context.observed.reports.get(current.pod.uid) if current else None,
        problem=problem,
        reason=reason,
    )


def _unwired(context: ClusterContext, rosproxy: RosProxy) -> Iterator[ClusterFinding]:
    there = service_of(context.observed, rosproxy.id)
    if there is not None and there.owner == rosproxy.uid and there.cluster_ip:
        for pod in context.view.taken.get(rosproxy.id, ()):
            found = unwired(pod, rosproxy, there.cluster_ip)
            if found is not None:
                yield found


def _patch(
    context: ClusterContext, of: RosProxy | InvalidRosProxy, status: Json
) -> Iterator[Action]:
    """Write a status if it is another one; not over and over again if that does not help."""
    if status != of.status:
        task = Task(of.id, "status", str(of.id), _digest(status))
        if context.retries.ask(task):
            yield PatchStatus(of.id, status)


def _digest(status: Json) -> str:
    """What a status says, without its times."""
    said = [
        {key: value for key, value in one.items() if key != "lastTransitionTime"}
        for one in status.get("conditions", ())
    ]
    text = json.dumps({**status, "conditions": said}, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
