"""The same fault on both engines is the same problem, and each output shows this problem.

A row has the fault on a Docker host and in a cluster, as the planner of the engine sees the fault.
The object, the options in the fix and the commands are of the engine. All else is the same.
"""

import asyncio
import json
import logging
from dataclasses import asdict, dataclass, replace
from typing import Any

import pytest
from msgspec.structs import replace as replace_struct

from rosproxy.page.page_document import shown_text
from rosproxy.shared.documents.doctor_finding import Severity
from rosproxy.shared.ports import PortRange
from rosproxy.shared.tasks import Tasks
from rosproxy_operator.common.merged_page import merged
from rosproxy_operator.common.problem import SILENT, Problem, ProblemLog
from rosproxy_operator.common.proxy_client import PolicyRefused, ProxyError
from rosproxy_operator.docker.doctor import host_findings
from rosproxy_operator.docker.errors import EngineError
from rosproxy_operator.docker.executor import Executor
from rosproxy_operator.docker.host_document import host_document
from rosproxy_operator.docker.host_status import HostStatus, show_plan
from rosproxy_operator.docker.planner.actions import Action
from rosproxy_operator.docker.planner.labels.members import LabelReading
from rosproxy_operator.docker.planner.model import HostState
from rosproxy_operator.docker.planner.plan import DockerPlan
from rosproxy_operator.docker.planner.report import render
from rosproxy_operator.docker.planner.specs import proxy_name
from rosproxy_operator.docker.planner.state import DockerMemory
from rosproxy_operator.docker.proxy_sync import silent_proxy_problem
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.docker.snapshot import DockerSnapshot
from rosproxy_operator.kubernetes.planner.actions import Emit, PatchStatus
from rosproxy_operator.kubernetes.planner.plan import ClusterPlan
from rosproxy_operator.kubernetes.proxies.proxy_report import no_answer
from rosproxy_operator.kubernetes.resources import objects as readers
from rosproxy_operator.kubernetes.resources import spec as parse_rosproxy
from rosproxy_operator.kubernetes.resources.cluster import (
    ClusterSnapshot,
    PodFailure,
    ProxyReport,
)
from rosproxy_operator.kubernetes.resources.model import ClusterFinding, MasterSpec, Name, Ros2Spec
from rosproxy_operator.kubernetes.settings import ClusterSettings
from rosproxy_operator.kubernetes.status.condition_findings import cluster_findings
from rosproxy_operator.kubernetes.watch.store import read_master
from rosproxy_operator.proxy_spec.place import Domain, Place
from tests.unit.operator.docker import builders as docker
from tests.unit.operator.docker.builders import ENABLED, PLACE, both, container, planned
from tests.unit.operator.docker.builders import observed as host
from tests.unit.operator.kubernetes import objects as cluster
from tests.unit.operator.kubernetes.objects import look, node, pod, proxy, rosproxy, scene
from tests.unit.operator.kubernetes.objects import observed as seen

PROXY = proxy_name(PLACE)
CLUSTER_PROXY = proxy().pod.id.name
ROS2 = {"rosproxy.enable": "true", "rosproxy.ros": "2"}
NAMED = Place(Domain(0), "site.example")
ON_SITE = replace(docker.SETTINGS, advertise_host=NAMED.advertise_host)
REFUSAL = "refuses its policy: name the rule anew"
FORBIDDEN = 'pods "p" is forbidden: violates PodSecurity "baseline:latest": hostPort'
ROSCORE = Name("ros", "roscore")
NARROW = replace(docker.SETTINGS, ports=4, port_window=PortRange(11400, 11403))
ONLY_ARM = replace_struct(
    cluster.SETTINGS, bounds=replace_struct(cluster.BOUNDS, masters=("http://arm:*",))
)


@dataclass(frozen=True, slots=True)
class OnDocker:
    """A fault on a host.

    ``error``: the error of the request to the running proxy. ``refused``: the error of the engine
    for each action.
    """

    subject: str
    state: HostState
    settings: PlanSettings = docker.SETTINGS
    error: ProxyError | None = None
    refused: EngineError | None = None

    def document(self) -> dict[str, Any]:
        """The status of the host."""
        made = planned(self.state, self.settings, DockerMemory(), 0.0)
        snapshot = DockerSnapshot(self.state, LabelReading(), {}, at_host=True)
        answers = {}
        if self.error:
            answers[PROXY] = silent_proxy_problem(PROXY, self.error, snapshot, self.settings.uplink)
        now = 2_000_000_000.0
        problems = [*made.problems, *(asyncio.run(self._failures(made)) if self.refused else ())]
        document = host_document(self.state, made, problems, answers, self.settings, now)
        return {**document, "operator": None}

    async def _failures(self, made: DockerPlan) -> list[Problem]:
        """The problems of the plan's actions."""
        tasks = Tasks()
        finished = asyncio.Event()
        executor = Executor(tasks, finished.set, lambda *_: None, lambda *_: None)

        async def refuse(_: Action) -> None:
            assert self.refused
            raise self.refused

        executor.start(made.groups, refuse, 1.0)
        while executor.busy:
            await finished.wait()
            finished.clear()
        return executor.problems


@dataclass(frozen=True, slots=True)
class OnKubernetes:
    """A fault in a cluster. ``refused``: the error of the API server for the pod of the proxy."""

    subject: str
    state: ClusterSnapshot
    settings: ClusterSettings = cluster.SETTINGS
    refused: str = ""

    def plan(self) -> ClusterPlan:
        first = look(self.state, settings=self.settings)
        if not self.refused:
            return first
        failures = {cluster.ROBOT: {proxy().pod.id: self.refused}}
        return look(replace_struct(self.state, failures=failures), first.state)


@dataclass(frozen=True, slots=True)
class Scenario:
    """A fault. ``words`` are part of the text on both engines, ``fixes`` of each of the fixes.

    An empty fix stands for no fix: the proxy or the engine gives the whole text.
    """

    reason: str
    fatal: bool
    words: str
    fixes: tuple[str, str]
    docker: OnDocker
    kubernetes: OnKubernetes


def misspelt_pod() -> ClusterSnapshot:
    body = {
        "metadata": {
            "name": "talker", "namespace": "ros", "uid": "uid-talker",
            "labels": {"rosproxy.io/injekt": "true"},
        },
        "status": {"phase": "Running"},
    }  # fmt: skip
    return seen(rosproxy(), misspelt_pods=(readers.pod(body),))


def unreadable_rosproxy() -> ClusterSnapshot:
    body = {
        "metadata": {"name": "robot", "namespace": "ros", "uid": "uid-robot", "generation": 1},
        "spec": {"master": {"uri": "http://robot:11311"}, "ports": "many"},
    }
    _, unusable = parse_rosproxy.rosproxies([body])
    return ClusterSnapshot(unusable=unusable)


def answered(report: ProxyReport) -> ClusterSnapshot:
    running = proxy()
    return seen(rosproxy(), pod(), cluster.service(), running, reports={running.pod.uid: report})


def without_address() -> ClusterSnapshot:
    return seen(rosproxy(), pod(), cluster.service(), node(addresses={}))


SCENARIOS = {
    "a label whose name is unknown": Scenario(
        "UnknownName", False, "is unknown and ignored. Did you mean",
        ("with the right label", "Correct the name"),
        OnDocker("container talker", host(container(labels={**ENABLED, "rosproxy.portz": "8"}))),
        OnKubernetes("pod ros/talker", misspelt_pod()),
    ),
    "an option with an unusable value": Scenario(
        "Invalid", True, "many", ("such as rosproxy.ports=32", "Write an integer"),
        OnDocker("container talker", host(container(labels={**ENABLED, "rosproxy.ports": "many"}))),
        OnKubernetes("rosproxy ros/robot", unreadable_rosproxy()),
    ),
    "a master that the administrator does not allow": Scenario(
        "NotAllowed", True, "http://robot:11311", ("--allow-master robot:11311", "allow.masters"),
        OnDocker("container talker", host(container()),
                 replace(docker.SETTINGS, allow_master=("arm:*",))),
        OnKubernetes("rosproxy ros/robot", scene(), ONLY_ARM),
    ),
    "no range of free ports": Scenario(
        "PortsExhausted", True, "no 4 free ports in a row between 11400 and 11403",
        ("--port-window", "spec.portWindow"),
        OnDocker(f"proxy {PROXY}", host(container(), listening=[11402]), NARROW),
        OnKubernetes("node one", scene(pod("web", ports=[11402]),
                                       of=rosproxy(window=PortRange(11400, 11403)))),
    ),
    "a proxy that ends again and again": Scenario(
        "ProxyStuck", True, "the container ends again and again", ("docker logs", "kubectl -n ros"),
        OnDocker(f"proxy {PROXY}", host(container(), sandboxes=[docker.sandbox()],
                                        proxies=[docker.proxy(state="restarting")])),
        OnKubernetes(f"proxy {CLUSTER_PROXY} on node one", scene(proxy(stuck=PodFailure.CRASHING))),
    ),
    "an image that is missing": Scenario(
        "ProxyStuck", True, "", ("docker pull", "spec.image"),
        OnDocker(f"proxy image {docker.SETTINGS.proxy_image}", host(container(), image="")),
        OnKubernetes(f"proxy {CLUSTER_PROXY} on node one", scene(proxy(stuck=PodFailure.IMAGE))),
    ),
    "a proxy that does not answer": Scenario(
        "ProxyUnreachable", True, "does not answer the operator (no route)",
        ("docker logs", "NetworkPolicy"),
        OnDocker(f"proxy {PROXY}", host(container(), **both()), error=ProxyError("no route")),
        OnKubernetes(f"proxy {CLUSTER_PROXY} on node one", answered(no_answer("no route"))),
    ),
    "a proxy that refuses its policy": Scenario(
        "PolicyRefused", True, REFUSAL, ("", ""),
        OnDocker(f"proxy {PROXY}", host(container(), **both()),
                 error=PolicyRefused(REFUSAL)),
        OnKubernetes(f"proxy {CLUSTER_PROXY} on node one",
                     answered(ProxyReport(True, True, refusal=REFUSAL))),
    ),
    "an unknown address of the host towards outside": Scenario(
        "NoAdvertiseHost", True, "address", ("--advertise-host", "advertise-host="),
        OnDocker("container talker", host(container()),
                 replace(docker.SETTINGS, advertise_host=None)),
        OnKubernetes("node one", without_address()),
    ),
    "a master that is not found": Scenario(
        "MasterUnknown", True, "", ("/etc/hosts", "Service"),
        OnDocker("master robot", host(container(), masters={"robot": ""})),
        OnKubernetes("node one", replace_struct(
            scene(of=rosproxy(master=MasterSpec(service=ROSCORE, service_port=11311))),
            masters={ROSCORE: read_master(None, ROSCORE, ())})),
    ),
    "an action that the engine refuses": Scenario(
        "ProxyNotAdmitted", True, "", ("", "kubectl label namespace"),
        OnDocker(f"proxy {PROXY}", host(container()), refused=EngineError("no space is left")),
        OnKubernetes(f"ros/{CLUSTER_PROXY}", scene(), refused=FORBIDDEN),
    ),
    "a LAN relay without an address on the LAN": Scenario(
        "NoLanAddress", False, "no LAN relay", ("--ros2-lan", "spec.peers"),
        OnDocker(f"proxy {proxy_name(NAMED)}",
                 host(container(labels=ROS2, env="")), ON_SITE),
        OnKubernetes("rosproxy ros/robot", scene(
            node(addresses={"InternalIP": "2001:db8::1"}, advertise_host="192.0.2.1"),
            of=rosproxy(ros1=False, ros2=Ros2Spec(multicast=True)))),
    ),
}  # fmt: skip


@pytest.fixture(params=[*SCENARIOS.values()], ids=[*SCENARIOS])
def scenario(request: pytest.FixtureRequest) -> Scenario:
    of: Scenario = request.param
    return of


def on_docker(scenario: Scenario) -> Problem:
    """The problem in the status of the host."""
    problems = [Problem(**problem) for problem in scenario.docker.document()["problems"]]
    (problem,) = (problem for problem in problems if problem.reason == scenario.reason)
    return problem


def on_kubernetes(scenario: Scenario) -> ClusterFinding:
    """The finding in the plan for the cluster."""
    findings = scenario.kubernetes.plan().problems
    (finding,) = (finding for finding in findings if finding.reason == scenario.reason)
    return finding


def test_both_engines_have_the_same_problem(scenario: Scenario) -> None:
    engines = (scenario.docker.subject, scenario.kubernetes.subject)
    problems = (on_docker(scenario), on_kubernetes(scenario))
    for subject, fix, problem in zip(engines, scenario.fixes, problems, strict=True):
        assert (problem.subject, problem.fatal) == (subject, scenario.fatal)
        assert scenario.words in problem.text
        assert fix in problem.fix
        assert bool(problem.fix) == bool(fix)
        assert not (problem.fix and problem.fix in problem.text)
        assert problem.fix[:1].upper() == problem.fix[:1]


def test_the_log_and_the_live_page_have_the_problem(
    scenario: Scenario, caplog: pytest.LogCaptureFixture
) -> None:
    problems = [on_docker(scenario), on_kubernetes(scenario)]
    caplog.clear()  # the executor logs a refused action itself
    ProblemLog().update(problems, 0.0)
    level = logging.ERROR if scenario.fatal else logging.WARNING
    logged = [(r.levelno, r.getMessage(), vars(r)["reason"]) for r in caplog.records]
    assert logged == [(level, f"{p.subject}: {p.message}", scenario.reason) for p in problems]
    findings = merged({}, "1", str, {}, dict.fromkeys(problems, 0.0))["findings"]
    severity = "error" if scenario.fatal else "warning"
    shown = [(f["severity"], f["subject"], f["text"], f["fix"]) for f in findings]
    assert shown == [(severity, p.subject, shown_text(p.text), shown_text(p.fix)) for p in problems]


def test_status_and_doctor_of_docker_have_the_problem(scenario: Scenario) -> None:
    problem = on_docker(scenario)
    document = scenario.docker.document()
    assert problem.message in render(document, 10_000)
    severity = Severity.ERROR if scenario.fatal else Severity.WARNING
    found = [(f.severity, f.subject, f.text, f.fix) for f in host_findings(document)]
    assert (severity, problem.subject, problem.text, problem.fix) in found


def test_the_plan_of_docker_has_the_problem(
    scenario: Scenario, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    document = scenario.docker.document()
    problem = on_docker(scenario)

    async def now(_: HostStatus) -> dict[str, Any]:
        return document

    monkeypatch.setattr(HostStatus, "now", now)
    status = HostStatus(scenario.docker.settings, None)
    code = show_plan(status, as_json=False, wait=0)
    assert f"{problem.subject}: {problem.message}" in capsys.readouterr().out.splitlines()
    assert show_plan(status, as_json=True, wait=0) == code
    assert asdict(problem) in json.loads(capsys.readouterr().out)["problems"]


def test_conditions_events_and_doctor_of_kubernetes_have_the_problem(scenario: Scenario) -> None:
    finding = on_kubernetes(scenario)
    actions = scenario.kubernetes.plan().actions
    (status,) = (action.status for action in actions if isinstance(action, PatchStatus))
    assert finding.message in status["message"] or not scenario.fatal
    (degraded,) = (c for c in status["conditions"] if c["type"] == "Degraded")
    assert degraded["status"] == "True"
    assert finding.message in degraded["message"]
    metadata = {"namespace": finding.of.namespace, "name": finding.of.name}
    doctor = cluster_findings([{"metadata": metadata, "status": status}])
    assert [f.severity for f in doctor if finding.message in f.text] == [Severity.ERROR]
    events = [a for a in actions if isinstance(a, Emit) and a.reason == scenario.reason]
    if scenario.reason != SILENT:  # an operator that reaches no proxy would create many Events
        (event,) = events
        assert (event.type, event.about) == ("Warning", finding.about)
        assert finding.message in event.message
