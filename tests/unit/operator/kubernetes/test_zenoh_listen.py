"""The port of rmw_zenoh for outside (``spec.listen``): the Service, the proxies, the address."""

from typing import Any

import pytest
from msgspec.structs import replace

from rosproxy_operator.kubernetes.planner import manifests
from rosproxy_operator.kubernetes.planner.actions import (
    CreateService,
    DeleteProxy,
    DeleteService,
    Emit,
)
from rosproxy_operator.kubernetes.planner.bounds import bounds_violation
from rosproxy_operator.kubernetes.planner.steps.network_policy import policy
from rosproxy_operator.kubernetes.resources import names, objects
from rosproxy_operator.kubernetes.resources.cluster import ProxyService, ServiceRole
from rosproxy_operator.kubernetes.resources.fields import InvalidField
from rosproxy_operator.kubernetes.resources.model import (
    Json,
    ListenSpec,
    ListenType,
    RosProxy,
    ZenohSpec,
)
from rosproxy_operator.kubernetes.settings import Bounds
from rosproxy_operator.kubernetes.status.condition_findings import cluster_findings
from tests.run_options import settings_of
from tests.unit.operator.kubernetes import objects as some
from tests.unit.operator.kubernetes.builders_api import rosproxy_obj
from tests.unit.operator.kubernetes.objects import (
    ROBOT,
    SETTINGS,
    done,
    look,
    node,
    pod,
    service,
    site,
    status,
)
from tests.unit.operator.kubernetes.test_zenoh import env_of, ofz, proxy_of, seen, specified

NODE_PORT = ListenSpec("NodePort")
BALANCER = ListenSpec("LoadBalancer")
PORT_OF_ROBOT = "port-of-rosproxy-robot"


def listening(listen: ListenSpec | None = NODE_PORT, **changes: Any) -> RosProxy:
    return ofz(zenoh=ZenohSpec(listen=listen), **changes)


def outside_service(of: RosProxy, **status: Any) -> ProxyService:
    """The Service for outside, as the API server lists the Service with port 31000."""
    listen = of.spec.zenoh.listen if of.spec.zenoh else None
    body: Any = manifests.outside_service(of, listen or NODE_PORT)
    (port,) = body["spec"]["ports"]
    spec = {**body["spec"], "clusterIP": "10.96.2.2", "ports": [{"nodePort": 31000, **port}]}
    meta = {**body["metadata"], "uid": "uid-outside"}
    listed = objects.service({**body, "spec": spec, "metadata": meta, "status": status})
    assert listed is not None
    return listed


def listed(of: RosProxy, *more: Any, **status: Any) -> Any:
    """A cluster with all Services of a RosProxy."""
    outside = {of.id: outside_service(of, **status)}
    return seen(of, some.pod(wired_master_uri=""), *more, outside_services=outside)


def condition(plan: Any) -> Json:
    (found,) = [c for c in status(plan)["conditions"] if c["type"] == "Listening"]
    return found


def test_what_is_read() -> None:
    given = {
        "type": "LoadBalancer",
        "nodePort": 31447,
        "loadBalancerClass": "example.com/internal",
        "annotations": {"example.com/scheme": "internal"},
    }
    spec = specified(ros="zenoh", listen=given)
    assert spec.zenoh.listen == ListenSpec(
        "LoadBalancer", 31447, "example.com/internal", {"example.com/scheme": "internal"}
    )
    assert specified(ros="zenoh", listen={"type": "NodePort"}).zenoh.listen == NODE_PORT
    assert specified(ros="zenoh").zenoh.listen is None


@pytest.mark.parametrize(
    ("spec", "text"),
    [
        ({"listen": {}}, "spec.listen.type: None is unknown. Write one of LoadBalancer, NodePort"),
        ({"listen": {"type": "ClusterIP"}}, "spec.listen.type: 'ClusterIP' is unknown"),
        ({"listen": {"type": "NodePort", "nodePort": 70000}}, "spec.listen.nodePort: 70000"),
        (
            {"listen": {"type": "NodePort", "loadBalancerClass": "a"}},
            "spec.listen.loadBalancerClass: 'a' is for type: LoadBalancer",
        ),
        (
            {"listen": {"type": "NodePort", "annotations": {"rosproxy.io/fingerprint": "a"}}},
            "spec.listen.annotations: 'rosproxy.io/fingerprint' can't be the key",
        ),
        (
            {"listen": {"type": "NodePort", "annotations": {"a b": "c"}}},
            "spec.listen.annotations: 'a b' can't be the key",
        ),
        (
            {"ros": 2, "listen": {"type": "NodePort"}},
            "is for rmw_zenoh, but spec.ros is 2. Remove the field, or set spec.ros: zenoh",
        ),
    ],
)
def test_what_is_refused(spec: Any, text: str) -> None:
    with pytest.raises(InvalidField) as refused:
        specified(**{"ros": "zenoh", **spec})
    assert text in str(refused.value)


@pytest.mark.parametrize(
    ("allowed", "type", "fix"),
    [
        ((), "NodePort", "Remove spec.listen"),
        (("NodePort",), "LoadBalancer", "Choose NodePort"),
        (("NodePort", "LoadBalancer"), "LoadBalancer", ""),
    ],
)
def test_the_administrator_allows_types(
    allowed: tuple[ListenType, ...], type: ListenType, fix: str
) -> None:
    settings = replace(SETTINGS, bounds=Bounds(listen=allowed))
    refusal = str(bounds_violation(listening(ListenSpec(type)), {}, settings) or "")
    if fix:
        assert refusal.startswith(f"spec.listen.type: the operator does not allow '{type}'. {fix}")
        assert "allow.listen" in refusal
    else:
        assert not refusal


def test_by_default_no_type_is_allowed() -> None:
    assert Bounds().listen == ()


def test_the_service_leads_to_the_port_for_outside() -> None:
    of = listening(ListenSpec("LoadBalancer", 31447, "example.com/lb", {"example.com/a": "b"}))
    assert of.spec.zenoh
    assert of.spec.zenoh.listen
    body = manifests.outside_service(of, of.spec.zenoh.listen)
    place = site(of, node(), names.ROUTERS)
    proxy = manifests.proxy_pod(place, SETTINGS)
    assert body["spec"]["type"] == "LoadBalancer"
    assert body["spec"]["loadBalancerClass"] == "example.com/lb"
    assert body["metadata"]["annotations"]["example.com/a"] == "b"
    assert body["metadata"]["name"] == PORT_OF_ROBOT
    (port,) = body["spec"]["ports"]
    assert (port["port"], port["nodePort"]) == (7447, 31447)
    settings = settings_of(env_of(proxy))
    assert settings.zenoh_listen == port["targetPort"] == names.OUTSIDE_PORT
    assert settings.zenoh_listen not in (names.HUB_PORT, names.ROUTERS.first)
    assert body["spec"]["selector"].items() <= proxy["metadata"]["labels"].items()
    plain = manifests.outside_service(listening(), NODE_PORT)
    assert "loadBalancerClass" not in plain["spec"]
    assert "nodePort" not in plain["spec"]["ports"][0]


def test_names_fit_in_a_label() -> None:
    assert len(names.outside_service_id(replace(ROBOT, name="x" * 46)).name) <= 63


@pytest.mark.parametrize("of", [listening(), ofz()], ids=["asked for", "not asked for"])
def test_any_source_reaches_the_port_if_asked_for(of: RosProxy) -> None:
    rules: Any = policy(of, SETTINGS)["spec"]["ingress"]
    ports = {p["port"] for rule in rules if "from" not in rule for p in rule["ports"]}
    assert (names.OUTSIDE_PORT in ports) == (of.spec.zenoh != ZenohSpec())
    assert not ports & {names.HUB_PORT, names.ROUTERS.first}


def test_the_service_is_made_with_an_event_and_later_nothing_more() -> None:
    of = listening()
    plan = look(seen(of))
    (action,) = (action for action in done(plan) if isinstance(action, CreateService))
    assert action.body["metadata"]["name"] == PORT_OF_ROBOT
    (event,) = (a for a in plan.actions if isinstance(a, Emit) and a.reason == "ServiceCreated")
    assert event.message.startswith(f"created Service {PORT_OF_ROBOT} of type NodePort")
    assert not done(look(listed(of, proxy_of(of))))


@pytest.mark.parametrize("change", ["field", "version", "other uid", "other type", "RosProxy gone"])
def test_a_service_that_is_not_right_goes(change: str) -> None:
    of = listening()
    present = outside_service(of)
    rosproxy = {
        "field": ofz(),
        "version": some.rosproxy(),
        "other uid": of,
        "other type": listening(BALANCER),
        "RosProxy gone": None,
    }[change]
    if change == "other uid":
        present = replace(present, owner="uid-former")
    cluster = seen(of, outside_services={of.id: present})
    if rosproxy is None:
        cluster = replace(cluster, rosproxies=(), services={}, hub_services={})
    elif rosproxy.spec.zenoh is None:
        cluster = seen(rosproxy, outside_services={of.id: present}, hub_services={})
    else:
        cluster = replace(cluster, rosproxies=(rosproxy,))
    (action,) = done(look(cluster))
    assert isinstance(action, DeleteService)
    assert action.id.name == PORT_OF_ROBOT


def test_the_proxies_listen_only_while_the_field_is_set() -> None:
    former = proxy_of(listening())
    assert "ROSPROXY_ZENOH_LISTEN" not in env_of(
        manifests.proxy_pod(site(ofz(), node(), names.ROUTERS), SETTINGS)
    )
    actions = done(look(seen(ofz(), some.pod(wired_master_uri=""), former)))
    assert [type(action) for action in actions] == [DeleteProxy]


def test_a_node_port_is_told_with_the_address_of_a_node() -> None:
    of = listening()
    plan = look(listed(of, proxy_of(of)))
    assert status(plan)["listen"] == "tcp/192.0.2.1:31000"
    told = condition(plan)
    assert (told["status"], told["reason"]) == ("True", "Listening")
    assert told["message"] == (
        """on a laptop, set ZENOH_CONFIG_OVERRIDE='mode="client";"""
        """connect/endpoints=["tcp/192.0.2.1:31000"];connect/timeout_ms=-1'"""
    )
    outside = node(addresses={"InternalIP": "10.0.0.1", "ExternalIP": "192.0.2.80"})
    assert status(look(listed(of, outside, proxy_of(of, outside))))["listen"] == (
        "tcp/192.0.2.80:31000"
    )


@pytest.mark.parametrize(
    ("ingress", "address"),
    [
        ([{"ip": "192.0.2.90"}], "tcp/192.0.2.90:7447"),
        ([{"hostname": "lb.example"}, {"ip": "192.0.2.91"}], "tcp/lb.example:7447"),
        ([{"ip": "fd00::9"}], "tcp/[fd00::9]:7447"),
    ],
)
def test_a_load_balancer_is_told_with_its_address(ingress: list[Json], address: str) -> None:
    of = listening(BALANCER)
    plan = look(listed(of, proxy_of(of), loadBalancer={"ingress": ingress}))
    assert status(plan)["listen"] == address
    assert address in condition(plan)["message"]


def test_a_load_balancer_without_an_address_is_told() -> None:
    of = listening(BALANCER)
    plan = look(listed(of, proxy_of(of)))
    assert (condition(plan)["status"], condition(plan)["reason"]) == ("False", "NoAddress")
    assert "MetalLB" in condition(plan)["message"]
    assert "listen" not in status(plan)
    reported = cluster_findings([{**rosproxy_obj(), "status": dict(status(plan))}])
    (finding,) = (f for f in reported if f.text.startswith("Listening is False: "))
    assert "spec.listen" in finding.fix


def test_without_a_proxy_none_answers() -> None:
    of = listening()
    outside = {of.id: outside_service(of)}
    plan = look(seen(of, outside_services=outside))
    assert (condition(plan)["status"], condition(plan)["reason"]) == ("Unknown", "NoProxies")
    plan = look(listed(of, proxy_of(of, phase="Pending")))
    assert (condition(plan)["status"], condition(plan)["reason"]) == ("Unknown", "NoProxies")
    assert "tcp/192.0.2.1:31000" in condition(plan)["message"]


def test_a_service_of_a_former_rosproxy_is_no_address() -> None:
    of = listening()
    foreign = replace(outside_service(of), owner="uid-former")
    plan = look(
        seen(of, some.pod(wired_master_uri=""), proxy_of(of), outside_services={of.id: foreign})
    )
    assert condition(plan)["reason"] == "NoAddress"


def test_a_rosproxy_without_the_field_has_no_such_condition() -> None:
    plan = look(seen(ofz(), some.pod(wired_master_uri=""), proxy_of(ofz())))
    assert "Listening" not in {c["type"] for c in status(plan)["conditions"]}
    of = some.rosproxy()
    plan = look(some.observed(of, service(of), pod()))
    assert "Listening" not in {c["type"] for c in status(plan)["conditions"]}


def test_a_listed_service_has_its_role() -> None:
    of = listening()
    present = outside_service(of)
    assert (present.role, present.node_port) == (ServiceRole.OUTSIDE, 31000)
    assert present.id == names.outside_service_id(of.id)
    assert service(of).role is ServiceRole.PODS
