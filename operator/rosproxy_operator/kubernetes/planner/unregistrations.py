"""Remembers when the proxy of a place last unregistered ROS 1 nodes while the pods still ran.

A proxy without a successor unregisters the ROS 1 nodes (`DeleteProxy.retire`). A proxy has no
successor if the master or the ports change, or if no pod is selected any more. A ROS 1 node
registers only at the start of the node. So the nodes of older pods stay unregistered, also if the
RosProxy gets the former master or selector back. For the next operator, the status keeps a time for
each Kubernetes node (``unregisteredAt``).

A pod may be older than that time and registered all the same: the containers restarted later, the
unregistration was called off, or the clocks of operator and API server differ. So a pod at whose
address a proxy has ROS 1 nodes counts as registered.
"""

from collections.abc import Iterable, Mapping, Set

import msgspec
from msgspec.structs import replace

from rosproxy_operator.kubernetes.planner.actions import Action, DeleteProxy
from rosproxy_operator.kubernetes.planner.cluster_view import View
from rosproxy_operator.kubernetes.resources.cluster import ProxyPod
from rosproxy_operator.kubernetes.resources.model import ProxyPlace, RosProxy


class Unregistration(msgspec.Struct, frozen=True):
    """The unregistration of all ROS 1 nodes of a proxy ``at`` a time (RFC 3339).

    ``uid`` is the uid of the proxy's pod. The uid is empty if the time comes from a status.
    """

    uid: str
    at: str


Unregistrations = Mapping[ProxyPlace, Unregistration]


def recall(view: View, known: Unregistrations) -> dict[ProxyPlace, Unregistration]:
    """Return the last unregistration of each place, either ``known`` or, if later, from a status.

    A watched status may be older than the operator's own state. The pods of a node that has left
    the cluster are gone, so its unregistration is forgotten.
    """
    latest = {
        place: last
        for place, last in known.items()
        if place.of in view.rosproxies and place.node in view.observed.nodes
    }
    for rosproxy in view.rosproxies.values():
        for node, at in rosproxy.unregistered_at.items():
            place = ProxyPlace(rosproxy.id, node)
            if place not in latest or latest[place].at < at:
                latest[place] = Unregistration("", at)
    return latest


def note_unregistrations(
    view: View, rosproxy: RosProxy, actions: Iterable[Action], known: Unregistrations, stamp: str
) -> dict[ProxyPlace, Unregistration]:
    """Return the unregistrations that begin with these actions, at the time ``stamp``.

    A plan may ask for the same deletion again. The time of the first plan counts, because a retired
    proxy accepts no other nodes.
    """
    retiring = retiring_proxies(actions)
    return {
        place: Unregistration(proxy.pod.uid, stamp)
        for place in view.places.get(rosproxy.id, ())
        for proxy in view.proxies.get(place, ())
        if proxy.pod.uid in retiring
        and (place not in known or known[place].uid != proxy.pod.uid)
        and _has_nodes(view, rosproxy, proxy)
    }


def retiring_proxies(actions: Iterable[Action]) -> frozenset[str]:
    """Return the uids of the proxies' pods that these actions let unregister the ROS 1 nodes."""
    return frozenset(a.uid for a in actions if isinstance(a, DeleteProxy) and a.retire)


def with_unregistrations(
    view: View, rosproxy: RosProxy, known: Unregistrations, retiring: Set[str] = frozenset()
) -> RosProxy:
    """Return a RosProxy with the last unregistrations, and with what its proxies know of pods.

    ``retiring``: the uids of the proxies that unregister ROS 1 nodes now.
    """
    own = view.places.get(rosproxy.id, ())
    nodes = (*rosproxy.former_ranges, *(p.node for p in own))
    places = {node: ProxyPlace(rosproxy.id, node) for node in nodes}
    times = {node: known[place].at for node, place in places.items() if place in known}
    proxies = (proxy for place in own for proxy in view.proxies.get(place, ()))
    staying = [p for p in proxies if not p.pod.deleting and p.pod.uid not in retiring]
    reports = [(p.node, view.observed.reports.get(p.pod.uid)) for p in staying]
    silent = frozenset(node for node, report in reports if not (report and report.answered))
    answered = tuple(report for _, report in reports if report and not report.retired)
    return replace(
        rosproxy,
        unregistered_at=times,
        silent=silent,
        registered=frozenset(address for report in answered for address in report.nodes),
        discovered=frozenset(address for report in answered for address in report.participants),
    )


def _has_nodes(view: View, rosproxy: RosProxy, proxy: ProxyPod) -> bool:
    """Whether a proxy has ROS 1 nodes, as far as the operator knows."""
    report = view.observed.reports.get(proxy.pod.uid)
    return bool(report.nodes) if report and report.answered else rosproxy.spec.ros1
