"""From the engine's JSON to what the core plans with."""

from dataclasses import replace
from ipaddress import IPv4Network
from typing import Any

import pytest

from rosproxy.shared.ports import PortRange
from rosproxy_operator.common.master_resolver import MasterResolver
from rosproxy_operator.docker import snapshot
from rosproxy_operator.docker.engine_client import DockerClient
from rosproxy_operator.docker.engine_json import (
    MOST_ARGUMENTS,
    MOST_TEXT_CHARACTERS,
    check_inspection,
    container_of,
    environment,
    read_container,
    read_network,
    signature,
)
from rosproxy_operator.docker.planner.model import (
    Attachment,
    Container,
    HostState,
    LanRelayContainer,
    Network,
    Sandbox,
)
from rosproxy_operator.docker.snapshot import DockerObserver, address_in, foreign_ports
from rosproxy_operator.proxy_spec.place import Domain, Master, Place
from tests.unit.operator.docker import captured
from tests.unit.operator.docker.builders import SETTINGS, observed, read_members
from tests.unit.operator.docker.conftest import FakeEngine

APP = Network(captured.APP_ID, "app")


def container(inspected: dict[str, Any] | None = None, **row: Any) -> Container:
    return read_container(captured.running() | row, inspected, [APP])


def test_a_running_container() -> None:
    talker = container(captured.inspected())
    assert (talker.id, talker.name, talker.state) == (captured.ID, "talker", "running")
    assert talker.labels == {"rosproxy.enable": "true"}
    assert (talker.network_mode, talker.hostname) == ("app", "bhost")
    assert talker.master_uri == "http://robot:11311"
    assert talker.host_ports == {18080, 18000, 18001, 18002}
    assert talker.started_at == "2026-11-21T10:27:24.131326951Z"
    (attachment,) = talker.attachments
    assert (attachment.network, attachment.address, attachment.network_id) == (
        "app",
        "172.29.0.2",
        APP.id,
    )
    assert attachment.names == {"talker", "45afed2aea6c", "web", "bhost"}


def test_a_created_container_on_the_default_network() -> None:
    listener = read_container(captured.created(), None)
    assert (listener.name, listener.state, listener.network_mode) == (
        "listener",
        "created",
        "bridge",
    )
    assert listener.networks == {"bridge"}
    assert listener.attachments[0].address == listener.attachments[0].network_id == ""
    assert listener.started_at == ""


def test_names() -> None:
    assert container(HostConfig={"NetworkMode": captured.APP_ID}).network_mode == "app"
    assert container(Names=["/other/talker", "/talker"]).name == "talker"  # the first is a link's
    assert container(Names=None).name == "45afed2aea6c"


@pytest.mark.parametrize(
    ("entries", "entry"),
    [
        (["other:192.0.2.1", "Robot:192.0.2.7"], "192.0.2.7"),
        (["robot=192.0.2.7"], "192.0.2.7"),
        (["robot:2001:db8::7"], "2001:db8::7"),
        (["robot:host-gateway"], "host-gateway"),
        (["robot2:192.0.2.7", "robot"], ""),
        (None, ""),
    ],
)
def test_the_hosts_file_of_a_container(entries: list[str] | None, entry: str) -> None:
    config = {"Env": ["ROS_MASTER_URI=http://robot:11311"]}
    inspected = {"Config": config, "HostConfig": {"ExtraHosts": entries}}
    assert read_container(captured.created(), inspected).master_entry == entry


def test_variables() -> None:
    assert environment(captured.inspected())["ROSPROXY_ADMIN_TOKEN"] == "a=b"
    assert environment({"Config": {"Env": None}}) == environment(None) == {}


def test_newer_engines_keep_the_containers_own_names_apart() -> None:
    ends = {"app": {"Aliases": ["web"], "DNSNames": ["own", "web", "45afed2aea6c"]}}
    talker = container({"NetworkSettings": {"Networks": ends}})
    assert talker.attachments[0].names == {"talker", "own", "web", "45afed2aea6c"}


def test_a_container_that_was_never_started() -> None:
    assert container({"State": {"StartedAt": "0001-01-01T00:00:00Z"}}).started_at == ""


def test_an_inspection_with_nothing_in_it() -> None:
    assert container({}) == container(None)


@pytest.mark.parametrize(
    ("bindings", "ports"),
    [
        ({"1/tcp": [{"HostIp": "", "HostPort": "80"}]}, {80}),
        ({"1/tcp": [{"HostPort": "8000-8002"}]}, {8000, 8001, 8002}),
        ({"1/tcp": [{"HostPort": ""}, {"HostPort": "0"}, {"HostPort": "x"}]}, set()),
        ({"1": [{"HostPort": "80-"}]}, {80}),
        ({"1/udp": [{"HostPort": "80"}], "2/tcp": [], "3/tcp": None}, set()),
        (None, set()),
    ],
)
def test_host_ports(bindings: object, ports: set[int]) -> None:
    assert container({"HostConfig": {"PortBindings": bindings}}, Ports=None).host_ports == ports


def test_a_network_and_its_subnets() -> None:
    subnets = (IPv4Network("172.29.0.0/16"),)
    assert read_network(captured.network()) == Network(
        captured.APP_ID, "app", "bridge", False, "172.29.0.1", subnets
    )


@pytest.mark.parametrize(
    ("flags", "dual_stack"),
    [
        ({}, False),
        ({"EnableIPv6": False}, False),
        ({"EnableIPv6": True}, True),
        ({"EnableIPv6": True, "EnableIPv4": True}, True),
        ({"EnableIPv6": True, "EnableIPv4": False}, False),
    ],
)
def test_a_network_with_both_families(flags: dict[str, bool], dual_stack: bool) -> None:
    assert read_network({**captured.network(), **flags}).dual_stack is dual_stack


def test_a_network_without_addresses() -> None:
    host = {"Name": "host", "Id": "1", "Driver": "host", "IPAM": {"Config": None}}
    assert read_network(host).gateway == ""
    assert read_network(host).subnets == ()


@pytest.mark.parametrize(
    ("event", "container"),
    [
        ({"Type": "container", "Action": "die", "Actor": {"ID": "c1"}}, "c1"),
        ({"Type": "network", "Actor": {"ID": "n1", "Attributes": {"container": "c1"}}}, "c1"),
        ({"Type": "network", "Actor": {"ID": "n1", "Attributes": {"name": "app"}}}, ""),
        ({"Type": "image", "Actor": {"ID": "sha256:1"}}, ""),
        ({"Type": "container", "Actor": None}, ""),
        ({}, ""),
    ],
)
def test_which_container_an_event_is_about(event: dict[str, Any], container: str) -> None:
    assert container_of(event) == container


def test_the_signature_changes_with_each_connection() -> None:
    row: dict[str, Any] = captured.running()
    before = signature(row)
    row["State"] = "paused"
    row["Status"] = "Up 3 seconds (Paused)"
    assert signature(row) == before
    row["NetworkSettings"]["Networks"]["app"] = captured.end("another", "172.29.0.2")
    assert signature(row) != before


def test_ports_of_a_sandbox_that_is_being_started_are_no_strangers() -> None:
    place = Place(Master("http://robot:11311"), "192.0.2.10")
    ports = PortRange(11400, 11401)
    box = Sandbox(place, Container("1", "box", "created"), ports, "")
    listening = frozenset({22, 11400, 11401})
    assert foreign_ports([box], [], listening) == {22}
    assert foreign_ports([], [], listening) == listening


def test_the_port_of_an_lan_relay_is_no_strangers() -> None:
    place = Place(Domain(0), "192.0.2.10")
    ports = PortRange(11400, 11431)
    lan_relay = LanRelayContainer(place, Container("1", "lan-relay", "running"), ports, "")
    assert foreign_ports([], [lan_relay], frozenset({11400, 11431})) == {11400}


def test_the_engine_knows_names_that_no_name_server_has() -> None:
    uplink = Network("n0", "0-rosproxy", gateway="172.30.0.1")
    attachments = (Attachment("app", "172.18.0.5", frozenset({"RosCore"})),)
    core = Container("1", "core", "running", attachments=attachments)
    state = HostState((core,), (uplink,), (), PortRange(1, 2))
    assert address_in(state, "roscore", "0-rosproxy") == "172.18.0.5"
    assert address_in(state, "host.docker.internal", "0-rosproxy") == "172.30.0.1"
    assert address_in(state, "robot", "0-rosproxy") == ""
    ended = replace(state, containers=(replace(core, state="exited"),))
    assert address_in(ended, "roscore", "0-rosproxy") == ""


async def test_the_first_look_waits_longer_for_inspections(
    engine: FakeEngine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else a proxy gets the alias of a container that is not inspected yet."""
    waited: list[float] = []

    async def update(_: object, __: object, ___: object, patience: float) -> None:
        waited.append(patience)

    monkeypatch.setattr(snapshot.Inspector, "update", update)
    engine.knows[f"/images/{SETTINGS.proxy_image}/json"] = {"Id": "sha256:1"}
    observer = DockerObserver(DockerClient(), SETTINGS, MasterResolver(lambda: None), lambda: None)
    for _ in range(2):
        await observer.look()
    assert waited == [snapshot.FIRST_INSPECTION_WAIT_S, snapshot.INSPECTION_WAIT_S]


# what is kept of an inspection


def kept_of(**config: Any) -> dict[str, Any]:
    return check_inspection({**captured.inspected(), "Config": config})


def test_of_the_variables_those_are_kept_that_are_read() -> None:
    kept = kept_of(Env=["A=" + "a" * 1_000_000, "ROS_DISTRO=noetic", "B", "ROS_DOMAIN_ID=3"])
    assert environment(kept) == {"ROS_DISTRO": "noetic", "ROS_DOMAIN_ID": "3"}


def test_what_is_kept_of_a_container_is_bounded() -> None:
    uri = "http://robot:11311/" + "a" * 1_000_000
    kept = kept_of(
        Env=[f"ROS_MASTER_URI={uri}"], Cmd=["a" * 1_000_000] * 1000, Entrypoint=None, User="1"
    )
    assert len(str(kept["Config"])) < (MOST_ARGUMENTS + 1) * (MOST_TEXT_CHARACTERS + 10) + 100
    assert kept["Config"]["User"] == "1"
    # Cut off, a URI must not become another one.
    labels = {"rosproxy.enable": "true"}
    found = container(kept, Labels=labels)
    served, problems = read_members(observed(found))
    assert served == ()
    assert "ROS_MASTER_URI" in problems[0].message
