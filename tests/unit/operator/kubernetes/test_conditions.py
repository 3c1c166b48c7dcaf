"""The conditions of a RosProxy: what is wrong, and what to do."""

import pytest
from msgspec.structs import replace

from rosproxy.shared.documents.status_document import RangeProbeStatus
from rosproxy_operator.common.problem import bounded
from rosproxy_operator.kubernetes.proxies.proxy_report import no_answer
from rosproxy_operator.kubernetes.resources.cluster import Obstacle, PodFailure, ProxyReport
from rosproxy_operator.kubernetes.resources.model import ClusterFinding, MasterSpec, Name, Reference
from rosproxy_operator.kubernetes.status.findings import findings
from rosproxy_operator.proxy_spec.spec import ProxySpec
from tests.unit.operator.kubernetes.builders_api import (
    answer,
    condition,
    judged,
    message,
    proxy,
    rosproxy,
    state,
    status,
    stuck_proxy,
)

NAME = "rosproxy-arm-node1-"
REFUSED = Name("robots", "rosproxy-arm-node1-1")


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (state(proxy=None, answer=None), "node node1: the proxy is being created"),
        (
            state(proxy=proxy(pod={"deleting": True}), answer=None),
            "node node1: the proxy is being created",
        ),
        (
            state(proxy=proxy(ready=False), answer=None),
            f"node node1: proxy {proxy().pod.id.name} is starting",
        ),
    ],
)
def test_a_proxy_that_is_yet_to_come_is_no_problem(given, said):
    rosproxy_status = status(given, state("node2"))

    assert judged(rosproxy_status, "Ready") == ("False", "ProxiesStarting")
    assert message(rosproxy_status) == said
    assert judged(rosproxy_status, "Degraded") == ("False", "AsExpected")
    assert rosproxy_status["proxies"] == "1/2"


@pytest.mark.parametrize(
    ("why", "reason", "said"),
    [
        (
            PodFailure.PORTS,
            "PortConflict",
            "ports 11400-11431 are not all free on the node (because)",
        ),
        (PodFailure.SCHEDULING, "ProxyStuck", "does not admit the pod (because). Make room"),
        (PodFailure.IMAGE, "ProxyStuck", "can't get the image rosproxy:1 (because). Load the"),
        (
            PodFailure.CRASHING,
            "ProxyStuck",
            "kubectl -n robots logs --previous rosproxy-arm-node1-",
        ),
        (PodFailure.SANDBOX, "ProxyStuck", "kubectl -n robots describe pod rosproxy-arm-node1-"),
    ],
)
def test_a_proxy_that_does_not_run(why, reason, said):
    rosproxy_status = status(state(proxy=stuck_proxy(why), answer=None))

    assert judged(rosproxy_status, "Ready") == ("False", reason)
    assert message(rosproxy_status).startswith(f"proxy {NAME}")
    assert said in message(rosproxy_status)
    assert judged(rosproxy_status, "Degraded") == ("True", reason)
    assert said[:20] in rosproxy_status["perNode"][0]["message"]
    ports = ("False", "PortConflict") if why is PodFailure.PORTS else ("True", "Allocated")
    assert judged(rosproxy_status, "PortsAllocated") == ports


def test_a_node_without_ports():
    text = "no 32 free ports in a row between 11400 and 11410. Widen spec.portWindow"
    rosproxy_status = status(
        state(range=None, proxy=None, answer=None, obstacle=Obstacle("PortsExhausted", text))
    )

    for type in ("Ready", "PortsAllocated"):
        assert judged(rosproxy_status, type) == ("False", "PortsExhausted")
        assert message(rosproxy_status, type) == f"node node1: {text}"
    assert rosproxy_status["perNode"][0]["message"] == f"node node1: {text}"
    assert "ports" not in rosproxy_status["perNode"][0]


def test_another_reason_for_a_node_without_proxy():
    obstacle = Obstacle("NodeNotReady", "is not ready")
    rosproxy_status = status(state(proxy=None, answer=None, obstacle=obstacle))

    assert judged(rosproxy_status, "Ready") == ("False", "NodeNotReady")


def test_the_master_is_not_reached():
    down = ProxyReport(True, False, "refused", problems=("master: refused", "/a: hangs"))
    rosproxy_status = status(state("node2"), state(proxy=proxy(ready=False), answer=down))

    assert judged(rosproxy_status, "MasterReachable") == ("False", "MasterUnreachable")
    assert judged(rosproxy_status, "Ready") == ("False", "MasterUnreachable")
    assert "(refused). Start roscore on the master's host" in message(rosproxy_status)
    assert message(rosproxy_status, "Degraded").count("refused") == 1
    assert "/a: hangs" in message(rosproxy_status, "Degraded")


def test_a_master_whose_name_is_unknown_needs_another_name_or_an_address():
    """The advice was to start roscore, which ran."""
    error = "http://robto:11311: host name robto can't be resolved"
    down = ProxyReport(True, False, error)
    text = message(status(state(answer=down)), "MasterReachable")

    assert (
        f"({error}). Correct the host name in spec.master.uri, or set spec.master.address" in text
    )
    assert "roscore" not in text


def test_a_master_in_the_cluster_is_told_by_its_service():
    of = rosproxy(master=MasterSpec(service=Name("robots", "roscore")))
    down = state(proxy=proxy(ready=False), answer=ProxyReport(True, False, "refused"))

    assert "Start roscore behind Service robots/roscore, port 11311" in message(status(down, of=of))


def test_a_proxy_that_does_not_answer_the_controller():
    rosproxy_status = status(state(answer=no_answer("timed out")))

    assert judged(rosproxy_status, "Ready") == ("False", "ProxyUnreachable")
    assert "(timed out). Allow connections from the operator's pods to port 11312" in message(
        rosproxy_status
    )
    assert judged(rosproxy_status, "MasterReachable") == ("Unknown", "NotAsked")


@pytest.mark.parametrize(
    ("from_proxy", "from_master", "cause", "fix"),
    [
        ("refused", "missed", "nothing listens there", "(CNI: the plug-in portmap)"),
        ("silent", "missed", "there is no answer", "the node's firewall"),
        ("ok", "missed", "the master's machine does not", "as the master's machine sees it"),
        ("stranger", "unknown", "another program answers there", "spec.portWindow"),
        ("of a later release", "missed", "the test failed", "portmap"),
    ],
)
def test_ports_that_outside_does_not_reach(from_proxy, from_master, cause, fix):
    probe = RangeProbeStatus(False, from_proxy, from_master, "tcp")
    said = ("published range: 192.0.2.11, port 11400: docker run -p", "/a: hangs")
    dead = answer("/a", range_probe=probe, problems=said)
    rosproxy_status = status(state("node2"), state(answer=dead))

    assert judged(rosproxy_status, "PortsReachable") == ("False", "PortsUnreachable")
    text = message(rosproxy_status, "PortsReachable")
    proxy_name = f"proxy {proxy().pod.id.name} on node node1"
    assert text.startswith(
        f"{proxy_name}: outside does not reach ports 11400-11431 of 192.0.2.11 ("
    )
    assert cause in text
    assert fix in text
    assert judged(rosproxy_status, "Ready") == ("True", "Serving")
    assert judged(rosproxy_status, "Degraded") == ("True", "PortsUnreachable")
    assert "docker" not in message(rosproxy_status, "Degraded")
    assert "/a: hangs" in message(rosproxy_status, "Degraded")
    assert rosproxy_status["perNode"][0]["message"] == bounded(text, 300)
    (finding,) = (f for f in findings(rosproxy(), [state(answer=dead)], {}) if f.about)
    assert finding.about == Reference("RosProxy", rosproxy().id, "uid-arm")


@pytest.mark.parametrize(
    ("probe", "reason", "said"),
    [
        (None, "NotTried", "has not tested ports 11400-11431 of 192.0.2.11 yet"),
        (RangeProbeStatus(None, "silent", "unknown", "tcp"), "NotProven", "11 itself. Perhaps"),
        (RangeProbeStatus(None, "silent", "unknown", "udp"), "NotProven", "by UDP itself"),
    ],
)
def test_it_is_not_known_whether_outside_reaches_the_ports(probe, reason, said):
    rosproxy_status = status(state("node2"), state(answer=answer("/a", range_probe=probe)))

    assert judged(rosproxy_status, "PortsReachable") == ("Unknown", reason)
    assert said in message(rosproxy_status, "PortsReachable")
    assert judged(rosproxy_status, "Degraded") == ("False", "AsExpected")


def test_ports_of_a_proxy_that_does_not_answer_are_as_they_were():
    dead = RangeProbeStatus(False, "refused", "missed", "tcp")
    first = status(state("node2"), state(answer=answer("/a", range_probe=dead)))
    silent = [state("node2"), state(answer=no_answer("timed out"))]

    assert judged(status(*silent), "PortsReachable") == ("Unknown", "NotAsked")
    second = status(*silent, of=rosproxy(status=first))
    assert condition(second, "PortsReachable") == condition(first, "PortsReachable")


def test_a_proxy_that_does_not_take_its_policy():
    refusal = "does not support policies, since its image is of a former release"
    rosproxy_status = status(state(answer=ProxyReport(True, True, refusal=refusal)))

    assert judged(rosproxy_status, "Ready") == ("True", "Serving")
    assert judged(rosproxy_status, "Degraded") == ("True", "PolicyRefused")
    assert f"on node node1: {refusal}" in message(rosproxy_status, "Degraded")


def test_what_proxies_warn_of_keeps_nobody_from_being_served():
    rosproxy_status = status(state(answer=answer("/a", problems=("/a: does not answer",))))

    assert judged(rosproxy_status, "Ready") == ("True", "Serving")
    assert judged(rosproxy_status, "Degraded") == ("True", "ProxyWarns")
    assert message(rosproxy_status, "Degraded").endswith("/a: does not answer")


def test_a_pod_that_is_left_out_keeps_the_others_ready():
    about = Reference("Pod", Name("robots", "x"), "u")
    finding = ClusterFinding(
        "pod robots/x", "is ambiguous", reason="Ambiguous", of=rosproxy().id, about=about
    )

    assert judged(status(state(), more=(finding,)), "Ready") == ("True", "Serving")
    assert judged(status(state(), more=(finding,)), "Degraded") == ("True", "Ambiguous")
    starting = status(state(proxy=None, answer=None), more=(finding,))
    assert judged(starting, "Ready") == ("False", "ProxiesStarting")


def test_a_problem_without_a_reason():
    finding = ClusterFinding("service x", "is not there", reason="", of=rosproxy().id)
    rosproxy_status = status(state(proxy=None, answer=None), more=(finding,))

    assert judged(rosproxy_status, "Ready") == ("False", "Problem")
    assert message(rosproxy_status) == "service x: is not there"


@pytest.mark.parametrize(
    ("text", "fix"),
    [
        (
            'pods "x" is forbidden: violates PodSecurity "baseline:latest": hostPort',
            "kubectl label namespace robots pod-security.kubernetes.io/enforce=privileged",
        ),
        ('pods "x" is forbidden: exceeded quota: q, requested: cpu=50m', "ResourceQuota"),
        ('Pod "x" is invalid: spec.tolerations[0].effect: Unsupported value', "RosProxy's spec"),
        (
            'pods is forbidden: User "system:serviceaccount:a:b" cannot create resource "pods"',
            "Install the operator's chart or manifests again",
        ),
        ("a Pod of this name exists already that the operator did not create", "use another name"),
        ("internal error", "The operator tries again"),
    ],
)
def test_what_the_api_server_refuses(text, fix):
    rosproxy_status = status(state(proxy=None, answer=None), failures={REFUSED: text})

    assert judged(rosproxy_status, "Ready") == ("False", "ProxyNotAdmitted")
    assert message(rosproxy_status).startswith(
        "robots/rosproxy-arm-node1-1: the operator could not create, "
    )
    assert fix in message(rosproxy_status)


@pytest.mark.parametrize(
    ("text", "fix"),
    [
        (
            'pods "x" is forbidden: violates PodSecurity "baseline:latest": non-default '
            'capabilities (container "rosproxy" must not include "NET_ADMIN" in securityContext.'
            "capabilities.add), hostPort (container uses hostPorts " + "11400, " * 99 + ")",
            "A proxy needs hostPorts (and NET_ADMIN for spec.dataPlane: Kernel). This requires Pod "
            "Security privileged. Run kubectl label namespace robots "
            "pod-security.kubernetes.io/enforce=privileged --overwrite",
        ),
        (
            'admission webhook "x" denied the request: NET_ADMIN is not allowed',
            "or set spec.dataPlane: Auto",
        ),
        (
            "pods is forbidden: allowPrivilegeEscalation must be false",
            "or set spec.dataPlane: Auto",
        ),
    ],
)
def test_who_refuses_the_kernel_plane_is_told_of_it(text, fix):
    of = replace(rosproxy(), spec=replace(rosproxy().spec, proxy=ProxySpec(data_plane="kernel")))

    (finding,) = findings(of, (), {REFUSED: text})

    assert finding.message.endswith(fix)
    assert len(finding.message) <= 600


def test_findings_are_told_at_the_rosproxy():
    (finding,) = findings(rosproxy(), [state(proxy=stuck_proxy(PodFailure.PORTS), answer=None)], {})

    assert (finding.reason, finding.of) == ("PortConflict", rosproxy().id)
    assert finding.about == Reference("RosProxy", rosproxy().id, "uid-arm")
