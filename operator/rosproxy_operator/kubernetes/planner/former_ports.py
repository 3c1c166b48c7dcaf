"""Which ports participants of ROS 2 had, for a proxy whose pod is made anew.

A proxy that is started again in its pod is told that by the participants themselves. A new pod has
another address, at which they don't answer it (see `rosproxy.ros2.discovery.returning`): then the
operator tells what the former proxy has said last. If it has not seen that one, nobody tells.
"""

from collections.abc import Mapping

import msgspec

from rosproxy_operator.common.proxy_status import Leases
from rosproxy_operator.kubernetes.planner.view import View
from rosproxy_operator.kubernetes.resources.model import ProxyPlace


class FormerPorts(msgspec.Struct, frozen=True):
    """The ports at the proxy whose pod has this uid."""

    uid: str
    leases: Leases


def remember(view: View, before: Mapping[ProxyPlace, FormerPorts]) -> dict[ProxyPlace, FormerPorts]:
    """What is known of each place: as its proxy says now; or as the one before has said last.

    That one's counts until the new one has participants.
    """
    known = {place: each for place, each in before.items() if place.of in view.rosproxies}
    for place, proxy in view.current.items():
        answer = view.observed.reports.get(proxy.pod.uid)
        if answer is None or not answer.answered:
            continue
        if answer.leases or (place in known and known[place].uid == proxy.pod.uid):
            known[place] = FormerPorts(proxy.pod.uid, answer.leases)
    return known


def former_ports(view: View, known: Mapping[ProxyPlace, FormerPorts]) -> dict[str, Leases]:
    """What proxies are to be told of those before them, by the uid of their pod."""
    return {
        proxy.pod.uid: known[place].leases
        for place, proxy in view.current.items()
        if place in known and known[place].uid != proxy.pod.uid
    }
