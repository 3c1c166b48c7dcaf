"""Pods that are wired at admission, and pods that are not."""

import copy
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from rosproxy.shared.addresses import HostPort
from rosproxy_operator.kubernetes.planner.pods.recreation import needs_recreation
from rosproxy_operator.kubernetes.planner.pods.ros1_pods import ros1_finding
from rosproxy_operator.kubernetes.planner.pods.wiring import (
    MIRROR_ANNOTATION,
    PodVariables,
    Wiring,
    pod_variables,
    wire,
)
from rosproxy_operator.kubernetes.resources import objects
from rosproxy_operator.kubernetes.resources.cluster import WebhookState
from rosproxy_operator.kubernetes.resources.model import (
    VALUE_AT_RUNTIME,
    MasterSpec,
    Name,
    Ros2Spec,
)
from rosproxy_operator.kubernetes.resources.names import NOT_WIRED_BECAUSE
from tests.unit.operator.kubernetes.builders_api import CLUSTER_IP, NAMESPACE, URI, pod, rosproxy

TO = PodVariables(URI)
TO_ROBOT = PodVariables(URI, masters=frozenset({HostPort("robot", 11311)}))
MASTER = {"name": "ROS_MASTER_URI", "value": URI}
IP = {
    "name": "ROS_IP",
    "valueFrom": {"fieldRef": {"apiVersion": "v1", "fieldPath": "status.podIP"}},
}
ANNOTATION = "rosproxy.io/master-uri"
INJECT = "rosproxy.io/inject"


def admitted(*containers: Any, **spec: Any) -> dict[str, Any]:
    """A pod in the form that the webhook receives."""
    return {
        "metadata": {"generateName": "talker-", "labels": {INJECT: "true"}},
        "spec": {"containers": list(containers), **spec},
    }


def container(*env: Any, name: str = "ros", **more: Any) -> dict[str, Any]:
    return {"name": name, **({"env": list(env)} if env else {}), **more}


def applied(obj: dict[str, Any], wiring: Wiring) -> dict[str, Any]:
    """The pod in the form that the API server stores."""
    notes = {**obj["metadata"].get("annotations", {}), **wiring.annotations}
    meta = {**obj["metadata"], "annotations": notes}
    return {**obj, "metadata": meta, "spec": wiring.spec or obj["spec"]}


def env_of(wiring: Wiring, kind: str = "containers", place: int = 0) -> Any:
    assert wiring.spec is not None
    return wiring.spec[kind][place]["env"]


def test_a_pod_is_wired():
    wiring = wire(admitted(container()), TO)

    assert env_of(wiring) == [MASTER, IP]
    assert (wiring.annotations, wiring.warnings) == ({ANNOTATION: URI}, ())


def test_every_container_is_wired_and_nothing_else_changes():
    obj = admitted(
        container(name="a", image="ros"),
        container(name="b"),
        initContainers=[container(name="setup"), container(name="side", restartPolicy="Always")],
        volumes=[{"name": "data"}],
    )
    before = copy.deepcopy(obj)

    wiring = wire(obj, TO)

    assert obj == before
    assert wiring.spec is not None
    for kind in ("containers", "initContainers"):
        assert [c.pop("env") for c in wiring.spec[kind]] == [[MASTER, IP]] * 2
    assert wiring.spec == before["spec"]


def test_variables_of_the_template_can_use_those_that_are_set():
    url = {"name": "URL", "value": "$(ROS_MASTER_URI)/x"}

    assert env_of(wire(admitted(container(url)), TO)) == [MASTER, IP, url]


@pytest.mark.parametrize(
    ("own", "set_too"),
    [
        ({"name": "ROS_MASTER_URI", "value": "http://robot:11311"}, [IP]),
        ({"name": "ROS_MASTER_URI", "value": ""}, [IP]),
        ({"name": "ROS_MASTER_URI", "valueFrom": {"configMapKeyRef": {"key": "x"}}}, [IP]),
        ({"name": "ROS_IP", "value": "10.0.0.1"}, [MASTER]),
        ({"name": "ROS_HOSTNAME", "value": "talker"}, [MASTER]),
    ],
)
def test_a_container_keeps_what_it_sets_itself(own, set_too):
    assert env_of(wire(admitted(container(own)), TO)) == [*set_too, own]


def test_a_pod_that_sets_all_itself_stays_as_it_is():
    own = [{"name": "ROS_MASTER_URI", "value": "http://robot:11311"}, {"name": "ROS_IP"}]

    wiring = wire(admitted(container(*own)), TO)
    assert (wiring.spec, wiring.warnings) == (None, ())


def own(uri: str) -> dict[str, str]:
    return {"name": "ROS_MASTER_URI", "value": uri}


MASTERS = {
    "address": MasterSpec("http://192.168.1.10:11311"),
    "name": MasterSpec("http://Robot:11311/", "192.168.1.10"),
    "service": MasterSpec(service=Name("robots", "roscore"), service_port=11322),
    "other namespace's": MasterSpec(service=Name("other", "roscore")),
}


@pytest.mark.parametrize(
    ("master", "uri", "names_it"),
    [
        ("address", "http://192.168.1.10:11311", True),
        ("address", "http://192.168.1.10:11311/", True),
        ("address", " HTTP://192.168.1.10:11311", True),
        ("address", "http://192.168.1.10:11312", False),
        ("address", "http://192.168.1.11:11311", False),
        ("address", "http://192.168.1.10:11311/other", False),
        ("address", "http://$(HOST):11311", False),
        ("address", "http://:11311", False),
        ("address", "", False),
        ("name", "http://ROBOT:11311", True),
        ("name", "http://robot.:11311", True),
        ("name", "http://192.168.1.10:11311", True),
        ("name", "http://robot2:11311", False),
        ("service", "http://roscore:11322", True),
        ("service", "http://roscore.robots.svc.cluster.local:11322/", True),
        ("service", "http://roscore:11311", False),
        ("other namespace's", "http://roscore.other:11311", True),
        ("other namespace's", "http://roscore:11311", False),
    ],
)
def test_the_own_masters_uri_is_replaced_and_any_other_stays(master, uri, names_it):
    of = rosproxy(master=MASTERS[master])
    obj = admitted(container({"name": "A", "value": "b"}, own(uri)))

    wiring = wire(obj, pod_variables(of, CLUSTER_IP))

    assert env_of(wiring) == [IP, {"name": "A", "value": "b"}, MASTER if names_it else own(uri)]
    notes = {ANNOTATION: URI, "rosproxy.io/replaced-master-uri": uri}
    unchanged = {NOT_WIRED_BECAUSE: "the template sets ROS_MASTER_URI"}
    assert wiring.annotations == (notes if names_it else unchanged)
    finding = ros1_finding(objects.pod(applied(obj, wiring)), of, CLUSTER_IP)
    assert bool(finding) == (not names_it and "$" not in uri)
    unwired = objects.pod({**obj, "metadata": {"labels": {INJECT: "true"}}})
    assert needs_recreation(unwired, of, CLUSTER_IP) == names_it
    finding = ros1_finding(unwired, of, CLUSTER_IP)
    assert finding is None or ("Remove the variable" in finding.message) == (not names_it)


def test_what_was_replaced_stays_visible_when_it_is_wired_again():
    target = pod_variables(rosproxy(), CLUSTER_IP)
    obj = admitted(container(own("http://robot:11311")))
    first = wire(obj, target)

    second = wire(applied(obj, first), target)

    assert (second.spec, second.annotations) == (None, first.annotations)


def test_ros_2_alone_replaces_nothing():
    of = replace(rosproxy(), spec=replace(rosproxy().spec, ros1=False, ros2=Ros2Spec()))

    assert pod_variables(of, CLUSTER_IP).masters == frozenset()


def test_a_pod_of_which_one_container_sets_it_is_still_wired():
    own = {"name": "ROS_MASTER_URI", "value": "http://robot:11311"}

    wiring = wire(admitted(container(own), container(name="b")), TO)

    assert env_of(wiring, place=1) == [MASTER, IP]
    assert wiring.annotations == {ANNOTATION: URI}
    assert wire(admitted(container(own, MASTER, IP)), TO).annotations == {ANNOTATION: URI}


def test_host_aliases_are_added_to_those_of_the_pod():
    own = {"ip": "192.0.2.7", "hostnames": ["mine", "robot"]}
    other = {"ip": "192.0.2.9", "hostnames": ["other"]}

    wiring = wire(
        admitted(container(), hostAliases=[own]),
        TO,
        [{"ip": "192.0.2.7", "hostnames": ["robot", "robot.example"]}, other],
    )

    assert wiring.spec is not None
    assert wiring.spec["hostAliases"] == [
        {"ip": "192.0.2.7", "hostnames": ["mine", "robot", "robot.example"]},
        other,
    ]


def test_without_host_aliases_none_are_made():
    spec = wire(admitted(container()), TO).spec

    assert spec is not None
    assert "hostAliases" not in spec
    assert "initContainers" not in spec


def test_a_copy_of_a_wired_pod_is_wired_anew():
    obj = admitted(container())
    copied = applied(obj, wire(obj, PodVariables("http://10.96.0.1:11311")))

    wiring = wire(copied, TO)

    assert env_of(wiring) == [MASTER, IP]
    assert wiring.annotations == {ANNOTATION: URI}


def test_a_static_pods_picture_is_not_changed():
    obj = admitted(container())
    obj["metadata"]["annotations"] = {MIRROR_ANNOTATION: "hash"}

    wiring = wire(obj, TO)

    assert (wiring.spec, wiring.annotations) == (None, {})
    assert "static pod" in wiring.warnings[0]


_variable = st.builds(
    lambda name, value: {"name": name, "value": value},
    st.sampled_from(["ROS_MASTER_URI", "ROS_IP", "ROS_HOSTNAME", "PATH"]),
    st.sampled_from(["", URI, "http://robot:11311", "$(PATH)"]),
)
_containers = st.lists(
    st.lists(_variable, max_size=4).map(lambda env: container(*env)), min_size=1, max_size=3
)
_aliases = st.lists(
    st.builds(
        lambda ip, names: {"ip": ip, "hostnames": names},
        st.sampled_from(["192.0.2.7", "192.0.2.8"]),
        st.lists(st.sampled_from(["a", "b", "c"]), max_size=3),
    ),
    max_size=3,
)
_pods = st.builds(
    lambda containers, init, aliases: admitted(
        *containers, initContainers=init, hostAliases=aliases
    ),
    _containers,
    _containers,
    _aliases,
)


@given(_pods, _aliases, st.sampled_from([TO, TO_ROBOT]))
def test_wiring_twice_changes_nothing_more(obj, aliases, target):
    first = wire(obj, target, aliases)
    second = wire(applied(obj, first), target, aliases)

    assert second.spec is None
    assert second.annotations == first.annotations


@given(_pods)
def test_what_a_template_sets_comes_through_unharmed_and_last(obj):
    wiring = wire(obj, TO)
    spec = wiring.spec or obj["spec"]

    for kind in ("containers", "initContainers"):
        for before, after in zip(obj["spec"][kind], spec[kind], strict=True):
            own = before.get("env", [])
            added = after["env"][: len(after["env"]) - len(own)]
            assert after["env"] == [*added, *own]
            assert not {variable["name"] for variable in added} & {
                variable["name"] for variable in own
            }


@given(_pods)
def test_every_container_has_a_master_and_an_address_in_the_end(obj):
    spec = wire(obj, TO).spec or obj["spec"]

    for ros_container in (*spec["containers"], *spec["initContainers"]):
        variables = {variable["name"] for variable in ros_container["env"]}
        assert "ROS_MASTER_URI" in variables
        assert variables & {"ROS_IP", "ROS_HOSTNAME"}


def test_a_wired_pod_is_wired():
    obj = admitted(container())

    stored = objects.pod(applied(obj, wire(obj, TO)))

    assert stored.wired_master_uri == URI
    assert ros1_finding(stored, rosproxy(), CLUSTER_IP) is None


@pytest.mark.parametrize(
    "master",
    [
        URI,
        f"{URI}/",
        "http://rosproxy-arm:11311",
        "http://rosproxy-arm.robots:11311",
        "http://rosproxy-arm.robots.svc:11311/",
        "http://rosproxy-arm.robots.svc.cluster.local:11311",
        "http://rosproxy-arm.robots.svc.cluster.local.:11311",
        VALUE_AT_RUNTIME,
    ],
)
def test_a_pod_that_sets_its_proxy_itself_is_wired(master):
    assert ros1_finding(pod(own_masters=(master,)), rosproxy(), CLUSTER_IP) is None


@pytest.mark.parametrize(
    "master",
    [
        "http://robot:11312",
        "http://rosproxy-leg:11311",
        "http://rosproxy-arm.other:11311",
        "http://rosproxy-arm:11312",
        "http://10.96.7.8:11311",
        "",
        "rosproxy-arm:11311",
    ],
)
def test_a_pod_that_goes_around_its_proxy_is_told(master):
    finding = ros1_finding(
        pod(own_masters=(URI, master), wired_master_uri=URI), rosproxy(), CLUSTER_IP
    )

    assert finding is not None
    assert (finding.reason, finding.fatal) == ("NotWired", False)
    assert f"ROS_MASTER_URI={master}" in finding.message
    assert finding.about is not None
    assert finding.about.id == pod().id


@pytest.mark.parametrize(
    ("unwired", "said"),
    [
        (
            pod(),
            "at the webhook port (chart value webhook.port) when the pod was created. Run kubectl",
        ),
        (pod(controller="Job"), f". Run kubectl -n {NAMESPACE} delete pod {pod().id.name}"),
        (pod(workload="daemonset/arm"), f"kubectl -n {NAMESPACE} rollout restart daemonset/arm"),
        (pod(created="2026-01-01T00:00:00Z"), "is older than RosProxy arm. Run kubectl"),
        (
            pod(labels={"app": "x"}, workload="deployment/a"),
            "since the pod has no label rosproxy.io/inject. Add the label rosproxy.io/inject=arm "
            f"to the template: kubectl -n {NAMESPACE} edit deployment/a",
        ),
        (pod(wired_master_uri="http://10.96.0.1:11311"), f"the proxy is at {URI} now"),
    ],
)
def test_a_pod_that_is_not_wired_is_told_what_to_do(unwired, said):
    of = replace(rosproxy(), created="2026-01-02T00:00:00Z")
    finding = ros1_finding(unwired, of, CLUSTER_IP)

    assert finding is not None
    assert said in finding.message


@pytest.mark.parametrize(
    ("created", "said"),
    [
        ("2026-01-03T00:01:00Z", "although an operator was ready. Allow connections from the API"),
        ("2026-01-03T00:00:59Z", "when the pod was created. Run kubectl"),
    ],
)
def test_a_pod_that_no_operator_wired_though_one_was_ready_needs_another_fix(created, said):
    """The advice was to create the pod anew, which fails again while port 9443 is closed."""
    of = replace(rosproxy(), created="2026-01-02T00:00:00Z")
    webhook = WebhookState(since="2026-01-03T00:00:00Z")
    finding = ros1_finding(pod(created=created), of, CLUSTER_IP, webhook)

    assert finding is not None
    assert said in finding.message


def test_a_pod_that_is_older_than_the_service_is_told_so():
    """A RosProxy that was refused at first gets its Service late. The text blamed the webhook."""
    of = replace(rosproxy(), created="2026-01-02T00:00:00Z")
    webhook = WebhookState(since="2026-01-01T00:00:00Z", service_since="2026-01-05T00:00:00Z")
    old = ros1_finding(pod(created="2026-01-05T00:00:00Z"), of, CLUSTER_IP, webhook)
    new = ros1_finding(pod(created="2026-01-05T00:00:59Z"), of, CLUSTER_IP, webhook)
    newer = ros1_finding(pod(created="2026-01-05T00:01:00Z"), of, CLUSTER_IP, webhook)

    assert old is not None
    assert new is not None
    assert newer is not None
    assert "since the pod is older than Service rosproxy-arm of the RosProxy. Run" in old.message
    assert "although an operator was ready" not in new.message
    assert "although an operator was ready" in newer.message


def test_without_the_webhook_the_template_sets_the_variable():
    unwired = pod(workload="deployment/talker")
    finding = ros1_finding(unwired, rosproxy(), CLUSTER_IP, WebhookState(served=False))

    assert finding is not None
    assert (
        "(webhook.enabled=false). Set ROS_MASTER_URI=http://rosproxy-arm:11311, and ROS_IP from "
        "status.podIP, in the template: kubectl"
    ) in finding.message
