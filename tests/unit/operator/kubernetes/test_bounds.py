"""Bounds of RosProxies, and RosProxies that exceed the bounds."""

from collections.abc import Mapping
from typing import Any

import pytest
from msgspec.structs import replace

from rosproxy.shared.ports import PortRange
from rosproxy_operator.common.problem import Fault
from rosproxy_operator.kubernetes.planner.bounds import (
    bounds_violation,
    is_allowed_master,
    within_bounds,
)
from rosproxy_operator.kubernetes.resources.cluster import ClusterSnapshot
from rosproxy_operator.kubernetes.resources.model import MasterSpec, Name, Ros2Spec
from rosproxy_operator.kubernetes.settings import Bounds, ClusterSettings
from tests.unit.operator.kubernetes.objects import (
    ROBOT,
    creation,
    done,
    look,
    node,
    observed,
    pod,
    proxy,
    rosproxy,
    scene,
    service,
    status,
    told,
)

OWN = ClusterSettings(image="rosproxy:1", network_policy=False)
"""The settings of an operator without options."""
ROSCORE = Name("other", "roscore")
THEIRS = MasterSpec(service=ROSCORE)


def bounded(**bounds: Any) -> ClusterSettings:
    return replace(OWN, bounds=Bounds(**bounds))


NARROW = bounded(window=PortRange(12000, 12999))


def asks(settings: ClusterSettings = OWN, **changes: Any) -> str:
    return str(bounds_violation(rosproxy(**changes), {}, settings) or "")


def condition(rosproxy_status: Mapping[str, Any], kind: str = "Ready") -> tuple[str, str, str]:
    (matching,) = [c for c in rosproxy_status["conditions"] if c["type"] == kind]
    return matching["status"], matching["reason"], matching["message"]


@pytest.mark.parametrize(
    ("settings", "changes", "refused"),
    [
        (OWN, {"ports": 500}, ""),
        (bounded(max_ports=8), {"ports": 8}, ""),
        (bounded(max_ports=8), {"ports": 9}, "spec.ports: the operator does not allow 9. Ask for "
         "8 at most, or ask the operator's administrator to allow the value (chart value "
         "allow.maxPorts)"),
        (OWN, {"window": PortRange(1024, 65535)}, ""),
        (NARROW, {"window": PortRange(12000, 12999)}, ""),
        (NARROW, {"window": PortRange(11999, 12100)}, "spec.portWindow: the operator does not "
         "allow '11999-12100'. Choose a window within 12000-12999, or ask the operator's "
         "administrator to allow the value (chart value allow.portWindow)"),
        (NARROW, {"window": PortRange(12900, 13000)}, "allow.portWindow"),
        (NARROW, {"window": PortRange(12000, 12100), "master": MasterSpec("http://robot:11311",
         publish=13000)}, "spec.master.publish: the operator does not allow 13000. Choose a"),
        (NARROW, {"window": PortRange(12000, 12100), "master": MasterSpec("http://robot:11311",
         publish=12500)}, ""),
        (OWN, {"data_plane": "splice"}, ""),
        (OWN, {"data_plane": "kernel"}, "spec.dataPlane: the operator does not allow 'Kernel'. "
         "Choose Auto or Splice or Copy, or ask the operator's administrator to allow the value "
         "(chart value allow.dataPlanes)"),
        (bounded(data_planes=("auto", "kernel")), {"data_plane": "kernel"}, ""),
        (OWN, {"pod_egress": "proxy"}, "spec.podEgress: the operator does not allow 'Proxy'. "
         "Choose Any, or ask the operator's administrator to allow the value (chart value "
         "proxy.networkPolicy.enabled)"),
        (OWN, {"image": "rosproxy:1"}, ""),
        (OWN, {"image": "evil:1"}, "spec.image: the operator does not allow 'evil:1'. Remove the "
         "field, or ask the operator's administrator to allow the value (chart value "
         "allow.images)"),
        (bounded(images=("registry.example/ros/*",)), {"image": "registry.example/ros/a:1"}, ""),
        (bounded(images=("registry.example/ros/*",)), {"image": "registry.example/b:1"},
         "Remove the field, or choose an image that fits 'registry.example/ros/*', or ask"),
        (bounded(masters=("http://a:1", "http://b:*")), {}, "spec.master.uri: the operator does "
         "not allow 'http://robot:11311/'. Choose a master that fits 'http://a:1' or 'http://b:*', "
         "or ask the operator's administrator"),
        (bounded(masters=tuple(f"http://m{n}:1" for n in range(9))), {}, "or 'http://m4:1', or"),
        (bounded(peers=("192.0.2.*",)), {"ros2": Ros2Spec(peers=("198.51.100.1",))}, "spec.peers: "
         "the operator does not allow '198.51.100.1'. Choose a peer that fits '192.0.2.*', or"),
    ],
)  # fmt: skip
def test_what_the_administrator_allows(
    settings: ClusterSettings, changes: dict[str, Any], refused: str
) -> None:
    said = asks(settings, **changes)
    assert refused in said
    assert bool(refused) == bool(said)


@pytest.mark.parametrize(
    ("master", "pattern", "allowed"),
    [
        ("http://robot:11311", "http://robot:11311", True),
        ("http://robot:11311/", "http://robot:11311/", True),
        ("http://robot:11311", "http://*:11311", True),
        ("http://robot:443", "http://*:11311", False),
        ("http://api.example.com:80/:11311", "http://*:11311", False),  # a path hides no port
        ("http://192.0.2.7:11311", "http://192.0.2.*:11311", True),
        ("http://192.0.2.evil.example:11311", "http://192.0.2.*:11311", False),
        ("http://192.0.2.evil.example:11311", "http://192.0.2.*", False),
        ("http://192.0.3.7:11311", "http://192.0.2.*:11311", False),
        ("http://[fd00::7]:11311", "http://[fd00::*]:11311", True),
        ("http://f:11311", "http://[fd00::*]:11311", False),
        ("nonsense", "*", False),
    ],
)
def test_a_masters_pattern(master: str, pattern: str, allowed: bool) -> None:
    assert is_allowed_master(master, (pattern,)) is allowed


@pytest.mark.parametrize(
    ("changes", "allowed"),
    [
        ({"master": MasterSpec("http://robot:11311")}, True),
        ({"master": MasterSpec("http://other:11311")}, False),
        ({"master": MasterSpec("http://other:11311", "192.0.2.7")}, True),
        # With its own address for the name, a RosProxy does not mean the name's owner.
        ({"master": MasterSpec("http://robot:11311", "10.96.0.1")}, False),
        ({"host_aliases": ({"ip": "10.96.0.1", "hostnames": ["robot"]},)}, False),
        ({"host_aliases": ({"ip": "10.96.0.1", "hostnames": ["else"]},)}, True),
        ({"master": MasterSpec(service=Name("ros", "roscore"))}, True),
        ({"master": MasterSpec(service=Name("ros", "roscore"), service_port=443)}, False),
    ],
)
def test_where_the_master_really_is(changes: dict[str, Any], allowed: bool) -> None:
    masters = ("http://robot:11311", "http://192.0.2.*:11311", "http://roscore.ros.svc:11311")
    said = asks(bounded(masters=masters), **changes)
    assert (said == "") is allowed
    assert ("allow.masters" in said) is not allowed


@pytest.mark.parametrize("publish", [0, 11321])
@pytest.mark.parametrize(
    ("consents", "allowed"), [((), False), (("arms",), False), (("ros",), True), (("*",), True)]
)
def test_another_namespaces_master_needs_its_consent(
    consents: tuple[str, ...], allowed: bool, publish: int
) -> None:
    agreed = {ROSCORE: frozenset(consents)}
    said = bounds_violation(rosproxy(master=replace(THEIRS, publish=publish)), agreed, OWN)
    assert (said is None) is allowed
    command = "kubectl -n other annotate --overwrite service roscore rosproxy.io/allow-from="
    if not allowed:
        assert str(said).endswith(command + ",".join([*consents, "ros"]))


def test_whether_another_namespaces_service_exists_is_not_told() -> None:
    seen = scene(of=rosproxy(master=THEIRS))
    missing = replace(seen, masters={ROSCORE: ("", Fault("there is no Service"))})
    existing = replace(seen, masters={ROSCORE: ("10.96.0.9", None)})
    assert status(look(missing)) == status(look(existing))


def test_who_asks_for_too_much_gets_nothing_and_is_told() -> None:
    of = rosproxy(data_plane="kernel")
    plan = look(observed(of, pod(wired_master_uri="")), settings=OWN)
    assert done(plan) == []
    text = "spec.dataPlane: the operator does not allow 'Kernel'"
    for kind, holds in (("Ready", "False"), ("Degraded", "True")):
        status_, reason, message = condition(status(plan), kind)
        assert (status_, reason) == (holds, "NotAllowed")
        assert message.startswith(text)
    assert [problem.about.kind for problem in plan.problems if problem.about] == ["RosProxy"]
    assert told(plan, "NotAllowed")


def test_the_proxies_of_an_unusable_rosproxy_stay() -> None:
    """An upgrade with narrower bounds takes no ports away."""
    of = rosproxy(image="mine:1", status={"perNode": [{"name": "one", "ports": "11400-11403"}]})
    plan = look(observed(of, service(of), pod(), proxy(of)), settings=OWN)
    assert done(plan) == []
    assert status(plan)["perNode"] == of.status["perNode"]
    assert plan.briefings["uid-proxy-robot-one"].callers == (pod().ip,)


def test_ports_of_one_that_asks_for_too_much_are_still_his() -> None:
    bad = rosproxy("arm", image="mine:1")
    good = rosproxy(ports=2)
    plan = look(observed(bad, good, service(good), proxy(bad), pod()), settings=OWN)
    action = creation(plan)
    assert action.of == ROBOT
    assert action.body["metadata"]["annotations"]["rosproxy.io/port-range"] == "11404-11405"


def test_one_that_is_deleted_asks_for_nothing() -> None:
    of = rosproxy(image="mine:1", deleting=True)
    assert within_bounds(observed(of), OWN).unusable == {}


def test_nothing_is_set_aside_for_nothing() -> None:
    seen: ClusterSnapshot = observed(rosproxy(), node())
    assert within_bounds(seen, OWN) is seen
