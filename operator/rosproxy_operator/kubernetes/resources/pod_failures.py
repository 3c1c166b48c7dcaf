"""Why a proxy's pod does not run, read from the pod's status and Events.

Reasons and texts are from Kubernetes 1.36. Paths without a repository are in k8s.io/kubernetes.
"""

import re
from datetime import datetime

from rosproxy.shared.output.text import clean
from rosproxy_operator.common.problem import bounded
from rosproxy_operator.kubernetes.resources.checks import int_at, submap, submaps, text_at
from rosproxy_operator.kubernetes.resources.cluster import PodFailure
from rosproxy_operator.kubernetes.resources.model import Json
from rosproxy_operator.kubernetes.resources.names import CONTAINER, IMAGE_CHECK, LAN_RELAY

PORTS_TAKEN = "didn't have free ports for the requested pod ports"
"""``ErrReason`` in pkg/scheduler/framework/plugins/nodeports/node_ports.go.

The kubelet uses the same text with the reason ``NodePorts`` (pkg/kubelet/lifecycle/predicate.go).
"""
_IMAGE_REASONS = frozenset(
    {
        "ErrImagePull",
        "ImagePullBackOff",
        "ErrImageNeverPull",
        "InvalidImageName",
        "ImageInspectError",
        "RegistryUnavailable",
        "SignatureValidationFailed",
    }
)
"""Source: pkg/kubelet/images/types.go, and k8s.io/cri-api, pkg/errors/errors.go."""
_SANDBOX_REASONS = frozenset(
    {
        "CreateContainerConfigError",
        "PreCreateHookError",
        "CreateContainerError",
        "PreStartHookError",
        "PostStartHookError",
        "RunContainerError",
        "CreatePodSandboxError",
        "ConfigPodSandboxError",
    }
)
"""Source in pkg/kubelet: kuberuntime/kuberuntime_container.go, container/sync_result.go."""
_NOT_STARTED_REASONS = ("StartError", "ContainerCannotRun")
"""Reasons of containerd and cri-dockerd if the container's program could not be started."""
_BACK_OFF = re.compile(r'Back-off pulling image "[^"]*"(: )?')
"""Prefix that the kubelet puts before the last error while the kubelet waits for the next try.

Without the prefix, the message stays the same between tries (pkg/kubelet/images/image_manager.go).
"""
_REASON = re.compile(r"(ErrImagePull|RegistryUnavailable|SignatureValidationFailed): ")
_TIMESTAMP = re.compile(r"\d{4}-\d\d-\d\d[T ][\d:.,]+Z? *")
_PORT_TAKEN = ("address already in use", "port is already allocated", "cannot open hostport")
"""Texts of the runtimes that check a hostPort for listeners: CRI-O and cri-dockerd.

The CNI plugin portmap reports nothing: its DNAT rules take the port over from the listener.
"""
_MOST_MESSAGE_CHARACTERS = 300
"""Characters that are kept of a message."""
_STABLE_AFTER_S = 60.0
"""Seconds after which the end of a container counts as no crash.

Exception: the kubelet reports CrashLoopBackOff, and the exit code is not 0. A liveness probe that
never succeeds ends the container after half of this time (third failure).
"""


def pod_failure(status: Json) -> tuple[PodFailure | None, str]:
    """Return why a pod does not run, and the message of Kubernetes.

    None: the pod runs, or may still start. ``status`` is the pod's status. The message does not
    change while the cause is the same.
    """
    if text_at(status, "phase") == "Failed":
        return _failed(text_at(status, "reason"), text_at(status, "message"))
    for condition in submaps(status, "conditions"):
        if condition.get("type") == "PodScheduled" and condition.get("status") == "False":
            return _unscheduled(text_at(condition, "reason"), text_at(condition, "message"))
    for container in submaps(status, "containerStatuses"):
        if container.get("name") in (CONTAINER, LAN_RELAY, IMAGE_CHECK):
            return _container_failure(container)
    return None, ""


def stuck_by_event(message: str) -> PodFailure:
    """Return the cause in the message of a FailedCreatePodSandBox Event: PORTS or SANDBOX."""
    low = message.lower()
    return PodFailure.PORTS if any(text in low for text in _PORT_TAKEN) else PodFailure.SANDBOX


def _failed(reason: str, message: str) -> tuple[PodFailure, str]:
    """Return why the kubelet refused or ended a pod (``rejectPod`` in pkg/kubelet/kubelet.go)."""
    ports = reason == "NodePorts" or PORTS_TAKEN in message
    return PodFailure.PORTS if ports else PodFailure.SCHEDULING, _text(reason, message)


def _unscheduled(reason: str, message: str) -> tuple[PodFailure | None, str]:
    """Return why the scheduler bound a pod to no node: reason Unschedulable or SchedulingGated.

    A SchedulerError is no failure, because the scheduler tries again by itself
    (``handleSchedulingFailure`` in pkg/scheduler/schedule_one.go). Such an error occurs, for
    example, if a pod of the same name has just been deleted.
    """
    if reason in ("", "SchedulerError"):
        return None, ""
    return PodFailure.PORTS if PORTS_TAKEN in message else PodFailure.SCHEDULING, _text(
        reason, message
    )


def _container_failure(container: Json) -> tuple[PodFailure | None, str]:
    """Return why a container does not run, also for a container that has ended at least twice.

    The kubelet reports CrashLoopBackOff only later, when the kubelet syncs the pod again. A proxy
    ends with exit code 0 only if the kubelet stops the container, for example for another image.
    """
    ended = submap(container, "state", "terminated")
    waiting = submap(container, "state", "waiting")
    reason = text_at(waiting, "reason")
    message = text_at(waiting, "message")
    if int_at(ended, "exitCode") and int_at(container, "restartCount"):
        return (None, "") if _was_stable(ended) else _crashing(ended)
    if reason == "CrashLoopBackOff":
        last = submap(container, "lastState", "terminated")
        was_stopped = not int_at(last, "exitCode") and _was_stable(last)
        return (None, "") if was_stopped else _crashing(last)
    if reason in _IMAGE_REASONS:
        bare = _REASON.sub("", _BACK_OFF.sub("", message), count=1)
        return PodFailure.IMAGE, _text("", bare) or reason
    if reason in _SANDBOX_REASONS:
        return PodFailure.SANDBOX, _text(reason, message)
    return None, ""


def _was_stable(ended: Json) -> bool:
    """Whether a container ran for at least `_STABLE_AFTER_S` before the end."""
    try:
        started, finished = (
            datetime.fromisoformat(text_at(ended, key)) for key in ("startedAt", "finishedAt")
        )
        return (finished - started).total_seconds() >= _STABLE_AFTER_S
    except (ValueError, TypeError, OverflowError):
        return False


def _crashing(ended: Json) -> tuple[PodFailure, str]:
    """Return how a container ended.

    The kubelet's own message is unusable: the message has the back-off time, which changes. The
    kubelet also reports CrashLoopBackOff for a container that never ran: the cause is then SANDBOX.
    """
    reason = text_at(ended, "reason")
    message = text_at(ended, "message")
    if reason in _NOT_STARTED_REASONS:
        return PodFailure.SANDBOX, _text("RunContainerError", message)
    ending = f"exit code {int_at(ended, 'exitCode')}"
    if ended and not int_at(ended, "exitCode"):
        ending += ": the kubelet stops the container, as after failed liveness probes"
    if reason not in ("", "Error", "Completed"):
        ending = f"{reason}, {ending}"
    lines = message.strip().splitlines() or [""]
    return PodFailure.CRASHING, _text(ending, _TIMESTAMP.sub("", lines[-1]))


def _text(reason: str, message: str) -> str:
    text = ": ".join(s for s in (reason, " ".join(message.split())) if s)
    return bounded(clean(text), _MOST_MESSAGE_CHARACTERS)
