"""Specs of containers, fingerprints, and labels."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import structs

from rosproxy.shared.policy.rules import parse_rules
from rosproxy.shared.ports import PortRange
from rosproxy.shared.setting_kinds import hash_token
from rosproxy_operator.common.policy import administrators_policy
from rosproxy_operator.docker.planner.actions import Create, CreateSandbox
from rosproxy_operator.docker.planner.specs import (
    OwnLabels,
    admin_port,
    container_config,
    is_proxy_name,
    own_labels,
    proxy_fingerprint,
    proxy_name,
    proxy_token,
    read_own,
    reserved_ports,
    sandbox_config,
    sandbox_fingerprint,
    sandbox_name,
)
from rosproxy_operator.proxy_spec.place import Master, Place
from rosproxy_operator.proxy_spec.spec import ProxySpec
from tests.run_options import settings_of
from tests.unit.operator.docker.builders import HERE, IMAGE, PLACE, RANGE, SECRET, SETTINGS

SANDBOX = CreateSandbox("s", PLACE, PortRange(11400, 11401), fingerprint="f1")
PROXY = Create("p", PLACE, PortRange(11400, 11401), "s", fingerprint="f2")
TOKEN = proxy_token(PLACE, SECRET)
HASH = hash_token(TOKEN)


def test_a_sandbox_holds_ports_and_network_and_does_nothing() -> None:
    body = sandbox_config(SANDBOX, SETTINGS)
    assert (body["Entrypoint"], body["Cmd"]) == (["sleep"], ["infinity"])
    assert body["Healthcheck"] == {"Test": ["NONE"]}
    assert body["ExposedPorts"] == {"11400/tcp": {}, "11401/tcp": {}}
    assert body["NetworkingConfig"] == {"EndpointsConfig": {"0-rosproxy": {}}}
    host = body["HostConfig"]
    assert host["NetworkMode"] == "0-rosproxy"
    assert host["PortBindings"] == {
        "11400/tcp": [{"HostIp": "0.0.0.0", "HostPort": "11400"}],
        "11401/tcp": [{"HostIp": "0.0.0.0", "HostPort": "11401"}],
    }
    assert host["Init"] is True
    assert host["Sysctls"] == {"net.ipv4.ip_local_port_range": "1024 11000"}


@pytest.mark.parametrize("ports", [PortRange(9000, 9031), PortRange(11000, 11031)])
def test_outgoing_connections_take_no_port_of_the_range(ports: PortRange) -> None:
    """--port-window may begin below 11001."""
    body = sandbox_config(structs.replace(SANDBOX, range=ports), SETTINGS)
    assert body["HostConfig"]["Sysctls"] == {"net.ipv4.ip_local_port_range": "32768 60999"}


def test_a_proxy_is_in_its_sandbox_and_has_nothing_of_its_own() -> None:
    body = container_config(PROXY, SETTINGS, SECRET, "192.0.2.7")
    assert body["HostConfig"]["NetworkMode"] == "container:s"
    assert not {"ExposedPorts", "NetworkingConfig"} & body.keys()
    assert not {"PortBindings", "Sysctls"} & body["HostConfig"].keys()
    assert body["Env"] == [
        "ROSPROXY_OPERATOR=docker",
        "ROS_MASTER_URI=http://robot:11311",
        "ROSPROXY_ADVERTISE_HOST=192.0.2.10",
        "ROSPROXY_PORT_RANGE=11400-11401",
        "ROSPROXY_MASTER_PORT=11311",
        "ROSPROXY_ADMIN_BIND=0.0.0.0:11312",
        f"ROSPROXY_ADMIN_TOKEN_HASH={HASH}",
        "ROSPROXY_MASTER_ADDRESS=192.0.2.7",
        "ROSPROXY_AWAIT_POLICY=3",
    ]


@pytest.mark.parametrize(
    "body",
    [
        sandbox_config(SANDBOX, SETTINGS),
        container_config(PROXY, SETTINGS, "t", "192.0.2.7"),
    ],
)
def test_both_are_hardened(body: dict) -> None:
    host = body["HostConfig"]
    assert body["User"] == "10001:10001"
    assert body["Image"] == "rosproxy:latest"
    assert host["ReadonlyRootfs"] is True
    assert host["CapDrop"] == ["ALL"]
    assert host["SecurityOpt"] == ["no-new-privileges:true"]
    assert host["RestartPolicy"] == {"Name": "always"}
    assert not {"Privileged", "CapAdd", "Binds", "Devices"} & host.keys()


def test_a_policy_is_there_from_the_start_and_makes_no_proxy_anew() -> None:
    rules = parse_rules("deny publish /camera/*")
    other = replace(SETTINGS, policy=administrators_policy([rules], "audit"))
    body = container_config(PROXY, other, SECRET, "")
    assert (
        settings_of(dict(variable.split("=", 1) for variable in body["Env"])).policy_layers
        == other.policy
    )
    made = (proxy_fingerprint(PROXY, settings, IMAGE, SECRET) for settings in (other, SETTINGS))
    assert len({*made}) == 1


def test_an_unknown_address_is_not_given() -> None:
    names = [pair.split("=")[0] for pair in container_config(PROXY, SETTINGS, "t", "")["Env"]]
    assert "ROSPROXY_MASTER_ADDRESS" not in names


def test_a_token_is_made_of_the_secret_and_the_place_and_is_nowhere() -> None:
    """An inspection of a proxy shows only the hash of the token."""
    assert proxy_token(PLACE, SECRET) == TOKEN
    assert proxy_token(PLACE, "another secret") != TOKEN
    assert proxy_token(replace(PLACE, advertise_host="192.0.2.11"), SECRET) != TOKEN
    body = str(container_config(PROXY, SETTINGS, SECRET, ""))
    assert TOKEN not in body
    assert SECRET not in body
    assert SECRET not in repr(replace(SETTINGS, secret=SECRET))


def test_a_proxy_is_bounded_in_memory_and_threads() -> None:
    host = container_config(PROXY, SETTINGS, SECRET, "")["HostConfig"]
    assert (host["Memory"], host["PidsLimit"]) == (1024**3, 8192)
    unbounded = replace(SETTINGS, proxy_memory=0, proxy_pids=0)
    host = container_config(PROXY, unbounded, SECRET, "")["HostConfig"]
    assert not {"Memory", "PidsLimit"} & host.keys()


def test_a_proxy_is_told_who_may_control_its_nodes() -> None:
    narrow = structs.replace(PROXY, spec=ProxySpec(slave_control="master"))
    assert "ROSPROXY_SLAVE_CONTROL=master" in container_config(narrow, SETTINGS, SECRET, "")["Env"]
    assert "SLAVE_CONTROL" not in str(container_config(PROXY, SETTINGS, SECRET, ""))


def test_a_log_level_recreates_the_proxy_and_keeps_its_ports() -> None:
    spec = ProxySpec(log_level="debug")
    wordy = structs.replace(PROXY, spec=spec)
    body = container_config(wordy, SETTINGS, SECRET, "")
    assert settings_of(dict(pair.split("=", 1) for pair in body["Env"])).log_level == "debug"
    assert "LOG_LEVEL" not in str(container_config(PROXY, SETTINGS, SECRET, ""))
    proxies = {proxy_fingerprint(each, SETTINGS, IMAGE, SECRET) for each in (PROXY, wordy)}
    sandboxes = {SANDBOX, structs.replace(SANDBOX, spec=spec)}
    assert len(proxies) == 2
    assert len({sandbox_fingerprint(each, SETTINGS) for each in sandboxes}) == 1


def test_ports_are_published_on_each_address_asked_for() -> None:
    settings = replace(SETTINGS, publish_address=("192.0.2.10", "::"))
    bindings = sandbox_config(SANDBOX, settings)["HostConfig"]["PortBindings"]
    assert [binding["HostIp"] for binding in bindings["11400/tcp"]] == ["192.0.2.10", "::"]


@pytest.mark.parametrize("port", [11311, 11312, 11500])
def test_the_proxy_accepts_its_environment(port: int) -> None:
    """A second roscore is often at 11312, where the admin endpoint usually is."""
    place = Place(Master(f"http://robot:{port}"), HERE)
    body = container_config(
        structs.replace(PROXY, place=place), SETTINGS, "t0ken-t0ken", "192.0.2.7"
    )
    settings = settings_of(dict(pair.split("=", 1) for pair in body["Env"]))
    assert settings.admin.port == admin_port(place)
    assert settings.token_hash == hash_token(proxy_token(place, "t0ken-t0ken"))
    assert reserved_ports(place) == {port, settings.admin.port}


def test_what_makes_a_sandbox_anew() -> None:
    now = sandbox_fingerprint(SANDBOX, SETTINGS)
    renamed = structs.replace(SANDBOX, name="other", fingerprint="")
    assert now == sandbox_fingerprint(renamed, replace(SETTINGS, proxy_image="other", grace=1.0))
    assert now != sandbox_fingerprint(structs.replace(SANDBOX, range=RANGE), SETTINGS)
    assert now != sandbox_fingerprint(
        structs.replace(SANDBOX, spec=ProxySpec(data_plane="kernel")), SETTINGS
    )
    assert now != sandbox_fingerprint(SANDBOX, replace(SETTINGS, publish_address=("::",)))
    assert now != sandbox_fingerprint(SANDBOX, replace(SETTINGS, uplink="0-other"))


def test_what_makes_a_proxy_anew() -> None:
    now = proxy_fingerprint(PROXY, SETTINGS, IMAGE, SECRET)
    renamed = structs.replace(
        PROXY, name="other", sandbox="another", fingerprint="", replaces="old"
    )
    other = replace(SETTINGS, proxy_image="other", publish_address=("::",))
    assert now == proxy_fingerprint(renamed, other, IMAGE, SECRET)
    assert now != proxy_fingerprint(PROXY, SETTINGS, "sha256:2", SECRET)
    assert now != proxy_fingerprint(structs.replace(PROXY, range=RANGE), SETTINGS, IMAGE, SECRET)
    assert now != proxy_fingerprint(PROXY, SETTINGS, IMAGE, "another secret")
    assert now != proxy_fingerprint(
        structs.replace(PROXY, spec=ProxySpec(slave_control="master")), SETTINGS, IMAGE, SECRET
    )
    for bound in (replace(SETTINGS, proxy_memory=0), replace(SETTINGS, proxy_pids=300)):
        assert now != proxy_fingerprint(PROXY, bound, IMAGE, SECRET)
    elsewhere = replace(PLACE, advertise_host="192.0.2.11")
    assert now != proxy_fingerprint(
        structs.replace(PROXY, place=elsewhere), SETTINGS, IMAGE, SECRET
    )


def test_fingerprints_stay_as_they_were() -> None:
    """Else an update of the operator makes all proxies anew."""
    assert sandbox_fingerprint(SANDBOX, SETTINGS) == "a9291a3d8c5d7a0a"
    assert proxy_fingerprint(PROXY, SETTINGS, IMAGE, SECRET) == "fc7e3c97d41888da"


def test_labels_are_read_back() -> None:
    assert read_own(own_labels(SANDBOX)) == OwnLabels(
        "ports", PLACE, PortRange(11400, 11401), fingerprint="f1"
    )
    assert read_own(own_labels(PROXY)) == OwnLabels("proxy", PLACE, PortRange(11400, 11401), "f2")


@pytest.mark.parametrize(
    "wrong",
    [
        {"io.rosproxy.managed": "yes"},
        {"io.rosproxy.role": "robot"},
        {"io.rosproxy.master-uri": "robot"},
        {"io.rosproxy.advertise-host": ""},
        {"io.rosproxy.range": "11401-11400"},
        {"io.rosproxy.range": "many"},
    ],
)
def test_other_containers_are_not_taken_for_own_ones(wrong: dict[str, str]) -> None:
    assert read_own({**own_labels(SANDBOX), **wrong}) is None


@given(st.dictionaries(st.sampled_from(sorted(own_labels(SANDBOX))), st.text(max_size=20)))
def test_labels_of_whatever_kind_are_read_or_refused(labels: dict[str, str]) -> None:
    own = read_own({**own_labels(SANDBOX), **labels})
    assert own is None or own.role in ("ports", "proxy")


@pytest.mark.parametrize(
    ("uri", "start"),
    [
        ("http://robot:11311", "rosproxy-robot-"),
        ("http://robot.Lab.example:11311", "rosproxy-robot-lab-example-"),
        ("http://192.0.2.7:11311", "rosproxy-192-0-2-7-"),
        ("http://[2001:db8::1]:11311", "rosproxy-2001-db8-1-"),
        (f"http://{'r' * 200}:11311", f"rosproxy-{'r' * 30}-"),
        ("http://___:11311", "rosproxy-master-"),
    ],
)
def test_names(uri: str, start: str) -> None:
    name = proxy_name(Place(Master(uri), HERE))
    assert name.startswith(start)
    assert len(name) == len(start) + 6
    assert is_proxy_name(name)
    assert is_proxy_name(sandbox_name(Place(Master(uri), HERE)))
    assert name != proxy_name(Place(Master(uri), "192.0.2.11"))
    assert not is_proxy_name(start)
