"""ROS 2 in a RosProxy: what is read, allocated, made, and told to pods, proxies and users."""

from typing import Any

import pytest
from msgspec.structs import replace

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.ports import PortRange
from rosproxy_operator.kubernetes.planner import manifests
from rosproxy_operator.kubernetes.planner.actions import (
    CreateHelper,
    CreateProxy,
    DeleteHelper,
    DeleteProxy,
)
from rosproxy_operator.kubernetes.planner.bounds import bounds_violation
from rosproxy_operator.kubernetes.planner.pods.wiring import PodVariables, pod_variables, wire
from rosproxy_operator.kubernetes.planner.steps.context import TORN_DOWN_WITHIN_S
from rosproxy_operator.kubernetes.planner.steps.lan_relay import lan_relay_pod
from rosproxy_operator.kubernetes.planner.steps.network_policy import policy
from rosproxy_operator.kubernetes.resources import names, objects
from rosproxy_operator.kubernetes.resources.cluster import HelperPod, ProxyReport
from rosproxy_operator.kubernetes.resources.fields import InvalidField
from rosproxy_operator.kubernetes.resources.model import (
    Json,
    MasterSpec,
    Pod,
    PodContainer,
    ProxyPlace,
    Ros2Spec,
    RosProxy,
)
from rosproxy_operator.kubernetes.resources.pod_failures import pod_failure
from rosproxy_operator.kubernetes.resources.spec import rosproxy as read
from rosproxy_operator.kubernetes.settings import Bounds, ClusterSettings
from rosproxy_operator.kubernetes.status.rosproxy_status import participants
from tests.run_options import settings_of
from tests.unit.operator.kubernetes import objects as some
from tests.unit.operator.kubernetes.builders_api import rosproxy_obj
from tests.unit.operator.kubernetes.objects import (
    RANGE,
    ROBOT,
    SETTINGS,
    creation,
    done,
    look,
    node,
    observed,
    proxy,
    service,
    site,
    status,
    told,
)

ADDRESS = "10.96.1.1"
HEARING = Ros2Spec(multicast=True)
KEY = bytes(range(32))
SECRET = "0123456789abcdef"
GOOD = {"master": {"uri": "http://robot:11311"}}


def of2(ros2: Ros2Spec | None = None, **changes: Any) -> RosProxy:
    """A RosProxy for ROS 2 alone."""
    spec: dict[str, Any] = {"ros1": False, "ros2": ros2 or Ros2Spec(), "master": MasterSpec()}
    return some.rosproxy(**spec | changes)


@pytest.mark.parametrize(("of", "waits"), [(of2(), True), (some.rosproxy(), False)])
def test_a_proxy_waits_for_the_udp_ports_of_one_that_vanished(of: RosProxy, waits: bool) -> None:
    """Else the node's conntrack leads datagrams to the former pod's address for good."""
    vanished = {ProxyPlace(of.id, some.node().name): 100.0}
    seen = observed(of, service(of), pod(), vanished=vanished)
    early = look(seen, now=100.5)
    late = look(seen, now=100.0 + TORN_DOWN_WITHIN_S)
    assert any(isinstance(action, CreateProxy) for action in early.actions) is not waits
    assert any(isinstance(action, CreateProxy) for action in late.actions)
    assert early.next_look_in is not None
    assert early.next_look_in <= TORN_DOWN_WITHIN_S - 0.5


def pod(*containers: PodContainer, **changes: Any) -> Pod:
    defaults: dict[str, Any] = {
        "wired_master_uri": "",
        "static_peers": ADDRESS,
        "containers": containers,
    }
    return some.pod(**defaults | changes)


def env_of(body: Json) -> dict[str, str]:
    return {
        variable["name"]: variable["value"] for variable in body["spec"]["containers"][0]["env"]
    }


def specified(**spec: Any) -> Any:
    obj = rosproxy_obj()
    return read({**obj, "spec": spec}).spec


def test_what_is_read():
    spec = specified(ros=2, domain=7, peers=["Robot", "192.0.2.9:11400"], multicast=True)

    assert (spec.ros1, spec.master) == (False, MasterSpec())
    assert spec.ros2 == Ros2Spec(7, ("192.0.2.9:11400", "robot"), True)
    both = specified(ros="1, 2", **GOOD)
    assert (both.ros1, both.ros2) == (True, Ros2Spec())
    assert specified(**GOOD).ros2 is None


@pytest.mark.parametrize(
    ("spec", "text"),
    [
        ({"ros": 3}, "spec.ros: 3 is unknown"),
        ({"ros": True}, "spec.ros: True is unknown"),
        ({"ros": 2, **GOOD}, "spec.master"),
        ({"ros": 2, "domain": 233}, "spec.domain"),
        ({"ros": 2, "peers": ["a b"]}, "spec.peers[0]: 'a b' is not a peer"),
        ({"ros": 2, "peers": ["a"] * 33}, "has too many hosts"),
        ({"ros": 2, "multicast": "yes"}, "spec.multicast"),
        ({"ros": 2, "ports": 3}, "Write at least 4"),
        ({"ros": 2, "ports": 4, "multicast": True}, "Write at least 5"),
        ({"domain": 1, **GOOD}, "spec.domain: 1 is for ROS 2"),
        ({"ros": "1,2"}, "give exactly one of uri"),
    ],
)
def test_what_is_refused(spec: Any, text: str):
    with pytest.raises(InvalidField) as refused:
        specified(**spec)
    assert text in str(refused.value)


def test_a_proxy_understands_its_variables_and_takes_ports_of_udp():
    of = of2(Ros2Spec(3, ("robot",), True), ports=8)
    ports = PortRange(11400, 11407)
    peers = ("192.0.2.2:11400", "robot")
    place = replace(site(of, node(), ports), peers=peers, relay_secret=SECRET)

    body = manifests.proxy_pod(place, SETTINGS)

    settings = settings_of(env_of(body))
    assert (settings.ros, settings.domains, settings.master_uri) == (("2",), (3,), "")
    assert settings.ros2_peer == (HostPort("192.0.2.2", 11400), HostPort("robot", 0))
    assert settings.ros2_lan_relay == HostPort("192.0.2.1", 11407)
    assert settings.ros2_lan_relay_secret == SECRET
    assert settings.ports.listen == PortRange(11400, 11406)
    taken = body["spec"]["containers"][0]["ports"]
    assert {port["protocol"] for port in taken} == {"UDP"}
    assert [port["hostPort"] for port in taken] == list(range(11400, 11407))


def test_one_for_both_versions_has_both_kinds_of_ports():
    proxy_pod = proxy(some.rosproxy(ros2=Ros2Spec()))
    assert proxy_pod.pod.host_ports == proxy_pod.pod.udp_ports == set(RANGE.ports())


def test_peers_come_and_go_without_a_proxy_being_made_anew():
    place = site(of2(), node())
    place_with_peer = replace(place, peers=("192.0.2.2:11400",))
    body, body_with_peer = (
        manifests.proxy_pod(proxy_site, SETTINGS) for proxy_site in (place, place_with_peer)
    )
    assert manifests.fingerprint_of(body) == manifests.fingerprint_of(body_with_peer)
    assert body != body_with_peer


def test_the_service_leads_to_the_well_known_port():
    (port,) = manifests.service(of2(Ros2Spec(2)))["spec"]["ports"]
    assert (port["port"], port["protocol"]) == (7410 + 500, "UDP")
    both = manifests.service(some.rosproxy(ros2=Ros2Spec()))["spec"]["ports"]
    assert [service_port["protocol"] for service_port in both] == ["TCP", "UDP"]


def test_proxies_of_several_nodes_are_each_others_peers():
    of = of2(Ros2Spec(peers=("robot",)))
    far = node("two", addresses={"InternalIP": "192.0.2.2"})
    pods_and_proxies = (
        pod(),
        pod(name="b", on="two"),
        proxy(of),
        proxy(of, far, PortRange(11410, 11413)),
    )

    plan = look(observed(of, service(of), node(), far, *pods_and_proxies))

    expected_peers = ("192.0.2.1:11400", "robot"), ("192.0.2.2:11410", "robot")
    assert {briefing.peers for briefing in plan.briefings.values()} == set(expected_peers)


def test_a_proxy_has_no_peer_at_its_own_address_unless_others_have_the_address_too():
    of = of2(Ros2Spec(peers=("192.0.2.1:11400",)))
    hosts = {
        "named": "192.0.2.1",
        "shared": "192.0.2.2",
        "sharing": "192.0.2.2",
        "other": "192.0.2.3",
        "ipv6": "2001:db8::4",
    }
    nodes = [node(name, addresses={"InternalIP": host}) for name, host in hosts.items()]
    pods = [pod(name=f"pod-{name}", on=name) for name in hosts]

    plan = look(observed(of, service(of), *nodes, *pods))

    made = [action for action in plan.actions if isinstance(action, CreateProxy)]
    peers = {some.node_of(a): settings_of(env_of(a.body)).ros2_peer for a in made}
    own = {name: HostPort(host, 11400) for name, host in hosts.items()}
    common = (own["named"], own["shared"])
    everyone = (*common, own["other"])
    with_all = dict.fromkeys(("named", "shared", "sharing"), everyone)
    assert peers == {**with_all, "other": common}


def test_ports_of_udp_are_kept_clear_of_others():
    of = of2()
    tcp = pod(name="tcp", ports=())
    udp = pod(name="udp", labels={}, udp_ports=frozenset({11402}))
    tcp = replace(tcp, labels={}, host_ports=frozenset({11400}))
    action = creation(look(observed(of, service(of), pod(), tcp, udp)))
    assert some.ports_of(action) == "11403-11406"


def test_the_well_known_ports_are_none_of_a_range():
    window = PortRange(7409, 7420)
    of = of2(window=window)
    action = creation(look(observed(of, service(of), pod())))
    assert some.ports_of(action) == "7411-7414"


def hearing(**changes: Any) -> tuple[RosProxy, Any]:
    of = of2(HEARING, ports=5)
    return of, proxy(of, ports=PortRange(11400, 11404), **changes)


def lan_relay(of: RosProxy, address: str = "10.244.1.200", **changes: Any) -> HelperPod:
    place = site(of, node(), PortRange(11400, 11404))
    assert place.lan_relay is not None
    heard = proxy(of, ports=PortRange(11400, 11404))
    heard = replace(heard, pod=replace(heard.pod, ip=address))
    body = lan_relay_pod(place, place.lan_relay, heard, SETTINGS)
    parsed = objects.helper_pod({**body, "status": {"phase": "Running"}})
    assert parsed is not None
    own = replace(parsed.pod, uid="uid-lan-relay", node="one")
    return replace(parsed, **{"pod": own, "ready": True, **changes})


def test_an_lan_relay_is_made_once_its_proxy_has_an_address():
    of, proxy_pod = hearing()
    seen = observed(of, service(of), pod(), proxy_pod)

    (action,) = done(look(seen))

    assert isinstance(action, CreateHelper)
    body = action.body
    assert env_of(body)["ROSPROXY_LAN_RELAY_PROXY"] == "10.244.1.200:11400"
    assert env_of(body)["ROSPROXY_LAN_RELAY_BIND"] == "192.0.2.1:11404"
    assert body["spec"]["hostNetwork"] is True
    assert body["spec"]["containers"][0]["securityContext"]["capabilities"] == {"drop": ["ALL"]}
    assert not names.own_labels("robot").items() <= body["metadata"]["labels"].items()
    assert done(look(replace(seen, lan_relays=(lan_relay(of),)))) == []
    starting = replace(proxy_pod, pod=replace(proxy_pod.pod, ip=""), ready=False)
    assert done(look(observed(of, service(of), pod(), starting))) == []


def test_a_proxy_and_its_lan_relay_share_a_secret():
    """The operator computes this secret from its key: always the same, and different on
    each node.
    """
    of = of2(HEARING, ports=5)
    far = node("two", addresses={"InternalIP": "192.0.2.2"})

    def secrets(key: bytes) -> list[str]:
        seen = observed(of, service(of), node(), far, pod(), pod(name="b", on="two"), key=key)
        made = [action for action in done(look(seen)) if isinstance(action, CreateProxy)]
        return [env_of(action.body)["ROSPROXY_ROS2_LAN_RELAY_SECRET"] for action in made]

    of_proxies = secrets(KEY)
    assert len({*of_proxies, *secrets(bytes(32))}) == 4
    assert of_proxies == secrets(KEY)
    proxy_id = names.proxy_id(of.id, "one")
    assert names.relay_secret_of(KEY, proxy_id, "one") in of_proxies
    # The secret, visible to readers of pods, is no token for the admin endpoint.
    assert names.token_of(KEY, proxy_id, "one") not in of_proxies
    place = replace(site(of, node(), PortRange(11400, 11404)), relay_secret=SECRET)
    assert place.lan_relay is not None
    relay = lan_relay_pod(place, place.lan_relay, proxy(of), SETTINGS)
    assert env_of(relay)["ROSPROXY_LAN_RELAY_SECRET"] == SECRET


def test_a_proxy_without_a_lan_relay_has_no_secret():
    place = replace(site(of2(), node()), relay_secret=SECRET)
    assert "ROSPROXY_ROS2_LAN_RELAY_SECRET" not in env_of(manifests.proxy_pod(place, SETTINGS))


def test_both_are_made_anew_for_another_key():
    of, proxy_pod = hearing()
    seen = observed(of, service(of), pod(), proxy_pod, lan_relays=(lan_relay(of),))
    assert done(look(seen)) == []
    actions = done(look(replace(seen, key=KEY)))
    assert [type(action) for action in actions] == [DeleteProxy]


@pytest.mark.parametrize("why", ["address", "not asked for"])
def test_an_lan_relay_that_is_not_right_goes(why: str):
    of, proxy_pod = hearing()
    wrong_lan_relay = lan_relay(of, "10.244.1.9" if why == "address" else "10.244.1.200")
    if why == "not asked for":
        of = of2(ports=5)
        proxy_pod = proxy(of, ports=PortRange(11400, 11404))
    (action,) = done(
        look(observed(of, service(of), pod(), proxy_pod, lan_relays=(wrong_lan_relay,)))
    )
    assert isinstance(action, DeleteHelper)


def test_an_lan_relay_stays_while_its_proxy_is_made_anew():
    of, _ = hearing()
    (action,) = done(look(observed(of, service(of), pod(), lan_relays=(lan_relay(of),))))
    assert isinstance(action, CreateProxy)


def test_an_lan_relay_stays_until_its_proxy_has_left_its_ports():
    """The LAN relay passes the dispose messages of the proxy's participants to the LAN."""
    _, proxy_pod = hearing()
    moved = of2(HEARING, ports=5, window=PortRange(13000, 13099))
    (action,) = done(
        look(observed(moved, service(moved), pod(), proxy_pod, lan_relays=(lan_relay(moved),)))
    )
    assert isinstance(action, DeleteProxy)
    assert action.retire


def test_an_lan_relay_that_does_not_run_is_told():
    of, proxy_pod = hearing()
    deaf = pod_failure({"phase": "Failed", "reason": "Evicted", "message": "so it is"})
    stuck_lan_relay = lan_relay(of, stuck=deaf[0], message=deaf[1])
    plan = look(observed(of, service(of), pod(), proxy_pod, lan_relays=(stuck_lan_relay,)))
    assert "no discovery passes between the LAN and the proxy" in told(plan, "LanRelayStuck")[0]


def test_a_node_without_a_lan_address_is_told():
    of = of2(HEARING, ports=5)
    lost = node(addresses={"InternalIP": "fd00::1"}, advertise_host="192.0.2.1")
    plan = look(observed(of, service(of), lost, pod()))
    assert "spec.peers" in told(plan, "NoLanAddress")[0]


def test_an_address_of_ipv6_is_not_advertised():
    of = of2()
    lost = node(addresses={"InternalIP": "fd00::1"})
    plan = look(observed(of, service(of), lost, pod()))
    text = "the operator starts proxies for ROS 2 with IPv4 only. Give an IPv4 address"
    assert text in told(plan, "NoAdvertiseHost")[0]


def admitted(*env: Any) -> dict[str, Any]:
    containers = [{"name": "ros", **({"env": list(env)} if env else {})}]
    return {"metadata": {"labels": {names.INJECT: "true"}}, "spec": {"containers": containers}}


def test_what_the_webhook_sets():
    to = pod_variables(of2(Ros2Spec(5)), ADDRESS)
    assert to == PodVariables("", ADDRESS, 5)

    wiring = wire(admitted(), to)

    assert wiring.spec is not None
    peers = {"name": "ROS_STATIC_PEERS", "value": ADDRESS}
    domain = {"name": "ROS_DOMAIN_ID", "value": "5"}
    assert wiring.spec["containers"][0]["env"] == [domain, peers][::-1]
    assert wiring.annotations == {names.STATIC_PEERS: ADDRESS, names.DOMAIN: "5"}
    own = ({"name": "ROS_STATIC_PEERS", "value": "a"}, {"name": "ROS_DOMAIN_ID", "value": "4"})
    assert wire(admitted(*own), to).spec is None
    both = wire(admitted(), pod_variables(some.rosproxy(ros2=Ros2Spec()), ADDRESS))
    assert both.spec is not None
    set_ = [variable["name"] for variable in both.spec["containers"][0]["env"]]
    assert set_ == ["ROS_MASTER_URI", "ROS_STATIC_PEERS", "ROS_IP"]


def test_a_copy_of_a_wired_pod_is_wired_anew():
    former = {"ROS_STATIC_PEERS": "10.96.9.9", "ROS_DOMAIN_ID": "3"}
    old = admitted(*({"name": name, "value": value} for name, value in former.items()))
    old["metadata"]["annotations"] = {names.STATIC_PEERS: "10.96.9.9", names.DOMAIN: "3"}
    wiring = wire(old, PodVariables(static_peers=ADDRESS, domain=5))
    assert wiring.spec is not None
    assert [v["value"] for v in wiring.spec["containers"][0]["env"]] == [ADDRESS, "5"]
    assert wiring.annotations[names.DOMAIN] == "5"


def test_the_domain_of_a_template_is_not_the_webhooks():
    """After a change of spec.domain, the pod would be recreated in vain."""
    own = admitted({"name": "ROS_DOMAIN_ID", "value": "5"})
    wiring = wire(own, PodVariables(static_peers=ADDRESS, domain=5))
    assert wiring.annotations == {names.STATIC_PEERS: ADDRESS}


@pytest.mark.parametrize(
    ("bounds", "field"),
    [
        (Bounds(peers=("192.0.2.*",)), "spec.peers"),
        (Bounds(peers=("*.example",)), "spec.peers"),
        (Bounds(multicast=False), "spec.multicast"),
        (Bounds(peers=("rob*",), masters=("http://nobody:1",)), ""),
    ],
)
def test_what_the_administrator_allows(bounds: Bounds, field: str):
    of = of2(Ros2Spec(peers=("robot",), multicast=True), ports=5)
    violation = str(bounds_violation(of, {}, ClusterSettings(bounds=bounds)) or "")
    assert violation.startswith(field)
    assert bool(violation) == bool(field)


def test_a_network_policy_lets_udp_in():
    opened, pods, _ = policy(of2(window=PortRange(11400, 11499)), SETTINGS)["spec"]["ingress"]
    assert opened["ports"] == [{"protocol": "UDP", "port": 11400, "endPort": 11499}]
    assert pods["ports"] == [
        {"protocol": "UDP", "port": 7410},
        {"protocol": "UDP", "port": 20000, "endPort": 32767},
    ]
    assert "from" in pods


def test_a_participant_of_a_pod_that_is_gone_is_told_to_the_proxy():
    of = of2()
    proxy_pod = proxy(of)
    seen = observed(of, service(of), pod(ip="10.244.1.5"), proxy_pod)
    state = look(seen).state
    report = ProxyReport(True, True, participants={"10.244.1.5": ("01",)})
    gone = observed(of, service(of), proxy_pod, reports={proxy_pod.pod.uid: report})
    assert look(gone, state, 101.0).briefings[proxy_pod.pod.uid].gone == ("10.244.1.5",)


def test_what_users_are_told():
    of = of2(Ros2Spec(7))
    proxy_pod = proxy(of)
    report = ProxyReport(True, True, participants={"10.244.1.5": ("01", "02")})
    seen = observed(of, service(of), pod(), proxy_pod, reports={proxy_pod.pod.uid: report})

    rosproxy_status = status(look(seen), ROBOT)

    assert (
        rosproxy_status["domain"],
        rosproxy_status["participants"],
        rosproxy_status["staticPeers"],
    ) == (7, 2, ADDRESS)
    assert "master" not in rosproxy_status
    assert rosproxy_status["perNode"][0]["participants"] == 2
    kinds = [condition["type"] for condition in rosproxy_status["conditions"]]
    assert kinds == ["Ready", "PortsAllocated", "PortsReachable", "Degraded"]
    assert "2 participants of domain 7" in rosproxy_status["conditions"][0]["message"]
    assert participants(seen) == {7: 2}
    again = read({**rosproxy_obj(), "status": rosproxy_status})
    assert again.cluster_ip == ADDRESS


def test_a_proxy_made_anew_is_told_the_ports_that_participants_had():
    """Only until the proxy has participants, and not after a restart in the same pod."""
    of = of2()
    proxy_pod = proxy(of)
    leases = {"01": (11401, 11402)}
    report = ProxyReport(True, True, participants={"10.244.1.5": ("01",)}, leases=leases)
    seen = observed(of, service(of), pod(), proxy_pod, reports={proxy_pod.pod.uid: report})
    state = look(seen).state
    assert look(seen, state).briefings[proxy_pod.pod.uid].former_ports == {}

    retired = replace(
        seen, reports={proxy_pod.pod.uid: replace(report, participants={}, leases={})}
    )
    state = look(retired, state).state  # the proxy has sent dispose messages

    new = replace(proxy_pod, pod=replace(proxy_pod.pod, uid="uid-new"))
    starting = observed(of, service(of), pod(), new, reports={"uid-new": ProxyReport(True, True)})
    plan = look(starting, state)
    assert plan.briefings["uid-new"].former_ports == leases
    complete = replace(starting, reports={"uid-new": report})
    assert look(complete, plan.state).briefings["uid-new"].former_ports == {}
