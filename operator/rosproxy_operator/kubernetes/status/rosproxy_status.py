"""The status of a RosProxy, with its conditions (``metav1.Condition``)."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TypeGuard

import msgspec

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.output.text import brief, plural, shorten
from rosproxy_operator.common.problem import CONFLICT, EXHAUSTED, Fault, bounded
from rosproxy_operator.common.zenoh import OVERRIDE, client_override, tcp_endpoint
from rosproxy_operator.kubernetes.resources.checks import int_at, submaps, text_at
from rosproxy_operator.kubernetes.resources.cluster import (
    ClusterSnapshot,
    PodFailure,
    ProxyReport,
    RosProxyOnNode,
    ZenohReport,
)
from rosproxy_operator.kubernetes.resources.model import (
    ClusterFinding,
    InvalidRosProxy,
    Json,
    Pod,
    RosProxy,
    ZenohSpec,
)
from rosproxy_operator.kubernetes.resources.names import (
    ADMIN_PORT,
    INJECT,
    hub_address,
    master_uri,
    outside_service_id,
    router_of,
)
from rosproxy_operator.kubernetes.status.findings import (
    NO_MASTER,
    NO_PEER,
    NO_SITE,
    NO_WAY_IN,
    node_findings,
    proxy_subject,
)
from rosproxy_operator.kubernetes.status.range_texts import not_proven

READY = "Ready"
PORTS = "PortsAllocated"
MASTER = "MasterReachable"
DEGRADED = "Degraded"
WAY_IN = "PortsReachable"
PEERS = "PeersReachable"
SITES = "SitesReachable"
LISTENING = "Listening"
MOST_MESSAGE_CHARACTERS = 1024
"""Characters of a message at most."""
MOST_NODES = 200
"""Nodes in ``perNode`` at most.

The API server refuses an object of more than 1.5 MB (etcd, --max-request-bytes).
"""
MOST_NAMES = 50
"""Names of ROS nodes in a line of ``perNode`` at most."""
MOST_NAMES_OF_ALL = 4000
"""Names in all lines at most: 4,000 names of `_MOST_NAME_CHARACTERS` characters take 400 kB."""
_MOST_NAME_CHARACTERS = 100
_MOST_LINE_MESSAGE_CHARACTERS = 300
_MOST_BY_NODE_CHARACTERS = 400
# As for the reason of a metav1.Condition in k8s.io/apimachinery, pkg/apis/meta/v1/types.go.
_REASON = re.compile(r"[A-Za-z]([A-Za-z0-9_,:]{0,1022}[A-Za-z0-9_])?")
_NO_PODS = "NoPods"
MOST_DESCRIBED_PODS = 3
"""Most pods that a command in a condition names."""
_KEEPS_PODS_OUT = ("Ambiguous", "HostNetwork", "NodeLeftOut", "NotWired")
"""Reasons of findings about pods that get no proxy."""
_NO_PROXY = "no proxy runs, so this is not known"
_OF_ZENOH = ("sessions", "peers", "links")
"""Fields of ``perNode`` about rmw_zenoh that only the proxy of the node knows."""


class Addresses(msgspec.Struct, frozen=True):
    """The addresses in the status of a RosProxy.

    ``cluster_ip`` is the address of the Service for pods, empty before the Service exists.
    ``master`` is the URI of the real master for the proxies, empty if unknown. ``outside`` is where
    outside reaches the proxies for rmw_zenoh; None: no address yet.
    """

    cluster_ip: str = ""
    master: str = ""
    outside: HostPort | None = None


class Condition(msgspec.Struct, frozen=True):
    """A condition without times. ``status`` is True, False or Unknown."""

    type: str
    status: str
    reason: str
    message: str


def status_of(
    rosproxy: RosProxy,
    states: tuple[RosProxyOnNode, ...],
    problems: tuple[ClusterFinding, ...],
    addresses: Addresses,
    stamp: str,
    unscheduled: Sequence[Pod] = (),
) -> Json:
    """The status of a RosProxy, with the fields of the CRD.

    While a proxy has not answered, the facts that only this proxy knows stay as in the former
    status. So a start of the operator changes no status.

    ``problems`` are all findings about the RosProxy, with the findings about pods. ``stamp`` is the
    time for conditions that change, in RFC 3339. ``unscheduled`` are the selected pods without a
    node.
    """
    former = rosproxy.status
    lines = _lines(rosproxy, states)
    counts = _Counts(former, lines, states)
    ros_nodes = counts.total("rosNodes")
    wanted = [state for state in states if state.pods]
    spec = rosproxy.spec
    participant_count = counts.total("participants")
    served = [plural(ros_nodes, "ROS node")] if spec.ros1 or spec.zenoh else []
    if spec.ros2:
        served.append(f"{plural(participant_count, 'participant')} of domain {spec.ros2.number}")
    ready = _ready(rosproxy, wanted, problems, " and ".join(served), unscheduled)
    judged = (
        ready,
        *([_allocated(wanted, problems)] if not spec.zenoh else []),
        *([_reached(states, problems, former)] if spec.ros1 else []),
        *([_way_in(states, problems, former)] if not spec.zenoh else []),
        *_links(spec.zenoh or ZenohSpec(), states, problems, former),
        *_listening(rosproxy, wanted, addresses.outside),
        _degraded(problems),
    )
    return {
        "observedGeneration": rosproxy.generation,
        "message": _message(ready, problems),
        **_addressed(rosproxy, addresses),
        **({"domain": spec.ros2.number, "participants": participant_count} if spec.ros2 else {}),
        **({"sessions": counts.total("sessions")} if spec.zenoh else {}),
        "nodes": len(wanted),
        "proxies": f"{sum(map(_serving, wanted))}/{len(wanted)}",
        "rosNodes": ros_nodes,
        "topics": _topics(states, former),
        "addresses": "" if spec.zenoh else _addresses(wanted),
        "ports": "" if spec.zenoh else _ports(states),
        "livePage": _live_page(wanted),
        "perNode": lines,
        "conditions": _conditions(judged, former, rosproxy.generation, stamp),
    }


class _Counts:
    """The counts in the lines of ``perNode``, and of the nodes for which there is no line."""

    def __init__(
        self, former: Json, lines: Sequence[Json], states: Sequence[RosProxyOnNode]
    ) -> None:
        shown = {line["name"] for line in lines}
        hidden = [state for state in states if state.name not in shown]
        self._former = former
        self._lines = [*lines, *(_ros(state, 0, former) for state in hidden)]
        proxies = [state for state in hidden if state.proxy is not None]
        self._is_complete = all(_has_answered(state.answer) for state in proxies)

    def total(self, field: str) -> int:
        """The sum of a field of all nodes.

        At least the former sum while the proxy of a node without a line has not answered: the
        former status has no line of that node either.
        """
        total = sum(int_at(line, field) for line in self._lines)
        return total if self._is_complete else max(total, int_at(self._former, field))


def participants(observed: ClusterSnapshot) -> dict[int, int]:
    """The number of participants behind the proxies, by domain."""
    domains = {r.uid: r.spec.ros2.number for r in observed.rosproxies if r.spec.ros2}
    counts = dict.fromkeys(domains.values(), 0)
    for proxy in observed.proxies:
        answer = observed.reports.get(proxy.pod.uid)
        if answer is not None and proxy.owner in domains:
            counts[domains[proxy.owner]] += sum(map(len, answer.participants.values()))
    return counts


def _addressed(rosproxy: RosProxy, addresses: Addresses) -> dict[str, object]:
    """The addresses for pods and for outside, and the URI of the real master.

    Without a Service the former address stays in the status: the next Service asks for the same
    address.
    """
    fields: dict[str, object] = {}
    cluster_ip = addresses.cluster_ip
    if rosproxy.spec.ros1:
        uri = master_uri(cluster_ip) if cluster_ip else text_at(rosproxy.status, "masterURI")
        fields = {"master": addresses.master, "masterURI": uri}
    if rosproxy.spec.ros2:
        fields["staticPeers"] = cluster_ip or rosproxy.cluster_ip
    if rosproxy.spec.zenoh:
        address = cluster_ip or rosproxy.cluster_ip
        fields["routerEndpoint"] = tcp_endpoint(router_of(address)) if address else ""
    if addresses.outside:
        fields["listen"] = tcp_endpoint(addresses.outside)
    return fields


def status_of_invalid(rosproxy: InvalidRosProxy, stamp: str) -> Json:
    """The former status of a RosProxy that can't be used, with new conditions Ready and Degraded.

    All other conditions stay, because the operator leaves the existing proxies as they are.
    """
    former = rosproxy.status
    text = str(Fault(rosproxy.text, rosproxy.fix).shortened(MOST_MESSAGE_CHARACTERS))
    conditions = [_read(condition) for condition in submaps(former, "conditions")]
    judged = [
        Condition(READY, "False", rosproxy.reason, text),
        *(c for c in conditions if c.type not in (READY, DEGRADED)),
        Condition(DEGRADED, "True", rosproxy.reason, text),
    ]
    return {
        **former,
        "observedGeneration": rosproxy.generation,
        "message": text,
        "conditions": _conditions(judged, former, rosproxy.generation, stamp),
    }


def _shown_nodes(states: Sequence[RosProxyOnNode]) -> list[RosProxyOnNode]:
    """The nodes for ``perNode``, sorted by name, at most `MOST_NODES`.

    Nodes without pods are left out first, and of these first the nodes without a proxy.
    """
    ranked = sorted(states, key=lambda state: (not state.pods, state.proxy is None, state.name))
    return sorted(ranked[:MOST_NODES], key=lambda state: state.name)


def _lines(rosproxy: RosProxy, states: Sequence[RosProxyOnNode]) -> list[dict[str, object]]:
    """The entries of ``perNode``."""
    shown = _shown_nodes(states)
    most_names = min(MOST_NAMES, MOST_NAMES_OF_ALL // max(len(shown), 1))
    linked = _linked_nodes(rosproxy, states) if rosproxy.spec.zenoh else {}
    return [_line(rosproxy, state, linked, most_names) for state in shown]


def _line(
    rosproxy: RosProxy, state: RosProxyOnNode, linked: Mapping[str, set[str]], most_names: int
) -> dict[str, object]:
    """The entry of ``perNode`` for a node, with ``most_names`` names of ROS nodes at most.

    ``linked``: see `_linked_nodes`.
    """
    proxy = state.proxy
    hubs = f"{len(linked[state.name])}/{len(linked) - 1}" if state.name in linked else ""
    problem = next(iter(node_findings(rosproxy, state)), None)
    line = {
        "name": state.name,
        "advertiseHost": state.advertise_host,
        "ports": "" if rosproxy.spec.zenoh else str(state.range or ""),
        "proxy": proxy.pod.id.name if proxy else "",
        "ready": _serving(state),
        "pods": len(state.pods),
        **_ros(state, most_names, rosproxy.status),
        "hubs": hubs,
        "unregisteredAt": state.unregistered_at,
        "message": bounded(_one_line(problem), _MOST_LINE_MESSAGE_CHARACTERS) if problem else "",
    }
    return {key: value for key, value in line.items() if value != ""}


def _ros(state: RosProxyOnNode, limit: int, former: Json) -> dict[str, object]:
    """The ROS nodes and topics behind a proxy, by the present answer or else the former status."""
    if _has_answered(state.answer):
        zenoh = state.answer.zenoh
        found = {name for group in state.answer.nodes.values() for name in group}
        names = sorted({*found, *(zenoh.nodes if zenoh else ())})
        # `brief` cuts before it cleans: to clean a megabyte takes 0.3 s.
        brief_names = (brief(name, 3 * _MOST_NAME_CHARACTERS) for name in names[:limit])
        shown = [shorten(name, _MOST_NAME_CHARACTERS) for name in brief_names]
        by_address = state.answer.participants
        counted = {"participants": sum(map(len, by_address.values()))} if by_address else {}
        count = len(state.answer.topics)
        sessions = _sessions(zenoh) if zenoh else {}
        return {"rosNodes": len(names), "names": shown, "topics": count, **counted, **sessions}
    lines = submaps(former, "perNode") if state.proxy is not None else ()
    last = next((line for line in lines if line.get("name") == state.name), {})
    return {
        "rosNodes": int_at(last, "rosNodes"),
        "names": list(last.get("names") or ()),
        "topics": int_at(last, "topics"),
        **{key: last[key] for key in ("participants", *_OF_ZENOH) if key in last},
    }


def _sessions(zenoh: ZenohReport) -> dict[str, object]:
    """The sessions of nodes in pods, and how many links to outside are up, of all."""
    sites = {"links": _up_of_all(zenoh.sites)} if zenoh.sites else {}
    return {"sessions": zenoh.sessions, "peers": _up_of_all(zenoh.peers), **sites}


def _up_of_all(faults: Mapping[str, str]) -> str:
    return f"{sum(not fault for fault in faults.values())}/{len(faults)}"


def _linked_nodes(of: RosProxy, states: Sequence[RosProxyOnNode]) -> Mapping[str, set[str]]:
    """By node with a proxy for rmw_zenoh: the nodes whose proxies are linked with this proxy.

    A single side sees the link if the other side is older, or behind NAT.
    """
    nodes = {str(hub_address(of.id, s.name)): s.name for s in states if s.proxy is not None}
    linked = {node: set[str]() for node in nodes.values()}
    for state in states:
        if state.proxy is None or not _has_answered(state.answer) or state.answer.zenoh is None:
            continue
        up = (hub for hub, fault in state.answer.zenoh.hubs.items() if not fault)
        for other in {nodes[hub] for hub in up if hub in nodes} - {state.name}:
            linked[state.name].add(other)
            linked[other].add(state.name)
    return linked


def _has_answered(answer: ProxyReport | None) -> TypeGuard[ProxyReport]:
    return answer is not None and answer.answered


def _topics(states: Sequence[RosProxyOnNode], former: Json) -> int:
    """The number of topics; at least the former number while a proxy has not answered."""
    answers = [state.answer for state in states if state.proxy is not None]
    count = len({topic for answer in answers if _has_answered(answer) for topic in answer.topics})
    return count if all(map(_has_answered, answers)) else max(count, int_at(former, "topics"))


def _ports(states: Sequence[RosProxyOnNode]) -> str:
    """The range of all nodes with pods or a proxy; if the ranges differ, the range of each node."""
    ranges = {s.name: str(s.range) for s in states if s.range and (s.pods or s.proxy)}
    if len(set(ranges.values())) <= 1:
        return next(iter(ranges.values()), "")
    return bounded(
        ", ".join(f"{name}: {ports}" for name, ports in sorted(ranges.items())),
        _MOST_BY_NODE_CHARACTERS,
    )


def _addresses(wanted: Sequence[RosProxyOnNode]) -> str:
    """The advertised host of each node, with a mark at nodes whose proxy is not ready."""
    hosts = {state.name: state.advertise_host or "no address" for state in wanted}
    waiting = {state.name for state in wanted if not _serving(state)}
    lines = (
        f"{name}: {host}{' (not ready)' if name in waiting else ''}"
        for name, host in sorted(hosts.items())
    )
    return bounded(", ".join(lines), _MOST_BY_NODE_CHARACTERS)


def _live_page(wanted: Sequence[RosProxyOnNode]) -> str:
    """The command for the live page of the first proxy that works; empty without such a proxy.

    Users of the RosProxy may have rights in its namespace alone. The page of all proxies is in the
    namespace of the operator.
    """
    working = (state for state in wanted if _serving(state))
    first = min(working, key=lambda state: state.name, default=None)
    if first is None or first.proxy is None:
        return ""
    pod = first.proxy.pod.id
    forward = f"kubectl -n {pod.namespace} port-forward {pod.name} {ADMIN_PORT}"
    return f"{forward} # then http://localhost:{ADMIN_PORT}/"


def _serving(state: RosProxyOnNode) -> bool:
    """Whether the proxy of a node is ready, is not stuck, and answers.

    Before the operator has asked the proxy, the condition Ready of the pod suffices.
    """
    proxy = state.proxy
    if proxy is None or proxy.pod.deleting or not proxy.ready or proxy.stuck is not None:
        return False
    return state.answer is None or state.answer.answered


def _conditions(
    judged: Iterable[Condition], former: Json, generation: int, stamp: str
) -> list[dict[str, object]]:
    """The conditions as JSON (``metav1.Condition``).

    A condition with the same status as in the ``former`` RosProxy status keeps the
    lastTransitionTime. A changed condition gets ``stamp``, in RFC 3339.
    """
    since = {
        (text_at(condition, "type"), text_at(condition, "status")): text_at(
            condition, "lastTransitionTime"
        )
        for condition in submaps(former, "conditions")
    }
    return [
        {
            "type": c.type,
            "status": c.status,
            "observedGeneration": generation,
            "lastTransitionTime": since.get((c.type, c.status)) or stamp,
            "reason": c.reason if _REASON.fullmatch(c.reason) else "Problem",
            "message": bounded(c.message, MOST_MESSAGE_CHARACTERS),
        }
        for c in judged
    ]


def _read(condition: Json) -> Condition:
    return Condition(*(text_at(condition, key) for key in ("type", "status", "reason", "message")))


def _one_line(problem: ClusterFinding) -> str:
    fault = Fault(f"{problem.subject}: {problem.text}", problem.fix)
    return str(fault.shortened(MOST_MESSAGE_CHARACTERS))


def _ready(
    rosproxy: RosProxy,
    wanted: Sequence[RosProxyOnNode],
    problems: Sequence[ClusterFinding],
    served: str,
    unscheduled: Sequence[Pod],
) -> Condition:
    if not wanted:
        cause = next((p for p in problems if p.reason in _KEEPS_PODS_OUT), None)
        if cause is not None:
            return Condition(READY, "True", _NO_PODS, f"no pod has a proxy. {_one_line(cause)}")
        if unscheduled:
            names = " ".join(sorted(pod.id.name for pod in unscheduled)[:MOST_DESCRIBED_PODS])
            text = f"no selected pod runs on a node yet ({plural(len(unscheduled), 'pod')})"
            command = f"kubectl -n {rosproxy.id.namespace} describe pod {names}"
            return Condition(READY, "True", _NO_PODS, f"{text}. Read the Events: {command}")
        fix = "Give pods the labels that spec.podSelector requires"
        if rosproxy.spec.pod_selector is None:
            # Not "true": with several RosProxies this value is ambiguous.
            fix = f"Add the label {INJECT}={rosproxy.id.name} to the template of your pods"
        return Condition(READY, "True", _NO_PODS, f"no pod is selected. {fix}")
    waiting = [state for state in wanted if not _serving(state)]
    if not waiting:
        text = f"{len(wanted)} of {len(wanted)} proxies serve {served}"
        return Condition(READY, "True", "Serving", text)
    blocking = [problem for problem in problems if problem.fatal and not _of_pod(problem)]
    if blocking:
        return Condition(READY, "False", blocking[0].reason, _one_line(blocking[0]))
    name = waiting[0].name
    proxy = waiting[0].proxy
    progress = "the proxy is being created"
    if proxy is not None and not proxy.pod.deleting:
        progress = f"proxy {proxy.pod.id.name} is starting"
    return Condition(READY, "False", "ProxiesStarting", f"node {name}: {progress}")


def _message(ready: Condition, problems: Sequence[ClusterFinding]) -> str:
    """The text of Ready if the RosProxy is not ready or has no finding, else the first finding."""
    is_ready = ready.status == "True"
    text = _one_line(problems[0]) if is_ready and problems else ready.message
    return bounded(text, MOST_MESSAGE_CHARACTERS)


def _of_pod(problem: ClusterFinding) -> bool:
    """Whether a finding is about a user's pod. The proxies serve all other pods meanwhile."""
    return problem.about is not None and problem.about.kind == "Pod"


def _allocated(wanted: Sequence[RosProxyOnNode], problems: Sequence[ClusterFinding]) -> Condition:
    if not wanted:
        return Condition(PORTS, "True", _NO_PODS, "no pod is selected, so no ports are needed")
    lacking = [state for state in wanted if state.range is None]
    refused = [s for s in wanted if s.proxy is not None and s.proxy.stuck is PodFailure.PORTS]
    if not lacking and not refused:
        return Condition(PORTS, "True", "Allocated", "every node with selected pods has its ports")
    reason = CONFLICT if refused else EXHAUSTED
    lines = [_one_line(p) for p in problems if p.reason in (CONFLICT, EXHAUSTED)]
    names = ", ".join(state.name for state in (*refused, *lacking))
    return Condition(PORTS, "False", reason, ". ".join(lines) or f"node {names}: no ports yet")


def _reached(
    states: Sequence[RosProxyOnNode], problems: Sequence[ClusterFinding], former: Json
) -> Condition:
    """The condition MasterReachable; the former condition if a proxy has not answered yet."""
    proxies = [state for state in states if _may_answer(state)]
    answers = [s.answer for s in proxies if s.answer is not None and s.answer.answered]
    if not all(answer.master_up for answer in answers):
        lines = [_one_line(p) for p in problems if p.reason == NO_MASTER]
        return Condition(
            MASTER, "False", NO_MASTER, ". ".join(lines) or "not every proxy reaches the master"
        )
    if not proxies:
        return Condition(MASTER, "Unknown", "NoProxies", _NO_PROXY)
    if len(answers) == len(proxies):
        return Condition(MASTER, "True", "Reached", "every proxy reaches the master")
    return _previous(MASTER, former)


def _way_in(
    states: Sequence[RosProxyOnNode], problems: Sequence[ClusterFinding], former: Json
) -> Condition:
    """The condition PortsReachable; the former condition if a proxy has not answered yet."""
    proxies = [(s, s.proxy, s.answer) for s in states if s.proxy is not None and _may_answer(s)]
    probes = [(s, p, a.range_probe) for s, p, a in proxies if a is not None and a.answered]
    if any(probe is not None and probe.reached is False for _, _, probe in probes):
        lines = [_one_line(p) for p in problems if p.reason == NO_WAY_IN]
        text = ". ".join(lines) or "outside does not reach the ports of every proxy"
        return Condition(WAY_IN, "False", NO_WAY_IN, text)
    if not proxies:
        return Condition(WAY_IN, "Unknown", "NoProxies", _NO_PROXY)
    if len(probes) < len(proxies):
        return _previous(WAY_IN, former)
    open_questions = [(s, p, probe) for s, p, probe in probes if probe is None or not probe.reached]
    if not open_questions:
        return Condition(WAY_IN, "True", "Reached", "outside reaches the ports of every proxy")
    lines = [f"{proxy_subject(p)}: {not_proven(s, probe)}" for s, p, probe in open_questions]
    reason = "NotTried" if any(probe is None for _, _, probe in open_questions) else "NotProven"
    return Condition(WAY_IN, "Unknown", reason, ". ".join(lines))


def _links(
    spec: ZenohSpec,
    states: Sequence[RosProxyOnNode],
    problems: Sequence[ClusterFinding],
    former: Json,
) -> Iterator[Condition]:
    """The conditions PeersReachable and SitesReachable, each if the spec names peers or sites.

    A condition stays as before if a proxy has not answered yet.
    """
    proxies = [state for state in states if _may_answer(state)]
    answers = {s.name: s.answer.zenoh for s in proxies if _has_answered(s.answer)}
    reports = {name: zenoh or ZenohReport() for name, zenoh in answers.items()}
    peers = {name: zenoh.peers for name, zenoh in reports.items()}
    sites = {name: zenoh.sites for name, zenoh in reports.items()}
    for condition, reason, target, asked, faults in (
        (PEERS, NO_PEER, "router of spec.peers", spec.peers, peers),
        (SITES, NO_SITE, "site of spec.link.to", spec.link, sites),
    ):
        lines = [_one_line(problem) for problem in problems if problem.reason == reason]
        if not asked:
            continue
        if lines:
            yield Condition(condition, "False", reason, ". ".join(lines))
        elif not proxies:
            yield Condition(condition, "Unknown", "NoProxies", _NO_PROXY)
        elif len(reports) < len(proxies):
            yield _previous(condition, former)
        else:
            yield _linked(condition, target, faults)


def _linked(condition: str, target: str, faults: Mapping[str, Mapping[str, str]]) -> Condition:
    """A condition about links without problems. ``faults``: by node and by the peer of the link."""
    down = [
        f"node {node}: {peer}" for node, every in faults.items() for peer in every if every[peer]
    ]
    if down:
        return Condition(condition, "Unknown", "Linking", f"not linked yet: {', '.join(down)}")
    return Condition(condition, "True", "Reached", f"every proxy is linked with every {target}")


def _listening(
    rosproxy: RosProxy, wanted: Sequence[RosProxyOnNode], outside: HostPort | None
) -> Iterator[Condition]:
    """The condition Listening of a RosProxy with ``spec.listen``: what laptops have to set."""
    listen = rosproxy.spec.zenoh.listen if rosproxy.spec.zenoh else None
    if listen is None:
        return
    service = outside_service_id(rosproxy.id).name
    if outside is None and listen.type == "NodePort" and not wanted:
        yield Condition(LISTENING, "Unknown", "NoProxies", _NO_PROXY)
        return
    if outside is None:
        text = f"Service {service} has no address yet"
        if listen.type == "LoadBalancer":
            text += ". The address comes from a controller for load balancers: that of the cloud, "
            text += "or one such as MetalLB"
        yield Condition(LISTENING, "False", "NoAddress", text)
        return
    variable = f"on a laptop, set {OVERRIDE}='{client_override(outside)}'"
    if any(map(_serving, wanted)):
        yield Condition(LISTENING, "True", "Listening", variable)
    else:
        text = f"no proxy is ready, so none answers at {outside}. Then {variable}"
        yield Condition(LISTENING, "Unknown", "NoProxies", text)


def _may_answer(state: RosProxyOnNode) -> bool:
    """Whether a node has a proxy that is not stuck."""
    return state.proxy is not None and state.proxy.stuck is None


def _previous(condition: str, former: Json) -> Condition:
    """The former condition; Unknown if there is none."""
    previous = (c for c in submaps(former, "conditions") if c.get("type") == condition)
    unknown = Condition(condition, "Unknown", "NotAsked", "not every proxy has answered yet")
    return next(map(_read, previous), unknown)


def _degraded(problems: Sequence[ClusterFinding]) -> Condition:
    if not problems:
        return Condition(DEGRADED, "False", "AsExpected", "nothing is wrong")
    lines = ". ".join(map(_one_line, problems))
    return Condition(DEGRADED, "True", problems[0].reason, lines)
