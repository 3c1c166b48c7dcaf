"""The doctor's findings about the webhook and from Events, and missing permissions."""

import copy
import time
from datetime import UTC, datetime
from functools import cache
from typing import Any

import pytest
from msgspec.structs import replace

from rosproxy.shared.documents.doctor_finding import DoctorFinding, Severity
from rosproxy_operator.common.threads import in_thread
from rosproxy_operator.kubernetes.api.api_client import Api, ApiNotFound
from rosproxy_operator.kubernetes.api.rbac import missing_right
from rosproxy_operator.kubernetes.doctor import examine, running_proxies
from rosproxy_operator.kubernetes.doctor_facts import DoctorFacts, ready_pods
from rosproxy_operator.kubernetes.planner.pods.labelled import (
    missing_rosproxy_findings,
    misspelt_findings,
    unreached,
)
from rosproxy_operator.kubernetes.resources.model import Name
from rosproxy_operator.kubernetes.resources.names import (
    COMPONENT_LABEL,
    IMAGE_CHECK,
    LAN_RELAY,
    PROXY,
)
from rosproxy_operator.kubernetes.status.condition_findings import cluster_findings
from rosproxy_operator.kubernetes.status.event_findings import (
    MOST_EVENTS,
    RecentEvent,
    event_findings,
    recent_events,
)
from rosproxy_operator.kubernetes.status.operator_findings import Operators, operator_findings
from rosproxy_operator.kubernetes.status.webhook_findings import webhook_findings
from tests.unit.operator.kubernetes.api_server import ApiServer
from tests.unit.operator.kubernetes.builders_api import (
    CLUSTER_IP,
    NAMESPACE,
    URI,
    pod,
    pod_obj,
    proxy_obj,
    rosproxy,
    rosproxy_obj,
)

Obj = dict[str, Any]
NAME = "rosproxy-operator"
OPERATOR = {"app.kubernetes.io/component": "operator", "app.kubernetes.io/part-of": "rosproxy"}


def put_webhook(server: ApiServer, ca: str = "Q0E=", annotations: Obj | None = None) -> None:
    client = {"service": {"namespace": "system", "name": NAME}, "caBundle": ca}
    webhooks = [{"name": "wire.rosproxy.io", "clientConfig": client}]
    meta = {"name": NAME, "annotations": annotations or {}}
    server.put("mutatingwebhookconfigurations", {"metadata": meta, "webhooks": webhooks})


def put_service(server: ApiServer, *ready: bool) -> None:
    server.put("services", {"metadata": {"name": NAME}}, "system")
    labels = {"kubernetes.io/service-name": NAME}
    endpoints = [{"conditions": {"ready": is_ready}} for is_ready in ready]
    endpoint_slice = {"metadata": {"name": "s", "labels": labels}, "endpoints": endpoints}
    server.put("endpointslices", endpoint_slice, "system")


def operator_obj(*args: str, ready: bool = True, env: tuple[Obj, ...] = ()) -> Obj:
    ready_at = {"type": "Ready", "status": str(ready), "lastTransitionTime": "2026-11-01T00:00:00Z"}
    container = {"args": ["kubernetes", *args], "env": [*env]}
    return {
        "metadata": {"name": "o", "namespace": "system", "labels": OPERATOR},
        "spec": {"serviceAccountName": "op", "containers": [container]},
        "status": {"conditions": [ready_at]},
    }


def put_operator(server: ApiServer, *args: str, env: tuple[Obj, ...] = ()) -> None:
    server.put("pods", operator_obj(*args, env=env), "system")


def variable(name: str, value: str) -> tuple[Obj, ...]:
    return ({"name": f"ROSPROXY_{name}", "value": value},)


def from_a_field(name: str) -> tuple[Obj, ...]:
    reference = {"fieldRef": {"fieldPath": "metadata.namespace"}}
    return ({"name": f"ROSPROXY_{name}", "valueFrom": reference},)


async def about_webhook(api: Api, unreached: tuple[str, ...] = ()) -> list[DoctorFinding]:
    def look() -> list[DoctorFinding]:
        facts = DoctorFacts(api, ())
        operators = facts.operators([])
        found = [
            *operator_findings(operators),
            *webhook_findings(facts.webhook(operators, unreached, ())),
        ]
        return [*found, *facts.refused]

    return await in_thread(look)


async def test_a_webhook_that_can_work(server: ApiServer, api: Api) -> None:
    other = {"metadata": {"name": "other"}, "webhooks": [{"name": "x.example"}]}
    server.put("mutatingwebhookconfigurations", other)
    put_operator(server)
    put_webhook(server)
    put_service(server, True, False, True)
    (finding,) = await about_webhook(api)
    assert (finding.severity, finding.text) == (Severity.OK, "2 operators ready to wire pods")


async def test_a_webhook_that_the_api_server_does_not_reach(server: ApiServer, api: Api) -> None:
    """The doctor said "2 operators ready to wire pods", while each new pod stayed unwired."""
    put_operator(server)
    put_webhook(server)
    put_service(server, True)
    (finding,) = await about_webhook(api, ("robots/talker",))
    assert finding.severity is Severity.ERROR
    assert finding.text == (
        "no operator answered the API server at the webhook port (chart value webhook.port) when "
        "these pods were created, although an operator was ready: "
        "robots/talker"
    )
    assert "the webhook port of the operator's pods in namespace system" in finding.fix


def no_service(_: object) -> str:
    """The doctor could not read the Service."""
    return ""


def test_which_pods_show_that_the_api_server_reached_no_operator() -> None:
    of = replace(rosproxy(cluster_ip=CLUSTER_IP), created="2026-01-02T00:00:00Z")
    late: Obj = {"created": "2026-02-01T00:00:00Z"}
    pods = [
        pod("unwired", **late),
        pod("wired", wired_master_uri=URI, **late),
        pod("its-own", own_masters=("http://mine:1",), **late),
        pod("unlabelled", {}, **late),
        pod("astray", {"rosproxy.io/inject": "leg"}, **late),
        pod("old", created="2026-01-01T00:00:00Z"),
    ]
    assert unreached(pods, [of], "2026-01-31T00:00:00Z", no_service) == ["robots/unwired"]
    assert unreached(pods, [of], "2026-01-31T23:59:30Z", no_service) == []
    assert unreached(pods, [of], "", no_service) == []


async def test_pods_older_than_the_service_show_nothing_about_the_webhook(
    server: ApiServer, api: Api
) -> None:
    """A RosProxy that was refused for long gets its Service when its spec is corrected."""
    of = replace(rosproxy(cluster_ip=CLUSTER_IP), created="2026-01-02T00:00:00Z")
    unwired = pod("unwired", created="2026-02-01T00:00:00Z")

    def look() -> list[str]:
        since = cache(DoctorFacts(api, ()).service_since)
        return unreached([unwired], [of], "2026-01-31T00:00:00Z", since)

    assert await in_thread(look) == ["robots/unwired"]
    made = {"name": "rosproxy-arm", "creationTimestamp": "2026-02-01T00:00:10Z"}
    server.put("services", {"metadata": made}, NAMESPACE)
    assert await in_thread(look) == []


async def test_labelled_pods_in_a_namespace_without_a_rosproxy(server: ApiServer, api: Api) -> None:
    """Otherwise only an admission warning mentions the pods, which no user of a Deployment sees."""
    for name in ("talker", "listener"):
        server.put("pods", pod_obj(name, {"rosproxy.io/inject": "true"}), NAMESPACE)
    server.put("pods", pod_obj("off", {"rosproxy.io/inject": "false"}), NAMESPACE)
    pods = await in_thread(DoctorFacts(api, ()).labelled_pods)
    (finding,) = missing_rosproxy_findings(pods, frozenset({"other"}), Operators())
    assert (finding.severity, finding.subject) == (Severity.ERROR, f"namespace {NAMESPACE}")
    assert "2 pods with the label rosproxy.io/inject (listener, talker)" in finding.text
    assert "create a RosProxy in the namespace, then run kubectl -n robots delete" in finding.fix
    assert list(missing_rosproxy_findings(pods, frozenset({NAMESPACE}), Operators())) == []
    elsewhere = Operators((operator_obj("--namespace=a"),))
    (finding,) = missing_rosproxy_findings(pods, frozenset({"other"}), elsewhere)
    assert finding.text.startswith(f"no operator manages the namespace {NAMESPACE} (option ")
    assert "and the namespace has no RosProxy, but 2 pods" in finding.text
    assert finding.fix.startswith(
        "add the namespace to the chart's value namespaces and run helm upgrade, create a RosProxy"
    )


async def test_misspelt_labels_in_a_namespace_without_a_rosproxy(
    server: ApiServer, api: Api
) -> None:
    """The doctor mentioned no pod, and only asked for a RosProxy."""
    for name in ("talker", "listener"):
        obj = pod_obj(name, {"rosproxy.io/injekt": "true"})
        owner = {"kind": "StatefulSet", "name": "robots", "controller": True}
        server.put(
            "pods", {**obj, "metadata": {**obj["metadata"], "ownerReferences": [owner]}}, NAMESPACE
        )
    server.put("pods", pod_obj("other", {"app": "x"}), NAMESPACE)
    pods = await in_thread(DoctorFacts(api, ()).labelled_pods)
    (finding,) = misspelt_findings(pods, frozenset())
    assert (finding.severity, finding.subject) == (Severity.ERROR, f"pod {NAMESPACE}/listener")
    assert "Did you mean the label rosproxy.io/inject of pods?" in finding.text
    assert finding.fix == (
        f"correct the name in the template: kubectl -n {NAMESPACE} edit statefulset/robots"
    )
    assert misspelt_findings(pods, frozenset({NAMESPACE})) == []
    assert list(missing_rosproxy_findings(pods, frozenset(), Operators())) == []


CERT_MANAGER = {"cert-manager.io/inject-ca-from": "a/b"}


@pytest.mark.parametrize(
    ("webhook", "ready", "text", "fix"),
    [
        ({"ca": ""}, (True,), "no caBundle", "wait 20 s"),
        ({"ca": "", "annotations": CERT_MANAGER}, (True,), "no caBundle", "cainjector runs"),
        ({}, None, "Service system/rosproxy-operator of the webhook does not", "helm upgrade"),
        ({}, (False,), "no ready endpoint", "kubectl -n system describe pods"),
        (None, (True,), "although operators serve the webhook", "helm upgrade"),
    ],
)
async def test_a_webhook_that_can_not_work(
    server: ApiServer, api: Api, webhook: Obj | None, ready: Any, text: str, fix: str
) -> None:
    put_operator(server, "--webhook-bind=x:1")
    if webhook is not None:
        put_webhook(server, **webhook)
    if ready is not None:
        put_service(server, *ready)
    (finding,) = await about_webhook(api)
    assert finding.severity is Severity.ERROR
    assert text in finding.text
    assert fix in finding.fix
    assert "rollout restart" in finding.fix


async def test_without_an_operator_that_is_the_first_finding(server: ApiServer, api: Api) -> None:
    """After helm uninstall the doctor began with a consequence, and warned of the cause."""
    (finding,) = await about_webhook(api)
    assert (finding.severity, finding.check) == (Severity.ERROR, "operator")
    assert finding.text.startswith("no operator runs in the cluster")
    assert "helm upgrade --install rosproxy" in finding.fix
    assert cluster_findings([rosproxy_obj()], Operators(())) == []


def test_operators_that_are_not_ready() -> None:
    (finding,) = operator_findings(Operators((operator_obj(ready=False),)))
    assert finding.text == "no operator is ready (pods system/o), so no pod is wired"
    assert finding.fix.startswith("read the operator's log: kubectl -n system logs -l")


@pytest.mark.parametrize(
    ("option", "env"),
    [
        (("--namespace=a", "--namespace=b"), ()),
        (("--namespace", "a"), ()),
        ((), variable("NAMESPACE", "a b")),
    ],
)
def test_a_namespace_that_no_operator_manages(
    option: tuple[str, ...], env: tuple[Obj, ...]
) -> None:
    """The doctor asked whether the operator runs, and said that no pod is selected."""
    operators = Operators((operator_obj(*option, env=env),))
    (finding,) = cluster_findings([rosproxy_obj()], operators)
    assert finding.severity is Severity.ERROR
    assert finding.text.startswith(f"no operator manages the namespace {NAMESPACE} (option ")
    assert "the chart's value namespaces" in finding.fix
    another = operator_obj(f"--namespace={NAMESPACE}")
    both = (operator_obj(*option, env=env), another)
    (finding,) = cluster_findings([rosproxy_obj()], Operators(both))
    assert "has not looked at the last change" in finding.text
    assert "kubectl -n system logs -l" in finding.fix


@pytest.mark.parametrize(
    ("option", "env", "namespaces"),
    [
        ((), (), set()),
        (("--namespace=a",), variable("NAMESPACE", "b"), {"a"}),
        ((), variable("NAMESPACE", ""), set()),
        ((), from_a_field("NAMESPACE"), set()),
        (("--namespace=$(POD_NAMESPACE)",), (), set()),
    ],
)
def test_the_namespaces_of_an_operator(
    option: tuple[str, ...], env: tuple[Obj, ...], namespaces: set[str]
) -> None:
    """The doctor took "$(POD_NAMESPACE)" for the name of a namespace."""
    assert Operators((operator_obj(*option, env=env),)).namespaces == namespaces


async def test_an_operator_that_may_not_write_the_status(server: ApiServer, api: Api) -> None:
    put_operator(server)
    facts = DoctorFacts(api, ())
    operators = await in_thread(facts.operators, [rosproxy_obj()])
    assert server.bodies[-1]["spec"]["user"] == "system:serviceaccount:system:op"
    (finding,) = cluster_findings([rosproxy_obj()], operators)
    assert finding.text.startswith("the operator lacks the right to patch rosproxies/status")
    server.granted = {"system:serviceaccount:system:op"}
    operators = await in_thread(facts.operators, [rosproxy_obj()])
    (finding,) = cluster_findings([rosproxy_obj()], operators)
    assert "has not looked at the last change" in finding.text
    assert facts.refused == []


async def test_the_rights_of_the_operator_that_manages_the_namespace_count(
    server: ApiServer, api: Api
) -> None:
    other = operator_obj("--namespace=elsewhere")
    other["metadata"] |= {"name": "a", "namespace": "another"}
    server.put("pods", other, "another")
    put_operator(server, f"--namespace={NAMESPACE}")
    server.granted = {"system:serviceaccount:another:op"}
    facts = DoctorFacts(api, ())
    operators = await in_thread(facts.operators, [rosproxy_obj()])
    (finding,) = cluster_findings([rosproxy_obj()], operators)
    assert finding.text.startswith("the operator lacks the right to patch rosproxies/status")
    server.granted = {"system:serviceaccount:system:op"}
    operators = await in_thread(facts.operators, [rosproxy_obj()])
    (finding,) = cluster_findings([rosproxy_obj()], operators)
    assert "has not looked at the last change" in finding.text
    assert "kubectl -n system logs -l" in finding.fix


@pytest.mark.parametrize(
    ("args", "env"),
    [
        (("--webhook-bind", "x:1"), ()),
        ((), variable("WEBHOOK_BIND", "x:1")),
        ((), from_a_field("WEBHOOK_BIND")),
    ],
)
async def test_a_missing_webhook_that_operators_serve(
    server: ApiServer, api: Api, args: tuple[str, ...], env: tuple[Obj, ...]
) -> None:
    """The doctor recognised only --webhook-bind=…, and said webhook.enabled=false."""
    put_operator(server, *args, env=env)
    (finding,) = await about_webhook(api)
    assert finding.severity is Severity.ERROR
    assert "although operators serve the webhook" in finding.text


@pytest.mark.parametrize(
    ("args", "env"),
    [
        ((), ()),
        (("--webhook-bind=x:1", "--webhook-bind=none"), ()),
        (("--webhook-bind=none",), variable("WEBHOOK_BIND", "x:1")),
    ],
)
async def test_a_webhook_that_no_operator_serves(
    server: ApiServer, api: Api, args: tuple[str, ...], env: tuple[Obj, ...]
) -> None:
    put_operator(server, *args, env=env)
    (finding,) = await about_webhook(api)
    assert finding.severity is Severity.INFO
    assert "no MutatingWebhookConfiguration has the webhook wire.rosproxy.io" in finding.text


def forbid(server: ApiServer, kind: str, group: str, place: str = "at the cluster scope") -> None:
    words = f'{kind} is forbidden: User "me" cannot list resource "{kind}" in API group "{group}"'
    server.refuse("GET", kind, 403, f"{words} {place}")


async def test_rights_that_are_missing_are_named_and_the_rest_is_looked_at(
    server: ApiServer, api: Api
) -> None:
    forbid(server, "endpointslices", "discovery.k8s.io", 'in the namespace "system"')
    put_operator(server)
    put_webhook(server, "")
    put_service(server)
    found, refused = await about_webhook(api)
    assert "no caBundle" in found.text
    assert refused.severity is Severity.WARNING
    right = "list endpointslices.discovery.k8s.io -n system"
    assert refused.text == f"not checked: you lack the right to {right}"
    assert refused.fix.startswith(f"check with kubectl auth can-i {right};")
    forbid(server, "mutatingwebhookconfigurations", "admissionregistration.k8s.io")
    (refused,) = await about_webhook(api)
    assert "list mutatingwebhookconfigurations.admissionregistration.k8s.io -A" in refused.text


async def test_without_the_right_to_pods_it_is_not_known_whether_the_webhook_is_meant(
    server: ApiServer, api: Api
) -> None:
    forbid(server, "pods", "")
    found, refused = await about_webhook(api)
    assert (found.severity, "unless the webhook is switched off" in found.fix) == (
        Severity.WARNING,
        True,
    )
    assert "list pods -A" in refused.text


@pytest.mark.parametrize(
    ("kind", "group", "subject", "right"),
    [
        ("rosproxies", "rosproxy.io", "rosproxy", "list rosproxies.rosproxy.io -A"),
        ("pods", "", "proxy", "list pods -A"),
    ],
)
async def test_without_a_right_that_the_doctor_needs_it_checks_the_rest(
    server: ApiServer, kind: str, group: str, subject: str, right: str
) -> None:
    """The doctor ended with "the operator's role lacks a rule": its user lacks the right."""
    put_webhook(server, "")
    put_operator(server)
    server.put("pods", pod_obj("talker", {"rosproxy.io/inject": "true"}), NAMESPACE)
    forbid(server, kind, group)
    findings = await in_thread(examine, (), ())
    (refused,) = [f for f in findings if f.check == subject and f.severity is Severity.ERROR]
    assert refused.text == f"not checked: you lack the right to {right}"
    assert "operator's role" not in str(findings)
    assert "no caBundle" in str([f for f in findings if f.check == "webhook"])
    assert "has no RosProxy" not in str(findings)


async def test_the_doctor_ends_if_the_cluster_has_no_definition(server: ApiServer) -> None:
    server.refuse("GET", "rosproxies", 404, "404 page not found")
    with pytest.raises(ApiNotFound, match=r"rosproxies\.rosproxy\.io is not installed"):
        await in_thread(examine, (), ())


def test_what_is_no_right() -> None:
    assert missing_right("etcd is away") == ""


NOW = 1_800_000_000.0


def event(about: Obj, reason: str = "R", message: str = "m", ago: float = 60, **more: Any) -> Obj:
    meta = about["metadata"]
    names = {"namespace": meta["namespace"], "name": meta["name"], "uid": meta["uid"]}
    kind = about.get("kind", "Pod")
    when = datetime.fromtimestamp(NOW - ago, UTC).isoformat().replace("+00:00", "Z")
    return {
        "metadata": {"name": f"{meta['name']}.{reason}.{message}.{ago}"},
        "involvedObject": {"kind": kind, **names},
        "type": "Warning",
        "reason": reason,
        "message": message,
        "lastTimestamp": when,
        **more,
    }


OWN: Obj = {"source": {"component": NAME}}


def found(events: list[Obj], rosproxy: Obj | None = None, ready: bool = False) -> list[str]:
    proxy = proxy_obj()
    of = rosproxy or rosproxy_obj()
    recent = recent_events(events, [of], [proxy], NOW)
    uids = {proxy["metadata"]["uid"]} if ready else set()
    return [f"{f.severity.name} {f.subject}: {f.text}" for f in event_findings(recent, uids)]


def test_events_of_rosproxies_and_their_pods_the_newest_first() -> None:
    proxy = proxy_obj()
    stranger = pod_obj("stranger")
    name = f"pod {NAMESPACE}/{proxy['metadata']['name']}"
    events = [
        event(proxy, "BackOff", "older", 300),
        event(proxy, "BackOff", "pulling", 60, count=7),
        event(rosproxy_obj(), "MasterUnreachable", "refused", 120, **OWN),
        event(pod_obj(), "NotWired", "has no", 30, **OWN),
        event(stranger, "Failed", "is no business of ours", 1),
        event({**rosproxy_obj(name="gone"), "kind": "RosProxy"}, "R", "m", 1, **OWN),
    ]
    assert found(events) == [
        f"INFO pod {NAMESPACE}/talker: NotWired 30 s ago: has no (no condition reports this now)",
        f"WARNING {name}: BackOff 1 min ago, 7 times: pulling",
        f"INFO rosproxy {NAMESPACE}/arm: MasterUnreachable 2 min ago: refused (no condition "
        "reports this now)",
    ]
    assert "WARNING" not in "".join(found(events, ready=True))
    assert f"INFO {name}: BackOff 1 min ago, 7 times: pulling (the pod is ready now)" in found(
        events, ready=True
    )


def test_what_a_condition_says_is_not_told_twice() -> None:
    text = "pod robots/talker: has no ROS_MASTER_URI. And more"
    of = rosproxy_obj(status={"conditions": [{"type": "Degraded", "message": text}]})
    assert found([event(pod_obj(), "NotWired", "has no ROS_MASTER_URI", **OWN)], of) == []


def test_where_there_is_no_rosproxy_an_event_is_not_over() -> None:
    lonely = pod_obj()
    lonely["metadata"]["namespace"] = "elsewhere"
    assert found([event(lonely, "NotWired", "namespace elsewhere has no RosProxy", **OWN)]) == []


def test_events_are_bounded_and_harmless() -> None:
    proxy = proxy_obj()
    events = [event(proxy, f"R{n}", "x" * 9000 + "\x1b", float(n)) for n in range(MOST_EVENTS + 5)]
    texts = found(events)
    assert len(texts) == MOST_EVENTS
    assert all(len(text) < 600 and "\x1b" not in text for text in texts)


@pytest.mark.parametrize(
    "more",
    [
        {"lastTimestamp": None, "eventTime": "2027-01-15T07:59:00.000000Z"},
        {"series": {"lastObservedTime": "2027-01-15T07:59:00.000000Z", "count": 1}},
        {"lastTimestamp": "nonsense", "firstTimestamp": "2027-01-15T07:59:00Z"},
    ],
)
def test_whoever_made_it_its_time_is_found(more: Obj) -> None:
    (text,) = found([event(proxy_obj(), "R", "m", 9999, **more)])
    assert "R 1 min ago: m" in text


async def test_of_pods_that_are_gone_nothing_is_told(server: ApiServer, api: Api) -> None:
    there, gone, other = (pod_obj(name) for name in ("there", "gone", "other"))
    of = rosproxy_obj()
    proxy = proxy_obj(status={"conditions": [{"type": "Ready"}]})
    server.put("pods", there, NAMESPACE)
    server.put("pods", {**other, "metadata": {**other["metadata"], "uid": "anew"}}, NAMESPACE)
    for obj in (there, gone, other, proxy):
        server.put("events", event(obj, "NotWired", "m", NOW - time.time(), **OWN), NAMESPACE)
    facts = DoctorFacts(api, ())
    events = await in_thread(facts.events, [of], [proxy])
    assert {e.id.name for e in events} == {"there", proxy["metadata"]["name"]}
    assert ready_pods([proxy]) == frozenset()
    forbid(server, "events", "")
    assert await in_thread(facts.events, [of], [proxy]) == []
    assert "list events -A" in facts.refused[0].text


def test_the_name_in_an_event_is_no_command() -> None:
    """A user that may create Events can write any text there."""
    evil = RecentEvent(
        kind="Pod",
        id=Name("robots;reboot", "talker;reboot"),
        uid="u",
        reason="R",
        message="m",
        age=1.0,
        count=1,
        own=False,
    )
    (finding,) = event_findings([evil], ())
    assert finding.fix == "read kubectl -n 'robots;reboot' describe pod 'talker;reboot'"


def test_only_running_proxies_have_a_doctor() -> None:
    """A LAN relay has no doctor, and must not become an ERROR."""
    proxy = proxy_obj("robot")
    pods = [proxy, *(copy.deepcopy(proxy) for _ in range(3))]
    for obj, component in zip(pods[1:], (LAN_RELAY, IMAGE_CHECK, PROXY), strict=True):
        obj["metadata"]["labels"][COMPONENT_LABEL] = component
    pods[3]["status"]["phase"] = "Pending"
    assert running_proxies(pods) == [proxy]


async def test_a_missing_crd_is_told(server: ApiServer, api: Api) -> None:
    """The doctor printed the answer of the API server, "404 page not found", and nothing else."""
    server.refuse("GET", "rosproxies", 404, "404 page not found")
    with pytest.raises(ApiNotFound, match=r"rosproxies\.rosproxy\.io is not installed"):
        await in_thread(api.rosproxies)
