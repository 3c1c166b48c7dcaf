"""The running pods of which the proxy discovers no participant, and findings about these pods.

A variable alone is no fault: the operator does not read DDS profiles, and the proxy announces
itself to the address of each pod, whatever the variables say.
"""

from collections.abc import Iterator, Mapping

from rosproxy_operator.common.problem import Fault
from rosproxy_operator.common.ros2_variables import discovery_obstacle
from rosproxy_operator.kubernetes.planner.cluster_view import View
from rosproxy_operator.kubernetes.planner.pods.pod_fixes import edit_fix
from rosproxy_operator.kubernetes.resources.model import (
    VALUE_AT_RUNTIME,
    ClusterFinding,
    Name,
    Pod,
    PodContainer,
    ProxyPlace,
    RosProxy,
)
from rosproxy_operator.kubernetes.status.findings import pod_finding

UNDISCOVERED_FOR_S = 30.0
"""Seconds until a pod is reported. Nodes may take some seconds to start."""
_HARMLESS = ("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
"""With this range, participants announce themselves to ROS_STATIC_PEERS."""


def undiscovered(view: View, since: Mapping[Name, float]) -> Iterator[tuple[Pod, RosProxy]]:
    """Yield the running pods without participants.

    ``since`` is the time at which the operator first saw each of these pods without participants.
    A pod in ``since`` stays while the proxy does not answer.
    """
    for id, pods in view.selected_pods.items():
        rosproxy = view.rosproxies[id]
        for pod in pods if rosproxy.spec.ros2 else ():
            proxy = view.current.get(ProxyPlace(id, pod.node))
            report = view.observed.reports.get(proxy.pod.uid) if proxy else None
            if pod.phase != "Running":
                continue
            if report and report.answered:
                is_missing = not report.participants.keys() & {pod.ip, *pod.ips}
            else:
                is_missing = pod.id in since
            if is_missing:
                yield pod, rosproxy


def is_undiscovered(pod: Pod, since: Mapping[Name, float], now: float) -> bool:
    """Whether a pod has had no participants for `UNDISCOVERED_FOR_S`. ``since``: see above."""
    return now - since.get(pod.id, now) >= UNDISCOVERED_FOR_S


def undiscovered_findings(
    view: View, since: Mapping[Name, float], now: float
) -> Iterator[ClusterFinding]:
    """Yield a finding for each undiscovered pod with a variable that may be the cause."""
    for pod, rosproxy in undiscovered(view, since):
        fault = next(filter(None, map(_obstacle, pod.containers)), None)
        if fault and is_undiscovered(pod, since, now):
            text = (
                "the proxy has discovered no participant of the pod. Possible cause, if one runs: "
            )
            described = Fault(text + fault.text, edit_fix(f"{fault.fix}. Edit the template", pod))
            yield pod_finding(pod, rosproxy, "NotDiscovered", described, fatal=False)


def undiscovered_waits(since: Mapping[Name, float], now: float) -> Iterator[float]:
    """Yield the seconds until each pod counts as undiscovered that does not yet."""
    return (left for at in since.values() if (left := at + UNDISCOVERED_FOR_S - now) > 0)


def _obstacle(container: PodContainer) -> Fault | None:
    known = {
        name: value
        for name, value in container.variables.items()
        if value != VALUE_AT_RUNTIME and (name, value.upper()) != _HARMLESS
    }
    return discovery_obstacle(known)
