"""rmw_zenoh in a RosProxy: what is read, made, and told to pods, proxies and users."""

from typing import Any

import pytest
from msgspec.structs import replace

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.documents.status_document import (
    ProblemStatus,
    ProxyStatus,
    StatusSettings,
    ZenohLinkStatus,
    ZenohNodeStatus,
    ZenohSessionStatus,
    ZenohStatus,
)
from rosproxy.shared.policy.rules import parse_rules
from rosproxy.shared.ports import PortRange
from rosproxy_operator.common.policy import administrators_policy
from rosproxy_operator.kubernetes.planner import manifests
from rosproxy_operator.kubernetes.planner.actions import (
    CreateProxy,
    CreateService,
    DeleteProxy,
    DeleteService,
    Emit,
)
from rosproxy_operator.kubernetes.planner.bounds import bounds_violation
from rosproxy_operator.kubernetes.planner.pods.recreation import needs_recreation
from rosproxy_operator.kubernetes.planner.pods.undiscovered import UNDISCOVERED_FOR_S
from rosproxy_operator.kubernetes.planner.pods.wiring import pod_variables, wire
from rosproxy_operator.kubernetes.planner.pods.zenoh_pods import zenoh_findings
from rosproxy_operator.kubernetes.planner.state import ClusterState
from rosproxy_operator.kubernetes.planner.steps.network_policy import policy
from rosproxy_operator.kubernetes.planner.zenoh_hubs import APART_REPORTED_S
from rosproxy_operator.kubernetes.proxies.proxy_report import report
from rosproxy_operator.kubernetes.resources import names, objects
from rosproxy_operator.kubernetes.resources.cluster import ProxyReport, ProxyService, ZenohReport
from rosproxy_operator.kubernetes.resources.fields import InvalidField
from rosproxy_operator.kubernetes.resources.model import (
    Json,
    MasterSpec,
    Pod,
    PodContainer,
    Ros2Spec,
    RosProxy,
    ZenohSpec,
)
from rosproxy_operator.kubernetes.resources.spec import rosproxy as read
from rosproxy_operator.kubernetes.settings import Bounds
from rosproxy_operator.kubernetes.status.condition_findings import cluster_findings
from tests.run_options import settings_of
from tests.unit.operator.kubernetes import objects as some
from tests.unit.operator.kubernetes.builders_api import rosproxy_obj
from tests.unit.operator.kubernetes.objects import (
    ROBOT,
    SETTINGS,
    creation,
    done,
    kinds,
    look,
    node,
    observed,
    proxy,
    service,
    site,
    status,
    told,
    written,
)

DEFAULTS = {
    "ports": 32,
    "portWindow": {"first": 11412, "last": 29999},
    "advertise": "InternalIP",
    "cleanupAfterSeconds": 30,
    "dataPlane": "Auto",
    "direction": "Out",
    "udp": False,
    "policy": {"slaveControl": "Any"},
    "logLevel": "Info",
}
"""What the API server fills in."""
EXCEPTION = [
    {"action": "Allow", "kind": "Publish", "names": ["/camera/info"]},
    {"action": "Deny", "kind": "Publish", "names": ["/camera/*"]},
]
"""Rules that zenoh can't hold."""


def ofz(*peers: str, **changes: Any) -> RosProxy:
    """A RosProxy for rmw_zenoh."""
    spec: dict[str, Any] = {"ros1": False, "zenoh": ZenohSpec(peers), "master": MasterSpec()}
    return some.rosproxy(**spec | changes)


def pod(**changes: Any) -> Pod:
    return some.pod(**{"wired_master_uri": ""} | changes)


def proxy_of(of: RosProxy, on: Any = None, **changes: Any) -> Any:
    return proxy(of, on, names.ROUTERS, **changes)


def hubs_service(of: RosProxy, **changes: Any) -> ProxyService:
    """The headless Service, as the API server lists the Service."""
    body: Any = manifests.hubs_service(of)
    body = {**body, "metadata": {**body["metadata"], "uid": "uid-hubs"}}
    listed = objects.service(body)
    assert listed is not None
    return replace(listed, **changes)


def seen(of: RosProxy, *more: Any, **changes: Any) -> Any:
    """A cluster with both Services of a RosProxy."""
    hubs = {"hub_services": {of.id: hubs_service(of)}}
    return observed(of, service(of), *more, **hubs | changes)


def env_of(body: Json) -> dict[str, str]:
    return {
        variable["name"]: variable["value"] for variable in body["spec"]["containers"][0]["env"]
    }


def specified(**spec: Any) -> Any:
    return read({**rosproxy_obj(), "spec": spec}).spec


def test_what_is_read():
    spec = specified(ros="zenoh", **DEFAULTS, peers=["Robot", "192.0.2.9:7448", "robot:7447"])

    assert (spec.ros1, spec.ros2, spec.master) == (False, None, MasterSpec())
    assert spec.zenoh == ZenohSpec(("192.0.2.9:7448", "robot:7447"))
    assert specified(ros="zenoh").zenoh == ZenohSpec()
    assert specified(ros=2).zenoh is None


def test_no_way_out_but_the_proxy_needs_no_direction():
    assert specified(ros="zenoh", podEgress="Proxy").pod_egress == "proxy"


@pytest.mark.parametrize(
    ("spec", "text"),
    [
        ({"master": {"uri": "http://robot:11311"}}, "spec.master"),
        ({"domain": 1}, "spec.domain: 1 is for ROS 2, but spec.ros is zenoh"),
        ({"multicast": True}, "spec.multicast"),
        ({"udp": True, "direction": "Both"}, "spec.udp"),
        ({"direction": "Both"}, "spec.direction: 'Both' has no effect with spec.ros: zenoh"),
        ({"ports": 64}, "spec.ports: 64 has no effect"),
        ({"portWindow": {"first": 12000}}, "spec.portWindow"),
        ({"advertise": "Hostname"}, "spec.advertise"),
        ({"cleanupAfterSeconds": 5}, "spec.cleanupAfterSeconds"),
        ({"dataPlane": "Splice"}, "spec.dataPlane"),
        (
            {"policy": {"slaveControl": "Master"}},
            "spec.policy.slaveControl: 'Master' has no effect",
        ),
        (
            {"policy": {"rules": EXCEPTION}},
            "spec.policy.rules: layer 'RosProxy robots/arm': rmw_zenoh",
        ),
        ({"peers": ["a b"]}, "spec.peers[0]: 'a b' is not a peer"),
        ({"peers": ["localhost"]}, "spec.peers[0]: 'localhost' is not a peer"),
        ({"peers": ["a"] * 33}, "has too many hosts"),
        ({"ros": "1,2,zenoh"}, "run nodes of rmw_zenoh in pods of their own"),
    ],
)
def test_what_is_refused(spec: Any, text: str):
    with pytest.raises(InvalidField) as refused:
        specified(**{"ros": "zenoh", **spec})
    assert text in str(refused.value)


def test_rules_of_all_kinds_are_read():
    """Rules about parameters and about the slave API match nothing, as with DDS."""
    rules = [{"action": "Deny", "kind": kind, "names": ["*"]} for kind in ("Publish", "Slave")]
    assert len(specified(ros="zenoh", policy={"rules": rules}).policy[0].rules) == 2


def test_the_address_of_the_service_stays_in_the_status():
    obj = rosproxy_obj(status={"routerEndpoint": "tcp/10.96.1.7:7448"})
    assert read({**obj, "spec": {"ros": "zenoh"}}).cluster_ip == "10.96.1.7"


def test_the_administrators_bounds_hold():
    allowed = replace(SETTINGS, bounds=Bounds(peers=("192.0.2.*",)))
    assert not bounds_violation(ofz("192.0.2.7:7447"), {}, allowed)
    refusal = str(bounds_violation(ofz("robot:7447"), {}, allowed))
    assert refusal.startswith("spec.peers: the operator does not allow 'robot:7447'")
    assert "allow.peers" in refusal


@pytest.mark.parametrize(
    ("peer", "pattern", "is_allowed"),
    [
        ("[fd00::7]:7447", "fd00::*", True),
        ("[fd00::7]:7447", "[fd00::*]", True),
        ("[fd00:0:0::7]:7447", "fd00::7", True),
        ("[fd01::7]:7447", "fd00::*", False),
        ("fd.example:7447", "fd*", True),
        ("fd.example:7447", "[fd*]", False),
        ("192.0.2.7:7447", "fd00::*", False),
    ],
)
def test_the_administrator_allows_ipv6_routers(peer: str, pattern: str, is_allowed: bool):
    bounds = replace(SETTINGS, bounds=Bounds(peers=(pattern,)))
    assert bool(bounds_violation(ofz(peer), {}, bounds)) != is_allowed


def test_an_own_address_for_a_name_counts_instead_of_the_name():
    alias = ({"ip": "198.51.100.1", "hostnames": ["robot"]},)
    of = ofz("robot:7447", host_aliases=alias)
    by_name, by_address = (
        replace(SETTINGS, bounds=Bounds(peers=(pattern,))) for pattern in ("robot", "198.51.100.*")
    )
    assert "allow.peers" in str(bounds_violation(of, {}, by_name))
    assert not bounds_violation(of, {}, by_address)
    dds = some.rosproxy(ros1=False, ros2=Ros2Spec(peers=("robot",)), host_aliases=alias)
    assert "allow.peers" in str(bounds_violation(dds, {}, by_name))


def test_ipv6_routers_are_read():
    given = ["[fd00::7]", "[fd00::8]:7448"]
    assert specified(ros="zenoh", peers=given).zenoh.peers == ("[fd00::7]:7447", "[fd00::8]:7448")
    with pytest.raises(InvalidField, match="is not a peer"):
        specified(ros=2, peers=given)


def test_bounds_of_ports_do_not_concern_a_proxy_without_ports():
    narrow = replace(SETTINGS, bounds=Bounds(max_ports=1))
    assert not bounds_violation(ofz(ports=32), {}, narrow)


def test_bounds_of_data_planes_do_not_concern_a_proxy_without_a_data_plane():
    """The definition allows the default alone, which the administrator may have excluded."""
    narrow = replace(SETTINGS, bounds=Bounds(data_planes=("splice",)))
    assert not bounds_violation(ofz(), {}, narrow)
    assert "allow.dataPlanes" in str(bounds_violation(some.rosproxy(), {}, narrow))


def test_a_policy_of_the_administrator_that_zenoh_can_not_hold_is_told():
    rules = parse_rules("allow publish /camera/info; deny publish /camera/*")
    settings = replace(SETTINGS, policy=administrators_policy([rules], "enforce"))
    assert "rmw_zenoh can't hold the operator's policy" in str(
        bounds_violation(ofz(), {}, settings)
    )
    audit = replace(SETTINGS, policy=administrators_policy([rules], "audit"))
    assert not bounds_violation(ofz(), {}, audit)


def test_a_proxy_understands_its_variables_and_has_no_hostport():
    of = ofz("192.0.2.7:7447", "robot:7448")
    place = replace(site(of, node(), names.ROUTERS), hubs=("hub.hubs.ros.svc:7447",))

    body = manifests.proxy_pod(place, SETTINGS)

    settings = settings_of(env_of(body))
    assert settings.ros == ("zenoh",)
    assert settings.zenoh_ports == names.ROUTERS
    assert settings.zenoh_hub_listen == names.HUB_PORT
    assert settings.zenoh_listen is None
    assert settings.zenoh_peer == (HostPort("192.0.2.7", 7447), HostPort("robot", 7448))
    assert settings.zenoh_hub == (HostPort("hub.hubs.ros.svc", 7447),)
    assert body["spec"]["containers"][0]["ports"] == []
    assert not {"ROSPROXY_PORT_RANGE", "ROS_MASTER_URI"} & env_of(body).keys()
    security = body["spec"]["containers"][0]["securityContext"]
    assert security["capabilities"] == {"drop": ["ALL"]}


def test_a_proxy_gets_its_log_level():
    of = replace(ofz(), spec=specified(ros="zenoh", logLevel="Debug"))
    body = manifests.proxy_pod(site(of, node(), names.ROUTERS), SETTINGS)
    assert settings_of(env_of(body)).log_level == "debug"
    default = manifests.proxy_pod(site(ofz(), node(), names.ROUTERS), SETTINGS)
    assert "ROSPROXY_LOG_LEVEL" not in env_of(default)


def test_the_pod_has_the_name_that_other_hubs_dial():
    of = ofz()
    body = manifests.proxy_pod(site(of, node(), names.ROUTERS), SETTINGS)
    hubs = manifests.hubs_service(of)
    host = f"{body['spec']['hostname']}.{body['spec']['subdomain']}"
    assert names.hub_address(of.id, "one") == HostPort(f"{host}.ros.svc", 7447)
    assert body["spec"]["subdomain"] == hubs["metadata"]["name"]
    assert (hubs["spec"]["clusterIP"], hubs["spec"]["publishNotReadyAddresses"]) == ("None", True)
    assert hubs["spec"]["selector"].items() <= body["metadata"]["labels"].items()
    other = manifests.proxy_pod(site(some.rosproxy(), node()), SETTINGS)
    assert not {"hostname", "subdomain"} & other["spec"].keys()


@pytest.mark.parametrize("name", ["a", "x" * 46])
def test_names_fit_in_a_label_and_differ_from_other_services(name: str):
    of = replace(ROBOT, name=name)
    assert len(names.hubs_service_id(of).name) <= 63
    assert names.hubs_service_id(of) != names.service_id(replace(ROBOT, name=f"{name}-hubs"))


def test_hubs_come_and_go_without_a_proxy_being_made_anew():
    place = site(ofz("robot:7447"), node(), names.ROUTERS)
    bodies = [manifests.proxy_pod(replace(place, hubs=h), SETTINGS) for h in ((), ("a.b:7447",))]
    assert len({manifests.fingerprint_of(body) for body in bodies}) == 1
    assert env_of(bodies[0]) != env_of(bodies[1])
    moved = manifests.proxy_pod(site(ofz("arm:7447"), node(), names.ROUTERS), SETTINGS)
    assert manifests.fingerprint_of(moved) != manifests.fingerprint_of(bodies[0])


def test_the_service_leads_to_the_router():
    (port,) = manifests.service(ofz())["spec"]["ports"]
    assert (port["port"], port["protocol"]) == (7448, "TCP")


def test_proxies_of_other_nodes_are_hubs():
    of = ofz()
    far = node("two", addresses={})
    plan = look(seen(of, node(), far, pod(), pod(name="b", on="two")))
    made = [action for action in done(plan) if isinstance(action, CreateProxy)]
    hubs = {some.node_of(action): env_of(action.body)["ROSPROXY_ZENOH_HUBS"] for action in made}
    assert hubs == {
        "one": str(names.hub_address(of.id, "two")),
        "two": str(names.hub_address(of.id, "one")),
    }


def test_a_proxy_needs_neither_ports_nor_an_address_of_the_node():
    of = ofz(ports=500)
    full = pod(name="stranger", labels={}, host_ports=frozenset({7448, 7447}))
    action = creation(look(seen(of, node(addresses={}), pod(), full)))
    assert some.ports_of(action) == "7448-7448"


def test_two_proxies_on_a_node_have_no_conflict():
    of = ofz()
    other = replace(ofz(), id=replace(of.id, name="arm"), uid="uid-arm")
    labels = ({names.INJECT: "robot"}, {names.INJECT: "arm"})
    pods = [pod(name=name, labels=own) for name, own in zip("ab", labels, strict=True)]
    hubs = {rosproxy.id: hubs_service(rosproxy) for rosproxy in (of, other)}
    plan = look(observed(of, other, service(of), service(other), *pods, hub_services=hubs))
    assert kinds(plan) == [CreateProxy, CreateProxy]


def test_both_services_are_made_and_later_nothing_more():
    of = ofz()
    made = [
        action for action in done(look(observed(of, pod()))) if isinstance(action, CreateService)
    ]
    assert [action.body["metadata"]["name"] for action in made] == [
        "rosproxy-robot",
        "hubs-of-rosproxy-robot",
    ]
    assert not done(look(seen(of, pod(), proxy_of(of))))


@pytest.mark.parametrize("change", ["other version", "other uid", "RosProxy gone", "outdated"])
def test_a_headless_service_that_is_not_right_goes(change: str):
    of = ofz()
    present = {
        "other version": (some.rosproxy(ros1=False, ros2=Ros2Spec()), hubs_service(of)),
        "other uid": (of, hubs_service(of, owner="uid-former")),
        "RosProxy gone": (None, hubs_service(of)),
        "outdated": (of, hubs_service(of, fingerprint="0")),
    }[change]
    rosproxy, hubs = present
    services = {of.id: service(rosproxy)} if rosproxy else {}
    cluster = replace(observed(), services=services, hub_services={of.id: hubs})
    cluster = replace(cluster, rosproxies=tuple(filter(None, [rosproxy])))
    (action,) = done(look(cluster))
    assert isinstance(action, DeleteService)
    assert action.id == names.hubs_service_id(of.id)


def test_a_proxy_of_zenoh_unregisters_nothing_when_it_goes():
    of = ofz()
    later = look(seen(of, proxy_of(of)), now=100.0)
    gone = look(seen(of, proxy_of(of)), later.state, now=100.0 + of.spec.grace + 1)
    (action,) = done(gone)
    assert isinstance(action, DeleteProxy)
    assert not action.retire


def test_another_version_is_another_proxy():
    of = ofz()
    former = proxy(replace(some.rosproxy(), uid=of.uid))
    (action,) = done(look(seen(of, pod(), former)))
    assert isinstance(action, DeleteProxy)
    assert action.retire  # the nodes of ROS 1 are registered at the master
    back = some.rosproxy()
    (action,) = done(look(observed(back, service(back), some.pod(), proxy_of(ofz()))))
    assert isinstance(action, DeleteProxy)
    assert not action.retire


def test_the_port_of_the_router_is_no_former_range():
    """A RosProxy that was for rmw_zenoh may now have a window with the port of the router."""
    back = some.rosproxy(window=PortRange(7000, 7999))
    former = proxy_of(ofz())
    going = look(observed(back, service(back), some.pod(), former))
    made = creation(look(observed(back, service(back), some.pod()), going.state))
    assert some.ports_of(made) == "7000-7003"


def test_a_proxy_of_ros_1_may_have_the_port_of_the_router_as_its_range():
    of = some.rosproxy(ports=1, window=PortRange(7448, 7448))
    of_ros1 = proxy(of, ports=names.ROUTERS)
    assert of_ros1.has_registrations
    assert not proxy_of(ofz()).has_registrations
    plan = look(observed(of, service(of), some.pod(), of_ros1))
    assert not done(plan)
    wider = replace(of, spec=replace(of.spec, window=PortRange(7440, 7459)))
    moved = look(observed(wider, service(wider), some.pod(), of_ros1), plan.state)
    assert not done(moved)  # the proxy keeps its ports
    other = replace(of, spec=replace(of.spec, window=PortRange(7450, 7459)))
    left = look(observed(other, service(other), some.pod(), of_ros1), plan.state)
    (action,) = done(left)
    assert isinstance(action, DeleteProxy)
    assert action.retire
    assert "has left ports 7448-7448 for 7450-7450" in told(left, "PortConflict")[0]


@pytest.mark.parametrize(
    ("rosproxy", "wired"),
    [
        (ofz(), {"wired_master_uri": "http://10.96.1.1:11311"}),
        (ofz(), {"static_peers": "10.96.1.1"}),
        (some.rosproxy(), {"router_endpoint": "tcp/10.96.1.1:7448"}),
        (some.rosproxy(ros1=False, ros2=Ros2Spec()), {"router_endpoint": "tcp/10.96.1.1:7448"}),
    ],
)
def test_a_pod_that_was_wired_for_another_version_is_told(rosproxy: RosProxy, wired: Any):
    labels = {names.INJECT: "true"}
    former = pod(
        labels=labels, containers=(PodContainer("ros:1"),), workload="deployment/a", **wired
    )
    state = ClusterState(undiscovered={former.id: 0.0})
    plan = look(observed(rosproxy, service(rosproxy), former), state, UNDISCOVERED_FOR_S)
    (text,) = told(plan, "NotWired")
    assert "since the pod was created for another spec.ros, or for another RosProxy" in text
    assert text.endswith("Run kubectl -n ros rollout restart deployment/a")


def test_a_proxy_is_told_its_policy_and_no_callers():
    rules = parse_rules("deny publish *")
    settings = replace(SETTINGS, policy=administrators_policy([rules], "enforce"))
    of = ofz()
    (briefing,) = look(seen(of, pod(), proxy_of(of)), settings=settings).briefings.values()
    assert briefing.policy == settings.policy
    assert (briefing.callers, briefing.peers, briefing.gone) == (None, None, ())


ADDRESS = "10.96.1.1"
ENDPOINT = f"tcp/{ADDRESS}:7448"
BRIEF = f'mode="client";connect/endpoints=["{ENDPOINT}"]'
AS_CLIENT = f"{BRIEF};connect/timeout_ms=-1"
OVERRIDE = "ZENOH_CONFIG_OVERRIDE"
RMW = "RMW_IMPLEMENTATION"
ROBOTS = 'connect/endpoints=["tcp/192.0.2.7:7447"]'


def wired(env: dict[str, str], address: str = ADDRESS, former: str = "") -> tuple[Any, Any]:
    """The variables and annotations of a pod after the webhook."""
    variables = [{"name": name, "value": value} for name, value in env.items()]
    annotations = {names.ROUTER_ENDPOINT: former} if former else {}
    container = {"name": "main", "env": variables}
    body = {"metadata": {"annotations": annotations}, "spec": {"containers": [container]}}
    wiring = wire(body, pod_variables(ofz(), address))
    spec: Any = wiring.spec or body["spec"]
    made = {v["name"]: v["value"] for v in spec["containers"][0]["env"]}
    assert len(made) == len(spec["containers"][0]["env"])
    return made, wiring.annotations


@pytest.mark.parametrize("rmw", [None, "", "rmw_zenoh_cpp", "$(CHOSEN)"])
def test_nodes_become_clients_of_the_router(rmw: str | None):
    given = {} if rmw is None else {RMW: rmw}
    env, annotations = wired(given)
    assert env == {OVERRIDE: AS_CLIENT, **given}
    assert annotations == {names.ROUTER_ENDPOINT: ENDPOINT}


def test_an_address_of_ipv6_stands_in_brackets():
    env, _ = wired({}, "fd00::1")
    assert 'connect/endpoints=["tcp/[fd00::1]:7448"]' in env[OVERRIDE]


def test_nodes_of_dds_stay_as_they_are():
    assert wired({RMW: "rmw_fastrtps_cpp"}) == ({RMW: "rmw_fastrtps_cpp"}, {})


@pytest.mark.parametrize(
    ("own", "made"),
    [
        ("", AS_CLIENT),
        (
            "transport/shared_memory/enabled=true",
            f"transport/shared_memory/enabled=true;{AS_CLIENT}",
        ),
        ('namespace="r1"; ', f'namespace="r1";{AS_CLIENT}'),
        ("connect/timeout_ms=5", f"connect/timeout_ms=5;{BRIEF}"),
        (ROBOTS, ROBOTS),
        ('mode="router"', 'mode="router"'),
        ("connect={endpoints:[]}", "connect={endpoints:[]}"),
        ("connect/endpoints/0=1", "connect/endpoints/0=1"),
        ("$(OTHER)", "$(OTHER)"),
    ],
)
def test_an_override_of_the_template_is_joined_or_kept(own: str, made: str):
    env, annotations = wired({OVERRIDE: own})
    assert env == {OVERRIDE: made}
    assert bool(annotations) == (ENDPOINT in made)


def test_a_long_override_is_kept_whole():
    """The operator keeps only the beginning of long values, but the webhook may not cut any."""
    own = f'namespace="r1";transport/x="{"x" * 5000}"'
    env, _ = wired({OVERRIDE: own})
    assert env == {OVERRIDE: f"{own};{AS_CLIENT}"}
    assert not findings(env, router_endpoint=ENDPOINT)


def test_a_value_that_is_known_at_run_time_is_kept():
    source = {"name": OVERRIDE, "valueFrom": {"configMapKeyRef": {"name": "a", "key": "b"}}}
    body = {"metadata": {}, "spec": {"containers": [{"name": "main", "env": [source]}]}}
    assert wire(body, pod_variables(ofz(), ADDRESS)).spec is None


def test_a_second_wiring_changes_nothing_and_a_copy_gets_the_new_address():
    env, _ = wired({OVERRIDE: 'namespace="r1"'})
    again, annotations = wired(env, former=ENDPOINT)
    assert (again, annotations) == (env, {names.ROUTER_ENDPOINT: ENDPOINT})
    moved, annotations = wired(env, "10.96.1.9", former=ENDPOINT)
    assert moved == {OVERRIDE: env[OVERRIDE].replace(ADDRESS, "10.96.1.9")}
    assert annotations == {names.ROUTER_ENDPOINT: "tcp/10.96.1.9:7448"}


def test_variables_of_other_versions_are_not_set():
    variables = pod_variables(ofz(), ADDRESS)
    assert (variables.uri, variables.static_peers, variables.domain) == ("", "", None)
    assert pod_variables(some.rosproxy(), ADDRESS).router is None


def findings(*containers: dict[str, str], **changes: Any) -> list[tuple[str, str]]:
    own = pod(containers=tuple(PodContainer("", c) for c in containers), **changes)
    return [(f.reason, f.message) for f in zenoh_findings(own, ofz(), ADDRESS)]


def test_a_pod_that_is_wired_has_no_finding():
    assert not findings({OVERRIDE: AS_CLIENT}, {}, router_endpoint=ENDPOINT)
    by_name = 'mode="client";connect/endpoints=["tcp/rosproxy-robot:7448"]'
    assert not findings({OVERRIDE: by_name})
    assert not findings({OVERRIDE: "$()"})
    assert not [*zenoh_findings(pod(), some.rosproxy(), ADDRESS)]


@pytest.mark.parametrize(
    ("env", "reason", "text"),
    [
        ({RMW: "rmw_fastrtps_cpp"}, "NoZenoh", "RMW_IMPLEMENTATION=rmw_fastrtps_cpp is DDS"),
        ({OVERRIDE: ROBOTS}, "NotWired", "connects the nodes past the proxy. Remove mode and"),
        ({OVERRIDE: 'mode="client"'}, "NotWired", "past the proxy"),
        ({OVERRIDE: f'connect/endpoints=["{ENDPOINT}"]'}, "NotWired", "passes no messages between"),
        ({}, "NotWired", "has no variable ZENOH_CONFIG_OVERRIDE with the address of the proxy"),
        ({OVERRIDE: 'namespace="r1"'}, "NotWired", "has no variable ZENOH_CONFIG_OVERRIDE with"),
    ],
)
def test_faults_of_pods(env: dict[str, str], reason: str, text: str):
    ((found, told),) = findings(env)
    assert found == reason
    assert text in told


def test_a_pod_with_a_former_address_is_told():
    former = AS_CLIENT.replace(ADDRESS, "10.96.1.9")
    ((reason, text),) = findings({OVERRIDE: former}, router_endpoint="tcp/10.96.1.9:7448")
    assert reason == "NotWired"
    assert text.startswith("was wired to tcp/10.96.1.9:7448")


@pytest.mark.parametrize(
    ("env", "endpoint", "expected"),
    [
        ({}, "", True),
        ({OVERRIDE: 'namespace="r1"'}, "", True),
        ({OVERRIDE: AS_CLIENT}, ENDPOINT, False),
        ({OVERRIDE: AS_CLIENT.replace(ADDRESS, "10.96.1.9")}, "tcp/10.96.1.9:7448", True),
        ({OVERRIDE: ROBOTS}, "", False),
        ({RMW: "rmw_cyclonedds_cpp"}, "", False),
    ],
)
def test_pods_to_recreate(env: dict[str, str], endpoint: str, expected: bool):
    own = pod(containers=(PodContainer("", env),), router_endpoint=endpoint)
    assert needs_recreation(own, ofz(), ADDRESS) is expected


def test_a_container_of_a_later_webhook_is_no_reason_to_recreate_a_pod():
    containers = (PodContainer("", {OVERRIDE: AS_CLIENT}), PodContainer())
    own = pod(containers=containers, router_endpoint=ENDPOINT)
    assert not needs_recreation(own, ofz(), ADDRESS)


def test_the_service_gets_the_address_to_which_pods_are_wired():
    own = pod(router_endpoint="tcp/10.96.1.7:7448")
    made = done(look(observed(ofz(), own)))
    assert made[0].body["spec"]["clusterIP"] == "10.96.1.7"  # type: ignore[union-attr]


def test_what_the_webhook_has_set_is_read():
    annotations = {names.ROUTER_ENDPOINT: ENDPOINT}
    container = {"name": "a", "env": [{"name": OVERRIDE, "value": AS_CLIENT}]}
    read_pod = objects.pod(
        {"metadata": {"annotations": annotations}, "spec": {"containers": [container]}}
    )
    assert read_pod.router_endpoint == ENDPOINT
    assert read_pod.containers[0].variables == {OVERRIDE: AS_CLIENT}
    assert not read_pod.misspelt


def test_pods_reach_the_router_and_proxies_reach_the_hub():
    admin = replace(SETTINGS, admin_from=())
    pods, hubs, operators = policy(ofz(), admin, {names.ROUTERS})["spec"]["ingress"]
    assert [port["port"] for port in pods["ports"]] == [7448]
    assert pods["from"] == [
        {
            "podSelector": {
                "matchExpressions": [
                    {"key": names.INJECT, "operator": "In", "values": ["robot", "true"]}
                ]
            }
        }
    ]
    assert [port["port"] for port in hubs["ports"]] == [7447]
    assert hubs["from"] == [{"podSelector": {"matchLabels": names.own_labels("robot")}}]
    assert operators["from"] == []


STATUS = ProxyStatus(
    settings=StatusSettings(ros=("zenoh",)),
    zenoh=ZenohStatus(
        links=(
            ZenohLinkStatus("192.0.2.7:7447", True),
            ZenohLinkStatus("robot:7447", error="refused"),
            ZenohLinkStatus("far:7447", error="unresolvable", hub=True),
        ),
        sessions=(
            ZenohSessionStatus(7448, "client", "a", "10.244.1.200:7448", "10.244.1.9:5000"),
            ZenohSessionStatus(None, "router", "b", "10.244.1.200:5001", "192.0.2.7:7447"),
        ),
        nodes=(
            ZenohNodeStatus("/talker", 0, "10.244.1.9", ("/chatter",), ("/clock",), port=7448),
            ZenohNodeStatus("/laptop", 0, "192.0.2.50", ("/joy",)),
            ZenohNodeStatus("/robot", 0, "", ("/scan",)),
        ),
    ),
)
FAULT = "zenoh peer robot:7447: connection refused. Fix: start a router"


def test_what_the_operator_keeps_of_a_status():
    told_status = report(STATUS)
    assert told_status.zenoh == ZenohReport(
        nodes=("/talker",),
        sessions=1,
        peers={"192.0.2.7:7447": "", "robot:7447": "refused"},
        hubs={"far:7447": "unresolvable"},
    )
    assert told_status.topics == {"/chatter", "/clock"}
    assert told_status.master_up
    # Nodes of rmw_zenoh are unregistered by no call of the operator.
    assert not told_status.addresses
    assert report(ProxyStatus()).zenoh is None


def answered(of: RosProxy, *answers: Any, **changes: Any) -> Any:
    """A cluster with a proxy on each node, which has answered."""
    nodes = [node(name, addresses={}) for name in ("one", "two", "three")[: len(answers)]]
    pods = [pod(name=f"on-{n.name}", on=n.name, router_endpoint=ENDPOINT) for n in nodes]
    proxies = [proxy_of(of, n) for n in nodes]
    reports = {p.pod.uid: a for p, a in zip(proxies, answers, strict=True)}
    return seen(of, *nodes, *pods, *proxies, reports=reports, **changes)


def conditions(plan: Any) -> dict[str, tuple[str, str]]:
    return {c["type"]: (c["status"], c["reason"]) for c in status(plan)["conditions"]}


def test_the_status_of_a_rosproxy():
    of = ofz("192.0.2.7:7447", "robot:7447")
    plan = look(answered(of, report(STATUS)))
    told_status = status(plan)
    assert told_status["routerEndpoint"] == ENDPOINT
    assert (told_status["sessions"], told_status["rosNodes"], told_status["topics"]) == (1, 1, 2)
    assert (told_status["ports"], told_status["addresses"]) == ("", "")
    (line,) = told_status["perNode"]
    assert (line["sessions"], line["peers"], line["hubs"]) == (1, "1/2", "0/0")
    assert line["names"] == ["/talker"]
    assert not {"ports", "advertiseHost"} & line.keys()
    assert conditions(plan) == {
        "Ready": ("True", "Serving"),
        "PeersReachable": ("Unknown", "Linking"),
        "Degraded": ("False", "AsExpected"),
    }
    message = told_status["conditions"][0]["message"]
    assert message == "1 of 1 proxies serve 1 ROS node"


def test_a_proxy_that_has_not_answered_changes_no_status():
    of = ofz("robot:7447")
    first = answered(of, report(STATUS))
    known = written(first)
    assert status_or_none(look(replace(known, reports={}))) is None


def status_or_none(plan: Any) -> Any:
    try:
        return status(plan)
    except StopIteration:
        return None


def test_a_peer_that_is_down_is_told_with_an_event():
    of = ofz("robot:7447")
    faulty = replace(report(STATUS), problems=(FAULT,))
    plan = look(answered(of, faulty))
    assert conditions(plan)["PeersReachable"] == ("False", "PeerUnreachable")
    assert conditions(plan)["Degraded"] == ("True", "PeerUnreachable")
    assert conditions(plan)["Ready"] == ("True", "Serving")
    (text,) = told(plan, "PeerUnreachable")
    assert text.endswith(FAULT)
    events = [action for action in plan.actions if isinstance(action, Emit)]
    assert "PeerUnreachable" in {event.reason for event in events}
    problem = ProblemStatus(subject="zenoh peer robot:7447", text="connection refused", holds=True)
    told_status = report(replace(STATUS, problems=(problem,)))
    assert told_status.problems == ("zenoh peer robot:7447: connection refused",)


def test_the_doctor_says_which_peer_is_down():
    of = ofz("robot:7447")
    plan = look(answered(of, replace(report(STATUS), problems=(FAULT,))))
    reported = cluster_findings([{**rosproxy_obj(), "status": dict(status(plan))}])
    (peers,) = (f for f in reported if f.text.startswith("PeersReachable is False: "))
    assert FAULT in peers.text
    assert "spec.peers" in peers.fix


def test_a_hub_that_refuses_is_told_with_an_event():
    of = ofz()
    problem = "zenoh hub two.hubs:7447: the program there does not prove itself"
    plan = look(answered(of, replace(report(STATUS), problems=(problem,))))
    assert conditions(plan)["Degraded"] == ("True", "HubRefused")
    assert conditions(plan)["Ready"] == ("True", "Serving")
    (text,) = told(plan, "HubRefused")
    assert text.endswith(problem)


def test_peers_that_are_linked():
    good = ZenohReport(peers={"robot:7447": ""})
    plan = look(answered(ofz("robot:7447"), ProxyReport(True, True, zenoh=good)))
    assert conditions(plan)["PeersReachable"] == ("True", "Reached")
    assert "PeersReachable" not in conditions(look(answered(ofz(), ProxyReport(True, True))))


def linked(*nodes_up: str, down: tuple[str, ...] = ()) -> ProxyReport:
    """The answer of a proxy that is linked with the proxies on some nodes."""
    hubs = {str(names.hub_address(ROBOT, on)): "" for on in nodes_up}
    hubs |= {str(names.hub_address(ROBOT, on)): "silent" for on in down}
    return ProxyReport(True, True, zenoh=ZenohReport(hubs=hubs))


@pytest.mark.parametrize(
    ("one", "two", "apart"),
    [
        (linked("two"), linked("one"), False),
        (linked("two"), linked(down=("one",)), False),  # behind NAT, one side sees the address
        (linked(), linked("one"), False),  # the proxy on one is older than node two
        (linked(), linked(), False),  # beyond the bound of hubs
        (linked(down=("two",)), linked(down=("one",)), True),
        (linked(), linked(down=("one",)), True),
    ],
)
def test_hubs_that_are_apart_are_told_after_a_while(
    one: ProxyReport, two: ProxyReport, apart: bool
):
    cluster = answered(ofz(), one, two)
    first = look(cluster, now=100.0)
    assert not told(first, "HubsApart")
    assert bool(first.state.apart) is apart
    assert first.next_look_in is not None
    assert first.next_look_in <= APART_REPORTED_S
    later = look(cluster, first.state, now=100.0 + APART_REPORTED_S)
    assert [text[:24] for text in told(later, "HubsApart")] == (
        ["proxy on node one: the hub "[:24]] if apart else []
    )
    counts = [line["hubs"] for line in status(later)["perNode"]]
    is_linked = one.zenoh != two.zenoh and not apart
    assert counts == (["1/1"] * 2 if is_linked else ["0/1"] * 2)
    healed = look(answered(ofz(), linked("two"), linked("one")), later.state, now=200.0)
    assert not told(healed, "HubsApart")
    assert not healed.state.apart
