"""From what is seen in a cluster to what is to be done there: the way of a RosProxy.

`plan` is a function of what is seen, the state before and the time. `bounds` sets aside RosProxies
that ask for too much. `view` puts in order what is seen: which proxies are wanted where.
`state.learn` draws conclusions from it, `allocation.allocate` gives each wanted proxy its ports,
`reconcile` and `network_policy` say what is to be done to Services, proxies and NetworkPolicies,
`status` and `events` what users are told, `briefing` and `departures` what proxies are.
"""

import json
from collections.abc import Iterable, Iterator, Mapping

import msgspec
from msgspec.structs import replace

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
from rosproxy_operator.kubernetes.planner.pods.injection import wiring_finding
from rosproxy_operator.kubernetes.planner.pods.ros2_pods import ros2_findings
from rosproxy_operator.kubernetes.planner.pods.unselected import (
    unselected_findings,
    unselected_waits,
)
from rosproxy_operator.kubernetes.planner.retries import Retries, Task
from rosproxy_operator.kubernetes.planner.state import ClusterState, decide, learn, moves
from rosproxy_operator.kubernetes.planner.steps.context import (
    ClusterContext,
    advertise_host,
    master_of,
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
    ends,
    reconcile_orphans,
    reconcile_proxies,
    reconcile_service,
)
from rosproxy_operator.kubernetes.planner.steps.remake import remake_unwired
from rosproxy_operator.kubernetes.resources.cluster import ClusterSnapshot, Obstacle, RosProxyOnNode
from rosproxy_operator.kubernetes.resources.model import (
    ClusterFinding,
    InvalidRosProxy,
    Json,
    ProxyPlace,
    RosProxy,
)
from rosproxy_operator.kubernetes.resources.pod_defaults import with_pod_defaults
from rosproxy_operator.kubernetes.settings import ClusterSettings
from rosproxy_operator.kubernetes.status import events
from rosproxy_operator.kubernetes.status.findings import finding, findings
from rosproxy_operator.kubernetes.status.rosproxy_status import status_of, status_of_invalid

_STEPS = (
    reconcile_service,
    reconcile_policies,
    reconcile_proxies,
    reconcile_lan_relays,
    remove_image_checks,
    remake_unwired,
)
"""What is done for each RosProxy, in this order."""


class ClusterPlan(msgspec.Struct, frozen=True):
    """What to do, in this order, and what to remember.

    One action that fails keeps none of the others from being done. ``briefings`` are what proxies
    are told, by the uid of their pods. ``next_look_in`` is in how many seconds to look again even
    if nothing happens; None: no need.
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
    """The next actions, from everything that is seen; none if all is as it ought to be.

    ``state`` is that of the plan before, or an empty one. ``now`` is in seconds of a monotonic
    clock that goes on as long as the state does; ``stamp`` is the time of day in RFC 3339.
    """
    full_snapshot = observed
    observed = with_pod_defaults(within_bounds(observed, settings), settings.pod)
    cluster_view = view(observed)
    learned = learn(cluster_view, state, now)
    ranges = allocate(cluster_view, settings, learned)
    decided = decide(learned, ranges.given, now)
    retries = Retries(decided.attempts, observed.failures, now)
    context = ClusterContext(cluster_view, settings, decided, ranges, retries, now)
    actions = [*reconcile_orphans(context), *reconcile_orphaned_policies(context)]
    of_pods = _pod_findings(cluster_view, decided, now)
    problems = [*of_pods]
    shared = (*of_pods, *moves(cluster_view, decided, ranges.given))
    for _, rosproxy in sorted(cluster_view.rosproxies.items()):
        own = [action for step in _STEPS for action in step(context, rosproxy)]
        states = tuple(_states(context, rosproxy))
        own_problems = _problems(context, rosproxy, states, shared)
        status = _status(context, rosproxy, states, own_problems, stamp)
        problems += own_problems
        actions += [*own, *_patch(context, rosproxy, status), *events.results(rosproxy, own)]
    for invalid in observed.unusable.values():
        problems.append(finding(invalid, invalid.reason, invalid.text, fatal=True))
        actions += _patch(context, invalid, status_of_invalid(invalid, stamp))
    unique = tuple(dict.fromkeys(problems))
    warnings = events.warnings(unique, decided.reported, now)
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


def _pod_findings(
    cluster_view: View, state: ClusterState, now: float
) -> tuple[ClusterFinding, ...]:
    """What is wrong with pods, in namespaces with and without a RosProxy."""
    return (
        *cluster_view.findings,
        *unselected_findings(cluster_view, state.unselected, now),
        *misspelt_pod_findings(cluster_view),
    )


def _waits(context: ClusterContext, departed: departures.Departures) -> Iterator[float]:
    """The seconds until something is due, whatever happens."""
    yield from (seconds for seconds in ends(context) if seconds > 0)
    yield from context.retries.pauses()
    yield from departures.next_checks(departed, context.now)
    yield from unselected_waits(context.state.unselected, context.now)


def _status(
    context: ClusterContext,
    rosproxy: RosProxy,
    states: tuple[RosProxyOnNode, ...],
    problems: tuple[ClusterFinding, ...],
    stamp: str,
) -> Json:
    """The status of a RosProxy, with the address of its Service and the URI of its master."""
    master, _ = master_of(rosproxy, context.observed)
    uri = master.uri if master else ""
    return status_of(rosproxy, states, problems, context.cluster_ip(rosproxy), uri, stamp)


def stand_by(
    observed: ClusterSnapshot, settings: ClusterSettings, state: ClusterState, now: float
) -> ClusterState:
    """What an operator remembers while another operator acts, to take over from it.

    That is what can't be seen any more once it is needed: which ports participants had, and which
    addresses pods had. Everything else is learnt from the cluster by the first plan.
    """
    departed = departures.find_departures(observed, state, now).state
    observed = with_pod_defaults(within_bounds(observed, settings), settings.pod)
    former = remember(view(observed), state.former)
    return ClusterState(former=former, addresses=departed.addresses, strange=departed.strange)


def _states(context: ClusterContext, rosproxy: RosProxy) -> Iterator[RosProxyOnNode]:
    """What a RosProxy has on each node that its status names: also where it had a proxy."""
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
        )


def _problems(
    context: ClusterContext,
    rosproxy: RosProxy,
    states: tuple[RosProxyOnNode, ...],
    shared: Iterable[ClusterFinding],
) -> tuple[ClusterFinding, ...]:
    """All that is wrong with a RosProxy."""
    address = context.cluster_ip(rosproxy)
    pods = context.view.selected_pods.get(rosproxy.id, ()) if address else ()
    webhook = context.observed.webhook
    unlisted = context.observed.policies_error if context.settings.network_policy else ""
    text = f"the operator can't list NetworkPolicies, so this RosProxy gets none: {unlisted}"
    return (
        *((finding(rosproxy, "NoNetworkPolicy", text),) if unlisted else ()),
        *findings(rosproxy, states, context.retries.failures(rosproxy.id)),
        *(f for f in (*shared, *context.ranges.findings) if f.of == rosproxy.id),
        *filter(
            None,
            (wiring_finding(p, rosproxy, address, webhook) for p in pods if rosproxy.spec.ros1),
        ),
        *(f for pod in pods for f in ros2_findings(pod, rosproxy, address, webhook)),
        *lan_relay_findings(context, rosproxy),
        *misspellings(context.view, rosproxy),
    )


def _patch(
    context: ClusterContext, rosproxy: RosProxy | InvalidRosProxy, status: Json
) -> Iterator[Action]:
    """Write a status if it has changed; not over and over again if that does not help.

    Whether it was written before is judged without its times.
    """
    if status != rosproxy.status:
        conditions = [{**c, "lastTransitionTime": ""} for c in status.get("conditions", ())]
        content = json.dumps({**status, "conditions": conditions}, sort_keys=True, default=str)
        if context.retries.is_due(Task(rosproxy.id, "status", rosproxy.id, content)):
            yield PatchStatus(rosproxy.id, rosproxy.uid, status)
