"""Proxies for ROS 2 and their LAN relays: creation and recreation."""

from dataclasses import replace
from typing import Any

import pytest
from msgspec import structs

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.ports import PortRange
from rosproxy_operator.docker.engine_json import read_making
from rosproxy_operator.docker.planner.actions import (
    Action,
    Create,
    CreateLanRelay,
    CreateNetwork,
    CreateSandbox,
    Remove,
    Start,
    Unpause,
)
from rosproxy_operator.docker.planner.container_steps import removal_steps
from rosproxy_operator.docker.planner.model import (
    Attachment,
    Container,
    HostState,
    LanRelayContainer,
    Proxy,
    Sandbox,
)
from rosproxy_operator.docker.planner.own_containers import forgery_reason
from rosproxy_operator.docker.planner.plan import DockerPlan
from rosproxy_operator.docker.planner.specs import (
    FINGERPRINT,
    ROLE,
    OwnLabels,
    container_config,
    lan_relay_config,
    lan_relay_fingerprint,
    lan_relay_name,
    own_labels,
    proxy_fingerprint,
    proxy_name,
    proxy_token,
    read_own,
    sandbox_config,
    sandbox_fingerprint,
    sandbox_name,
)
from rosproxy_operator.docker.planner.state import DockerMemory
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.proxy_spec.place import Domain, Place
from tests.run_options import settings_of
from tests.unit.operator.docker.builders import (
    APP,
    HERE,
    IMAGE,
    RANGE,
    SECRET,
    SETTINGS,
    UPLINK,
    container,
    inspection,
    observed,
    planned,
)

TWO = {"rosproxy.enable": "true", "rosproxy.ros": "2"}
PLACE = Place(Domain(0), HERE)
NEAR = "172.30.0.2"
LAN_RELAY = HostPort(UPLINK.gateway, RANGE.last)
MADE = CreateLanRelay(
    lan_relay_name(PLACE), PLACE, RANGE, HERE, LAN_RELAY, HostPort(NEAR, RANGE.first)
)
BOX = CreateSandbox(sandbox_name(PLACE), PLACE, RANGE)
PROXY = Create(proxy_name(PLACE), PLACE, RANGE, BOX.name, lan_relay=LAN_RELAY)


def own(made: Any, attachments: tuple[Attachment, ...] = (), mode: str = "host") -> Container:
    return Container(
        f"id-{made.name}", made.name, "running", own_labels(made), mode, attachments,
        started_at="2026-01-01T10:00:00Z",
    )  # fmt: skip


def running_proxy(near: str = NEAR, lan_relay: CreateLanRelay | None = MADE) -> dict[str, Any]:
    """A running proxy for ROS 2, with a LAN relay."""
    box = structs.replace(BOX, fingerprint=sandbox_fingerprint(BOX, SETTINGS))
    made = proxy_fingerprint(PROXY, SETTINGS, IMAGE, SECRET)
    attachments = (Attachment(SETTINGS.uplink, near), Attachment("app", "172.18.0.9"))
    lan_relays = []
    if lan_relay is not None:
        lan_relay = structs.replace(
            lan_relay, fingerprint=lan_relay_fingerprint(lan_relay, SETTINGS, IMAGE, SECRET)
        )
        lan_relays = [LanRelayContainer(PLACE, own(lan_relay), RANGE, lan_relay.fingerprint)]
    return {
        "sandboxes": [Sandbox(PLACE, own(box, attachments, "app"), RANGE, box.fingerprint)],
        "proxies": [Proxy(PLACE, own(PROXY, mode=f"container:id-{BOX.name}"), RANGE, made)],
        "lan_relays": tuple(lan_relays),
    }


def look(state: HostState, settings: PlanSettings = SETTINGS) -> DockerPlan:
    return planned(state, settings, DockerMemory(), 100.0)


def actions(state: HostState, settings: PlanSettings = SETTINGS) -> list[Action]:
    return list(look(state, settings).actions)


TALKER = container(labels=TWO)


def test_a_proxy_waits_for_the_uplink_where_its_lan_relay_is_to_listen() -> None:
    plan = look(observed(TALKER, networks=[APP]))
    assert list(plan.actions) == [CreateNetwork(SETTINGS.uplink)]
    assert isinstance(plan.deferred[0].actions[0], CreateSandbox)


def test_the_lan_relay_is_made_once_its_proxy_has_an_address() -> None:
    made = actions(observed(TALKER))
    assert [type(action) for action in made] == [CreateSandbox, Start, *map(type, made[2:])]
    assert not any(isinstance(action, CreateLanRelay) for action in made)
    assert next(action for action in made if isinstance(action, Create)).lan_relay == LAN_RELAY

    create, start = actions(observed(TALKER, **running_proxy(lan_relay=None)))

    fingerprint = lan_relay_fingerprint(MADE, SETTINGS, IMAGE, SECRET)
    assert create == structs.replace(MADE, fingerprint=fingerprint)
    assert start == Start(MADE.name)
    assert actions(observed(TALKER, **running_proxy())) == []


def test_a_proxy_retires_before_its_relay_and_its_sandbox_go() -> None:
    """The relay carries the dispose messages of a proxy that retires."""
    assert list(removal_steps(observed(**running_proxy()), PLACE, "gone")) == [
        Remove(PROXY.name, "gone", retire=True),
        Remove(MADE.name, "gone"),
        Remove(BOX.name, "gone"),
    ]


def test_a_paused_relay_is_resumed_before_its_proxy_retires() -> None:
    parts = running_proxy()
    (lan_relay,) = parts["lan_relays"]
    paused = replace(lan_relay.container, state="paused")
    parts["lan_relays"] = (LanRelayContainer(PLACE, paused, RANGE, lan_relay.fingerprint),)

    first, second, *_ = removal_steps(observed(**parts), PLACE, "gone")

    assert (first, second) == (Unpause(MADE.name), Remove(PROXY.name, "gone", retire=True))


def test_the_lan_relay_is_made_anew_when_its_proxy_has_another_address() -> None:
    old = f"{MADE.name}-old"
    rename, create, remove, start = actions(observed(TALKER, **running_proxy("172.30.0.7")))
    assert (rename.name, remove, start) == (
        MADE.name, Remove(old, "replaced by another container"), Start(MADE.name),
    )  # fmt: skip
    assert isinstance(create, CreateLanRelay)
    assert create.proxy == HostPort("172.30.0.7", RANGE.first)


def test_the_lan_relay_goes_before_its_sandbox_is_made_anew() -> None:
    more = container(labels={**TWO, "rosproxy.ports": "40"})
    steps = actions(observed(more, **running_proxy()))
    assert steps[0] == Remove(MADE.name, "the proxy gets another address")
    assert any(isinstance(action, CreateSandbox) and len(action.range) == 40 for action in steps)
    assert not any(isinstance(action, CreateLanRelay) for action in steps)


def test_all_three_go_when_nobody_wants_them() -> None:
    plan = look(observed(**running_proxy()), replace(SETTINGS, grace=0.0))
    assert [action.name for action in plan.actions] == [PROXY.name, MADE.name, BOX.name]


def test_no_lan_no_lan_relay() -> None:
    deaf = replace(SETTINGS, ros2_lan="none")
    plan = look(observed(TALKER, **running_proxy()), deaf)
    assert Remove(MADE.name, "--ros2-lan is none") in plan.actions
    assert not plan.problems
    (create,) = (action for action in actions(observed(TALKER), deaf) if isinstance(action, Create))
    assert create.lan_relay is None


def test_the_lan_is_where_the_option_says_or_the_advertised_host_or_far_hosts_are() -> None:
    def lan(host: str, option: str, far: str = "") -> list[str]:
        settings = replace(SETTINGS, advertise_host=host, ros2_lan=option)
        place = Place(Domain(0), host)
        box = CreateSandbox(sandbox_name(place), place, RANGE)
        box = structs.replace(box, fingerprint=sandbox_fingerprint(box, settings))
        attachments = (Attachment(settings.uplink, NEAR), Attachment("app", "172.18.0.9"))
        state = observed(
            TALKER, default_route_address=far,
            sandboxes=[Sandbox(place, own(box, attachments, "app"), RANGE, box.fingerprint)],
        )  # fmt: skip
        plan = look(state, settings)
        told = [p.message for p in plan.problems if "has no LAN relay" in p.message]
        return [action.lan for action in plan.actions if isinstance(action, CreateLanRelay)] or told

    assert lan(HERE, "192.0.2.77") == ["192.0.2.77"]
    assert lan(HERE, "", "192.0.2.99") == [HERE]
    assert lan("lab-pc", "", "192.0.2.99") == ["192.0.2.99"]
    assert lan("lab-pc", "")[0].endswith("or with --ros2-lan none if peers are enough")


def test_udp_ports_alone_are_in_its_way() -> None:
    state = observed(
        TALKER,
        replace(container("web", labels={}, ports=[11400]), udp_ports=frozenset({11410})),
        listening=[11411, 11412],
        listening_udp=frozenset({11420}),
    )
    (box,) = (action for action in actions(state) if isinstance(action, CreateSandbox))
    assert box.range == PortRange(11421, 11452)


def test_its_own_well_known_ports_are_not_in_its_range() -> None:
    labels = {**TWO, "rosproxy.domain": "16"}  # 7400 + 250 * 16 = 11400
    (box,) = (action for action in actions(observed(container(labels=labels)))
              if isinstance(action, CreateSandbox))  # fmt: skip
    assert box.range.first == 11411


def test_both_versions_have_ports_of_their_own() -> None:
    labels = {**TWO, "rosproxy.ros": "1,2", "rosproxy.master-uri": "http://192.0.2.7:11311"}
    boxes = [action for action in actions(observed(container(labels=labels)))
             if isinstance(action, CreateSandbox)]  # fmt: skip
    assert {(str(box.place.graph), str(box.range)) for box in boxes} == {
        ("ROS 2 domain 0", "11400-11431"), ("master http://192.0.2.7:11311", "11464-11495"),
    }  # fmt: skip


def test_peers_of_all_containers_are_told() -> None:
    first = container("one", {**TWO, "rosproxy.peers": "robot"})
    second = container("other", {**TWO, "rosproxy.peers": "arm:11400"})
    settings = replace(SETTINGS, ros2_peer=("laptop",))
    (made,) = (action for action in actions(observed(first, second), settings)
               if isinstance(action, Create))  # fmt: skip
    assert made.peers == ("arm:11400", "laptop", "robot")


def test_what_a_proxy_for_ros_2_is_made_of() -> None:
    made = structs.replace(PROXY, peers=("arm:11400", "robot"))
    env = environment(container_config(made, SETTINGS, SECRET, ""))
    settings_of(env)  # it starts
    env.pop("ROSPROXY_ADMIN_TOKEN_HASH")
    env.pop("ROSPROXY_ROS2_LAN_RELAY_SECRET")
    assert env == {
        "ROSPROXY_OPERATOR": "docker",
        "ROSPROXY_ROS": "2",
        "ROSPROXY_ADVERTISE_HOST": HERE,
        "ROSPROXY_PORT_RANGE": "11400-11430",
        "ROSPROXY_ADMIN_BIND": "0.0.0.0:11312",
        "ROSPROXY_ROS2_DOMAINS": "0",
        "ROSPROXY_ROS2_PEERS": "arm:11400 robot",
        "ROSPROXY_ROS2_LAN_RELAY": "172.30.0.1:11431",
        "ROSPROXY_AWAIT_POLICY": "3",
    }
    ports = sandbox_config(BOX, SETTINGS)["HostConfig"]["PortBindings"]
    assert [*ports] == [f"{port}/udp" for port in range(11400, 11431)]
    assert (proxy_name(PLACE), read_own(own_labels(BOX))) == (
        "rosproxy-domain-0-7ec54e", OwnLabels("ports", PLACE, RANGE, ""),
    )  # fmt: skip


def environment(config: dict[str, Any]) -> dict[str, str]:
    return dict(text.split("=", 1) for text in config["Env"])


def secrets_of(secret: str, place: Place = PLACE) -> tuple[str, str]:
    """The secret of a place's proxy, and the secret of the LAN relay."""
    proxy = container_config(structs.replace(PROXY, place=place), SETTINGS, secret, "")
    relay = lan_relay_config(structs.replace(MADE, place=place), SETTINGS, secret)
    proxy_env = environment(proxy)
    relay_env = environment(relay)
    return proxy_env["ROSPROXY_ROS2_LAN_RELAY_SECRET"], relay_env["ROSPROXY_LAN_RELAY_SECRET"]


def test_a_proxy_and_its_lan_relay_share_a_secret() -> None:
    """The operator computes this secret from its own: always the same, and different for each
    proxy.
    """
    of_proxy, of_relay = secrets_of(SECRET)
    assert of_proxy == of_relay == secrets_of(SECRET)[0]
    others = [secrets_of("another"), secrets_of(SECRET, Place(Domain(1), HERE))]
    assert len({of_proxy, *(secret for pair in others for secret in pair)}) == 3
    # The secret, visible by inspection of the LAN relay, is no token for the admin endpoint.
    assert proxy_token(PLACE, SECRET) != of_proxy
    without = container_config(structs.replace(PROXY, lan_relay=None), SETTINGS, SECRET, "")
    assert "ROSPROXY_ROS2_LAN_RELAY_SECRET" not in environment(without)


def test_both_are_made_anew_for_another_secret() -> None:
    state = replace(observed(TALKER, **running_proxy()), secret="another")
    created = [type(a) for a in actions(state) if isinstance(a, Create | CreateLanRelay)]
    assert created == [Create, CreateLanRelay]
    assert actions(replace(state, secret=SECRET)) == []


def test_an_lan_relay_has_the_hosts_network_and_no_other_right() -> None:
    config = lan_relay_config(MADE, SETTINGS, SECRET)
    assert config["User"] == "10001:10001"
    assert config["HostConfig"] == {
        "ReadonlyRootfs": True,
        "CapDrop": ["ALL"],
        "SecurityOpt": ["no-new-privileges:true"],
        "RestartPolicy": {"Name": "always"},
        "Init": False,
        "Memory": 128 * 1024**2,
        "PidsLimit": 64,
        "NetworkMode": "host",
    }
    own = read_own(config["Labels"])
    assert own == OwnLabels("lan-relay", PLACE, RANGE, "")
    assert not forgery_reason(own, MADE.name, read_making(inspection(config)), IMAGE)


def test_one_that_an_operator_before_0_1_0_made_is_known_and_made_anew() -> None:
    former = f"{proxy_name(PLACE)}-ear"
    config = lan_relay_config(MADE, SETTINGS, SECRET)
    labels = {**config["Labels"], ROLE: "ear", FINGERPRINT: "of then"}
    making = inspection({**config, "Cmd": ["ear"]})
    own = read_own(labels)
    assert own == OwnLabels("lan-relay", PLACE, RANGE, "of then")
    assert not forgery_reason(own, former, read_making(making), IMAGE)

    parts = running_proxy()
    (lan_relay,) = parts["lan_relays"]
    there = replace(lan_relay.container, name=former)
    parts["lan_relays"] = (LanRelayContainer(PLACE, there, RANGE, "of then"),)
    steps = actions(observed(TALKER, **parts))
    assert any(isinstance(step, Remove) and step.name.startswith(former) for step in steps)
    assert any(isinstance(step, CreateLanRelay) and step.name == MADE.name for step in steps)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("NetworkMode", "app"),
        ("CapAdd", ["NET_ADMIN"]),
        ("SecurityOpt", None),
        ("PidMode", "host"),
        ("PortBindings", {"80/tcp": [{"HostPort": "80"}]}),
    ],
)
def test_what_gives_a_forged_lan_relay_away(field: str, value: object) -> None:
    making = inspection(lan_relay_config(MADE, SETTINGS, SECRET))
    making["HostConfig"][field] = value
    own = OwnLabels("lan-relay", PLACE, RANGE, "")
    reason = forgery_reason(own, MADE.name, read_making(making), IMAGE)
    assert reason == f"HostConfig.{field} is not the operator's"


@pytest.mark.parametrize(
    "wrong",
    [
        {"io.rosproxy.domain": "233"},
        {"io.rosproxy.domain": "x"},
        {"io.rosproxy.domain": ""},
        {"io.rosproxy.master-uri": "http://robot:11311"},
        {"io.rosproxy.domain": "", "io.rosproxy.master-uri": "http://robot:11311"},
    ],
)
def test_labels_of_a_lan_relay_that_are_not_whole(wrong: dict[str, str]) -> None:
    assert read_own({**own_labels(MADE), **wrong}) is None


@pytest.mark.parametrize(
    ("role", "subject"),
    [
        ("sandboxes", f"container {BOX.name}"),
        ("proxies", f"proxy {PROXY.name}"),
        ("lan_relays", f"container {MADE.name}"),
    ],
)
def test_a_restarting_container_is_reported_by_what_it_is(role: str, subject: str) -> None:
    """The sandbox was reported as "proxy …-ports", the LAN relay as "proxy …-lan-relay"."""
    made = running_proxy()
    (one,) = made[role]
    made[role] = (replace(one, container=replace(one.container, state="restarting")),)
    problems = [p for p in look(observed(TALKER, **made)).problems if "restarts" in p.message]
    assert [(p.subject, p.message.split(". ")[1]) for p in problems] == [
        (subject, f"Read docker logs {subject.split()[1]}")
    ]
