"""Plans the next actions in a cluster, from a snapshot, the last state, the settings and the time.

`plan` is a pure function with these steps:

1. `bounds` sets aside the RosProxies that ask for too much.
2. `cluster_view` sorts the snapshot: which proxies are wanted, and where.
3. `state.learn` updates the state from the view.
4. `allocation` gives each wanted proxy a range.
5. The modules in `steps` yield the actions.
6. `status` and `events` create statuses and Events for users.
7. `departures` and `briefing` collect what the operator sends to the proxies.
"""

import json
from collections.abc import Iterable, Iterator, Mapping

import msgspec
from msgspec.structs import replace

from rosproxy_operator.common.problem import Fault
from rosproxy_operator.kubernetes.planner import departures
from rosproxy_operator.kubernetes.planner.actions import Action, PatchStatus
from rosproxy_operator.kubernetes.planner.allocation import allocate
from rosproxy_operator.kubernetes.planner.bounds import within_bounds
from rosproxy_operator.kubernetes.planner.briefing import Briefing, briefings
from rosproxy_operator.kubernetes.planner.cluster_view import View, view
from rosproxy_operator.kubernetes.planner.former_ports import former_ports, remember
from rosproxy_operator.kubernetes.planner.misspellings import (
    misspellings,
    misspelt_pod_findings,
)
from rosproxy_operator.kubernetes.planner.pods.ros1_pods import ros1_finding
from rosproxy_operator.kubernetes.planner.pods.ros2_pods import ros2_findings
from rosproxy_operator.kubernetes.planner.pods.undiscovered import (
    is_undiscovered,
    undiscovered_findings,
    undiscovered_waits,
)
from rosproxy_operator.kubernetes.planner.pods.unselected import (
    unselected_findings,
    unselected_waits,
)
from rosproxy_operator.kubernetes.planner.pods.zenoh_pods import zenoh_findings
from rosproxy_operator.kubernetes.planner.retries import Retries, Task
from rosproxy_operator.kubernetes.planner.state import ClusterState, decide, learn, moves
from rosproxy_operator.kubernetes.planner.steps.context import (
    ClusterContext,
    advertise_host,
    master_of,
    outside_address,
    peers,
    site_of,
)
from rosproxy_operator.kubernetes.planner.steps.image_check import remove_image_checks
from rosproxy_operator.kubernetes.planner.steps.lan_relay import (
    lan_relay_findings,
    reconcile_lan_relays,
)
from rosproxy_operator.kubernetes.planner.steps.network_policy import (
    reconcile_orphaned_policies,
    reconcile_policies,
)
from rosproxy_operator.kubernetes.planner.steps.reconcile import (
    reconcile_hubs_service,
    reconcile_orphans,
    reconcile_outside_service,
    reconcile_proxies,
    reconcile_service,
    seconds_to_deadlines,
)
from rosproxy_operator.kubernetes.planner.steps.remake import remake_unwired
from rosproxy_operator.kubernetes.planner.unregistrations import (
    Unregistration,
    note_unregistrations,
    retiring_proxies,
    with_unregistrations,
)
from rosproxy_operator.kubernetes.planner.zenoh_hubs import apart_findings, due_in
from rosproxy_operator.kubernetes.resources.cluster import (
    ClusterSnapshot,
    Obstacle,
    RosProxyOnNode,
    WebhookState,
)
from rosproxy_operator.kubernetes.resources.model import (
    ClusterFinding,
    InvalidRosProxy,
    Json,
    Pod,
    ProxyPlace,
    RosProxy,
)
from rosproxy_operator.kubernetes.resources.pod_defaults import with_pod_defaults
from rosproxy_operator.kubernetes.settings import ClusterSettings
from rosproxy_operator.kubernetes.status import events
from rosproxy_operator.kubernetes.status.findings import finding, findings
from rosproxy_operator.kubernetes.status.rosproxy_status import (
    Addresses,
    status_of,
    status_of_invalid,
)

_STEPS = (
    reconcile_service,
    reconcile_hubs_service,
    reconcile_outside_service,
    reconcile_policies,
    reconcile_proxies,
    reconcile_lan_relays,
    remove_image_checks,
    remake_unwired,
)
"""The functions that plan the actions for a RosProxy, in this order."""


class ClusterPlan(msgspec.Struct, frozen=True):
    """The actions to take, in this order, and the next state.

    If an action fails, the operator still takes the next actions. ``briefings`` has what the
    operator sends each proxy, by the uid of the pod. ``next_look_in`` is the time to the next look
    in seconds, if no event comes earlier; None: the operator waits for an event.
    """

    actions: tuple[Action, ...] = ()
    problems: tuple[ClusterFinding, ...] = ()
    state: ClusterState = ClusterState()
    briefings: Mapping[str, Briefing] = {}
    next_look_in: float | None = None


def plan(
    observed: ClusterSnapshot,
    settings: ClusterSettings,
    state: ClusterState,
    now: float,
    stamp: str,
) -> ClusterPlan:
    """Return the next plan. A plan has no actions if everything is as the RosProxies ask.

    ``state`` is the state of the last plan, or an empty state. ``now`` is in seconds of a monotonic
    clock, the same clock as in ``state``. ``stamp`` is the present time in RFC 3339.
    """
    full_snapshot = observed  # with the RosProxies that `within_bounds` makes unusable
    observed = with_pod_defaults(within_bounds(observed, settings), settings.pod)
    cluster_view = view(observed)
    learned = learn(cluster_view, state, now)
    ranges = allocate(cluster_view, settings, learned)
    decided = decide(learned, ranges.on_hosts, now)
    retries = Retries(decided.attempts, observed.failures, now)
    context = ClusterContext(cluster_view, settings, decided, ranges, retries, now)
    actions = [*reconcile_orphans(context), *reconcile_orphaned_policies(context)]
    pod_findings = _pod_findings(cluster_view, decided, now)
    problems = [*pod_findings]
    shared = (*pod_findings, *moves(cluster_view, decided, ranges.on_hosts))
    unregistered = {**decided.unregistered}
    for _, rosproxy in sorted(cluster_view.rosproxies.items()):
        own, own_problems = _of_rosproxy(context, rosproxy, shared, unregistered, stamp)
        problems += own_problems
        actions += own
    for invalid in observed.unusable.values():
        fault = Fault(invalid.text, invalid.fix)
        problems.append(finding(invalid, invalid.reason, fault, fatal=True))
        actions += _patch(context, invalid, status_of_invalid(invalid, stamp))
    unique = tuple(dict.fromkeys(problems))
    warnings = events.warnings(unique, decided.reported, now)
    decided = replace(decided, unregistered=unregistered)
    departed = departures.find_departures(observed, decided, now)
    return ClusterPlan(
        actions=(*actions, *warnings.emits),
        problems=unique,
        state=replace(departed.state, attempts=retries.noted, reported=warnings.reported),
        briefings=briefings(
            full_snapshot,
            settings,
            peers(context),
            former_ports(cluster_view, decided.former),
            departed.addresses,
        ),
        next_look_in=min(_waits(context, departed), default=None),
    )


def _of_rosproxy(
    context: ClusterContext,
    rosproxy: RosProxy,
    shared: Iterable[ClusterFinding],
    unregistered: dict[ProxyPlace, Unregistration],
    stamp: str,
) -> tuple[list[Action], tuple[ClusterFinding, ...]]:
    """Return the actions and the findings of a RosProxy.

    Add the unregistrations that begin with these actions to ``unregistered``.
    """
    rosproxy = with_unregistrations(context.view, rosproxy, unregistered)
    actions = [action for step in _STEPS for action in step(context, rosproxy)]
    unregistered |= note_unregistrations(context.view, rosproxy, actions, unregistered, stamp)
    retiring = retiring_proxies(actions)
    rosproxy = with_unregistrations(context.view, rosproxy, unregistered, retiring)
    states = tuple(_states(context, rosproxy))
    problems = _problems(context, rosproxy, states, shared)
    status = _status(context, rosproxy, states, problems, stamp)
    results = events.results(rosproxy, actions)
    return [*actions, *_patch(context, rosproxy, status), *results], problems


def _pod_findings(
    cluster_view: View, state: ClusterState, now: float
) -> tuple[ClusterFinding, ...]:
    """Return the findings about pods, in namespaces with and without a RosProxy."""
    return (
        *cluster_view.findings,
        *unselected_findings(cluster_view, state.unselected, now),
        *undiscovered_findings(cluster_view, state.undiscovered, now),
        *misspelt_pod_findings(cluster_view),
    )


def _waits(context: ClusterContext, departed: departures.Departures) -> Iterator[float]:
    """Yield the seconds to each look that is due without an event."""
    yield from (seconds for seconds in seconds_to_deadlines(context) if seconds > 0)
    yield from context.retries.pauses()
    yield from departures.next_checks(departed, context.now)
    yield from unselected_waits(context.state.unselected, context.now)
    yield from undiscovered_waits(context.state.undiscovered, context.now)
    waits = (due_in(since, context.now) for since in context.state.apart.values())
    yield from (seconds for seconds in waits if seconds > 0)


def _status(
    context: ClusterContext,
    rosproxy: RosProxy,
    states: tuple[RosProxyOnNode, ...],
    problems: tuple[ClusterFinding, ...],
    stamp: str,
) -> Json:
    """The status of a RosProxy, with the addresses of its Services and the URI of its master."""
    master, _ = master_of(rosproxy, context.observed)
    uri = master.uri if master else ""
    addresses = Addresses(context.cluster_ip(rosproxy), uri, outside_address(context, rosproxy))
    selected = context.view.selected_pods.get(rosproxy.id, ())
    unscheduled = [pod for pod in selected if not pod.node]
    return status_of(rosproxy, states, problems, addresses, stamp, unscheduled)


def stand_by(
    observed: ClusterSnapshot, settings: ClusterSettings, state: ClusterState, now: float
) -> ClusterState:
    """Return the state that a standby remembers, so that the standby can take over.

    The state has only what a new leader can't read from the cluster later: the ports that
    participants had, and the addresses that pods had. The first plan learns everything else.
    """
    departed = departures.find_departures(observed, state, now).state
    observed = with_pod_defaults(within_bounds(observed, settings), settings.pod)
    former = remember(view(observed), state.former)
    return ClusterState(former=former, addresses=departed.addresses, strange=departed.strange)


def _states(context: ClusterContext, rosproxy: RosProxy) -> Iterator[RosProxyOnNode]:
    """Yield the state of a RosProxy on each node where the RosProxy has, needs or had a proxy."""
    lan_relays = {h.node: h for h in context.observed.lan_relays if h.owner == rosproxy.uid}
    image_checks = {h.node: h for h in context.observed.image_checks if h.owner == rosproxy.uid}
    node_names = {
        *rosproxy.former_ranges,
        *(p.node for p in context.view.places.get(rosproxy.id, ())),
    }
    for node in sorted(node_names & context.observed.nodes.keys()):
        place = ProxyPlace(rosproxy.id, node)
        current = context.view.current.get(place)
        wanted = place in context.view.wanted
        site = site_of(context, place) if wanted else None
        former = context.state.given.get(place) or rosproxy.former_ranges.get(node)
        kept = current.range if current else former
        yield RosProxyOnNode(
            name=node,
            advertise_host=advertise_host(rosproxy, context.observed.nodes[node])[0],
            range=context.ranges.given.get(place) if wanted else kept,
            proxy=current,
            pods=context.view.wanted.get(place, ()),
            answer=context.observed.reports.get(current.pod.uid) if current else None,
            obstacle=site if isinstance(site, Obstacle) else None,
            lan_relay=lan_relays.get(node),
            image_check=image_checks.get(node),
            unregistered_at=rosproxy.unregistered_at.get(node, ""),
        )


def _problems(
    context: ClusterContext,
    rosproxy: RosProxy,
    states: tuple[RosProxyOnNode, ...],
    shared: Iterable[ClusterFinding],
) -> tuple[ClusterFinding, ...]:
    """Return all findings about a RosProxy."""
    address = context.cluster_ip(rosproxy)
    pods = context.view.selected_pods.get(rosproxy.id, ()) if address else ()
    service = context.observed.services.get(rosproxy.id)
    since = service.created if service else ""
    webhook = replace(context.observed.webhook, service_since=since)
    unlisted = context.observed.policies_error if context.settings.network_policy else ""
    text = f"the operator can't list NetworkPolicies, so this RosProxy gets none: {unlisted}"
    return (
        *((finding(rosproxy, "NoNetworkPolicy", Fault(text)),) if unlisted else ()),
        *findings(rosproxy, states, context.retries.failures(rosproxy.id)),
        *(f for f in (*shared, *context.ranges.findings) if f.of == rosproxy.id),
        *filter(
            None,
            (ros1_finding(p, rosproxy, address, webhook) for p in pods if rosproxy.spec.ros1),
        ),
        *_ros2_findings(context, rosproxy, pods, webhook),
        *(f for pod in pods for f in zenoh_findings(pod, rosproxy, address, webhook)),
        *lan_relay_findings(context, rosproxy),
        *apart_findings(context.state.apart, rosproxy, context.now),
        *misspellings(context.view, rosproxy),
    )


def _ros2_findings(
    context: ClusterContext, rosproxy: RosProxy, pods: Iterable[Pod], webhook: WebhookState
) -> Iterator[ClusterFinding]:
    address = context.cluster_ip(rosproxy)
    for pod in pods:
        lacks_participants = is_undiscovered(pod, context.state.undiscovered, context.now)
        yield from ros2_findings(
            pod, rosproxy, address, webhook, is_undiscovered=lacks_participants
        )


def _patch(
    context: ClusterContext, rosproxy: RosProxy | InvalidRosProxy, status: Json
) -> Iterator[Action]:
    """Yield the action that writes a status, if the status has changed.

    If the API server does not keep a status, `Retries` delays the next write of the same status. A
    status that differs only in the times of conditions counts as the same.
    """
    if status != rosproxy.status:
        conditions = [{**c, "lastTransitionTime": ""} for c in status.get("conditions", ())]
        content = json.dumps({**status, "conditions": conditions}, sort_keys=True, default=str)
        if context.retries.is_due(Task(rosproxy.id, "status", rosproxy.id, content)):
            yield PatchStatus(rosproxy.id, rosproxy.uid, status)
