"""Findings about pods of which the proxy discovers no participant, if a variable may be the cause.

A variable alone is no fault, since the operator does not read DDS profiles. `ros2_pods` reports
variables that prevent discovery for sure.
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
_IN_ROS2_PODS = ("ROS_LOCALHOST_ONLY", "ROS_AUTOMATIC_DISCOVERY_RANGE")


def undiscovered(view: View) -> Iterator[tuple[Pod, RosProxy, Fault]]:
    """Yield the running pods without participants that have such a variable, with the fault."""
    for id, pods in view.selected_pods.items():
        rosproxy = view.rosproxies[id]
        for pod in pods if rosproxy.spec.ros2 else ():
            proxy = view.current.get(ProxyPlace(id, pod.node))
            report = view.observed.reports.get(proxy.pod.uid) if proxy else None
            if pod.phase != "Running" or not report or not report.answered:
                continue
            fault = next(filter(None, map(_obstacle, pod.containers)), None)
            if fault and not report.participants.keys() & {pod.ip, *pod.ips}:
                yield pod, rosproxy, fault


def undiscovered_findings(
    view: View, since: Mapping[Name, float], now: float
) -> Iterator[ClusterFinding]:
    """Yield a finding for each pod that has no participants for `UNDISCOVERED_FOR_S`.

    ``since`` is the time at which the operator first saw each pod without participants.
    """
    for pod, rosproxy, fault in undiscovered(view):
        if now - since.get(pod.id, now) >= UNDISCOVERED_FOR_S:
            text = (
                "the proxy has discovered no participant of the pod. Possible cause, if one runs: "
            )
            described = Fault(text + fault.text, edit_fix(f"{fault.fix}. Edit the template", pod))
            yield pod_finding(pod, rosproxy, "NotDiscovered", described, fatal=False)


def undiscovered_waits(since: Mapping[Name, float], now: float) -> Iterator[float]:
    """Yield the seconds until each pod that is not reported yet is reported."""
    return (left for at in since.values() if (left := at + UNDISCOVERED_FOR_S - now) > 0)


def _obstacle(container: PodContainer) -> Fault | None:
    known = {
        name: value
        for name, value in container.variables.items()
        if name not in _IN_ROS2_PODS and value != VALUE_AT_RUNTIME
    }
    return discovery_obstacle(known)
