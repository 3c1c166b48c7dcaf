"""``rosproxy-operator kubernetes doctor``, run where kubectl is."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tests.docker.engine import wait_until
from tests.kubernetes import api, release
from tests.kubernetes.cluster.control_plane import kubectl
from tests.kubernetes.cluster.layout import KUBECONFIG, NODES
from tests.kubernetes.cluster.network import inside
from tests.kubernetes.pods import Namespace
from tests.kubernetes.robot import Robot
from tests.kubernetes.rosproxies import NOWHERE, rosproxy, wait_event
from tests.kubernetes.traffic import START, wait_for_service

WEBHOOKS = "mutatingwebhookconfigurations"
PROGRAM = Path(sys.executable).with_name("rosproxy-operator")


def doctor(namespace: str, kubeconfig: Path = KUBECONFIG) -> tuple[int, list[dict[str, Any]]]:
    """The exit code, and what is found in a namespace."""
    ended = subprocess.run(
        [PROGRAM, "kubernetes", "--namespace", namespace, "doctor", "--json"],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
        env={**os.environ, "KUBECONFIG": str(kubeconfig)},
    )
    assert "Traceback" not in ended.stderr
    findings: list[dict[str, Any]] = json.loads(ended.stdout)["findings"]
    return ended.returncode, findings


def test_it_asks_the_doctor_in_each_proxys_pod(net: Namespace, robot: Robot) -> None:
    assert "there is no RosProxy" in doctor(net.name)[1][0]["text"]
    made = rosproxy(net.name, master={"uri": robot.master_uri}, ports=8)
    wait_for_service(net)
    net.node("roscpp", "pub", "--topic", "/told", "--word", "inside", on="node1")
    made.wait_status(lambda s: s.get("rosNodes") == 1, "the ROS node is counted", START)

    def masters() -> list[str]:
        name = f"proxy {net.name}/{made.the_proxy('node1').name}: master"
        return [finding["text"] for finding in doctor(net.name)[1] if finding["subject"] == name]

    wait_until(lambda: bool(masters()), 60, lambda: str(doctor(net.name)))
    assert masters()[0].startswith(f"{robot.master_uri} answers in")
    (own,) = [finding for finding in doctor(net.name)[1] if finding["check"] == "rosproxy"]
    assert own["severity"] == "ok"


def page() -> dict[str, Any]:
    """The document of the operator's live page, from loopback in the pod."""
    code = "import urllib.request as u; print(u.urlopen('http://127.0.0.1:11313/graph').read().decode())"
    graph: dict[str, Any] = json.loads(release.operator().run("python3", "-c", code))
    return graph


def test_the_operators_page_shows_the_nodes_of_each_pod(net: Namespace, robot: Robot) -> None:
    made = rosproxy(net.name, master={"uri": robot.master_uri}, ports=8)
    wait_for_service(net)
    pod = net.node("roscpp", "pub", "--topic", "/shown", "--word", "inside", on="node1")
    made.wait_status(lambda s: s.get("rosNodes") == 1, "the ROS node is counted", START)
    name = f"{net.name}/{made.the_proxy('node1').name}"
    key = f"{name} /{pod.node}"
    wait_until(lambda: key in page()["nodes"], 60, lambda: str(page()["nodes"]))
    assert page()["nodes"][key]["lane"] == "container"


def test_a_master_that_is_not_there_is_the_first_cause(net: Namespace) -> None:
    made = rosproxy(net.name, master={"uri": "http://10.88.0.50:1"}, ports=4)
    net.idle(on="node1")
    made.wait_for("MasterReachable", "False")
    code, findings = doctor(net.name)
    assert code == 1
    assert findings[0]["text"].startswith("MasterReachable is False: ")
    assert "or correct spec.master" in findings[0]["fix"]


def test_a_webhook_whose_configuration_is_gone_is_told(net: Namespace) -> None:
    """Otherwise no program reports why labelled pods are unwired."""

    def about_webhook() -> list[tuple[str, str]]:
        found = [finding for finding in doctor(net.name)[1] if finding["check"] == "webhook"]
        return [(finding["severity"], finding["text"]) for finding in found]

    rosproxy(net.name, master=NOWHERE)
    assert [severity for severity, _ in about_webhook()] == ["ok"]
    configuration = api.get(WEBHOOKS, "", release.FULL_NAME)
    api.delete(WEBHOOKS, "", release.FULL_NAME)
    try:
        ((severity, text),) = about_webhook()
    finally:
        kept = {key: configuration["metadata"].get(key, {}) for key in ("labels", "annotations")}
        metadata = {**kept, "name": release.FULL_NAME}
        api.json_call("POST", api.path(WEBHOOKS), {**configuration, "metadata": metadata})
    assert severity == "error"
    assert "no MutatingWebhookConfiguration has the webhook wire.rosproxy.io" in text
    release.wait_operator()


@contextmanager
def webhook_cut_off() -> Iterator[None]:
    """Let no packet get to the webhook port of the operators' pods, as a firewall does."""
    rule = ("FORWARD", "-p", "tcp", "--dport", "9443", "-j", "DROP")
    for node in NODES:
        inside(node, "iptables", "-w", "-I", *rule)
    try:
        yield
    finally:
        for node in NODES:
            inside(node, "iptables", "-w", "-D", *rule)
        release.wait_operator()


def test_a_webhook_that_the_api_server_does_not_reach_is_told(net: Namespace) -> None:
    made = rosproxy(net.name, master=NOWHERE)
    wait_until(lambda: bool(made.service), 60, made.tell)
    settled = time.monotonic() + 62
    wait_until(lambda: time.monotonic() > settled, 90, "RosProxy and operators are a minute old")
    with webhook_cut_off():
        pod = net.idle(on="node1")
    wait_event(net.name, pod.name, "Pod", "NotWired", "although an operator was ready")
    # The way is open again, so the doctor accuses the pod, not the webhook.
    made.wait_for("Degraded")
    code, findings = doctor(net.name)
    assert code == 1
    reason = (
        "no operator answered the API server at the webhook port (chart value webhook.port) when "
        "the pod was created, although an operator was ready"
    )
    told = [f for f in findings if reason in f["text"] and pod.name in f["text"]]
    assert told, findings
    fix = "llow connections from the API server to the webhook port"
    assert any(fix in f["text"] + f["fix"] for f in told), told
    assert [f["severity"] for f in findings if f["check"] == "webhook"] == ["ok"]
    pod.remove(grace=0)
    assert net.idle(on="node1").environment
    (found,) = [f for f in doctor(net.name)[1] if f["check"] == "webhook"]
    assert found["severity"] == "ok"


def test_a_webhook_that_the_api_server_does_not_reach_is_told_before_there_is_a_pod(
    net: Namespace,
) -> None:
    made = rosproxy(net.name, master=NOWHERE)
    made.wait_status(lambda s: bool(s.get("masterURI")), "the Service has an address")

    def about_webhook() -> tuple[str, str]:
        (found,) = [f for f in doctor(net.name)[1] if f["check"] == "webhook"]
        return found["severity"], found["text"]

    severity, text = about_webhook()
    assert (severity, text.endswith(f"of a dry run in namespace {net.name}")) == ("ok", True)
    with webhook_cut_off():
        severity, text = about_webhook()
    assert severity == "error"
    assert text.startswith("no operator answered the API server at the webhook port")
    assert text.endswith(f"in namespace {net.name} is not wired")
    assert not net.pods()


def test_labelled_pods_without_a_rosproxy_are_told(net: Namespace) -> None:
    pod = net.idle(on="node1")
    (found,) = [f for f in doctor(net.name)[1] if f["check"] == "pods"]
    assert (found["severity"], found["subject"]) == ("error", f"namespace {net.name}")
    assert pod.name in found["text"]


def test_the_doctor_names_missing_rights(net: Namespace, tmp_path: Path) -> None:
    """A user with rights to RosProxies and pods of a single namespace."""
    made = rosproxy(net.name, master=NOWHERE)
    made.wait_status(lambda s: s.get("nodes") == 0, "the operator has looked")
    rights = ("--verb=list", "--resource=rosproxies.rosproxy.io,pods")
    kubectl("create", "role", "looker", *rights, "-n", net.name)
    whom = ("--role=looker", f"--serviceaccount={net.name}:default")
    kubectl("create", "rolebinding", "looker", *whom, "-n", net.name)
    token = kubectl("create", "token", "default", "-n", net.name)
    config = json.loads(KUBECONFIG.read_text())
    config["users"][0]["user"] = {"token": token.strip()}
    kubeconfig = tmp_path / "kubeconfig"
    kubeconfig.write_text(json.dumps(config))
    code, findings = doctor(net.name, kubeconfig)
    assert code == 0, findings
    refused = [f["text"] for f in findings if f["text"].startswith("not checked")]
    assert refused == [
        "not checked: you lack the right to list pods -A",
        "not checked: you lack the right to list "
        "mutatingwebhookconfigurations.admissionregistration.k8s.io -A",
        f"not checked: you lack the right to list events -n {net.name}",
    ]
