"""The doctor sees in a dry run whether the API server reaches the webhook."""

from typing import Any

import pytest
from msgspec.structs import replace

from rosproxy.shared.documents.doctor_finding import DoctorFinding, Severity
from rosproxy_operator.common.threads import in_thread
from rosproxy_operator.kubernetes import doctor_facts
from rosproxy_operator.kubernetes.api.api_client import Api
from rosproxy_operator.kubernetes.doctor import examine
from rosproxy_operator.kubernetes.doctor_facts import DoctorFacts
from rosproxy_operator.kubernetes.planner.pods.trial import trial_pod
from rosproxy_operator.kubernetes.planner.pods.wiring import UNWIRED, pod_variables, wire
from rosproxy_operator.kubernetes.resources.model import Ros2Spec, RosProxy, Selector, ZenohSpec
from rosproxy_operator.kubernetes.resources.names import INJECT
from rosproxy_operator.kubernetes.status.webhook_findings import webhook_findings
from tests.unit.operator.kubernetes.api_server import ApiServer
from tests.unit.operator.kubernetes.builders_api import (
    CLUSTER_IP,
    NAMESPACE,
    URI,
    rosproxy,
    rosproxy_obj,
)
from tests.unit.operator.kubernetes.test_doctor_facts import put_operator, put_service, put_webhook

Obj = dict[str, Any]
OF = rosproxy(cluster_ip=CLUSTER_IP)
WEBHOOK: Obj = {
    "name": "wire.rosproxy.io",
    "objectSelector": {
        "matchExpressions": [
            {"key": INJECT, "operator": "Exists"},
            {"key": INJECT, "operator": "NotIn", "values": ["false", ""]},
        ]
    },
    "namespaceSelector": {
        "matchExpressions": [
            {"key": "kubernetes.io/metadata.name", "operator": "NotIn", "values": ["kube-system"]}
        ]
    },
}


@pytest.fixture
def ready(server: ApiServer, monkeypatch: pytest.MonkeyPatch) -> ApiServer:
    """An API server with an operator that is ready to wire pods."""
    monkeypatch.setattr(doctor_facts, "RETRIAL_PAUSE_S", 0.0)
    put_operator(server)
    put_webhook(server)
    put_service(server, True)
    return server


def wired_by(of: RosProxy = OF) -> Any:
    def admit(body: Obj) -> Obj:
        wiring = wire(body, pod_variables(of, CLUSTER_IP))
        annotations = {**wiring.annotations}
        return {**body, "metadata": {**body["metadata"], "annotations": annotations}}

    return admit


async def about_webhook(api: Api, of: RosProxy = OF) -> list[DoctorFinding]:
    def look() -> list[DoctorFinding]:
        facts = DoctorFacts(api, ())
        found = [*webhook_findings(facts.webhook(facts.operators([]), (), [of]))]
        return [*found, *facts.refused]

    return await in_thread(look)


@pytest.mark.parametrize(
    "changes",
    [{}, {"ros1": False, "ros2": Ros2Spec()}, {"ros1": False, "zenoh": ZenohSpec()}],
    ids=["1", "2", "zenoh"],
)
async def test_a_pod_that_would_be_wired(ready: ApiServer, api: Api, changes: Obj) -> None:
    of = replace(OF, spec=replace(OF.spec, **changes))
    ready.admit = wired_by(of)
    (finding,) = await about_webhook(api, of)
    assert (finding.severity, finding.text) == (
        Severity.OK,
        f"1 operator ready to wire pods, and wired a pod of a dry run in namespace {NAMESPACE}",
    )
    assert ready.asked("POST", "pods") == [{"dryRun": "All"}]


async def test_a_closed_webhook_port_is_seen_before_a_pod_is_created(
    ready: ApiServer, api: Api
) -> None:
    (finding,) = await about_webhook(api)
    assert finding.severity is Severity.ERROR
    assert finding.text == (
        "no operator answered the API server at the webhook port (chart value webhook.port) in a "
        "dry run, although an operator is ready: a new pod with the label rosproxy.io/inject in "
        f"namespace {NAMESPACE} is not wired"
    )
    assert "the webhook port of the operator's pods in namespace system" in finding.fix


async def test_a_second_trial_reaches_the_new_operator(ready: ApiServer, api: Api) -> None:
    """For a second, kube-proxy may lead to an operator that is gone."""
    wired = wired_by()
    ready.admit = lambda body: wired(body) if len(ready.asked("POST", "pods")) > 1 else body
    (finding,) = await about_webhook(api)
    assert finding.severity is Severity.OK
    assert len(ready.asked("POST", "pods")) == 2


async def test_a_closed_webhook_port_with_the_failure_policy_fail(
    ready: ApiServer, api: Api
) -> None:
    failed = 'Internal error occurred: failed calling webhook "wire.rosproxy.io": i/o timeout'
    ready.refuse("POST", "pods", 500, failed)
    (finding,) = await about_webhook(api)
    assert finding.severity is Severity.ERROR
    assert "is refused (" in finding.text
    assert failed in finding.text


async def test_an_operator_that_answers_with_a_warning_is_reached(
    ready: ApiServer, api: Api
) -> None:
    ready.warning = f"{UNWIRED}the Service has no cluster IP yet"
    (finding,) = await about_webhook(api)
    assert (finding.severity, finding.text) == (Severity.OK, "1 operator ready to wire pods")


@pytest.mark.parametrize(
    ("status", "severity", "message", "text"),
    [
        (
            403,
            Severity.WARNING,
            'pods is forbidden: User "me" cannot create resource "pods" in API group "" in the '
            f'namespace "{NAMESPACE}"',
            f"not checked: you lack the right to create pods -n {NAMESPACE}",
        ),
        (403, Severity.INFO, "exceeded quota: pods", "not checked: exceeded quota: pods"),
        (
            400,
            Severity.INFO,
            'admission webhook "x.example" does not support dry run',
            'not checked: admission webhook "x.example" does not support dry run',
        ),
    ],
)
async def test_a_refusal_tells_nothing_about_the_webhook(
    ready: ApiServer, api: Api, status: int, severity: Severity, message: str, text: str
) -> None:
    """A policy of the cluster that refuses the pod of the trial is no fault: real pods differ."""
    ready.refuse("POST", "pods", status, message)
    found, refused = await about_webhook(api)
    assert (found.severity, found.text) == (Severity.OK, "1 operator ready to wire pods")
    assert (refused.severity, refused.text) == (severity, text)


async def test_the_doctor_tries_a_rosproxy_of_the_cluster(ready: ApiServer) -> None:
    ready.put("rosproxies", rosproxy_obj(status={"masterURI": URI}), NAMESPACE)
    findings = await in_thread(examine, (), ())
    (found,) = [f for f in findings if f.check == "webhook"]
    assert found.text.endswith(f"in namespace {NAMESPACE} is not wired")


@pytest.mark.parametrize(
    ("webhook", "of"),
    [
        (WEBHOOK, rosproxy()),  # no Service yet
        (WEBHOOK, rosproxy(cluster_ip=CLUSTER_IP, deleting=True)),
        (WEBHOOK, rosproxy(cluster_ip=CLUSTER_IP, namespace="kube-system")),
        ({**WEBHOOK, "namespaceSelector": {"matchLabels": {"ros": "yes"}}}, OF),
        ({**WEBHOOK, "matchConditions": [{"name": "own"}]}, OF),
        ({**WEBHOOK, "objectSelector": {"matchLabels": {INJECT: "other"}}}, OF),
        (WEBHOOK, rosproxy(
            selector=Selector({}, (("app", "Exists", frozenset()),)), cluster_ip=CLUSTER_IP
        )),
    ],
)  # fmt: skip
def test_without_a_pod_that_the_webhook_is_sure_to_see_there_is_no_trial(
    webhook: Obj, of: RosProxy
) -> None:
    assert trial_pod(webhook, [of]) is None


def test_the_pod_has_the_labels_that_webhook_and_rosproxy_ask_for() -> None:
    webhook = {**WEBHOOK, "objectSelector": {"matchLabels": {"ros": "yes"}}}
    of = rosproxy(selector=Selector({"app": "x"}), cluster_ip=CLUSTER_IP)
    pod = trial_pod(webhook, [rosproxy("a"), of])
    assert pod is not None
    assert pod["metadata"]["labels"] == {"ros": "yes", "app": "x", INJECT: "arm"}
    assert pod["metadata"]["namespace"] == NAMESPACE
