"""Remembers when the proxy of a place last unregistered its ROS 1 nodes while their pods ran.

A proxy that no other proxy takes over unregisters its nodes (`DeleteProxy.retire`): another master,
other ports, or no selected pod any more. ROS 1 nodes register only at their start. So the nodes of
older pods stay unregistered, also if the RosProxy gets its former master or selector back. The
status keeps the time of each node (``unregisteredAt``), for the next operator.
"""

from collections.abc import Iterable, Mapping

import msgspec
from msgspec.structs import replace

from rosproxy_operator.kubernetes.planner.actions import Action, DeleteProxy
from rosproxy_operator.kubernetes.planner.cluster_view import View
from rosproxy_operator.kubernetes.resources.cluster import ProxyPod
from rosproxy_operator.kubernetes.resources.model import ProxyPlace, RosProxy


class Unregistration(msgspec.Struct, frozen=True):
    """The proxy whose pod has this ``uid`` unregistered its nodes ``at`` this time (RFC 3339).

    The ``uid`` is empty if the time comes from a status.
    """

    uid: str
    at: str


Unregistrations = Mapping[ProxyPlace, Unregistration]


def recall(view: View, known: Unregistrations) -> dict[ProxyPlace, Unregistration]:
    """Return the last unregistration of each place: the ``known`` one, or a later one of a status.

    A watched status may be older than the operator's own state.
    """
    latest = {place: last for place, last in known.items() if place.of in view.rosproxies}
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

    A plan may ask for the same deletion again. The time of the first plan counts, because a proxy
    that has unregistered its nodes accepts no other nodes.
    """
    retiring = {a.uid for a in actions if isinstance(a, DeleteProxy) and a.retire}
    return {
        place: Unregistration(proxy.pod.uid, stamp)
        for place in view.places.get(rosproxy.id, ())
        for proxy in view.proxies.get(place, ())
        if proxy.pod.uid in retiring
        and (place not in known or known[place].uid != proxy.pod.uid)
        and _has_nodes(view, rosproxy, proxy)
    }


def with_unregistrations(view: View, rosproxy: RosProxy, known: Unregistrations) -> RosProxy:
    """Return a RosProxy with the last unregistration on each of its nodes."""
    nodes = (*rosproxy.former_ranges, *(p.node for p in view.places.get(rosproxy.id, ())))
    places = {node: ProxyPlace(rosproxy.id, node) for node in nodes}
    times = {node: known[place].at for node, place in places.items() if place in known}
    return replace(rosproxy, unregistered_at=times)


def _has_nodes(view: View, rosproxy: RosProxy, proxy: ProxyPod) -> bool:
    """Whether a proxy has ROS 1 nodes, as far as the operator knows."""
    report = view.observed.reports.get(proxy.pod.uid)
    return bool(report.nodes) if report and report.answered else rosproxy.spec.ros1
