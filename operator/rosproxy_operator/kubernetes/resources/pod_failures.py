"""Why a proxy's pod does not run, from what the scheduler and the kubelet say of it.

The texts are those of Kubernetes 1.36; the files named are in k8s.io/kubernetes.
"""

import re

from rosproxy.telemetry.text import clean
from rosproxy_operator.kubernetes.resources.api_objects import (
    ContainerStatus,
    ObjectCondition,
    PodStatus,
    Terminated,
)
from rosproxy_operator.kubernetes.resources.model import Stuck
from rosproxy_operator.kubernetes.resources.names import CONTAINER

PORTS_TAKEN = "didn't have free ports for the requested pod ports"
"""``ErrReason`` in pkg/scheduler/framework/plugins/nodeports/node_ports.go; the kubelet gives the
same text with the reason ``NodePorts`` (pkg/kubelet/lifecycle/predicate.go).
"""
_REASON_TRANSIENT = "SchedulerError"
_REASON_PORTS = "NodePorts"
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
_CRASHING = "CrashLoopBackOff"
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
the CNI plugin portmap the port is silently taken over.
"""
_LONGEST = 300


def stuck(status: PodStatus) -> tuple[Stuck | None, str]:
    """Why a pod does not run, and the same in the words of Kubernetes; None if it does, or may yet.

    The words don't change while the trouble is the same.
    """
    if status.phase == "Failed":
        return _failed(status)
    for condition in status.conditions:
        if condition.type == "PodScheduled" and condition.status == "False":
            return _unscheduled(condition)
    for container in status.container_statuses:
        if container.name == CONTAINER:
            return _waiting(container)
    return None, ""


def stuck_by_event(message: str) -> Stuck:
    """What the message of a FailedCreatePodSandBox event means: PORTS or SANDBOX."""
    low = message.lower()
    return Stuck.PORTS if any(text in low for text in _TAKEN) else Stuck.SANDBOX


def _failed(status: PodStatus) -> tuple[Stuck, str]:
    """The kubelet did not admit the pod, or ended it (``rejectPod`` in pkg/kubelet/kubelet.go)."""
    ports = status.reason == _REASON_PORTS or PORTS_TAKEN in status.message
    return Stuck.PORTS if ports else Stuck.SCHEDULING, _text(status.reason, status.message)


def _unscheduled(condition: ObjectCondition) -> tuple[Stuck | None, str]:
    """The scheduler found no place: reason Unschedulable or SchedulingGated.

    After a SchedulerError, as when a pod of the same name has just been deleted, it tries again by
    itself (``handleSchedulingFailure`` in pkg/scheduler/schedule_one.go).
    """
    reason, message = condition.reason, condition.message
    if reason in ("", _REASON_TRANSIENT):
        return None, ""
    return Stuck.PORTS if PORTS_TAKEN in message else Stuck.SCHEDULING, _text(reason, message)


def _waiting(container: ContainerStatus) -> tuple[Stuck | None, str]:
    """What a container waits for. One that has ended for the second time waits as well.

    The kubelet calls that CrashLoopBackOff only when it looks at the pod again.
    """
    ended, waiting = container.state.terminated, container.state.waiting
    if ended.exit_code and container.restart_count:
        return _crashing(ended)
    if waiting.reason in _IMAGE:
        return Stuck.IMAGE, _image(waiting.reason, waiting.message)
    if waiting.reason == _CRASHING:
        return _crashing(container.last_state.terminated)
    if waiting.reason in _SANDBOX:
        return Stuck.SANDBOX, _text(waiting.reason, waiting.message)
    return None, ""


def _image(reason: str, message: str) -> str:
    bare = _REASON.sub("", _BACK_OFF.sub("", message), count=1)
    return _text("", bare) or reason


def _crashing(ended: Terminated) -> tuple[Stuck, str]:
    """Between two tries to start a container that never ran, the kubelet calls that a crash too."""
    if ended.reason in _NOT_STARTED:
        return Stuck.SANDBOX, _text("RunContainerError", ended.message)
    return Stuck.CRASHING, _crash(ended)


def _crash(ended: Terminated) -> str:
    """How the container ended; the kubelet's own words count the seconds until it is started."""
    lines = ended.message.strip().splitlines() or [""]
    how = f"exit code {ended.exit_code}"
    if ended.reason not in ("", "Error", "Completed"):
        how = f"{ended.reason}, {how}"
    return _text(how, _STAMP.sub("", lines[-1]))


def _text(reason: str, message: str) -> str:
    text = clean(": ".join(one for one in (reason, " ".join(message.split())) if one))
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1]}…"
