"""``rosproxy-operator kubernetes doctor``: finds faults in a cluster, the first cause first.

The doctor checks in this order: the operators, the statuses of the RosProxies, the labelled pods,
the webhook, and the last Events (`doctor_facts`). Then the doctor runs ``rosproxy doctor`` in the
pod of each proxy, as ``kubectl exec`` does: this command tests from the place of the proxy. All
requests use the rights of the user that calls the doctor. A missing right becomes a finding, and
the doctor checks the rest.
"""

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache

from kubernetes.client import ApiClient, CoreV1Api
from kubernetes.client.exceptions import ApiException
from kubernetes.stream import stream
from websocket import WebSocketException

from rosproxy.shared.documents.doctor_finding import DoctorFinding, warning, without_known_names
from rosproxy_operator.common.proxy_doctor import command, read_findings
from rosproxy_operator.kubernetes.api.api_client import Api
from rosproxy_operator.kubernetes.api.kubeconfig import configuration
from rosproxy_operator.kubernetes.doctor_facts import DoctorFacts, ready_pods
from rosproxy_operator.kubernetes.planner.pods.labelled import (
    missing_rosproxy_findings,
    misspelt_findings,
    unreached,
)
from rosproxy_operator.kubernetes.resources.checks import submap, text_at, texts_at
from rosproxy_operator.kubernetes.resources.model import Json, Pod
from rosproxy_operator.kubernetes.resources.names import PROXY, component
from rosproxy_operator.kubernetes.resources.spec import rosproxies as read_rosproxies
from rosproxy_operator.kubernetes.status.condition_findings import cluster_findings
from rosproxy_operator.kubernetes.status.event_findings import event_findings
from rosproxy_operator.kubernetes.status.operator_findings import Operators, operator_findings
from rosproxy_operator.kubernetes.status.webhook_findings import webhook_findings

MOST_DOCTORS = 4
"""Proxies checked at the same time: each doctor is a separate Python process in the pod."""
DOCTOR_TIMEOUT_S = 60
"""Most seconds for the doctor of a proxy, which waits for nodes that may not answer."""


def examine(namespaces: Sequence[str], names: Sequence[str]) -> list[DoctorFinding]:
    """Return all findings.

    If ``names`` are given, the proxies report only on these nodes, topics and services. Raises
    ApiError if the API server does not answer, or has no definition of RosProxies.
    """
    api = Api(namespaces)
    try:
        facts = DoctorFacts(api, namespaces)
        listed = facts.rosproxies()
        rosproxies = listed or ()
        own_pods = facts.own_pods()
        operators = facts.operators(rosproxies)
        pods = facts.labelled_pods()
        by_name, _ = read_rosproxies(rosproxies)
        usable = [*by_name.values()]
        cut_off = unreached(pods, usable, operators.ready_since, cache(facts.service_since))
        webhook = facts.webhook(operators, cut_off, usable)
        findings = [
            *operator_findings(operators),
            *([] if listed is None else _rosproxy_findings(listed, operators, pods)),
            *webhook_findings(webhook),
            *event_findings(facts.events(rosproxies, own_pods), ready_pods(own_pods)),
            *facts.refused,
        ]
    finally:
        api.close()
    proxies = running_proxies(own_pods)
    with ThreadPoolExecutor(MOST_DOCTORS) as threads:
        answers = threads.map(lambda pod: [*_ask(pod["metadata"], names)], proxies)
        return [*findings, *without_known_names([*answers], names)]


def _rosproxy_findings(
    rosproxies: Sequence[Json], operators: Operators, pods: Sequence[Pod]
) -> Iterator[DoctorFinding]:
    """The findings about RosProxies, and about labelled pods in namespaces without a RosProxy."""
    with_rosproxy = namespaces_of(rosproxies)
    yield from cluster_findings(rosproxies, operators)
    yield from missing_rosproxy_findings(pods, with_rosproxy, operators)
    yield from misspelt_findings(pods, with_rosproxy)


def namespaces_of(objs: Iterable[Json]) -> frozenset[str]:
    """Return the namespaces of objects."""
    return frozenset(text_at(submap(obj, "metadata"), "namespace") for obj in objs)


def running_proxies(own_pods: Iterable[Json]) -> list[Json]:
    """Return the pods with a doctor: running proxies, without LAN relays and image checks."""
    return [
        pod
        for pod in own_pods
        if component(texts_at(submap(pod, "metadata"), "labels")) == PROXY
        and submap(pod, "status").get("phase") == "Running"
    ]


def _ask(pod: Json, names: Sequence[str]) -> Iterator[DoctorFinding]:
    """Yield the findings of the doctor in a pod; if the doctor can't run, a warning."""
    namespace = pod["namespace"]
    name = pod["name"]
    subject = f"proxy {namespace}/{name}"
    try:
        output = _run(namespace, name, command(names))
    except (ApiException, WebSocketException, OSError) as error:
        reason = getattr(error, "reason", "") or str(error)
        line = str(reason).strip().partition("\n")[0][:300]
        text = f"rosproxy doctor could not run in the proxy's container: {line}"
        fix = "check that you may create pods/exec: kubectl auth can-i create pods/exec -n "
        yield warning("proxy", subject, text, fix + namespace)
        return
    yield from read_findings(subject, output)


def _run(namespace: str, pod: str, arguments: Sequence[str]) -> bytes:
    """Return the standard output of a command in a pod, up to its end or `DOCTOR_TIMEOUT_S`."""
    with ApiClient(configuration()) as client:  # `stream` changes the client during the call
        channel = stream(
            CoreV1Api(client).connect_get_namespaced_pod_exec,
            pod,
            namespace,
            command=list(arguments),
            stdout=True,
            stderr=False,
            stdin=False,
            tty=False,
            _preload_content=False,
        )
        try:
            channel.run_forever(timeout=DOCTOR_TIMEOUT_S)
            return str(channel.read_stdout(timeout=1)).encode()
        finally:
            channel.close()
