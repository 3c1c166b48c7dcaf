"""Pods that the webhook wires, and pods that stay unchanged."""

from collections.abc import Iterator

import pytest

from tests.docker.engine import wait_until
from tests.kubernetes import api
from tests.kubernetes.api import Json
from tests.kubernetes.pods import INJECT, Namespace, Pod, environment, namespace
from tests.kubernetes.rosproxies import NOWHERE, rosproxy, wait_event


def variables(body: Json, kind: str = "containers", number: int = 0) -> Json:
    return environment(body["spec"][kind][number])


@pytest.fixture(scope="module")
def shared(_release: None) -> Iterator[Namespace]:
    """A namespace with a RosProxy."""
    with namespace() as made:
        yield made


@pytest.fixture(scope="module")
def uri(shared: Namespace) -> str:
    """The URI of the RosProxy's Service."""
    made = rosproxy(
        shared.name, master=NOWHERE, hostAliases=[{"ip": "192.0.2.9", "hostnames": ["robot"]}]
    )
    wait_until(lambda: bool(made.service), 60, made.tell)
    return f"http://{made.service['spec']['clusterIP']}:11311"


def test_labelled_pod_finds_its_master_and_knows_its_address(shared: Namespace, uri: str) -> None:
    pod = shared.idle(on="node1")
    assert pod.environment == {"ROS_MASTER_URI": uri, "ROS_IP": "status.podIP"}
    assert pod.body["spec"]["hostAliases"] == [{"ip": "192.0.2.9", "hostnames": ["robot"]}]
    pod.wait_ready()
    assert pod.run("printenv", "ROS_IP") == pod.ip


def test_what_containers_set_themselves_stays(shared: Namespace, uri: str) -> None:
    body = shared.pod_body("own", "sleep", "1", env={"ROS_MASTER_URI": "http://mine:1", "X": "y"})
    first = body["spec"]["containers"][0]
    body["spec"]["containers"].append(
        {**first, "name": "b", "env": [{"name": "ROS_HOSTNAME", "value": "h"}]}
    )
    body["spec"]["initContainers"] = [{**first, "name": "c", "env": []}]
    made, _ = api.dry_run(body)
    assert variables(made) == {
        "ROS_MASTER_URI": "http://mine:1",
        "X": "y",
        "ROS_IP": "status.podIP",
    }
    assert variables(made, number=1) == {"ROS_HOSTNAME": "h", "ROS_MASTER_URI": uri}
    assert variables(made, "initContainers") == {"ROS_MASTER_URI": uri, "ROS_IP": "status.podIP"}


@pytest.mark.parametrize("label", ["true", "robot"])
def test_labels_that_wire(label: str, shared: Namespace, uri: str) -> None:
    made, warnings = api.dry_run(shared.pod_body("pod", "true", labels={INJECT: label}))
    assert variables(made)["ROS_MASTER_URI"] == uri
    assert warnings == ""


@pytest.mark.parametrize("labels", [{}, {INJECT: "false"}, {INJECT: ""}])
def test_labels_that_do_not_wire(labels: dict[str, str], shared: Namespace, uri: str) -> None:
    made, warnings = api.dry_run(shared.pod_body("pod", "true", labels=labels))
    assert variables(made) == {}
    assert warnings == ""


def test_a_misspelt_label_is_told_on_the_pod(net: Namespace) -> None:
    made = rosproxy(net.name, master=NOWHERE)
    pod = net.idle(labels={"rosproxy.io/injekt": "true"})
    wait_event(
        net.name, pod.name, "Pod", "UnknownName", "Did you mean the label rosproxy.io/inject"
    )
    condition = made.wait_for("Degraded", reason="UnknownName")
    assert f"pod {net.name}/{pod.name}: label rosproxy.io/injekt" in condition["message"]
    pod.remove()
    made.wait_for("Degraded", "False")


def test_a_label_that_no_rosproxy_selects_is_an_event_on_the_pod(net: Namespace) -> None:
    """After a minute, because a RosProxy may be created after its pods."""
    made = rosproxy(net.name, master=NOWHERE)
    with namespace() as bare:
        lonely = bare.idle(labels={INJECT: "true"})
        astray = net.idle(labels={INJECT: "robott"})
        text = f"label {INJECT}=robott names no RosProxy"
        wait_event(net.name, astray.name, "Pod", "NotWired", text, 120)
        wait_event(bare.name, lonely.name, "Pod", "NotWired", "has no RosProxy", 120)
    condition = made.wait_for("Degraded", reason="NotWired")
    assert f"pod {net.name}/{astray.name}: label {INJECT}=robott" in condition["message"]
    astray.remove()
    made.wait_for("Degraded", "False")


def test_unknown_rosproxy_is_warned_of(shared: Namespace, uri: str) -> None:
    made, warnings = api.dry_run(shared.pod_body("pod", "true", labels={INJECT: "elsewhere"}))
    assert variables(made) == {}
    assert "elsewhere" in warnings


def test_no_rosproxy_is_warned_of(net: Namespace) -> None:
    made, warnings = api.dry_run(net.pod_body("pod", "true"))
    assert variables(made) == {}
    assert "RosProxy" in warnings


def test_two_rosproxies_are_warned_of(net: Namespace) -> None:
    first = rosproxy(net.name, master=NOWHERE)
    second = rosproxy(net.name, "second", master=NOWHERE)
    wait_until(lambda: bool(first.service and second.service), 60, second.tell)
    uri = f"http://{second.service['spec']['clusterIP']}:11311"
    made, warnings = api.dry_run(net.pod_body("pod", "true"))
    assert variables(made) == {}
    assert "robot" in warnings
    assert "second" in warnings
    made, warnings = api.dry_run(net.pod_body("pod", "true", labels={INJECT: "second"}))
    assert variables(made)["ROS_MASTER_URI"] == uri


def test_host_network_is_warned_of(shared: Namespace, uri: str) -> None:
    made, warnings = api.dry_run(shared.pod_body("pod", "true", hostNetwork=True))
    assert variables(made) == {}
    assert "hostNetwork" in warnings


def test_pod_made_right_after_its_rosproxy_is_wired(net: Namespace) -> None:
    """Both in the same file for kubectl apply: the pod comes before the Service."""
    made = rosproxy(net.name, master=NOWHERE)
    pod = net.idle(on="node1")
    address = made.service["spec"]["clusterIP"]
    assert pod.environment["ROS_MASTER_URI"] == f"http://{address}:11311"


def test_pod_made_before_its_rosproxy_is_told_so(net: Namespace) -> None:
    pod = net.idle(on="node1")
    rosproxy(net.name, master=NOWHERE)
    event = wait_event(net.name, pod.name, "Pod", "NotWired")
    assert event.type == "Warning"


def test_no_pod_gets_a_finalizer(shared: Namespace, uri: str) -> None:
    pod = shared.idle(on="node1")
    wait_until(lambda: pod.body["spec"].get("nodeName", "") != "", 60, "the pod is scheduled")
    assert "finalizers" not in pod.body["metadata"]
    assert not [a for a in pod.body["metadata"].get("annotations", {}) if "kopf" in a]


def test_pods_of_a_deployment_are_wired(shared: Namespace, uri: str) -> None:
    """Like a tutorial: with the master's own URI, and only the label added."""
    env = {"ROS_MASTER_URI": f"{NOWHERE['uri']}/"}
    template = shared.pod_body("unused", "sleep", "infinity", env=env)
    labels = {"app": "many", INJECT: "true"}
    api.create({
        "apiVersion": "apps/v1", "kind": "Deployment",
        "metadata": {"name": "many", "namespace": shared.name},
        "spec": {"replicas": 2, "selector": {"matchLabels": {"app": "many"}},
                 "template": {"metadata": {"labels": labels}, "spec": template["spec"]}},
    })  # fmt: skip
    wait_until(lambda: len(shared.pods("app=many")) == 2, 60, "two pods")
    for body in shared.pods("app=many"):
        assert variables(body)["ROS_MASTER_URI"] == uri
        assert body["metadata"]["annotations"] == {
            "rosproxy.io/master-uri": uri,
            "rosproxy.io/replaced-master-uri": f"{NOWHERE['uri']}/",
        }


def test_pod_that_sets_the_right_master_itself_is_served(net: Namespace) -> None:
    """The RosProxy selects the pod. Without the label, the webhook does not see the pod."""
    made = rosproxy(net.name, master=NOWHERE, podSelector={"matchLabels": {"app": "own"}})
    pod = net.pod("sleep", "infinity", labels={"app": "own"}, on="node1",
                  env={"ROS_MASTER_URI": "http://rosproxy-robot:11311"})  # fmt: skip
    made.wait_status(lambda s: s.get("nodes") == 1, "a node is served")
    other = net.pod("sleep", "infinity", labels={"app": "own"}, on="node1")
    wait_event(net.name, other.name, "Pod", "NotWired")
    assert not [e for e in _events(pod) if e["reason"] == "NotWired"]


def _events(pod: Pod) -> list[Json]:
    every = api.objects("events", pod.namespace)
    return [event for event in every if event["involvedObject"].get("name") == pod.name]
