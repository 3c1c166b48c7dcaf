"""Remembers the ports of ROS 2 participants, for the next proxy of the place.

The participants themselves tell these ports to a proxy that starts again in the same pod (see
`rosproxy.ros2.ports.former_ports`). A new pod has another address, and the participants don't
answer a proxy at that address. So the operator sends the new proxy the ports that the former proxy
reported last. If the operator has seen no such report, the new proxy does not learn the ports.
"""

from collections.abc import Mapping

import msgspec

from rosproxy_operator.common.proxy_status import Leases
from rosproxy_operator.kubernetes.planner.cluster_view import View
from rosproxy_operator.kubernetes.resources.model import ProxyPlace


class FormerPorts(msgspec.Struct, frozen=True):
    """The ports of participants at the proxy whose pod has this ``uid``."""

    uid: str
    leases: Leases


def remember(view: View, former: Mapping[ProxyPlace, FormerPorts]) -> dict[ProxyPlace, FormerPorts]:
    """Return the last reported ports of each place.

    The ports of the former proxy stay until the new proxy reports participants. Ports also stay if
    the same proxy reports no participants any more: the operator may have had the proxy unregister
    the participants before a recreation. Outside may have missed the dispose messages, which are
    datagrams.
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
    """Return the ports at the former proxy, by the uid of the pod of the present proxy."""
    return {
        proxy.pod.uid: former[place].leases
        for place, proxy in view.current.items()
        if place in former and former[place].uid != proxy.pod.uid
    }
