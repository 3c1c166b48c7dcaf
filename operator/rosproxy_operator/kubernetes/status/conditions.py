"""The conditions of a RosProxy (``metav1.Condition``)."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from rosproxy.telemetry.text import plural
from rosproxy_operator.common.problem import Problem, bounded
from rosproxy_operator.kubernetes.resources.model import (
    ClusterFinding,
    Json,
    NodeState,
    RosProxy,
    Stuck,
)
from rosproxy_operator.kubernetes.resources.names import INJECT
from rosproxy_operator.kubernetes.resources.values import parts, word
from rosproxy_operator.kubernetes.status.findings import CONFLICT, EXHAUSTED, NO_MASTER

READY, PORTS, MASTER, DEGRADED = "Ready", "PortsAllocated", "MasterReachable", "Degraded"
LONGEST = 1024
"""Characters of a message."""
_REASON = re.compile(r"[A-Za-z]([A-Za-z0-9_,:]{0,1022}[A-Za-z0-9_])?")
_NO_PODS = "NoPods"


@dataclass(frozen=True, slots=True)
class Condition:
    """A condition without its times. ``status`` is True, False or Unknown."""

    type: str
    status: str
    reason: str
    message: str


def serving(state: NodeState) -> bool:
    """Whether a node's proxy has its ports and works.

    One that has not been asked since the operator started counts if the kubelet finds it ready.
    """
    proxy = state.proxy
    if proxy is None or proxy.pod.deleting or not proxy.ready or proxy.stuck is not None:
        return False
    return state.answer is None or state.answer.answered


def verdicts(
    rosproxy: RosProxy,
    states: Sequence[NodeState],
    problems: Sequence[Problem],
    nodes: int,
    former: Json,
) -> tuple[Condition, ...]:
    """All conditions of a RosProxy that can be read.

    ``nodes`` is how many ROS nodes there are; ``former`` is the status as it was.
    """
    wanted = [state for state in states if state.pods]
    degraded = Condition(DEGRADED, "False", "AsExpected", "nothing is wrong")
    if problems:
        lines = "; ".join(map(one_line, problems))
        degraded = Condition(DEGRADED, "True", reason_of(problems[0]), lines)
    return (
        _ready(rosproxy, wanted, problems, nodes),
        _ports(wanted, problems),
        _master(states, problems, former),
        degraded,
    )


def conditions(
    judged: Iterable[Condition], former: Json, generation: int, stamp: str
) -> list[dict[str, object]]:
    """Conditions as the API server takes them.

    One whose status is the same as in the ``former`` status keeps its time; the time of the others
    is ``stamp``, in RFC 3339.
    """
    return [
        {
            "type": one.type,
            "status": one.status,
            "observedGeneration": generation,
            "lastTransitionTime": _since(former, one, stamp),
            "reason": one.reason if _REASON.fullmatch(one.reason) else "Problem",
            "message": bounded(one.message, LONGEST),
        }
        for one in judged
    ]


def condition(status: Json, type: str) -> Json:
    """A condition in a status, empty if it is not there."""
    found = (one for one in parts(status, "conditions") if one.get("type") == type)
    return next(found, {})


def read(was: Json) -> Condition:
    """A condition out of a status."""
    return Condition(*(word(was, key) for key in ("type", "status", "reason", "message")))


def one_line(problem: Problem) -> str:
    """A problem in one line."""
    return f"{problem.subject}: {problem.text}"


def reason_of(problem: Problem) -> str:
    """A problem's reason."""
    return problem.reason if isinstance(problem, ClusterFinding) else "Problem"


def _since(former: Json, verdict: Condition, stamp: str) -> str:
    was = condition(former, verdict.type)
    return (word(was, "lastTransitionTime") if was.get("status") == verdict.status else "") or stamp


def _ready(
    rosproxy: RosProxy, wanted: Sequence[NodeState], problems: Sequence[Problem], nodes: int
) -> Condition:
    if not wanted:
        fix = "give pods the labels that spec.podSelector asks for"
        if rosproxy.spec.pod_selector is None:
            fix = f"label pods with {INJECT}=true"
        return Condition(READY, "True", _NO_PODS, f"no pod is selected: {fix}")
    waiting = [state for state in wanted if not serving(state)]
    if not waiting:
        text = f"{len(wanted)} of {len(wanted)} proxies serve {plural(nodes, 'ROS node')}"
        return Condition(READY, "True", "Serving", text)
    blocking = [problem for problem in problems if problem.fatal and not _of_pod(problem)]
    if blocking:
        return Condition(READY, "False", reason_of(blocking[0]), one_line(blocking[0]))
    name, proxy = waiting[0].name, waiting[0].proxy
    doing = "its proxy is being created"
    if proxy is not None and not proxy.pod.deleting:
        doing = f"its proxy {proxy.pod.id.name} is starting"
    return Condition(READY, "False", "ProxiesStarting", f"node {name}: {doing}")


def _of_pod(problem: Problem) -> bool:
    """Whether it concerns one of the users' pods, without which the others are served."""
    about = problem.about if isinstance(problem, ClusterFinding) else None
    return about is not None and about.kind == "Pod"


def _ports(wanted: Sequence[NodeState], problems: Sequence[Problem]) -> Condition:
    if not wanted:
        return Condition(PORTS, "True", _NO_PODS, "no pod is selected, so no ports are needed")
    lacking = [state for state in wanted if state.range is None]
    refused = [one for one in wanted if one.proxy is not None and one.proxy.stuck is Stuck.PORTS]
    if not lacking and not refused:
        return Condition(PORTS, "True", "Allocated", "every node with selected pods has its ports")
    reason = CONFLICT if refused else EXHAUSTED
    lines = [one_line(one) for one in problems if reason_of(one) in (CONFLICT, EXHAUSTED)]
    names = ", ".join(state.name for state in (*refused, *lacking))
    return Condition(PORTS, "False", reason, "; ".join(lines) or f"node {names}: no ports yet")


def _master(states: Sequence[NodeState], problems: Sequence[Problem], former: Json) -> Condition:
    """Of proxies that are not asked yet nothing is known: what was so far holds on."""
    proxies = [state for state in states if state.proxy is not None]
    answers = [one.answer for one in proxies if one.answer is not None and one.answer.answered]
    if not all(answer.master_up for answer in answers):
        lines = [one_line(one) for one in problems if reason_of(one) == NO_MASTER]
        return Condition(MASTER, "False", NO_MASTER, "; ".join(lines) or "it is not reached")
    if not proxies:
        return Condition(MASTER, "Unknown", "NoProxies", "there is no proxy that could tell")
    if len(answers) == len(proxies):
        return Condition(MASTER, "True", "Reached", "every proxy reaches the master")
    was = condition(former, MASTER)
    return read(was) if was else Condition(MASTER, "Unknown", "NotAsked", "no proxy has told yet")
