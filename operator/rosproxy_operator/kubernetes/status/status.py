"""The status of a RosProxy."""

from collections.abc import Sequence
from typing import TypeGuard

from rosproxy.telemetry.text import clean, shorten
from rosproxy_operator.common.problem import Problem, bounded
from rosproxy_operator.kubernetes.resources.model import (
    InvalidRosProxy,
    Json,
    NodeState,
    ProxyReport,
    ProxyService,
    RosProxy,
)
from rosproxy_operator.kubernetes.resources.names import master_uri
from rosproxy_operator.kubernetes.resources.values import number, parts, word
from rosproxy_operator.kubernetes.status.conditions import (
    DEGRADED,
    READY,
    Condition,
    conditions,
    one_line,
    read,
    serving,
    verdicts,
)
from rosproxy_operator.kubernetes.status.findings import findings, invalid_finding, of_node

__all__ = ["findings", "invalid_finding", "status_of", "status_of_invalid"]

MOST_NODES = 200
"""Nodes that are told one by one. The API server takes an object of about a megabyte."""
MOST_NAMES = 50
"""Names of ROS nodes that are told of each."""
MOST_NAMES_OF_ALL = 4000
_NAME = 100
_MESSAGE = 300
_PORTS = 400
_INVALID = "Invalid"


def status_of(
    rosproxy: RosProxy,
    states: tuple[NodeState, ...],
    problems: tuple[Problem, ...],
    service: ProxyService | None,
    master: str,
    stamp: str,
) -> Json:
    """The status of a RosProxy, as in the CRD.

    What only proxies can tell stays as it was until they have been asked, so that an operator that
    is started changes nothing.

    ``problems`` are all that is wrong with it: `findings`, those of its pods, and others.
    ``service`` is None if it is yet to be made. ``master`` is the URI of the real master as the
    proxies use it, empty if it is not known; ``stamp`` the time for conditions that change, in
    RFC 3339.
    """
    former = rosproxy.status
    shown = _shown_nodes(states)
    names = min(MOST_NAMES, MOST_NAMES_OF_ALL // max(len(shown), 1))
    lines = [_line(rosproxy, state, names) for state in shown]
    nodes = sum(number(line, "rosNodes") for line in lines)
    wanted = [state for state in states if state.pods]
    judged = verdicts(rosproxy, states, problems, nodes, former)
    # The former one as long as there is no Service: it is to be had again.
    uri = word(former, "masterURI")
    if service is not None and service.cluster_ip:
        uri = master_uri(service.cluster_ip)
    return {
        "observedGeneration": rosproxy.generation,
        "master": master,
        "masterURI": uri,
        "nodes": len(wanted),
        "proxies": f"{sum(map(serving, wanted))}/{len(wanted)}",
        "rosNodes": nodes,
        "topics": _topics(states, former),
        "ports": _ports(states),
        "perNode": lines,
        "conditions": conditions(judged, former, rosproxy.generation, stamp),
    }


def status_of_invalid(rosproxy: InvalidRosProxy, stamp: str) -> Json:
    """The status of a RosProxy that can't be read: as it was, but not Ready.

    What it has goes on as it is, so that the other conditions stay.
    """
    former, text = rosproxy.status, rosproxy.text
    judged = [
        Condition(READY, "False", _INVALID, text),
        *(one for one in map(read, parts(former, "conditions")) if one.type not in _OVERRULED),
        Condition(DEGRADED, "True", _INVALID, text),
    ]
    return {
        **former,
        "observedGeneration": rosproxy.generation,
        "conditions": conditions(judged, former, rosproxy.generation, stamp),
    }


_OVERRULED = (READY, DEGRADED)


def _shown_nodes(states: Sequence[NodeState]) -> list[NodeState]:
    """The nodes to be told, by name; those without pods are the first to be left out."""
    first = sorted(states, key=lambda one: (not one.pods, one.proxy is None, one.name))
    return sorted(first[:MOST_NODES], key=lambda one: one.name)


def _line(rosproxy: RosProxy, state: NodeState, names: int) -> dict[str, object]:
    proxy, wrong = state.proxy, next(of_node(rosproxy, state), None)
    line = {
        "name": state.name,
        "advertiseHost": state.advertise_host,
        "ports": str(state.range or ""),
        "proxy": proxy.pod.id.name if proxy else "",
        "ready": serving(state),
        "pods": len(state.pods),
        **_ros(state, names, rosproxy.status),
        "message": bounded(one_line(wrong), _MESSAGE) if wrong else "",
    }
    return {key: value for key, value in line.items() if value != ""}


def _ros(state: NodeState, most: int, former: Json) -> dict[str, object]:
    """What a proxy tells of its ROS nodes, now or when it was asked last."""
    if _has_answered(state.answer):
        names = sorted({name for found in state.answer.nodes.values() for name in found})
        shown = [shorten(clean(name), _NAME) for name in names[:most]]
        return {"rosNodes": len(names), "names": shown, "topics": len(state.answer.topics)}
    lines = parts(former, "perNode") if state.proxy is not None else ()
    was = next((line for line in lines if line.get("name") == state.name), {})
    return {
        "rosNodes": number(was, "rosNodes"),
        "names": list(was.get("names") or ()),
        "topics": number(was, "topics"),
    }


def _has_answered(answer: ProxyReport | None) -> TypeGuard[ProxyReport]:
    return answer is not None and answer.answered


def _topics(states: Sequence[NodeState], former: Json) -> int:
    answers = [state.answer for state in states if state.proxy is not None]
    known = len({topic for answer in answers if _has_answered(answer) for topic in answer.topics})
    return known if all(map(_has_answered, answers)) else max(known, number(former, "topics"))


def _ports(states: Sequence[NodeState]) -> str:
    """The one range of all nodes that need one, or each node's."""
    given = {one.name: str(one.range) for one in states if one.range and (one.pods or one.proxy)}
    if len(set(given.values())) <= 1:
        return next(iter(given.values()), "")
    return bounded(", ".join(f"{name}: {ports}" for name, ports in sorted(given.items())), _PORTS)
