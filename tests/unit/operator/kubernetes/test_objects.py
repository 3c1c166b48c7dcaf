"""Parsing of nodes, pods, Services and answers."""

from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from rosproxy.shared.documents.status_document import RangeProbeStatus, read_status
from rosproxy.shared.output.problems import MOST_PROBLEMS
from rosproxy.shared.output.text import clean
from rosproxy.shared.settings import MOST_ZENOH_HUBS, MOST_ZENOH_LINKS, MOST_ZENOH_PEERS
from rosproxy_operator.kubernetes.proxies import proxy_report as reports
from rosproxy_operator.kubernetes.proxies.proxy_report import RECENT_S, no_answer, report
from rosproxy_operator.kubernetes.resources import objects
from rosproxy_operator.kubernetes.resources.checks import host_problem
from rosproxy_operator.kubernetes.resources.model import VALUE_AT_RUNTIME, Name
from rosproxy_operator.kubernetes.resources.objects import node, pod, proxy_pod, service
from tests.unit.operator.kubernetes.builders_api import (
    CLUSTER_IP,
    NAMESPACE,
    RANGE,
    pod_obj,
    proxy_obj,
    service_obj,
)

NODE = {
    "metadata": {
        "name": "node1",
        "labels": {"kubernetes.io/hostname": "node1"},
        "annotations": {"rosproxy.io/advertise-host": " arm.example "},
    },
    "spec": {"podCIDR": "10.244.1.0/24", "podCIDRs": ["10.244.1.0/24", "fd00:1::/64"]},
    "status": {
        "addresses": [
            {"type": "InternalIP", "address": "10.88.0.11"},
            {"type": "InternalIP", "address": "fd00::11"},
            {"type": "Hostname", "address": "node1"},
        ],
        "conditions": [
            {"type": "MemoryPressure", "status": "False"},
            {"type": "Ready", "status": "True"},
        ],
    },
}


def test_a_node():
    parsed_node = node(NODE)

    assert parsed_node.name == "node1"
    assert parsed_node.addresses == {"InternalIP": "10.88.0.11", "Hostname": "node1"}
    assert parsed_node.advertise_host == "arm.example"
    assert parsed_node.pod_networks == ("10.244.1.0/24", "fd00:1::/64")
    assert (parsed_node.ready, parsed_node.deleting) == (True, False)


def test_a_cordoned_node_is_as_any_other():
    spec = {"spec": {"podCIDR": "10.244.1.0/24"}}
    cordoned = {"spec": {**spec["spec"], "unschedulable": True}}

    assert node(cordoned) == node(spec)


@pytest.mark.parametrize("status", ["False", "Unknown"])
def test_a_node_whose_kubelet_is_gone_is_not_ready(status):
    conditions = [{"type": "Ready", "status": status}]

    assert not node({**NODE, "status": {"conditions": conditions}}).ready


def test_a_node_that_was_just_made_is_not_ready_and_has_nothing():
    parsed_node = node({"metadata": {"name": "node3"}, "spec": {"unschedulable": True}})

    assert (parsed_node.ready, parsed_node.pod_networks) == (False, ())


def test_a_pod():
    parsed_pod = pod(pod_obj(labels={"app": "talker"}))

    assert parsed_pod.id == Name(NAMESPACE, "talker")
    assert (parsed_pod.node, parsed_pod.phase, parsed_pod.ip) == ("node1", "Running", "10.244.1.5")
    assert parsed_pod.labels == {"app": "talker"}
    assert (parsed_pod.own_masters, parsed_pod.wired_master_uri, parsed_pod.host_network) == (
        (),
        "",
        False,
    )


def test_a_pod_at_admission_has_neither_name_nor_node():
    meta = {"generateName": "talker-", "namespace": "robots"}

    parsed_pod = pod({"metadata": meta, "spec": {"containers": [{"name": "ros"}]}})

    assert parsed_pod.id == Name("robots", "")
    assert (parsed_pod.uid, parsed_pod.node, parsed_pod.ip, parsed_pod.phase) == (
        "",
        "",
        "",
        "Pending",
    )


def test_host_ports_are_those_that_the_scheduler_counts():
    def container(name: str, port: int, **more: Any) -> dict[str, Any]:
        return {"name": name, "ports": [{"containerPort": 80, "hostPort": port, **more}]}

    parsed_pod = pod(
        pod_obj(
            containers=[container("a", 8080), container("b", 8081, protocol="UDP"), {"name": "c"}],
            initContainers=[
                {**container("sidecar", 8082), "restartPolicy": "Always"},
                container("setup", 8083),
            ],
        )
    )

    assert parsed_pod.host_ports == {8080, 8082}


def test_what_does_not_fit_is_as_if_it_were_not_there_and_the_rest_is_read():
    ports = [{"containerPort": 80, "hostPort": 8080}, {"hostPort": "many"}, "strange"]
    obj = pod_obj(
        labels={"app": "ros", "number": 7},
        hostNetwork="yes",
        initContainers=None,
        containers=[{"name": "a", "ports": ports}, None],
    )

    parsed_pod = pod(obj)

    assert (parsed_pod.labels, parsed_pod.host_network) == ({"app": "ros"}, False)
    assert (parsed_pod.host_ports, parsed_pod.ip) == (frozenset({8080}), "10.244.1.5")


def test_masters_that_a_template_sets_itself():
    def container(**variable: Any) -> dict[str, Any]:
        return {"name": "x", "env": [{"name": "ROS_MASTER_URI", **variable}]}

    parsed_pod = pod(
        pod_obj(
            containers=[
                container(value="http://robot:11311"),
                container(valueFrom={"configMapKeyRef": {"name": "ros", "key": "master"}}),
                container(value="http://$(HOST_IP):11311"),
                {"name": "none"},
            ],
            initContainers=[container(value="")],
        )
    )

    assert parsed_pod.own_masters == ("", "http://robot:11311", VALUE_AT_RUNTIME, VALUE_AT_RUNTIME)


def test_what_the_webhook_has_set_is_not_the_templates_own():
    obj = pod_obj(
        containers=[{"name": "x", "env": [{"name": "ROS_MASTER_URI", "value": "http://a:11311"}]}]
    )
    obj["metadata"]["annotations"] = {"rosproxy.io/master-uri": "http://a:11311"}

    parsed_pod = pod(obj)

    assert (parsed_pod.own_masters, parsed_pod.wired_master_uri) == ((), "http://a:11311")


def wired_pod(*init_containers: str, **started: str) -> dict[str, Any]:
    """A wired pod with these containers. ``started`` has the start of each one that runs."""
    env = [{"name": "ROS_MASTER_URI", "value": "http://a:11311"}]
    containers = {"arm": env, "hand": env, "log": []}
    specs = [{"name": name, "env": own} for name, own in containers.items()]
    obj = pod_obj(
        containers=specs, initContainers=[{"name": name, "env": env} for name in init_containers]
    )
    obj["metadata"]["annotations"] = {"rosproxy.io/master-uri": "http://a:11311"}
    for name in (*containers, *init_containers):
        running = {"running": {"startedAt": started[name]}} if name in started else {"waiting": {}}
        kind = "initContainerStatuses" if name in init_containers else "containerStatuses"
        obj["status"].setdefault(kind, []).append({"name": name, "state": running})
    return obj


@pytest.mark.parametrize(
    ("obj", "since"),
    [
        (wired_pod(arm="2026-01-01T01:00:00Z", hand="2026-01-01T02:00:00Z"), 1),
        (wired_pod(hand="2026-01-01T02:00:00Z"), 2),
        (wired_pod("side", arm="2026-01-01T03:00:00Z", side="2026-01-01T02:00:00Z"), 2),
        (wired_pod(arm="2026-01-01T03:00:00Z", log="2026-01-01T02:00:00Z"), 3),
        (wired_pod(log="2026-01-01T02:00:00Z"), None),
        (wired_pod(), None),
        (pod_obj(), None),
    ],
    ids=["two", "one waits", "sidecar", "other container", "no ROS", "none runs", "not wired"],
)
def test_a_pod_runs_since_the_oldest_start_of_its_wired_containers(obj, since):
    assert pod(obj).running_since == (f"2026-01-01T0{since}:00:00Z" if since else "")


@pytest.mark.parametrize(
    ("phase", "ended"), [("Succeeded", True), ("Failed", True), ("Running", False), ("", False)]
)
def test_pods_that_have_ended(phase, ended):
    obj = pod_obj()
    obj["status"]["phase"] = phase

    assert pod(obj).ended is ended


def test_a_proxy_is_read_back_from_its_pod():
    parsed_proxy = proxy_pod(
        proxy_obj(
            status={
                "phase": "Running",
                "podIP": "10.244.1.9",
                "conditions": [{"type": "Ready", "status": "True"}],
                "containerStatuses": [
                    {"name": "proxy", "restartCount": 2, "state": {"running": {}}}
                ],
            }
        )
    )

    assert parsed_proxy is not None
    assert (parsed_proxy.of, parsed_proxy.owner, parsed_proxy.node) == (
        Name(NAMESPACE, "arm"),
        "uid-arm",
        "node1",
    )
    assert (parsed_proxy.range, parsed_proxy.fingerprint, parsed_proxy.image) == (
        RANGE,
        "0123456789abcdef",
        "rosproxy:1",
    )
    assert (parsed_proxy.token, parsed_proxy.ready, parsed_proxy.stuck, parsed_proxy.restarts) == (
        "",
        True,
        None,
        2,
    )
    assert parsed_proxy.pod.host_ports == set(RANGE.ports())


@pytest.mark.parametrize(
    "path",
    [
        ("metadata", "labels", "rosproxy.io/proxy-of"),
        ("metadata", "labels", "app.kubernetes.io/managed-by"),
        ("metadata", "annotations", "rosproxy.io/node"),
        ("metadata", "annotations", "rosproxy.io/port-range"),
        ("metadata", "ownerReferences"),
        ("spec", "containers"),
    ],
)
def test_a_pod_that_lacks_something_is_no_proxy(path):
    obj = proxy_obj()
    inner = obj
    for key in path[:-1]:
        inner = inner[key]
    del inner[path[-1]]

    assert proxy_pod(obj) is None


@pytest.mark.parametrize(
    ("kind", "name", "labels", "workload"),
    [
        ("ReplicaSet", "talker-5d4c9", {"pod-template-hash": "5d4c9"}, "deployment/talker"),
        ("ReplicaSet", "talker-5d4c9", {}, ""),  # no Deployment has made it
        ("ReplicaSet", "talker", {"pod-template-hash": "5d4c9"}, ""),
        ("StatefulSet", "arm", {}, "statefulset/arm"),
        ("DaemonSet", "arm", {}, "daemonset/arm"),
        ("Job", "arm", {}, "job/arm"),
        ("CustomSet", "arm", {}, ""),
    ],
)
def test_what_has_the_template_of_a_pod(kind, name, labels, workload):
    obj = pod_obj()
    owner = {"kind": kind, "name": name, "controller": True}
    obj["metadata"] |= {"labels": labels, "ownerReferences": [owner]}

    parsed = pod(obj)

    assert (parsed.controller, parsed.workload) == (kind, workload)


@pytest.mark.parametrize(
    "owner", [{"apiVersion": "apps/v1"}, {"kind": "ReplicaSet"}, {"controller": False}]
)
def test_somebody_elses_pod_with_the_same_labels_is_no_proxy(owner):
    obj = proxy_obj()
    obj["metadata"]["ownerReferences"][0].update(owner)

    assert proxy_pod(obj) is None
    assert proxy_pod(pod_obj()) is None


def test_a_service():
    parsed_service = service(service_obj())

    assert parsed_service is not None
    assert (parsed_service.of, parsed_service.owner) == (Name(NAMESPACE, "arm"), "uid-arm")
    assert (parsed_service.cluster_ip, parsed_service.fingerprint, parsed_service.deleting) == (
        CLUSTER_IP,
        "f",
        False,
    )
    of_today = service(service_obj(creationTimestamp="2026-11-28T14:00:00Z"))
    assert of_today is not None
    assert of_today.created == "2026-11-28T14:00:00Z"


def test_a_service_without_an_address():
    assert service({**service_obj(), "spec": {"clusterIP": "None"}}).cluster_ip == ""  # type: ignore[union-attr]
    assert service(service_obj(deletionTimestamp="2026-11-21T14:00:00Z")).deleting  # type: ignore[union-attr]


def test_other_services_are_not_ours():
    assert service(service_obj(labels={})) is None
    assert service(service_obj(ownerReferences=[])) is None
    assert service(service_obj(name="roscore")) is None


STATUS = {
    "master": {"up": True, "error": ""},
    "nodes": [
        {
            "nodes": ["/talker"],
            "address": "10.244.1.5:40001",
            "publishes": ["/chatter", "/rosout"],
            "subscribes": [],
        },
        {"nodes": ["/b", "/a"], "address": "10.244.1.5:40002", "subscribes": ["/chatter"]},
        {"nodes": ["/v6"], "address": "[fd00::5]:40001", "state": "silent"},
        {"nodes": ["/dead"], "address": "10.244.1.6:40001", "state": "cleaned"},
    ],
    "problems": [
        {"age": 3.0, "subject": "/talker", "text": "does not answer"},
        {"age": RECENT_S + 1, "subject": "/old", "text": "long ago"},
        {"age": RECENT_S + 1, "subject": "published range", "text": "dead", "holds": True},
        {"age": 1.0, "subject": "refused: policy", "text": "publish /camera of /a denied"},
        {"age": 1.0, "subject": "refused: policy audit", "text": "it would be denied"},
        {"age": 1.0, "subject": "refused: rate", "text": "too many calls"},
    ],
    "range_probe": {"reached": False, "from_proxy": "refused", "from_master": "missed", "age": 9.0},
}


def test_what_a_proxy_answers():
    proxy_report = report(read_status(STATUS))

    assert (proxy_report.answered, proxy_report.master_up, proxy_report.error) == (True, True, "")
    assert not proxy_report.retired
    assert report(replace(read_status(STATUS), retired=True)).retired
    assert proxy_report.nodes == {"10.244.1.5": ("/a", "/b", "/talker"), "fd00::5": ("/v6",)}
    assert proxy_report.addresses == {"10.244.1.5", "10.244.1.6", "fd00::5"}
    assert proxy_report.topics == {"/chatter", "/rosout"}
    assert proxy_report.problems == (
        "/talker: does not answer",
        "published range: dead",
        "refused: rate: too many calls",
    )
    assert proxy_report.range_probe == RangeProbeStatus(False, "refused", "missed")
    assert report(read_status({})).range_probe is None


def test_a_proxy_that_answers_too_much_causes_no_more_findings_than_another():
    """Each of 4,500 problems became a finding, and each fault of a peer an Event, 100 a second."""
    problems = [{"subject": f"zenoh peer h{number}", "holds": True} for number in range(4500)]
    kinds: list[dict[str, object]] = [{}, {"hub": True}, {"protocol": "tls"}]
    links = [{"peer": f"h{number}:1", **kind} for number in range(4500) for kind in kinds]
    answer = report(read_status({"problems": problems, "zenoh": {"links": links}}))
    assert len(answer.problems) == MOST_PROBLEMS
    assert answer.problems[-1].startswith("zenoh peer h4499: ")
    assert answer.zenoh is not None
    assert len(answer.zenoh.peers) == MOST_ZENOH_PEERS
    assert len(answer.zenoh.hubs) == MOST_ZENOH_HUBS
    assert len(answer.zenoh.sites) == MOST_ZENOH_LINKS


def test_a_long_text_of_a_proxy_is_cut_before_it_is_cleaned(monkeypatch):
    """To clean a text of 1 MiB took 0.3 s of the event loop."""
    cleaned = []

    def note(text):
        cleaned.append(text)
        return clean(text)

    monkeypatch.setattr(reports, "clean", note)
    for character, end in (("\x80", "\\x8…"), ("x", "xxx…")):
        text = reports.short(1000 * character)
        assert (len(text), text[-4:]) == (300, end)
    assert max(map(len, cleaned)) == 301
    assert reports.short(300 * "x") == 300 * "x"


def test_a_proxy_without_its_master():
    assert report(read_status({"master": {"up": False, "error": "refused"}})).error == "refused"
    unasked = report(read_status({"master": {"up": False, "error": ""}}))
    assert unasked.error == "the proxy has not asked the master yet"


def test_a_proxy_that_does_not_answer():
    proxy_report = no_answer("timed\x1bout")

    assert (proxy_report.answered, proxy_report.master_up, proxy_report.error) == (
        False,
        False,
        "timed\\x1bout",
    )


_json = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(
            st.sampled_from(["master", "up", "nodes", "address", "ports", "used", "problems"])
            | st.text(max_size=3),
            inner,
            max_size=4,
        )
    ),
)


@given(_json)
def test_no_answer_of_a_proxy_is_too_strange(status):
    assert report(read_status(status)).answered


@given(st.dictionaries(st.sampled_from(["metadata", "spec", "status"]), _json))
def test_no_object_is_too_strange(obj):
    pod(obj)
    node(obj)
    assert proxy_pod(obj) is None
    assert service(obj) is None


@pytest.mark.parametrize("host", ["node1", "arm.example", "192.0.2.7", "fd00::1", "[fd00::1]"])
def test_hosts_that_outside_can_be_told(host):
    assert host_problem(host) == ""


@pytest.mark.parametrize("host", ["", "a b", "http://a", "localhost", "127.0.0.1", "[::1]"])
def test_hosts_that_outside_can_not_be_told(host):
    assert host_problem(host)


def test_of_a_pod_little_is_kept_whatever_it_has() -> None:
    """20 pods with a megabyte of labels each took 157 MB of the operator's 512 MiB."""
    long = "x" * 100_000
    variables = [{"name": name, "value": long} for name in ("ROS_MASTER_URI", "ROS_DISTRO")]
    container = {"name": "c", "image": long, "env": variables * 3}
    labels = {f"a{number}": "x" for number in range(20_000)}
    obj = pod_obj("talker", {**labels, "rosproxy.io/inject": "true"}, containers=[container] * 200)
    obj["metadata"]["annotations"] = {"rosproxy.io/static-peers": long}
    kept = pod(obj)
    assert len(msgspec.json.encode(kept)) < 700_000
    assert len(kept.labels) == objects.MOST_LABELS
    assert kept.labels["rosproxy.io/inject"] == "true"
    assert (len(kept.containers), len(kept.own_masters)) == (64, 64)
    assert len(kept.containers[0].variables["ROS_DISTRO"]) == objects.MOST_TEXT_CHARACTERS
    obj["metadata"]["annotations"] = {"rosproxy.io/master-uri": long}
    assert len(pod(obj).wired_master_uri) == objects.MOST_TEXT_CHARACTERS


def test_a_long_list_of_namespaces_is_cut() -> None:
    annotations = {"rosproxy.io/allow-from": ",".join(f"n{number}" for number in range(50_000))}
    assert len(objects.allowed_from({"metadata": {"annotations": annotations}})) < 3000
