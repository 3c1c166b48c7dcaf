"""Containers of rmw_zenoh: a common proxy, and a port and redirect for each network namespace."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from ipaddress import IPv4Network
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.policy.layers import PolicyLayer, PolicyMode
from rosproxy.shared.policy.rules import parse_rules
from rosproxy.shared.ports import PortRange
from rosproxy_operator.docker.engine_json import check_inspection, read_container, read_making
from rosproxy_operator.docker.planner.actions import (
    Action,
    Create,
    CreateRedirect,
    CreateSandbox,
    Remove,
    Run,
)
from rosproxy_operator.docker.planner.labels.readers import RMW
from rosproxy_operator.docker.planner.model import (
    Attachment,
    Container,
    HostState,
    Member,
    Network,
    Proxy,
    RedirectContainer,
    Sandbox,
)
from rosproxy_operator.docker.planner.own_containers import forgery_reason
from rosproxy_operator.docker.planner.plan import DockerPlan
from rosproxy_operator.docker.planner.proxy_update import network_facts
from rosproxy_operator.docker.planner.redirect import redirect_config
from rosproxy_operator.docker.planner.specs import (
    container_config,
    own_labels,
    proxy_fingerprint,
    proxy_name,
    read_own,
    sandbox_config,
    sandbox_fingerprint,
    sandbox_name,
)
from rosproxy_operator.docker.planner.state import DockerMemory
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.proxy_spec.place import ZENOH
from rosproxy_operator.proxy_spec.spec import ProxySpec
from tests.run_options import settings_of
from tests.unit.operator.docker.builders import (
    IMAGE,
    SECRET,
    SETTINGS,
    UPLINK,
    attachment,
    container,
    inspection,
    observed,
    planned,
    read_members,
)
from tests.unit.operator.docker.hosts import Hosts

ON = {"rosproxy.enable": "true"}
VARIABLES = {"ROS_DISTRO": "kilted", "RMW_IMPLEMENTATION": "rmw_zenoh_cpp"}
NEAR = "172.18.0.9"
PORTS = PortRange(7448, 7479)
ROBOT = 'connect/endpoints=["tcp/192.0.2.7:7447"]'
LOCAL = HostPort("127.0.0.1", 7447)


def node(
    name: str = "talker",
    labels: Mapping[str, str] | None = None,
    override: str = "",
    mode: str = "",
    router: bool = False,
    address: str = "172.18.0.3",
) -> Container:
    variables = {**VARIABLES, **({"ZENOH_CONFIG_OVERRIDE": override} if override else {})}
    made = container(name, {**ON, **(labels or {})}, env="", mode=mode)
    attachments = () if mode else (Attachment("app", address, frozenset({name})),)
    return replace(made, attachments=attachments, variables=variables, is_zenoh_router=router,
                   started_at="2026-01-01T09:00:00Z")  # fmt: skip


def read(
    *containers: Container, settings: PlanSettings = SETTINGS, **more: Any
) -> tuple[tuple[Member, ...], list[str]]:
    members, problems = read_members(observed(*containers, **more), settings)
    return members, [problem.message for problem in problems]


def look(
    state: HostState, settings: PlanSettings = SETTINGS, memory: DockerMemory | None = None
) -> DockerPlan:
    return planned(state, settings, memory or DockerMemory(), 100.0)


def the_proxy(peers: tuple[str, ...] = (), ports: PortRange = PORTS) -> dict[str, Any]:
    """A proxy that needs no change, with an address on the network of the containers."""
    box = CreateSandbox(sandbox_name(ZENOH), ZENOH, ports)
    box_print = sandbox_fingerprint(box, SETTINGS)
    made = Create(proxy_name(ZENOH), ZENOH, ports, box.name, peers=peers)
    made_print = proxy_fingerprint(made, SETTINGS, IMAGE, SECRET)
    at = [attachment(SETTINGS.uplink, box.name), Attachment("app", NEAR, frozenset({made.name}))]
    holder = replace(container(box.name, own_labels(box), at, env=""), started_at="2026-01-01T10Z")
    runs = container(made.name, own_labels(made), (), env="", mode=f"container:id-{box.name}")
    runs = replace(runs, started_at="2026-01-01T10:00:01Z")
    return {
        "sandboxes": [Sandbox(ZENOH, holder, ports, box_print)],
        "proxies": [Proxy(ZENOH, runs, ports, made_print)],
    }


def redirects(state: HostState, settings: PlanSettings = SETTINGS) -> list[Action]:
    """The planned actions for redirects."""
    groups = look(state, settings).groups
    return [action for group in groups if group.subject for action in group.actions]


def made_for(state: HostState) -> dict[str, CreateRedirect]:
    """The planned redirects by container."""
    made = [action for action in redirects(state) if isinstance(action, CreateRedirect)]
    return {action.target.removeprefix("id-"): action for action in made}


def record(made: CreateRedirect) -> RedirectContainer:
    own = Container(f"id-{made.name}", made.name, "exited", own_labels(made),
                    f"container:{made.target}")  # fmt: skip
    return RedirectContainer(made.place, own, made.range, made.fingerprint)


# which containers


@pytest.mark.parametrize(
    ("labels", "variables"),
    [
        ({}, VARIABLES),
        ({}, {"RMW_IMPLEMENTATION": "rmw_zenoh_cpp"}),
        ({RMW: "zenoh"}, {}),
        ({RMW: "Zenoh"}, {"ROS_DISTRO": "kilted", "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp"}),
        ({"rosproxy.ros": "2"}, {"RMW_IMPLEMENTATION": "rmw_zenoh_cpp"}),
    ],
)
def test_a_label_or_a_variable_says_it(
    labels: Mapping[str, str], variables: Mapping[str, str]
) -> None:
    (member,), told = read(replace(node(labels=labels), variables=variables))
    assert (member.place, member.redirected, told) == (ZENOH, (LOCAL,), [])


def test_a_container_may_have_ros_1_as_well() -> None:
    both = {"rosproxy.ros": "1,2", "rosproxy.master-uri": "http://robot:11311"}
    members, told = read(replace(node(labels=both), master_uri="http://robot:11311"))
    assert [member.place.graph.ros for member in members] == ["1", "zenoh"]
    assert told == []


def test_where_variables_are_enough_rmw_zenoh_is_served() -> None:
    quiet = replace(node(), labels={})
    (member,), _ = read(quiet, settings=replace(SETTINGS, expose_by_default=True))
    assert member.place == ZENOH


def test_domains_and_hosts_share_one_proxy() -> None:
    other = replace(node("arm", {"rosproxy.peers": "robot"}), variables={
        **VARIABLES, "ROS_DOMAIN_ID": "5"})  # fmt: skip
    plan = look(observed(node(), other), replace(SETTINGS, advertise_host=None))
    assert [wanted.place for wanted in plan.desired] == [ZENOH]
    assert plan.problems == ()


@pytest.mark.parametrize(
    ("labels", "text"),
    [
        ({RMW: "dds"}, "label rosproxy.rmw='dds' is not zenoh. Write rosproxy.rmw=zenoh"),
        ({"rosproxy.policy": "deny publish /x"}, ""),
        ({"rosproxy.policy": "deny x /x"}, "label rosproxy.policy: rule 'deny x /x'"),
        (
            {"rosproxy.policy": "allow publish /a/b; deny publish /a/*"},
            "label rosproxy.policy: layer 'rosproxy.policy': rmw_zenoh can't except /a/b",
        ),
        (
            {"rosproxy.policy": "deny publish /x", "rosproxy.redirect": "false"},
            "label rosproxy.policy has no effect without the redirect",
        ),
        ({"rosproxy.peers": "a b"}, ""),
        ({"rosproxy.peers": "a:b:c"}, "label rosproxy.peers: 'a:b:c' is not of the form HOST or"),
        ({"rosproxy.peers": ",".join(f"h{n}" for n in range(33))}, "more than 32 hosts"),
        ({"rosproxy.ports": "40"}, "label rosproxy.ports is ignored: the label has no effect on"),
        ({"rosproxy.domain": "1"}, "label rosproxy.domain is ignored: the label has no effect"),
        ({"rosproxy.udp": "true"}, "label rosproxy.udp is ignored: the label has no effect"),
        ({"rosproxy.redirect": "false"}, 'mode="client";connect/endpoints=["tcp/rosproxy-zenoh-'),
    ],
)
def test_labels_that_can_not_be_had_are_told(labels: Mapping[str, str], text: str) -> None:
    _, told = read(node(labels=labels))
    assert bool(text) == bool(told)
    assert text in " ".join(told)


def test_the_label_is_ignored_on_a_container_of_ros_1() -> None:
    labels = {RMW: "zenoh", "rosproxy.ros": "1", "rosproxy.master-uri": "http://robot:11311"}
    (member,), told = read(replace(node(labels=labels), master_uri="http://robot:11311"))
    assert member.place.graph.ros == "1"
    assert told == [
        "label rosproxy.rmw is ignored: the label is for ROS 2, the container is not. Remove the "
        "label, or set rosproxy.ros=2 if the nodes use ROS 2"
    ]


def test_a_container_of_ros_1_and_rmw_zenoh_has_no_domain() -> None:
    labels = {RMW: "zenoh", "rosproxy.ros": "1,2", "rosproxy.domain": "7"}
    ros1 = replace(node(labels=labels), master_uri="http://robot:11311")
    members, told = read(ros1)
    assert sorted(member.place.graph.ros for member in members) == ["1", "zenoh"]
    assert told == [
        "label rosproxy.domain is ignored: the label has no effect on rmw_zenoh. Remove the label"
    ]


# rules

RULES = "deny publish /x"
ADMINISTRATOR = (PolicyLayer("administrator", parse_rules(RULES)),)


def test_rules_of_the_administrator_hold() -> None:
    settings = replace(SETTINGS, policy=ADMINISTRATOR)
    (member,), told = read(node(), settings=settings)
    assert (member.policy, told) == ((), [])
    (made,) = [a for a in look(observed(node()), settings).actions if isinstance(a, Create)]
    body = container_config(made, settings, SECRET, "")
    variables = dict(variable.split("=", 1) for variable in body["Env"])
    told_settings = settings_of(variables)
    assert told_settings.policy_layers == ADMINISTRATOR
    assert told_settings.await_policy > 0


def test_rules_of_the_administrator_that_a_router_can_not_have_keep_it_out() -> None:
    layer = PolicyLayer("administrator", parse_rules("deny publish /x?"))
    members, (text,) = read(node(), settings=replace(SETTINGS, policy=(layer,)))
    assert not members
    assert text.startswith("the operator's --policy: layer 'administrator': ")


@pytest.mark.parametrize(
    ("override", "of_label", "of_administrator"),
    [
        ("", True, True),
        ('connect/endpoints=["tcp/localhost:7447"]', True, True),
        ('connect/endpoints=["tcp/rosproxy:7448"]', False, True),
        (ROBOT, False, False),
        ('connect/endpoints=["tls/robot:7447"]', False, False),
        ('connect/endpoints=["tcp/other:7447"]', False, False),
    ],
)
def test_with_rules_no_node_connects_past_them(
    override: str, of_label: bool, of_administrator: bool
) -> None:
    labelled = node(labels={"rosproxy.policy": RULES}, override=override)
    settings = replace(SETTINGS, policy=ADMINISTRATOR)
    for made, used, is_served in (
        (labelled, SETTINGS, of_label),
        (node(override=override), settings, of_administrator),
    ):
        members, told = read(made, settings=used)
        assert bool(members) == is_served
        assert is_served or "connects the nodes to" in told[0]


def test_rules_that_only_report_keep_no_container_out() -> None:
    """A container that worked lost its proxy when the administrator tried rules."""
    (rules,) = ADMINISTRATOR
    audit = replace(SETTINGS, policy=(PolicyLayer(rules.name, rules.rules, PolicyMode.AUDIT),))
    members, _ = read(node(override=ROBOT), settings=audit)
    assert members
    members, (text, *_) = read(node(override=ROBOT), settings=replace(audit, policy=ADMINISTRATOR))
    assert not members
    assert text.startswith("has to obey the operator's --policy, and variable")


def test_with_rules_no_router_runs_in_the_container() -> None:
    members, (text,) = read(node(labels={"rosproxy.policy": RULES}, router=True))
    assert not members
    assert "a router runs in the container" in text


@pytest.mark.parametrize(
    "ruled",
    [
        [node("a", {"rosproxy.policy": RULES})],
        [
            node("a"),
            node("shares", mode="container:id-a"),
            node("z", {"rosproxy.policy": RULES}, mode="container:shares"),
        ],
    ],
    ids=["own network", "network of another container"],
)
def test_a_layer_holds_at_the_port_of_its_container_and_at_free_ports(
    ruled: list[Container],
) -> None:
    """Until the operator has told the proxy of a redirect, the port counts as free."""
    plain = node("b", address="172.18.0.4")
    gone = replace(node("c", address="172.18.0.5"), state="exited")
    before = observed(*ruled, plain, **the_proxy())

    def ports_of(state: HostState) -> set[int]:
        members, _ = read_members(state, SETTINGS)
        facts = network_facts(state, state.proxies[0], members)
        (layer,) = facts.policy
        assert layer.addresses == frozenset({"172.18.0.3"})
        return set(layer.ports or ())

    assert ports_of(before) == set(PORTS.ports())
    records = [record(made) for made in made_for(before).values()]
    port_by_target = {r.container.network_container: r.range.first for r in records}
    after = observed(*ruled, plain, **the_proxy(), redirects=records)
    assert ports_of(after) == set(PORTS.ports()) - {port_by_target["id-b"]}
    ended = replace(plain, state="exited")
    assert ports_of(observed(*ruled, ended, gone, **the_proxy(), redirects=records)) == set(
        PORTS.ports()
    )


# routers outside


def test_the_label_names_routers() -> None:
    (member,), _ = read(node(labels={"rosproxy.peers": "Robot, 192.0.2.8:7500"}))
    assert member.peers == {"robot:7447", "192.0.2.8:7500"}
    assert member.redirected == (LOCAL,)


@pytest.mark.parametrize(
    "override", [ROBOT, f'mode="client";{ROBOT}', f"scouting/delay=1; {ROBOT.replace('=', ' = ')}"]
)
def test_a_router_given_by_address_just_works(override: str) -> None:
    (member,), told = read(node(override=override))
    assert member.peers == {"192.0.2.7:7447"}
    assert member.redirected == (LOCAL, HostPort("192.0.2.7", 7447))
    assert told == []


@pytest.mark.parametrize(
    ("override", "peers", "text"),
    [
        ('connect/endpoints=["tcp/robot:7447"]', {"robot:7447"}, "add the label rosproxy.peers=ro"),
        ('connect/endpoints=["tcp/[2001:db8::7]:7447"]', {"[2001:db8::7]:7447"}, "bypass"),
        ('connect/endpoints=["tls/robot:7447"]', set(), "connects by tcp only"),
        (f'connect/endpoints=["tcp/{297 * "a"}:7447"]', set(), ""),  # too long: port 74, if cut
        ('connect/endpoints=["tcp/localhost:7447"]', set(), ""),
        ('connect/endpoints=["tcp/rosproxy:7448"]', set(), ""),
        ('connect/endpoints={peer:["tcp/router:7447"]}', {"router:7447"}, ""),
        ("connect/endpoints=['tcp/172.18.0.8:7447']", {"router:7447"}, ""),
        ('connect/endpoints=[]; mode="peer"', set(), ""),
        ("nonsense", set(), ""),
    ],
)
def test_what_the_variable_names(override: str, peers: set[str], text: str) -> None:
    """The proxy dials a container on the same network by name, without a redirect for that."""
    router = replace(node("router", address="172.18.0.8"), labels={})
    (member,), told = read(node(override=override), router)
    assert member.peers == peers
    assert member.redirected == (LOCAL,)
    assert text in " ".join(told)
    assert bool(text) == bool(told)


ROUTER = replace(node("router", address="172.18.0.8", router=True), labels={})
AT_ROUTER = 'connect/endpoints=["tcp/router:7447"]'
CLIENT = f'mode="client";{AT_ROUTER}'


def listener(override: str, **more: Any) -> Container:
    return node("listener", override=override, address="172.18.0.4", **more)


def test_peers_of_the_same_router_in_a_container_are_told() -> None:
    other = listener(AT_ROUTER.replace("router", "172.18.0.8"))
    _, problems = read_members(observed(node(override=AT_ROUTER), other, ROUTER), SETTINGS)
    assert [problem.subject for problem in problems] == ["container listener", "container talker"]
    assert not any(problem.fatal for problem in problems)
    assert problems[1].message == (
        "the nodes are peers of the same router ('router:7447') as the nodes of container "
        "listener. Messages between these containers do not pass: rmw_zenohd passes none between "
        'its peers, and neither does zenohd from 1.9 on. Add mode="client" to the variable '
        "ZENOH_CONFIG_OVERRIDE of these containers. Or remove connect/endpoints from the "
        "variables, and add the label rosproxy.peers=router:7447: a router of the proxy then "
        "serves each of these containers"
    )


def test_without_the_redirect_client_mode_is_the_only_fix() -> None:
    settings = replace(SETTINGS, redirect=False)
    _, told = read(node(override=AT_ROUTER), listener(AT_ROUTER), ROUTER, settings=settings)
    (text,) = (text for text in told if "as the nodes of container listener" in text)
    assert "mode" in text
    assert "remove connect/endpoints" not in text


def test_a_node_beside_the_router_is_a_peer_as_well() -> None:
    driver = node("driver", mode="container:id-router")
    _, told = read(driver, node(override=AT_ROUTER), ROUTER)
    assert ["as the nodes of container talker" in told[0], len(told)] == [True, 2]


@pytest.mark.parametrize(
    "other",
    [
        listener(""),
        listener(CLIENT),
        listener('connect/endpoints=["tcp/router:7448"]'),
        listener(f'listen/endpoints=["tcp/[::]:0"];{AT_ROUTER}'),
        node("listener", override=AT_ROUTER, mode="container:id-talker"),
        replace(listener(AT_ROUTER), labels={}),
        replace(listener(AT_ROUTER), state="exited"),
        replace(
            listener(AT_ROUTER),
            variables={
                **VARIABLES,
                "ZENOH_CONFIG_OVERRIDE": AT_ROUTER,
                "ZENOH_SESSION_CONFIG_URI": "/session.json5",
            },
        ),
    ],
    ids=[
        "the proxy's router",
        "a client",
        "another router",
        "reached directly",
        "in the same network namespace",
        "not labelled",
        "exited",
        "a session file",
    ],
)
def test_two_containers_that_are_not_peers_of_one_router(other: Container) -> None:
    _, told = read(node(override=AT_ROUTER), other, ROUTER)
    assert not [text for text in told if "peers of the same router" in text]


class CountedNames(frozenset[str]):
    """The names of a container on a network; counts the readings."""

    readings = 0

    def __iter__(self) -> Iterator[str]:
        CountedNames.readings += 1
        return super().__iter__()


def test_neighbours_are_searched_once_for_all_endpoints() -> None:
    """With 32 endpoints of each of 256 containers, a look took 1.7 s."""
    endpoints = ", ".join(f'"tcp/10.0.0.{number}:7447"' for number in range(32))
    names = CountedNames(["router"])
    router = replace(node("router"), attachments=(Attachment("app", "172.18.0.8", names),))
    CountedNames.readings = 0
    (member,), _ = read(
        node(override=f"connect/endpoints=[{endpoints}]"), replace(router, labels={})
    )
    assert len(member.peers) == 32
    assert CountedNames.readings < 8


def test_without_a_route_an_address_can_not_be_redirected() -> None:
    cell = Network("n1", "app", internal=True, subnets=(IPv4Network("172.18.0.0/16"),))
    (member,), (text,) = read(node(override=ROBOT), networks=[UPLINK, cell])
    assert member.redirected == (LOCAL,)
    assert "an IPv4 address with a route" in text


@pytest.mark.parametrize(
    ("named", "by"),
    [
        ({"labels": {"rosproxy.peers": "10.0.0.9"}}, "label rosproxy.peers"),
        (
            {"override": 'connect/endpoints=["tcp/10.0.0.9:7447"]'},
            "variable ZENOH_CONFIG_OVERRIDE",
        ),
    ],
)
def test_a_router_that_is_not_allowed_is_not_dialed(named: Any, by: str) -> None:
    """For a router in the variable, the text said "does not allow in labels"."""
    settings = replace(SETTINGS, allow_peer=("robot*:*",))
    (member,), (text,) = read(node(**named), settings=settings)
    assert (member.peers, member.redirected) == (frozenset(), (LOCAL,))
    assert text.startswith(f"{by} names '10.0.0.9:7447', which the operator does not allow.")
    assert "start the operator with --allow-peer 10.0.0.9:7447" in text


def test_a_container_that_is_a_router_is_dialed_and_left_as_it_is() -> None:
    """The same holds for containers in the network namespace of the router."""
    override = f'listen/endpoints=["tcp/[::]:7500"];{ROBOT}'
    router = node("router", override=override, router=True)
    sharing = node("driver", mode="container:id-router")
    members, told = read(router, sharing, node(address="172.18.0.4"))
    assert told == []
    assert {m.container.name: (m.peers, m.redirected) for m in members} == {
        "router": ({"router:7500"}, ()),
        "driver": (frozenset(), ()),
        "talker": (frozenset(), (LOCAL,)),
    }


@pytest.mark.parametrize("variables", [{"ROS_DISTRO": "kilted"}, {}])
def test_a_router_needs_no_variable(variables: dict[str, str]) -> None:
    """Images of zenohd do not set ROS_DISTRO, and rmw_zenohd runs without RMW_IMPLEMENTATION."""
    router = replace(node("router", router=True), variables=variables)
    (member,), told = read(router)
    assert member.place == ZENOH
    assert member.peers == {"router:7447"}
    assert told == []


def test_a_router_beside_nodes_of_dds_does_not_change_their_kind() -> None:
    variables = {"ROS_DISTRO": "kilted", "RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"}
    (member,), _ = read(replace(node("bridge", router=True), variables=variables))
    assert member.place != ZENOH


@pytest.mark.parametrize(
    ("command", "is_router"),
    [
        (["ros2", "run", "rmw_zenoh_cpp", "rmw_zenohd"], True),
        (["bash", "-c", "source /opt/ros/kilted/setup.bash; rmw_zenohd"], True),
        (["/zenohd", "--listen", "tcp/0.0.0.0:7447"], True),
        (["ros2", "launch", "my_zenohd_demo", "all.py"], False),
        (["ros2", "run", "rmw_zenoh_cpp", "zenohd_monitor"], False),
    ],
)
def test_the_command_tells_a_router(command: list[str], is_router: bool) -> None:
    config = {"Cmd": command, "Env": ["ZENOH_CONFIG_OVERRIDE=x=1", "OTHER=1"]}
    row = {"Id": "c" * 64, "Names": ["/router"], "State": "running"}
    seen = read_container(row, check_inspection({"Config": config}))
    assert seen.is_zenoh_router is is_router
    assert seen.variables == {"ZENOH_CONFIG_OVERRIDE": "x=1"}


def test_a_router_of_this_host_is_dialed_at_the_gateway() -> None:
    state = observed(node(labels={"rosproxy.peers": "host.docker.internal"}))
    (desired,) = look(state).desired
    assert desired.peers == (f"{UPLINK.gateway}:7447",)


def test_a_proxy_takes_so_many_routers() -> None:
    many = [
        node(f"n{n}", {"rosproxy.peers": ",".join(f"h{n}-{m}" for m in range(30))})
        for n in range(3)
    ]
    plan = look(observed(*many))
    assert len(plan.desired[0].peers) == 60
    (problem,) = plan.problems
    assert "a proxy takes at most 64 peers" in problem.message
    assert "ros2-peer" not in problem.message


# the proxy


def test_the_proxy_publishes_nothing_and_is_told_its_routers() -> None:
    peers = ("192.0.2.7:7447", "robot:7447")
    box = sandbox_config(CreateSandbox("n", ZENOH, PORTS), SETTINGS)
    assert box["HostConfig"]["PortBindings"] == {}
    # Connections of the proxy use no port of the routers.
    assert box["HostConfig"]["Sysctls"] == {"net.ipv4.ip_local_port_range": "7704 11000"}
    made = Create("n", ZENOH, PORTS, "box", peers=peers)
    config = container_config(made, replace(SETTINGS, data_plane="kernel"), SECRET, "")
    variables = dict(text.split("=", 1) for text in config["Env"])
    del variables["ROSPROXY_ADMIN_TOKEN_HASH"]
    assert variables == {
        "ROSPROXY_OPERATOR": "docker",
        "ROSPROXY_ADMIN_BIND": "0.0.0.0:11312",
        "ROSPROXY_ROS": "zenoh",
        "ROSPROXY_ZENOH_PORTS": "7448-7479",
        "ROSPROXY_ZENOH_PEERS": " ".join(peers),
        "ROSPROXY_AWAIT_POLICY": "3",
    }
    assert "CapAdd" not in config["HostConfig"]
    assert str(made) == "create container n: proxy of the zenoh network, ports 7448-7479 of box"


def test_one_label_gives_the_proxy_a_log_level() -> None:
    wordy = node("wordy", labels={"rosproxy.log-level": "debug"})
    (created,) = [a for a in look(observed(node(), wordy)).actions if isinstance(a, Create)]
    assert created.spec == ProxySpec(log_level="debug")
    config = container_config(created, SETTINGS, SECRET, "")
    assert [text for text in config["Env"] if "LOG" in text] == ["ROSPROXY_LOG_LEVEL=debug"]


def test_an_internal_network_asks_for_nothing() -> None:
    (member,), _ = read(node(), networks=[UPLINK, Network("n1", "app", internal=True)])
    assert member.wishes == {}


@pytest.mark.parametrize("role", ["ports", "proxy", "redirect"])
def test_its_containers_are_known_by_their_labels(role: str) -> None:
    redirect = CreateRedirect("r", ZENOH, PortRange(7449, 7449), "id", "1")
    made: Any = {
        "ports": CreateSandbox("n", ZENOH, PORTS),
        "proxy": Create("n", ZENOH, PORTS, "box"),
        "redirect": redirect,
    }[role]
    labels = own_labels(made)
    own = read_own(labels)
    assert own is not None
    assert (own.role, own.place, own.range) == (role, ZENOH, made.range)
    for forged in ("io.rosproxy.domain", "io.rosproxy.master-uri", "io.rosproxy.advertise-host"):
        assert read_own({**labels, forged: "1"}) is None


def test_its_routers_get_more_in_steps_and_never_fewer() -> None:
    few = look(observed(node()))
    assert few.memory.planned == {ZENOH: PORTS}
    crowd = [node(f"n{number:03}") for number in range(33)]
    many = look(observed(*crowd), memory=few.memory)
    assert many.memory.planned == {ZENOH: PortRange(7448, 7511)}
    assert look(observed(node()), memory=many.memory).memory.planned == many.memory.planned


def test_more_containers_than_routers_are_told() -> None:
    crowd = [node(f"n{number:03}") for number in range(258)]
    plan = look(observed(*crowd))
    assert plan.memory.planned == {ZENOH: PortRange(7448, 7703)}
    assert [problem.subject for problem in plan.problems] == ["container n256", "container n257"]


def test_its_routers_take_no_port_of_the_host() -> None:
    plan = look(observed(node(), listening=[7448], ephemeral=PortRange(7000, 8000)))
    assert plan.memory.planned == {ZENOH: PORTS}
    assert plan.problems == ()


def test_outside_is_not_told_of_its_end() -> None:
    memory = DockerMemory(absent={ZENOH: 0.0})
    removed = look(observed(**the_proxy()), memory=memory).actions
    assert len(removed) == 2
    assert all(isinstance(action, Remove) and not action.retire for action in removed)


# the redirects


def test_each_network_namespace_has_a_port_of_its_own() -> None:
    state = observed(
        node(),
        node("listener", override=ROBOT),
        node("guest", mode="container:id-talker"),
        **the_proxy(("192.0.2.7:7447",)),
    )
    made = made_for(state)
    assert {name: (action.addresses, action.proxy) for name, action in made.items()} == {
        "listener": ((LOCAL, HostPort("192.0.2.7", 7447)), HostPort(NEAR, 7448)),
        "talker": ((LOCAL,), HostPort(NEAR, 7449)),
    }
    done = replace(state, redirects=tuple(map(record, made.values())))
    assert look(done).actions == ()


def test_containers_that_share_a_network_look_for_the_routers_of_both() -> None:
    guest = node("guest", override=ROBOT, mode="container:id-talker")
    (made,) = made_for(observed(node(), guest, **the_proxy(("192.0.2.7:7447",)))).values()
    assert made.addresses == (LOCAL, HostPort("192.0.2.7", 7447))


def test_a_container_keeps_its_port() -> None:
    """The port stays after a restart, and with a new container that sorts first."""
    made = made_for(observed(node("b"), node("c"), **the_proxy()))
    records = tuple(map(record, made.values()))
    later = replace(node("c"), started_at="2026-01-01T11:00:00Z")
    anew = made_for(observed(node("a"), later, **the_proxy(), redirects=records))
    assert (made["b"].range.first, made["c"].range.first) == (7448, 7449)
    assert (anew["a"].range.first, anew["c"].range.first) == (7448, 7449)


def test_a_port_that_the_proxy_has_not_got_yet_waits() -> None:
    crowd = [node(f"n{number:03}") for number in range(33)]
    assert len(made_for(observed(*crowd, **the_proxy()))) == 32


def test_the_rules_keep_neighbours_from_loopback() -> None:
    (made,) = made_for(observed(node(override=ROBOT), **the_proxy(("192.0.2.7:7447",)))).values()
    config = redirect_config(made, SETTINGS)
    (rules,) = config["Cmd"]
    for line in (
        "    ip daddr 127.0.0.1 tcp dport 7447 dnat to 172.18.0.9:7448\n",
        "    ip daddr 192.0.2.7 tcp dport 7447 dnat to 172.18.0.9:7448\n",
        '    iifname != "lo" ip daddr 127.0.0.0/8 drop\n',
        "    ip daddr 172.18.0.9 tcp dport 7448 ct status dnat masquerade\n",
        "    ip daddr 192.0.2.7 tcp dport 7447 reject with tcp reset\n",
        "    ip saddr 192.0.2.7 tcp sport 7447 reject with tcp reset\n",
    ):
        assert line in rules
    assert rules.count("reject") == 2
    assert config["HostConfig"]["Sysctls"] == {"net.ipv4.conf.all.route_localnet": "1"}
    own = read_own(config["Labels"])
    assert own is not None
    assert not forgery_reason(own, made.name, read_making(inspection(config)), IMAGE)


def test_with_the_rules_the_sysctl_goes() -> None:
    state = observed(node(), **the_proxy())
    (made,) = made_for(state).values()
    assert "reject" not in redirect_config(made, SETTINGS)["Cmd"][0]
    off = replace(SETTINGS, redirect=False)
    undo, run, *removed = redirects(replace(state, redirects=(record(made),)), off)
    assert isinstance(undo, CreateRedirect)
    config = redirect_config(undo, off)
    assert config["Cmd"][0].startswith("add table ip rosproxy-redirect-")
    assert "dnat" not in config["Cmd"][0]
    assert config["HostConfig"]["Sysctls"] == {"net.ipv4.conf.all.route_localnet": "0"}
    assert [run, *removed] == [
        Run(undo.name), Remove(made.name, "outdated"), Remove(undo.name, "done"),
    ]  # fmt: skip


def test_where_it_can_not_be_set_a_client_is_the_fix() -> None:
    state = observed(node(), **the_proxy())
    (group,) = (g for g in look(state).groups if g.subject)
    endpoint = f"tcp/{proxy_name(ZENOH)}:7448"
    override = f'mode="client";connect/endpoints=["{endpoint}"];connect/timeout_ms=-1'
    assert group.fix.startswith(f"Set ZENOH_CONFIG_OVERRIDE='{override}'; or wait")


# whatever happens


EVENTS = st.tuples(
    st.sampled_from(
        [
            *(Hosts.run_zenoh, Hosts.run_zenoh, Hosts.run_zenoh, Hosts.change, Hosts.remove),
            *(Hosts.fail_redirects, Hosts.attach, Hosts.detach, Hosts.meddle, Hosts.break_one),
            *(Hosts.remove_own, Hosts.look, Hosts.look_and_be_killed, Hosts.look_and_stall),
            *(Hosts.come_to_rest, Hosts.change_image, Hosts.engine_restarts, Hosts.start_by_hand),
        ]
    ),
    st.integers(0, 59),
    st.integers(0, 59),
)


@given(st.lists(EVENTS, min_size=5, max_size=25))
def test_it_comes_to_rest_as_wished(events: list) -> None:
    host = Hosts()
    host.run_zenoh(0, 0)
    host.come_to_rest()
    assert host.engine.rules
    for happen, n, m in events:
        happen(host, n, m)
        host.check()
    host.come_to_rest()
    host.engine.image = "image-1"
    host.come_to_rest()
