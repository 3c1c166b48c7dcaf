"""Which ports participants of ROS 2 had, for a proxy whose pod is made anew.

A proxy that is started again in its pod is told that by the participants themselves. A new pod has
another address, at which they don't answer it (see
`rosproxy.ros2.ports.former_ports`): then the operator tells it what the former proxy
reported last, if it has seen that; otherwise nobody does.
"""

from collections.abc import Mapping

import msgspec

from rosproxy_operator.common.proxy_status import Leases
from rosproxy_operator.kubernetes.planner.cluster_view import View
from rosproxy_operator.kubernetes.resources.model import ProxyPlace


class FormerPorts(msgspec.Struct, frozen=True):
    """The ports at the proxy whose pod has this uid."""

    uid: str
    leases: Leases


def remember(view: View, former: Mapping[ProxyPlace, FormerPorts]) -> dict[ProxyPlace, FormerPorts]:
    """The ports by place: as its proxy reports them now, or as the former one did last.

    Those of the former proxy count until the new one has participants. The last ports count as
    well where a proxy has none any more: it may have unregistered its participants because it is to
    be made anew, and the dispose messages are datagrams, of which some may be lost.
    """
    latest = {place: ports for place, ports in former.items() if place.of in view.rosproxies}
    for place, proxy in view.current.items():
        report = view.observed.reports.get(proxy.pod.uid)
        if report is None or not report.answered:
            continue
        if report.leases:
            latest[place] = FormerPorts(proxy.pod.uid, report.leases)
    return latest


def former_ports(view: View, former: Mapping[ProxyPlace, FormerPorts]) -> dict[str, Leases]:
    """What proxies are to be told of their predecessors, by the uid of their pod."""
    return {
        proxy.pod.uid: former[place].leases
        for place, proxy in view.current.items()
        if place in former and former[place].uid != proxy.pod.uid
    }
