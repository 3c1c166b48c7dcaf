"""Findings about the nodes and proxies of a RosProxy.

The text of a finding must not change while the problem lasts: each new text is a new Event.
"""

from collections.abc import Iterable, Iterator, Mapping

from rosproxy.shared.documents.setup_rules import RANGE
from rosproxy.shared.output.text import clean
from rosproxy_operator.common.problem import (
    CONFLICT,
    LAN_RELAY_STUCK,
    NOT_ADMITTED,
    REFUSES,
    SILENT,
    STUCK,
    Fault,
    ends_again,
    silent,
)
from rosproxy_operator.kubernetes.resources.cluster import (
    HelperPod,
    PodFailure,
    ProxyPod,
    ProxyReport,
    RosProxyOnNode,
)
from rosproxy_operator.kubernetes.resources.model import (
    ClusterFinding,
    InvalidRosProxy,
    Name,
    Pod,
    Reference,
    RosProxy,
)
from rosproxy_operator.kubernetes.resources.names import ADMIN_PORT, KIND
from rosproxy_operator.kubernetes.status.range_texts import no_way_in
from rosproxy_operator.kubernetes.status.refusal_fixes import (
    admission_fix,
    image_fix,
    scheduling_fix,
)

# Reasons of findings, and of the conditions that repeat the findings, beside the common reasons.
NO_MASTER = "MasterUnreachable"
NO_WAY_IN = "PortsUnreachable"
NO_PEER = "PeerUnreachable"
NO_SITE = "SiteUnreachable"
WARNS = "ProxyWarns"
_MOST_TEXT_CHARACTERS = 600
_OF_ZENOH = {
    "zenoh peer ": NO_PEER,
    "zenoh hub ": "HubRefused",
    "zenoh link ": NO_SITE,
    "zenoh file ": "LinkCertificate",
}
"""The reason for a problem of rmw_zenoh, by its beginning (rosproxy.zenoh.findings)."""
_UNRESOLVED = "can't be resolved"
"""Part of the error of a proxy about a host name (rosproxy.net.http_client)."""


def findings(
    rosproxy: RosProxy, states: Iterable[RosProxyOnNode], failures: Mapping[Name, str]
) -> tuple[ClusterFinding, ...]:
    """The findings about failed actions, then about the nodes and proxies of a RosProxy.

    A finding with ``about`` becomes an Event. ``failures`` are the errors of the API server, by the
    object of the action.
    """
    problems = [_refused(rosproxy, id, text) for id, text in failures.items()]
    for state in sorted(states, key=lambda s: s.name):
        problems.extend(node_findings(rosproxy, state))
    return tuple(dict.fromkeys(problems))


def node_findings(rosproxy: RosProxy, state: RosProxyOnNode) -> list[ClusterFinding]:
    """The findings about a node and its pods: an obstacle, then fatal findings, then the rest.

    Findings that keep the node from being served are fatal. The status of a node has the first.
    """
    return sorted(_node_findings(rosproxy, state), key=lambda finding: not finding.fatal)


def _node_findings(rosproxy: RosProxy, state: RosProxyOnNode) -> Iterator[ClusterFinding]:
    if state.obstacle is not None:
        fault = Fault(state.obstacle.text, state.obstacle.fix)
        yield _finding(rosproxy, f"node {state.name}", fault, state.obstacle.reason)
    relay = state.lan_relay
    if relay is not None and relay.stuck is not None and not relay.pod.deleting:
        yield _lan_relay_stuck(rosproxy, relay)
    proxy = state.proxy
    if proxy is None or proxy.pod.deleting:
        return
    check = state.image_check
    has_failed = check is not None and (check.stuck is not None or check.pod.phase == "Failed")
    if check is not None and has_failed and not check.pod.deleting:
        yield _unusable(rosproxy, check, proxy)
    if proxy.stuck is not None:
        yield _stuck(rosproxy, proxy, proxy.stuck)
    else:
        yield from _answered(rosproxy, state, proxy)


def finding(
    of: RosProxy | InvalidRosProxy,
    reason: str,
    fault: Fault,
    fatal: bool = False,
    subject: str = "",
) -> ClusterFinding:
    """A finding about a RosProxy or a ``subject`` of the RosProxy, with an Event."""
    subject = subject or f"rosproxy {of.id}"
    about = Reference(KIND, of.id, of.uid)
    return ClusterFinding(subject, *fault, fatal=fatal, reason=reason, of=of.id, about=about)


def pod_finding(
    pod: Pod, rosproxy: RosProxy, reason: str, fault: Fault, fatal: bool = True
) -> ClusterFinding:
    """A finding about a pod that a RosProxy selects, with an Event on the pod."""
    subject = f"pod {pod.id}"
    about = Reference("Pod", pod.id, pod.uid)
    return ClusterFinding(subject, *fault, fatal=fatal, reason=reason, of=rosproxy.id, about=about)


def _finding(
    rosproxy: RosProxy, subject: str, fault: Fault, reason: str, fatal: bool = True
) -> ClusterFinding:
    """A finding of bounded length."""
    short = fault.shortened(_MOST_TEXT_CHARACTERS)
    return finding(rosproxy, reason, short, fatal=fatal, subject=subject)


def proxy_subject(proxy: ProxyPod) -> str:
    """The subject of a finding about a proxy."""
    return f"proxy {proxy.pod.id.name} on node {proxy.node}"


def _stuck(rosproxy: RosProxy, proxy: ProxyPod, cause: PodFailure) -> ClusterFinding:
    id = proxy.pod.id
    error = proxy.message
    command = f"kubectl -n {id.namespace} describe pod {id.name}"
    faults = {
        PodFailure.PORTS: Fault(
            f"ports {proxy.range} are not all free on the node ({error}). The operator tries other "
            "ports",
            "Set a spec.portWindow without the ports that other programs use",
        ),
        PodFailure.SCHEDULING: Fault(
            f"the scheduler or the kubelet does not admit the pod ({error})",
            f"{scheduling_fix(error)}. Read {command}",
        ),
        PodFailure.IMAGE: Fault(
            f"the node can't get the image {proxy.image} ({error})", image_fix(error)
        ),
        PodFailure.CRASHING: ends_again(
            error, f"kubectl -n {id.namespace} logs --previous {id.name}"
        ),
        PodFailure.SANDBOX: Fault(f"the node can't start the pod ({error})", f"Read {command}"),
    }
    reason = CONFLICT if cause is PodFailure.PORTS else STUCK
    return _finding(rosproxy, proxy_subject(proxy), faults[cause], reason)


def _unusable(rosproxy: RosProxy, check: HelperPod, proxy: ProxyPod) -> ClusterFinding:
    """The finding that the next image is unusable. The proxy keeps the present image."""
    id = check.pod.id
    if check.stuck is PodFailure.IMAGE:
        text = f"the node can't get the image {check.image} ({check.message})"
        fix = image_fix(check.message)
    elif check.pod.phase == "Failed":
        text = f"the image {check.image} does not run rosproxy ({check.message})"
        fix = (
            "Correct spec.image or the chart's proxy.image. To test the same image again, run "
            f"kubectl -n {id.namespace} delete pod {id.name}"
        )
    else:
        text = f"the pod that tests the image {check.image} does not run ({check.message})"
        fix = f"Read kubectl -n {id.namespace} describe pod {id.name}"
    fault = Fault(f"{text}. So proxy {proxy.pod.id.name} keeps the image {proxy.image}", fix)
    return _finding(rosproxy, f"node {check.node}", fault, "ImageUnusable", fatal=False)


def _lan_relay_stuck(rosproxy: RosProxy, lan_relay: HelperPod) -> ClusterFinding:
    id = lan_relay.pod.id
    text = (
        f"the pod does not run ({lan_relay.message}), so no discovery passes between the LAN and "
        "the proxy"
    )
    fault = Fault(text, f"Read kubectl -n {id.namespace} describe pod {id.name}")
    subject = f"LAN relay {id.name} on node {lan_relay.node}"
    return _finding(rosproxy, subject, fault, LAN_RELAY_STUCK, fatal=False)


def _answered(
    rosproxy: RosProxy, state: RosProxyOnNode, proxy: ProxyPod
) -> Iterator[ClusterFinding]:
    """The findings from the answer of a proxy; none before the operator has asked the proxy."""
    answer = state.answer
    subject = proxy_subject(proxy)
    if answer is None:
        return
    if not answer.answered:
        if proxy.ready:
            fix = (
                "Allow connections from the operator's pods to port "
                f"{ADMIN_PORT} of this pod (NetworkPolicy)"
            )
            # No Event: an operator that reaches no proxy would create an Event for each proxy.
            yield ClusterFinding(subject, *silent(answer.error, fix), reason=SILENT, of=rosproxy.id)
        return
    if answer.refusal:
        yield _finding(rosproxy, subject, Fault(answer.refusal), REFUSES)
    if not answer.master_up:
        fix = _master_remedy(rosproxy, answer.error)
        fault = Fault(f"does not reach the master ({answer.error})", fix)
        yield _finding(rosproxy, subject, fault, NO_MASTER)
    probe = answer.range_probe
    if probe is not None and probe.reached is False:
        yield _finding(rosproxy, subject, no_way_in(state, probe), NO_WAY_IN)
    yield from (_told(rosproxy, subject, problem) for problem in _own_problems(answer))


def _told(rosproxy: RosProxy, subject: str, problem: str) -> ClusterFinding:
    """The finding for a problem that a proxy reports."""
    reason = next((r for begin, r in _OF_ZENOH.items() if problem.startswith(begin)), "")
    if reason:
        return _finding(rosproxy, subject, Fault(problem), reason, fatal=False)
    return ClusterFinding(subject, problem, fatal=False, reason=WARNS, of=rosproxy.id)


def _own_problems(answer: ProxyReport) -> list[str]:
    """The problems that a proxy reports, without problems that the operator finds as well.

    The operator reports the master and the range in findings and conditions of its own.
    """
    known = ["master: "] if not answer.master_up else []
    known += [f"{RANGE}: "] if answer.range_probe else []
    return [problem for problem in answer.problems if not problem.startswith(tuple(known))]


def _master_remedy(rosproxy: RosProxy, error: str) -> str:
    """The fix for a master that does not answer; ``error`` is the text of the proxy."""
    master = rosproxy.spec.master
    if master.service is not None:
        return f"Start roscore behind Service {master.service}, port {master.service_port}"
    if _UNRESOLVED in error:
        return (
            "Correct the host name in spec.master.uri, or set spec.master.address to the IP "
            "address of that host"
        )
    return (
        "Start roscore on the master's host, allow connections from pods to "
        f"{master.uri}, or correct spec.master"
    )


def _refused(rosproxy: RosProxy, id: Name, text: str) -> ClusterFinding:
    message = clean(" ".join(text.split()))
    fix = admission_fix(message, rosproxy)
    problem = "the operator could not create, change or delete this object"
    message = message[: _MOST_TEXT_CHARACTERS - len(f"{problem} (). {fix}")]
    return _finding(rosproxy, str(id), Fault(f"{problem} ({message})", fix), NOT_ADMITTED)
