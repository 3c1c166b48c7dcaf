"""A RosProxy's status as tests look at it."""

from typing import Any

from rosproxy_operator.common.problem import Problem
from rosproxy_operator.kubernetes.resources.model import (
    Json,
    Name,
    NodeState,
    ProxyService,
    RosProxy,
)
from rosproxy_operator.kubernetes.status.status import findings, status_of
from tests.unit.operator.kubernetes.builders_api import CLUSTER_IP, ROBOT, STAMP, rosproxy

SERVICE = ProxyService(Name("robots", "arm"), "uid-arm", "uid-service", CLUSTER_IP, "f")


def status(
    *states: NodeState, of: RosProxy | None = None, more: tuple[Problem, ...] = (), **given: Any
) -> Json:
    """The status that follows from some nodes; ``more`` problems besides those that they have."""
    one = of or rosproxy()
    problems = (*findings(one, states, given.get("failures", ())), *more)
    stamp = given.get("stamp", STAMP)
    return status_of(one, states, problems, given.get("service", SERVICE), ROBOT, stamp)


def condition(found: Json, type: str) -> Any:
    (one,) = [one for one in found["conditions"] if one["type"] == type]
    return one


def judged(found: Json, type: str) -> tuple[str, str]:
    one = condition(found, type)
    return one["status"], one["reason"]


def message(found: Json, type: str = "Ready") -> str:
    return str(condition(found, type)["message"])
