"""Labels and annotations that the operator does not know: told once, with the right name."""

from typing import Any

import pytest
from msgspec.structs import replace

from rosproxy_operator.kubernetes.planner.actions import Emit
from rosproxy_operator.kubernetes.planner.misspellings import MOST_PODS
from rosproxy_operator.kubernetes.planner.partition import partitions
from rosproxy_operator.kubernetes.resources import misspelt_names as module
from rosproxy_operator.kubernetes.resources import objects
from rosproxy_operator.kubernetes.resources.misspelt_names import (
    MOST_MISSPELT_NAMES,
    misspelt_names,
)
from rosproxy_operator.kubernetes.resources.model import MasterSpec, Name, Reference
from rosproxy_operator.kubernetes.resources.names import own_labels
from rosproxy_operator.kubernetes.status.condition_findings import cluster_findings
from rosproxy_operator.kubernetes.watch.store import ClusterStore
from tests.unit.operator.kubernetes.api_server import ApiServer
from tests.unit.operator.kubernetes.builders_api import (
    NAMESPACE,
    pod_obj,
    proxy_obj,
    rosproxy_obj,
)
from tests.unit.operator.kubernetes.objects import (
    ROBOT,
    complete,
    look,
    node,
    observed,
    pod,
    rosproxy,
    status,
    told,
    written,
)
from tests.unit.operator.kubernetes.snapshots import snapshot_of

TEXT = (
    "label rosproxy.io/injekt is unknown and ignored. Did you mean the label rosproxy.io/inject of "
    "pods?"
)
FIX = "Correct the name in the template, then run kubectl -n ros delete pod"


@pytest.mark.parametrize(
    ("kind", "place", "name", "said"),
    [
        ("pods", "labels", "rosproxy.io/injekt", "Did you mean the label rosproxy.io/inject of"),
        ("pods", "labels", "rosproxy/inject", "Did you mean the label rosproxy.io/inject of"),
        ("pods", "labels", "ros-proxy.io/Inject", "Did you mean the label rosproxy.io/inject of"),
        ("pods", "labels", "rosproxy.enable", "Known: the label rosproxy.io/inject of pods"),
        ("pods", "annotations", "rosproxy.io/inject", "here. The operator reads only the label "),
        ("pods", "annotations", "rosproxy.io/advertise-host", "advertise-host of nodes"),
        ("nodes", "annotations", "rosproxy.io/advertised-host", "rosproxy.io/advertise-host of n"),
        ("nodes", "annotations", "rosproxy.advertise-host", "rosproxy.io/advertise-host of nodes"),
        ("nodes", "labels", "rosproxy.io/advertise-host", "only the annotation rosproxy.io/a"),
        ("Services of masters", "annotations", "rosproxy.io/allow-form", "rosproxy.io/allow-from"),
        ("RosProxies", "annotations", "rosproxy.io/remake_unwired", "rosproxy.io/remake-unwired"),
        (
            "RosProxies",
            "annotations",
            "rosproxy.io/x",
            "Known: the annotation rosproxy.io/remake",
        ),
    ],
)
def test_a_name_that_is_not_known_is_told_with_the_one_that_was_meant(kind, place, name, said):
    (text,) = misspelt_names({place: {name: "true"}}, kind)
    assert text.startswith(f"{place.removesuffix('s')} {name} ")
    assert said in text


@pytest.mark.parametrize(
    ("kind", "metadata"),
    [
        ("pods", {"labels": {"rosproxy.io/inject": "true", "app": "x", "ros/inject": "x"}}),
        ("pods", {"annotations": {"rosproxy.io/master-uri": "x", "rosproxy.io/static-peers": "x"}}),
        ("pods", {"labels": {"x" * 300: "true"}, "annotations": {"io.rosproxy": 3}}),
        ("pods", proxy_obj()["metadata"]),
        ("nodes", {"annotations": {"rosproxy.io/advertise-host": "gate"}}),
        ("Services of masters", {"annotations": {"rosproxy.io/allow-from": "*"}}),
        ("Services of masters", {"labels": own_labels("arm")}),
        ("RosProxies", {"annotations": {"rosproxy.io/remake-unwired": "true"}}),
        ("pods", {"labels": None}),
        ("pods", {}),
    ],
)
def test_right_names_and_those_of_others_are_nothing_to_tell(kind, metadata):
    assert misspelt_names(metadata, kind) == ()


def test_of_one_object_only_some_are_told_and_all_are_harmless():
    names = {f"rosproxy.io/{'x' * 300}{number}\x1b[2J": "" for number in range(9)}
    texts = misspelt_names({"annotations": names}, "pods")
    assert len(texts) == MOST_MISSPELT_NAMES
    assert all(len(text) < 300 and "\x1b" not in text for text in texts)


def test_a_pod_of_which_nobody_would_speak_is_in_the_snapshot() -> None:
    server = ApiServer()
    server.put("rosproxies", rosproxy_obj(), NAMESPACE)
    for name, namespace in (("talker", NAMESPACE), ("other", "elsewhere")):
        obj: dict[str, Any] = pod_obj(name, {"rosproxy.io/injekt": "true"})
        obj["metadata"]["namespace"] = namespace
        server.put("pods", obj, namespace)
    snapshot = snapshot_of(server)
    assert {p.id.name: p.misspelt for p in snapshot.misspelt_pods} == {
        "talker": (TEXT,),
        "other": (TEXT,),
    }
    assert snapshot.pods == ()


def test_it_is_told_once_on_the_pod_and_in_the_status():
    astray = pod("astray", labels={"rosproxy.io/injekt": "true"}, misspelt=(TEXT,))
    seen = complete(misspelt_pods=(astray,))

    first = look(seen)
    second = look(written(seen, first), first.state, now=101.0)

    (event,) = (a for a in first.actions if isinstance(a, Emit) and a.reason == "UnknownName")
    assert event.about == Reference("Pod", Name("ros", "astray"), "uid-astray")
    assert event.message == f"{TEXT} {FIX} astray, and create the pod again"
    assert not [a for a in second.actions if isinstance(a, Emit)]
    degraded = next(c for c in status(first)["conditions"] if c["type"] == "Degraded")
    assert (degraded["status"], degraded["reason"]) == ("True", "UnknownName")
    obj = {**rosproxy_obj(), "status": status(first)}
    assert any(TEXT in finding.text for finding in cluster_findings([obj]))


def test_without_a_rosproxy_it_is_told_once_on_the_pod() -> None:
    """The pod has no label that the webhook reads, and no RosProxy has a status that reports it."""
    astray = pod("astray", misspelt=(TEXT,), workload="deployment/talker")
    seen = observed(misspelt_pods=(astray,))
    assert [p.namespaces for p in partitions(seen)] == [{"ros"}]
    first = look(seen)
    (event,) = first.actions
    assert isinstance(event, Emit)
    assert event.about == Reference("Pod", Name("ros", "astray"), "uid-astray")
    fix = "Correct the name in the template: kubectl -n ros edit deployment/talker"
    assert (event.reason, event.message) == ("UnknownName", f"{TEXT} {fix}")
    assert look(seen, first.state, now=101.0).actions == ()


def test_a_misspelt_label_wakes_the_operator_without_a_rosproxy() -> None:
    store = ClusterStore([("pods", "")], ("",), lambda: None, lambda: None)
    store.changed("pods", "", [("uid", objects.pod(pod_obj("a", {"rosproxy.io/injekt": "true"})))])
    assert store.take_changes().namespaces == {NAMESPACE}
    assert len(store.snapshot().misspelt_pods) == 1
    store.changed("pods", "", [("uid", None)])
    assert store.snapshot().misspelt_pods == ()


def test_many_pods_of_one_kind_are_told_of_by_some():
    pods = tuple(pod(f"p{number:02}", misspelt=(TEXT,)) for number in range(MOST_PODS + 30))
    gone = pod("a", misspelt=(TEXT,), deleting=True)
    texts = told(look(complete(misspelt_pods=(*pods[::-1], gone))), "UnknownName")
    named = [text.partition(", and")[0] for text in texts]
    assert named == [f"pod ros/p{n:02}: {TEXT} {FIX} p{n:02}" for n in range(MOST_PODS)]


def test_of_two_rosproxies_the_first_one_is_told():
    astray = pod("astray", misspelt=(TEXT,))
    seen = replace(complete(misspelt_pods=(astray,)), rosproxies=(rosproxy(), rosproxy("arm")))
    (problem,) = (f for f in look(seen).problems if f.reason == "UnknownName")
    assert problem.of == Name("ros", "arm")


def test_nodes_services_and_rosproxies_are_told_of_at_the_rosproxy():
    service = Name("ros", "core")
    of = replace(rosproxy(master=MasterSpec(service=service)), misspelt=("a",))
    seen = replace(
        complete(misspelt_services={service: ("c",), Name("x", "y"): ("not this",)}),
        rosproxies=(of,),
        nodes={"one": node(misspelt=("b",)), "two": node("two", misspelt=("not this",))},
    )
    plan = look(seen)
    assert told(plan, "UnknownName") == [
        "rosproxy ros/robot: a",
        "node one: b",
        f"service {service}: c",
    ]
    about = {f.about for f in plan.problems if f.reason == "UnknownName"}
    assert about == {Reference("RosProxy", ROBOT, "uid-robot")}


def test_of_many_names_a_bounded_number_is_checked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Checking 60,000 labels of a pod took two seconds at each change of the pod."""
    checked = 0

    def counted(*_: object) -> str:
        nonlocal checked
        checked += 1
        return ""

    monkeypatch.setattr(module, "nearest", counted)
    labels = {f"a{number}": "x" for number in range(60_000)}
    assert misspelt_names({"labels": labels}, "pods") == ()
    assert checked == module.MOST_CHECKED_NAMES
    own = {f"rosproxy.io/x{number}": "x" for number in range(60_000)}
    assert len(misspelt_names({"labels": labels | own}, "pods")) == MOST_MISSPELT_NAMES
    assert checked <= module.MOST_CHECKED_NAMES + MOST_MISSPELT_NAMES
