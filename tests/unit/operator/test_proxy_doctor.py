"""The output of proxies' doctors, in the operator's doctor."""

import json
from typing import cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.doctor.presentation import as_json
from rosproxy.shared.documents.doctor_finding import (
    DoctorFinding,
    Severity,
    error,
    ok,
    warning,
)
from rosproxy_operator.common.proxy_doctor import read_findings
from rosproxy_operator.docker import doctor as docker_doctor
from rosproxy_operator.docker.doctor import host_findings
from rosproxy_operator.docker.host_status import HostStatus
from rosproxy_operator.kubernetes.status.condition_findings import cluster_findings


def test_findings_carry_the_proxys_name() -> None:
    said = [
        ok("admin", "proxy", "rosproxy 1"),
        error("node", "/talker", "is gone", "restart it"),
    ]
    findings = read_findings("proxy a", json.dumps(as_json(said)).encode())
    assert [finding.subject for finding in findings] == [
        "proxy a: proxy",
        "proxy a: /talker",
    ]
    assert (findings[1].severity, findings[1].fix) == (Severity.ERROR, "restart it")


@pytest.mark.parametrize(
    "said",
    [
        *(b"", b"rosproxy: usage", b"[]", b"{}", b"[" * 99999, b"\xff"),
        *(b'{"findings": 5}', b'{"findings": [1]}', b'{"findings": [{"severity": "loud"}]}'),
    ],
)
def test_what_is_no_findings_is_told(said: bytes) -> None:
    (finding,) = read_findings("proxy a", said)
    assert finding.severity is Severity.WARNING
    assert "can't be read" in finding.text


@given(st.binary() | st.recursive(st.none() | st.text(), st.lists).map(json.dumps).map(str.encode))
def test_nothing_that_a_proxy_prints_makes_it_fail(said: bytes) -> None:
    assert all(isinstance(finding, DoctorFinding) for finding in read_findings("a", said))


def test_causes_of_a_host_come_before_what_follows_from_them() -> None:
    def problem(subject: str, fatal: bool = True) -> dict[str, object]:
        return {"subject": subject, "text": "is wrong", "fatal": fatal}

    subjects = ["proxy b", "container a", "network n", "master robot", "proxy image i"]
    status = {
        "problems": [problem("container odd", fatal=False), *map(problem, subjects)],
        "proxies": [{"name": "p", "state": "exited"}],
        "containers": [{"name": "a", "proxy": "p"}],
        "actions": ["create p"],
        "operator": None,
    }
    findings = list(host_findings(status))
    assert [finding.subject for finding in findings] == [
        "proxy image i",
        "network n",
        "master robot",
        "container a",
        "proxy b",
        "container odd",
        "proxy p",
        "operator",
        "host",
    ]


@pytest.mark.parametrize(
    ("operator", "state", "severity"),
    [
        ("http://127.0.0.1:11313", "absent", Severity.INFO),
        ("http://127.0.0.1:11313", "created", Severity.INFO),
        ("http://127.0.0.1:11313", "exited", Severity.ERROR),
        (None, "absent", Severity.ERROR),
    ],
)
def test_a_proxy_that_an_operator_is_making_is_no_fault(
    operator: str | None, state: str, severity: Severity
) -> None:
    status = {
        "problems": [],
        "proxies": [{"name": "p", "state": state}],
        "containers": [],
        "actions": ["start p"],
        "operator": operator,
    }
    proxy, steps, *_ = host_findings(status)
    assert proxy.severity is severity
    assert steps.severity is (Severity.INFO if operator else Severity.WARNING)


def rosproxy(**status: object) -> dict[str, object]:
    metadata = {"namespace": "lab", "name": "robot", "generation": 2}
    return {"metadata": metadata, "status": {"observedGeneration": 2, "nodes": 1, **status}}


def condition(kind: str, status: str, message: str) -> dict[str, str]:
    return {"type": kind, "status": status, "message": message}


def test_a_cluster_tells_the_cause_and_no_text_twice() -> None:
    conditions = [
        condition("Ready", "False", "no proxy is ready"),
        condition("Degraded", "True", "no master"),
        condition("MasterReachable", "False", "no master"),
    ]
    findings = cluster_findings([rosproxy(conditions=conditions)])
    assert [finding.text for finding in findings] == [
        "MasterReachable is False: no master",
        "Ready is False: no proxy is ready",
    ]
    assert findings[0].fix.startswith("do as the message says; fields of the spec: kubectl -n lab")


def test_each_reason_has_its_own_fix() -> None:
    bad = {**condition("PortsAllocated", "False", "no ports"), "reason": "PortsExhausted"}
    dead = {**condition("PortsReachable", "False", "dead"), "reason": "PortsUnreachable"}
    findings = cluster_findings([rosproxy(conditions=[bad, dead])])
    assert findings[0].fix.startswith("enable hostPorts in the nodes' network plug-in")
    assert findings[1].fix == (
        "lower spec.ports, or widen spec.portWindow: kubectl -n lab edit rosproxy robot"
    )


def test_a_cluster_that_is_well_or_empty_or_without_an_operator() -> None:
    (sound,) = cluster_findings([rosproxy(proxies="1/1")])
    assert sound.severity is Severity.OK
    assert "there is no RosProxy" in cluster_findings([])[0].text
    assert "no running pod is selected" in cluster_findings([rosproxy(nodes=0)])[0].text
    idle = condition("Ready", "True", "no pod is selected. Give pods the labels")
    (finding,) = cluster_findings([rosproxy(nodes=0, conditions=[idle])])
    assert (finding.text, finding.fix) == ("no pod is selected", "Give pods the labels")
    assert (
        "check that the operator runs" in cluster_findings([rosproxy(observedGeneration=1)])[0].fix
    )


@pytest.mark.parametrize("is_new", [False, True])
def test_a_participant_of_another_domains_proxy_is_not_missed(
    monkeypatch: pytest.MonkeyPatch, is_new: bool
) -> None:
    """Two proxies on the same network, each for a domain, hear the participants of both.

    A proxy may begin to serve a participant (``is_new``) while the doctors run.
    """
    ours = warning("domain", "01.0f.aa", "is in domain 5, but this proxy serves domain 0")
    lost = warning("domain", "01.0f.bb", "is in domain 9, but this proxy serves domain 0")
    said = json.dumps(as_json([ours, lost])).encode()
    container = {"name": "talker", "proxy": "p5", "participants": [{"guid_prefix": "01.0f.aa"}]}
    status = {
        "problems": [],
        "proxies": [
            {"name": "p0", "state": "running", "reachable": True},
            {"name": "p1", "state": "running", "reachable": False},
        ],
        "actions": [],
        "operator": None,
    }
    is_served = not is_new

    class Host:
        async def now(self) -> object:
            return {**status, "containers": [container] if is_served else []}

    class Engine:
        def run(self, *_: str) -> bytes:
            nonlocal is_served
            is_served = True
            return said

    monkeypatch.setattr(docker_doctor, "DockerClient", Engine)
    subjects = [finding.subject for finding in docker_doctor.examine(cast(HostStatus, Host()), [])]
    assert "proxy p0: 01.0f.bb" in subjects
    assert not any("p1" in subject for subject in subjects), "the proxy is unreachable"
    assert "proxy p0: 01.0f.aa" not in subjects
