"""Why a proxy's pod does not run, from what the scheduler and the kubelet say of it.

The texts are those of Kubernetes 1.36; the files named are in k8s.io/kubernetes.
"""

import re
from datetime import datetime

from rosproxy.telemetry.text import clean
from rosproxy_operator.common.problem import bounded
from rosproxy_operator.kubernetes.resources.checks import int_at, submap, submaps, text_at
from rosproxy_operator.kubernetes.resources.cluster import PodFailure
from rosproxy_operator.kubernetes.resources.model import Json
from rosproxy_operator.kubernetes.resources.names import CONTAINER, IMAGE_CHECK, LAN_RELAY

PORTS_TAKEN = "didn't have free ports for the requested pod ports"
"""``ErrReason`` in pkg/scheduler/framework/plugins/nodeports/node_ports.go; the kubelet gives the
same text with the reason ``NodePorts`` (pkg/kubelet/lifecycle/predicate.go).
"""
_IMAGE = frozenset(
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
"""pkg/kubelet/images/types.go, and k8s.io/cri-api, pkg/errors/errors.go."""
_SANDBOX = frozenset(
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
"""pkg/kubelet/kuberuntime/kuberuntime_container.go, pkg/kubelet/container/sync_result.go."""
_NOT_STARTED = ("StartError", "ContainerCannotRun")
"""What containerd and cri-dockerd say of a container whose program could not be started."""
_BACK_OFF = re.compile(r'Back-off pulling image "[^"]*"(: )?')
"""The kubelet puts this before the error of the try before and takes it off again at the next
(pkg/kubelet/images/image_manager.go): the same trouble in other words.
"""
_REASON = re.compile(r"(ErrImagePull|RegistryUnavailable|SignatureValidationFailed): ")
_STAMP = re.compile(r"\d{4}-\d\d-\d\d[T ][\d:.,]+Z? *")
_TAKEN = ("address already in use", "port is already allocated", "cannot open hostport")
"""What container runtimes say that look for listeners on a hostPort: CRI-O and cri-dockerd. With
the CNI plugin portmap the port is silently taken over: its DNAT rules come before the listener.
"""
_LONGEST = 300
_STABLE_AFTER_S = 60.0
"""A container that ran this long and then ended does not end again and again: the liveness probe
fails for the third time after half of it."""


def pod_failure(status: Json) -> tuple[PodFailure | None, str]:
    """Why a pod does not run, and the same in the words of Kubernetes; None if it does, or may yet.

    ``status`` is the pod's. The words don't change while the trouble is the same.
    """
    if text_at(status, "phase") == "Failed":
        return _failed(text_at(status, "reason"), text_at(status, "message"))
    for condition in submaps(status, "conditions"):
        if condition.get("type") == "PodScheduled" and condition.get("status") == "False":
            return _unscheduled(text_at(condition, "reason"), text_at(condition, "message"))
    for container in submaps(status, "containerStatuses"):
        if container.get("name") in (CONTAINER, LAN_RELAY, IMAGE_CHECK):
            return _waiting(container)
    return None, ""


def stuck_by_event(message: str) -> PodFailure:
    """What the message of a FailedCreatePodSandBox event means: PORTS or SANDBOX."""
    low = message.lower()
    return PodFailure.PORTS if any(text in low for text in _TAKEN) else PodFailure.SANDBOX


def _failed(reason: str, message: str) -> tuple[PodFailure, str]:
    """The kubelet did not admit the pod, or ended it (``rejectPod`` in pkg/kubelet/kubelet.go)."""
    ports = reason == "NodePorts" or PORTS_TAKEN in message
    return PodFailure.PORTS if ports else PodFailure.SCHEDULING, _text(reason, message)


def _unscheduled(reason: str, message: str) -> tuple[PodFailure | None, str]:
    """The scheduler found no place: reason Unschedulable or SchedulingGated.

    After a SchedulerError, as when a pod of the same name has just been deleted, it tries again by
    itself (``handleSchedulingFailure`` in pkg/scheduler/schedule_one.go).
    """
    if reason in ("", "SchedulerError"):
        return None, ""
    return PodFailure.PORTS if PORTS_TAKEN in message else PodFailure.SCHEDULING, _text(
        reason, message
    )


def _waiting(container: Json) -> tuple[PodFailure | None, str]:
    """What a container waits for. One that has ended for the second time waits as well.

    The kubelet calls that CrashLoopBackOff only when it looks at the pod again. A proxy ends with
    exit code 0 only if the kubelet stops it, as for another image.
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
    if reason in _IMAGE:
        bare = _REASON.sub("", _BACK_OFF.sub("", message), count=1)
        return PodFailure.IMAGE, _text("", bare) or reason
    if reason in _SANDBOX:
        return PodFailure.SANDBOX, _text(reason, message)
    return None, ""


def _was_stable(ended: Json) -> bool:
    """Whether a container ran for a while before it ended."""
    try:
        started, finished = (
            datetime.fromisoformat(text_at(ended, key)) for key in ("startedAt", "finishedAt")
        )
        return (finished - started).total_seconds() >= _STABLE_AFTER_S
    except (ValueError, TypeError, OverflowError):
        return False


def _crashing(ended: Json) -> tuple[PodFailure, str]:
    """How the container ended; the kubelet's own words count the seconds until it is started.

    Between two tries to start a container that never ran, the kubelet calls that a crash too.
    """
    reason = text_at(ended, "reason")
    message = text_at(ended, "message")
    if reason in _NOT_STARTED:
        return PodFailure.SANDBOX, _text("RunContainerError", message)
    ending = f"exit code {int_at(ended, 'exitCode')}"
    if ended and not int_at(ended, "exitCode"):
        ending += ": the kubelet stops the container, as after failed liveness probes"
    if reason not in ("", "Error", "Completed"):
        ending = f"{reason}, {ending}"
    lines = message.strip().splitlines() or [""]
    return PodFailure.CRASHING, _text(ending, _STAMP.sub("", lines[-1]))


def _text(reason: str, message: str) -> str:
    text = ": ".join(s for s in (reason, " ".join(message.split())) if s)
    return bounded(clean(text), _LONGEST)
