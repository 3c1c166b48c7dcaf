"""Proxies that do not run, in the words of the scheduler and the kubelet."""

from typing import Any

import pytest

from rosproxy_operator.kubernetes.resources.cluster import PodFailure
from rosproxy_operator.kubernetes.resources.pod_failures import pod_failure as stuck_by_status
from rosproxy_operator.kubernetes.resources.pod_failures import stuck_by_event

NO_PORTS = (
    "0/2 nodes are available: 1 node(s) didn't have free ports for the requested pod ports, 1 "
    "node(s) didn't satisfy plugin(s) [NodeAffinity]. preemption: 0/2 nodes are available: 1 No "
    "preemption victims found for incoming pod, 1 Preemption is not helpful for scheduling."
)


def stuck(obj: dict[str, Any]) -> tuple[PodFailure | None, str]:
    return stuck_by_status(obj["status"])


def scheduled(reason: str, message: str) -> dict[str, Any]:
    condition = {
        "type": "PodScheduled",
        "status": "False",
        "reason": reason,
        "message": message,
    }
    return {"status": {"phase": "Pending", "conditions": [condition]}}


def waiting(why: str, said: str = "", **last: Any) -> dict[str, Any]:
    status = {
        "name": "proxy",
        "state": {"waiting": {"reason": why, "message": said}},
        "lastState": {"terminated": last} if last else {},
    }
    return {"status": {"phase": "Running", "containerStatuses": [status]}}


@pytest.mark.parametrize(
    ("reason", "message", "why"),
    [
        ("Unschedulable", NO_PORTS, PodFailure.PORTS),
        ("Unschedulable", "0/2 nodes are available: 1 Insufficient cpu.", PodFailure.SCHEDULING),
        ("SchedulingGated", "Scheduling is blocked due to non-empty gates", PodFailure.SCHEDULING),
    ],
)
def test_the_scheduler_finds_no_place(reason, message, why):
    failure, text = stuck(scheduled(reason, message))

    assert failure is why
    assert text.startswith(f"{reason}: {message[:40]}")
    assert len(text) <= 300


def test_an_error_that_the_scheduler_gets_over_by_itself_is_no_trouble():
    assert stuck(scheduled("SchedulerError", "Precondition failed: UID in precondition")) == (
        None,
        "",
    )


@pytest.mark.parametrize(
    ("reason", "message", "why"),
    [
        (
            "NodePorts",
            "Pod was rejected: Predicate NodePorts failed: node(s) didn't have free ports for the "
            "requested pod ports",
            PodFailure.PORTS,
        ),
        (
            "OutOfcpu",
            "Pod was rejected: Node didn't have enough resource: cpu",
            PodFailure.SCHEDULING,
        ),
        ("UnexpectedAdmissionError", "Pod was rejected: Allocate failed", PodFailure.SCHEDULING),
        ("SysctlForbidden", 'Pod was rejected: forbidden sysctl: "x"', PodFailure.SCHEDULING),
        ("Evicted", "The node was low on resource: memory.", PodFailure.SCHEDULING),
        ("", "", PodFailure.SCHEDULING),
    ],
)
def test_the_kubelet_does_not_admit_it(reason, message, why):
    failure, text = stuck({"status": {"phase": "Failed", "reason": reason, "message": message}})

    assert failure is why
    assert text == (f"{reason}: {message}" if reason else "")


@pytest.mark.parametrize(
    ("reason", "why"),
    [
        ("ErrImagePull", PodFailure.IMAGE),
        ("ImagePullBackOff", PodFailure.IMAGE),
        ("ErrImageNeverPull", PodFailure.IMAGE),
        ("InvalidImageName", PodFailure.IMAGE),
        ("ImageInspectError", PodFailure.IMAGE),
        ("CrashLoopBackOff", PodFailure.CRASHING),
        ("CreateContainerConfigError", PodFailure.SANDBOX),
        ("CreateContainerError", PodFailure.SANDBOX),
        ("RunContainerError", PodFailure.SANDBOX),
        ("ContainerCreating", None),
        ("PodInitializing", None),
        ("", None),
    ],
)
def test_what_a_container_waits_for(reason, why):
    assert stuck(waiting(reason))[0] is why


def test_an_image_that_can_not_be_had_is_told_in_the_same_words_at_each_try():
    error = 'failed to pull and unpack image "registry.example/rosproxy:9": not found'

    texts = {
        stuck(waiting("ErrImagePull", error))[1],
        stuck(
            waiting(
                "ImagePullBackOff",
                f'Back-off pulling image "registry.example/rosproxy:9": ErrImagePull: {error}',
            )
        )[1],
    }

    assert texts == {error}


def test_a_crash_is_told_by_how_it_ended_and_not_by_the_wait():
    back_off = "back-off {} restarting failed container=proxy pod=rosproxy-arm-node1_robots(1)"
    error = "2026-11-21 14:00:00,123 ERROR   --port-range: port 11312 lies in it\n"

    texts = {
        stuck(
            waiting(
                "CrashLoopBackOff",
                back_off.format(time),
                exitCode=2,
                reason="Error",
                message=f"starting\n{error}",
            )
        )[1]
        for time in ("10s", "20s")
    }

    assert texts == {"exit code 2: ERROR --port-range: port 11312 lies in it"}


@pytest.mark.parametrize(
    ("code", "restarts", "why"),
    [(2, 1, PodFailure.CRASHING), (2, 0, None), (0, 1, None)],
)
def test_a_container_that_has_ended_again_and_is_not_yet_called_crashing(code, restarts, why):
    status = {
        "name": "proxy",
        "restartCount": restarts,
        "state": {"terminated": {"exitCode": code, "reason": "Error", "message": "bad\n"}},
    }
    obj = {"status": {"phase": "Running", "containerStatuses": [status]}}

    assert stuck(obj) == (why, "exit code 2: bad" if why else "")


LONG = {"startedAt": "2026-11-21T14:00:00Z", "finishedAt": "2026-11-21T14:01:00Z"}
SHORT = {"startedAt": "2026-11-21T14:00:00Z", "finishedAt": "2026-11-21T14:00:40Z"}


@pytest.mark.parametrize(
    ("code", "ran", "why"),
    [(0, LONG, None), (0, SHORT, PodFailure.CRASHING), (2, LONG, PodFailure.CRASHING)],
)
def test_a_container_that_the_kubelet_has_stopped_does_not_crash(code, ran, why):
    """A proxy ends with exit code 0 if the kubelet stops the container, for example for a new
    image.
    """
    failure, text = stuck(waiting("CrashLoopBackOff", exitCode=code, reason="Completed", **ran))

    assert failure is why
    assert ("the kubelet stops the container" in text) == (code == 0 and why is not None)


@pytest.mark.parametrize(("ran", "why"), [(LONG, None), (SHORT, PodFailure.CRASHING)])
def test_a_container_that_is_killed_after_a_while_is_no_crash_yet(ran, why):
    ended = {"exitCode": 137, "reason": "Error", **ran}
    status = {"name": "proxy", "restartCount": 3, "state": {"terminated": ended}}

    assert stuck({"status": {"containerStatuses": [status]}})[0] is why


def test_a_program_that_can_not_be_started_is_told_in_the_same_words_between_tries():
    error = "failed to create containerd task: unable to start container process: exec: nosuch"

    now = stuck(waiting("RunContainerError", error))
    between = stuck(
        waiting(
            "CrashLoopBackOff", "back-off 10s", exitCode=128, reason="StartError", message=error
        )
    )

    assert now == between == (PodFailure.SANDBOX, f"RunContainerError: {error}")


@pytest.mark.parametrize(
    ("status", "text"),
    [
        (waiting("ImagePullBackOff", 'Back-off pulling image "a:1"'), "ImagePullBackOff"),
        (
            waiting("CrashLoopBackOff", exitCode=137, reason="OOMKilled"),
            "OOMKilled, exit code 137",
        ),
    ],
)
def test_what_has_no_message_is_told_by_the_reason(status, text):
    assert stuck(status)[1] == text


@pytest.mark.parametrize(
    "status",
    [
        {},
        {"phase": "Pending"},
        {"phase": "Running", "containerStatuses": [{"name": "proxy", "state": {"running": {}}}]},
        {
            "phase": "Running",
            "containerStatuses": [
                {"name": "mesh", "state": {"waiting": {"reason": "CrashLoopBackOff"}}}
            ],
        },
        {"phase": "Pending", "conditions": [{"type": "PodScheduled", "status": "True"}]},
        {"phase": "Pending", "conditions": [{"type": "PodScheduled", "status": "False"}]},
    ],
)
def test_what_is_not_stuck(status):
    assert stuck({"status": status}) == (None, "")


@pytest.mark.parametrize(
    ("message", "why"),
    [
        (
            "Failed to create pod sandbox: rpc error: code = Unknown desc = cannot open hostport "
            "11400 for pod: listen tcp4 :11400: bind: address already in use",
            PodFailure.PORTS,
        ),
        (
            "Failed to create pod sandbox: rpc error: Bind for 0.0.0.0:11400 failed: port is "
            "already allocated",
            PodFailure.PORTS,
        ),
        (
            "Failed to create pod sandbox: rpc error: code = Unknown desc = failed to setup "
            'network for sandbox "1": plugin type="ptp" failed (add): no IP addresses available',
            PodFailure.SANDBOX,
        ),
    ],
)
def test_sandboxes_that_can_not_be_made(message, why):
    assert stuck_by_event(message) is why
