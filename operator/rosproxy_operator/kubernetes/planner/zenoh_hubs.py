"""Finds proxies for rmw_zenoh that are not linked with each other.

Each hub dials the hubs of the other nodes. A session may be visible to a single side: behind NAT,
the hub that was dialed does not see the address of the other hub. So two proxies are linked if one
of the two says so.
"""

from collections.abc import Iterator, Mapping

from rosproxy.shared.output.text import listed
from rosproxy_operator.common.problem import Fault
from rosproxy_operator.kubernetes.planner.cluster_view import View, group_by_key
from rosproxy_operator.kubernetes.resources.cluster import ZenohReport
from rosproxy_operator.kubernetes.resources.model import ClusterFinding, ProxyPlace, RosProxy
from rosproxy_operator.kubernetes.resources.names import HUB_PORT, hub_address
from rosproxy_operator.kubernetes.status.findings import finding

APART_REPORTED_S = 30.0
"""Seconds until proxies that are not linked are reported. DNS may keep "no such name" as long."""
Apart = Mapping[tuple[ProxyPlace, str], float]
"""The time since when a proxy is not linked with the proxy on another node."""


def hubs_apart(view: View, former: Apart, now: float) -> dict[tuple[ProxyPlace, str], float]:
    """Return the pairs of ready proxies without a link, and the time since when."""
    reports = dict(_reports(view))
    addresses = {place: str(hub_address(place.of, place.node)) for place in reports}
    places = {address: place for place, address in addresses.items()}
    apart = set[tuple[ProxyPlace, str]]()
    for place, report in reports.items():
        for address in (address for address, fault in report.hubs.items() if fault):
            other = places.get(address)
            if other is None or other.of != place.of:
                continue
            if reports[other].hubs.get(addresses[place]) != "":  # that side has no link either
                one, two = sorted((place, other))
                apart.add((one, two.node))
    return {pair: former.get(pair, now) for pair in apart}


def apart_findings(apart: Apart, rosproxy: RosProxy, now: float) -> Iterator[ClusterFinding]:
    """Yield a finding for each proxy of a RosProxy that is not linked with others."""
    due = (p for p, since in apart.items() if p[0].of == rosproxy.id and due_in(since, now) <= 0)
    for place, nodes in sorted(group_by_key(due).items()):
        text = (
            f"the hub is not linked with the hubs on node {listed(sorted(nodes))}, so messages "
            "between pods of these nodes may not pass"
        )
        fix = (
            f"Let the proxies connect to each other at port {HUB_PORT} (NetworkPolicy, firewall), "
            f"and check that pods resolve {hub_address(place.of, nodes[0]).host}"
        )
        yield finding(
            rosproxy, "HubsApart", Fault(text, fix), subject=f"proxy on node {place.node}"
        )


def due_in(since: float, now: float) -> float:
    """Return the seconds until a missing link is reported."""
    return since + APART_REPORTED_S - now


def _reports(view: View) -> Iterator[tuple[ProxyPlace, ZenohReport]]:
    """Yield the reports of ready proxies for rmw_zenoh."""
    for place, proxy in view.current.items():
        report = view.observed.reports.get(proxy.pod.uid)
        if proxy.ready and report is not None and report.answered and report.zenoh is not None:
            yield place, report.zenoh
