"""Fixes for users' pods: the kubectl commands that recreate a pod or edit its template.

The template of a Job can't be changed, and the pod of a Job may not be created again.
"""

from rosproxy_operator.kubernetes.resources.model import Pod

_JOB = "job/"


def recreate_command(pod: Pod) -> str:
    """The kubectl command that recreates a pod."""
    if pod.workload.startswith(_JOB):
        command = f"kubectl -n {pod.id.namespace} delete {pod.workload}"
        return f"{command}, and create the Job again"
    if pod.workload:
        return f"kubectl -n {pod.id.namespace} rollout restart {pod.workload}"
    command = f"kubectl -n {pod.id.namespace} delete pod {pod.id.name}"
    return command if pod.controller else f"{command}, and create the pod again"


def recreate_fix(pod: Pod) -> str:
    """The fix that recreates a pod. A pod at admission has no uid, and may have no name."""
    return f"run {recreate_command(pod)}" if pod.uid or pod.workload else "create the pod again"


def edit_fix(change: str, pod: Pod) -> str:
    """The fix that makes a ``change`` in the template of a pod, with the kubectl command."""
    if pod.workload.startswith(_JOB):
        return f"{change} in the file of the Job or CronJob, then {recreate_fix(pod)}"
    if pod.workload:
        return f"{change}: kubectl -n {pod.id.namespace} edit {pod.workload}"
    return f"{change}, then {recreate_fix(pod)}"
