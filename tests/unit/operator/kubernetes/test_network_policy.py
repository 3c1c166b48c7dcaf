"""The NetworkPolicy of a RosProxy's proxies."""

from typing import Any

import pytest
from msgspec.structs import replace

from rosproxy.shared.ports import STAND_IN_PORTS, PortRange
from rosproxy_operator.kubernetes.planner import manifests
from rosproxy_operator.kubernetes.planner.actions import CreatePolicy, DeletePolicy, SetPolicy
from rosproxy_operator.kubernetes.planner.plan import ClusterPlan
from rosproxy_operator.kubernetes.planner.state import ClusterState
from rosproxy_operator.kubernetes.planner.steps.network_policy import policy, wanted_policies
from rosproxy_operator.kubernetes.resources import names, objects
from rosproxy_operator.kubernetes.resources.cluster import ClusterSnapshot, ProxyPolicy
from rosproxy_operator.kubernetes.resources.model import (
    Json,
    MasterSpec,
    Name,
    Ros2Spec,
    RosProxy,
    Selector,
)
from tests.unit.operator.kubernetes.objects import (
    ROBOT,
    SETTINGS,
    complete,
    done,
    node,
    observed,
    pod,
    proxy,
    rosproxy,
    service,
    site,
    told,
)
from tests.unit.operator.kubernetes.objects import look as look_at

PEERS: tuple[Json, ...] = ({"podSelector": {"matchLabels": {"a": "b"}}},)
ON = replace(SETTINGS, network_policy=True, admin_from=PEERS)
INSIDE = MasterSpec(service=Name("ros", "roscore"), publish=11321)


def look(seen: ClusterSnapshot, memory: ClusterState | None = None) -> ClusterPlan:
    return look_at(seen, memory, settings=ON)


def existing_policies(spec: Json | None = None, **changes: Any) -> dict[Name, ProxyPolicy]:
    own = policy(rosproxy(), ON)["spec"] if spec is None else spec
    name = names.policy_id(ROBOT)
    existing = ProxyPolicy(name, ROBOT, "uid-robot", "uid-policy", own)
    return {name: replace(existing, **changes)}


def rules(**changes: Any) -> list[Json]:
    return list(policy(rosproxy(**changes), ON)["spec"]["ingress"])


def test_it_is_about_the_proxies_of_its_rosproxy() -> None:
    made = policy(rosproxy(), ON)
    assert made["metadata"]["name"] == "rosproxy-robot"
    (owner,) = made["metadata"]["ownerReferences"]
    assert (owner["kind"], owner["uid"], owner["controller"]) == ("RosProxy", "uid-robot", True)
    proxy = manifests.proxy_pod(site(rosproxy(), node()), ON)
    selected = made["spec"]["podSelector"]["matchLabels"]
    assert selected.items() <= proxy["metadata"]["labels"].items()
    assert made["spec"]["policyTypes"] == ["Ingress"]


def test_ros_nodes_ports_are_for_everybody() -> None:
    first, *_ = rules(master=INSIDE)
    assert first == {
        "ports": [
            {"protocol": "TCP", "port": 11400, "endPort": 11499},
            {"protocol": "TCP", "port": 11321},
        ]
    }


@pytest.mark.parametrize(
    ("window", "ports"),
    [
        (PortRange(11306, 11315), [(11306, 11310), (11313, 11315)]),
        (PortRange(11311, 11313), [(11313, None)]),
        (PortRange(11300, 11312), [(11300, 11310)]),
        (PortRange(11312, 11320), [(11313, 11320)]),
    ],
)
def test_the_proxys_own_ports_are_not_among_them(window: PortRange, ports: list[Any]) -> None:
    first, *_ = rules(window=window, ports=1)
    assert [(port["port"], port.get("endPort")) for port in first["ports"]] == ports


def test_the_masters_port_is_for_selected_pods() -> None:
    _, second, _ = rules()
    assert second["ports"] == [{"protocol": "TCP", "port": 11311}]
    (peer,) = second["from"]
    expression = {"key": names.INJECT, "operator": "In", "values": ["robot", "true"]}
    assert peer == {"podSelector": {"matchExpressions": [expression]}}


def test_a_pod_selector_is_taken_over() -> None:
    tier = ("tier", "In", frozenset({"b", "a"}))
    x = ("x", "Exists", frozenset[str]())
    _, second, _ = rules(pod_selector=Selector({"app": "x"}, (tier, x)))
    assert second["from"] == [
        {
            "podSelector": {
                "matchLabels": {"app": "x"},
                "matchExpressions": [
                    {"key": "tier", "operator": "In", "values": ["a", "b"]},
                    {"key": "x", "operator": "Exists"},
                    {"key": names.INJECT, "operator": "NotIn", "values": ["", "false"]},
                ],
            }
        }
    ]


def test_the_admin_port_is_for_the_operator() -> None:
    *_, last = rules()
    assert last == {"ports": [{"protocol": "TCP", "port": 11312}], "from": [*PEERS]}
    everybody = policy(rosproxy(), replace(ON, admin_from=None))["spec"]["ingress"][-1]
    assert "from" not in everybody


def test_it_is_read_back_as_it_was_made() -> None:
    made = policy(rosproxy(), ON)
    parsed = objects.policy({**made, "metadata": {**made["metadata"], "uid": "uid-policy"}})
    assert parsed == existing_policies()[names.policy_id(ROBOT)]
    other = {**made["metadata"], "name": "other"}
    assert objects.policy({**made, "metadata": other}) is None


def test_it_is_made_before_the_proxies() -> None:
    plan = look(observed(rosproxy(), service()))
    (created,) = done(plan)
    assert isinstance(created, CreatePolicy)
    assert done(look(complete(policies=existing_policies()))) == []


@pytest.mark.parametrize("spec", [{}, {"podSelector": {}, "policyTypes": ["Ingress"]}])
def test_it_is_mended(spec: Json) -> None:
    (mended,) = done(look(complete(policies=existing_policies(spec))))
    assert isinstance(mended, SetPolicy)
    assert (mended.uid, mended.spec) == ("uid-policy", policy(rosproxy(), ON)["spec"])


def test_mending_that_does_not_help_is_not_repeated_at_once() -> None:
    seen = complete(policies=existing_policies({}))
    first = look(seen)
    assert done(look(seen, first.state)) == []


@pytest.mark.parametrize(
    ("policies", "rosproxies"),
    [
        (existing_policies(owner="uid-old"), (rosproxy(),)),
        (existing_policies(), ()),
        (existing_policies(owner="uid-old"), ()),
    ],
)
def test_that_of_a_rosproxy_that_is_gone_is_deleted(
    policies: dict[Name, ProxyPolicy], rosproxies: Any
) -> None:
    plan = look(replace(observed(), policies=policies, rosproxies=rosproxies))
    (deleted,) = [action for action in done(plan) if isinstance(action, DeletePolicy)]
    assert deleted.uid == "uid-policy"


def test_one_that_goes_already_is_left_alone() -> None:
    assert done(look(observed(policies=existing_policies(deleting=True)))) == []


def test_switched_off_it_is_deleted() -> None:
    (deleted,) = done(look_at(complete(policies=existing_policies())))
    assert isinstance(deleted, DeletePolicy)
    assert done(look_at(complete())) == []


def test_a_role_that_lacks_the_right_is_told() -> None:
    seen = complete(policies_error="the operator's role lacks a rule")
    plan = look(seen)
    assert done(plan) == []
    assert "the operator's role lacks a rule" in told(plan, "NoNetworkPolicy")[0]
    assert told(look_at(seen), "NoNetworkPolicy") == []


# direction Both, and podEgress


def test_the_ports_that_stand_in_for_outside_are_for_selected_pods() -> None:
    """For UDP, too: there the proxy takes what UDPROS sends out."""
    everybody, pods, _ = rules(direction="both")
    first = STAND_IN_PORTS.first
    last = STAND_IN_PORTS.last
    stand_ins = [
        {"protocol": protocol, "port": first, "endPort": last} for protocol in ("TCP", "UDP")
    ]
    assert pods["ports"] == [{"protocol": "TCP", "port": 11311}, *stand_ins]
    assert not [port for port in stand_ins if port in everybody["ports"]]


NEAR_STAND_INS = PortRange(19_990, 20_009)


@pytest.mark.parametrize(
    ("changes", "ranges", "ports"),
    [
        ({}, [], [("TCP", 19_990, 20_009)]),
        ({"direction": "both"}, [], [("TCP", 19_990, 19_999)]),
        ({"ros1": False, "ros2": Ros2Spec()}, [], [("UDP", 19_990, 19_999)]),
        # ROS 1 has no stand-ins here
        ({"ros2": Ros2Spec()}, [], [("TCP", 19_990, 20_009), ("UDP", 19_990, 19_999)]),
        ({"direction": "both"}, [PortRange(20_002, 20_005)],
         [("TCP", 19_990, 19_999), ("TCP", 20_002, 20_005)]),
        ({"direction": "both"}, [PortRange(19_998, 20_001)], [("TCP", 19_990, 20_001)]),
    ],
)  # fmt: skip
def test_a_window_opens_ports_of_stand_ins_only_for_present_ranges(
    changes: dict[str, Any], ranges: list[PortRange], ports: list[tuple[str, int, int]]
) -> None:
    made = policy(rosproxy(window=NEAR_STAND_INS, **changes), ON, ranges)
    first, *_ = made["spec"]["ingress"]
    assert [(p["protocol"], p["port"], p["endPort"]) for p in first["ports"]] == ports


def test_a_window_of_stand_ins_alone_opens_nothing_until_a_proxy_has_a_range() -> None:
    """A rule without ports would open all ports of the proxies."""
    of = rosproxy(window=PortRange(20_000, 20_019), direction="both")
    assert ["from" in rule for rule in policy(of, ON)["spec"]["ingress"]] == [True, True]
    created, *_ = done(look(observed(of, service(of), pod())))
    assert isinstance(created, CreatePolicy)
    public_ports = created.body["spec"]["ingress"][0]["ports"]
    assert public_ports == [{"protocol": "TCP", "port": 20_000, "endPort": 20_003}]


def test_a_running_proxy_keeps_an_open_range_of_stand_ins() -> None:
    of = rosproxy(window=NEAR_STAND_INS, direction="both")
    ports = PortRange(20_002, 20_005)
    seen = observed(of, service(of), pod(), proxy(of, ports=ports, settings=ON))
    created, *others = done(look(seen))
    assert isinstance(created, CreatePolicy)
    assert others == []
    assert created.body["spec"] == policy(of, ON, [ports])["spec"]
    unwanted = done(look(replace(seen, pods=())))
    assert unwanted == [created]


def test_the_window_is_open_for_datagrams_where_they_are_asked_for() -> None:
    (tcp,) = rules(direction="both")[0]["ports"]
    assert rules(direction="both", udp=True)[0]["ports"] == [tcp, {**tcp, "protocol": "UDP"}]


def rosproxy_restricting_egress(**changes: Any) -> RosProxy:
    """A RosProxy whose pods may send to their proxies only."""
    return rosproxy(direction="both", pod_egress="proxy", **changes)


def test_pods_are_kept_to_their_proxies_on_demand() -> None:
    both = wanted_policies(rosproxy_restricting_egress(), ON)
    assert both[names.policy_id(ROBOT)] == policy(rosproxy_restricting_egress(), ON)
    pods = both[names.pods_policy_id(ROBOT)]["spec"]
    assert pods["policyTypes"] == ["Egress"]
    assert pods["podSelector"] == rules()[1]["from"][0]["podSelector"]
    to_proxies, to_pods, to_dns = pods["egress"]
    proxy = manifests.proxy_pod(site(rosproxy(), node()), ON)
    selected = to_proxies["to"][0]["podSelector"]["matchLabels"]
    assert selected.items() <= proxy["metadata"]["labels"].items()
    assert to_pods == {"to": [{"podSelector": pods["podSelector"]}]}
    assert {(port["protocol"], port["port"]) for port in to_dns["ports"]} == {
        ("UDP", 53),
        ("TCP", 53),
    }
    assert list(wanted_policies(rosproxy(direction="both"), ON)) == [names.policy_id(ROBOT)]
    assert wanted_policies(rosproxy_restricting_egress(), SETTINGS) == {}


def seen_policies(of: RosProxy) -> dict[Name, ProxyPolicy]:
    """The policies of a RosProxy after their creation."""
    parsed = (
        objects.policy({**body, "metadata": {**body["metadata"], "uid": f"uid-{name}"}})
        for name, body in wanted_policies(of, ON).items()
    )
    return {p.id: p for p in parsed if p}


def test_the_pods_policy_is_made_and_goes_when_it_is_not_asked_for_any_more() -> None:
    seen = replace(
        complete(policies=existing_policies()), rosproxies=(rosproxy_restricting_egress(),)
    )
    made = [action for action in done(look(seen)) if isinstance(action, CreatePolicy)]
    assert [action.body["metadata"]["name"] for action in made] == ["rosproxy-robot.pods"]
    both_made = replace(
        complete(policies=seen_policies(rosproxy_restricting_egress())), rosproxies=(rosproxy(),)
    )
    (deleted,) = [action for action in done(look(both_made)) if isinstance(action, DeletePolicy)]
    assert deleted.id == names.pods_policy_id(ROBOT)
