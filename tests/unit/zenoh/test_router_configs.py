"""The configurations of the routers: which router listens where, and which router dials which."""

import base64
import json
from dataclasses import replace

import pytest

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.ports import PortRange
from rosproxy.shared.setting_kinds import Credentials
from rosproxy.zenoh.router_configs import (
    FILES_OF_ROUTER,
    MAX_SESSIONS,
    NO_FILE_LIMIT,
    SPARE_FILES,
    RouterConfig,
    RouterPlan,
)

PORTS = PortRange(7448, 7449)


def endpoints(config: RouterConfig, key: str) -> list[str]:
    given = json.loads(config[f"{key}/endpoints"])
    assert isinstance(given, list)
    return given


def test_a_router_for_each_port_and_a_hub_that_dials_all() -> None:
    peers = (HostPort("robot", 7447), HostPort("fd00::7", 7448))
    *routers, hub = RouterPlan("0.0.0.0", PORTS, None, peers).configs({})
    assert [endpoints(router, "listen") for router in routers] == [
        ["tcp/0.0.0.0:7448"],
        ["tcp/0.0.0.0:7449"],
    ]
    assert [endpoints(router, "connect") for router in routers] == [[], []]
    assert endpoints(hub, "listen") == []
    own = ["tcp/127.0.0.1:7448", "tcp/127.0.0.1:7449"]
    assert endpoints(hub, "connect") == [*own, "tcp/robot:7447", "tcp/[fd00::7]:7448"]


def test_each_router_has_a_long_queue_for_declarations() -> None:
    """With zenoh's default, a burst of 1,800 tokens stopped all routers, in five of eleven runs."""
    for config in RouterPlan("0.0.0.0", PORTS, None, ()).configs({}):
        assert json.loads(config["transport/link/tx/queue/size/control"]) == 16


def session_bounds(files: int) -> list[tuple[int, int]]:
    """The most sessions, and the most that are being opened, of each router."""
    plan = RouterPlan("0.0.0.0", PORTS, None, (HostPort("robot", 7447),), "/run/r", files=files)
    return [
        (json.loads(config[MAX_SESSIONS]), json.loads(config["transport/unicast/accept_pending"]))
        for config in plan.configs({})
    ]


@pytest.mark.parametrize("files", [NO_FILE_LIMIT, 1_048_576, 10_000])
def test_routers_have_the_most_sessions_with_enough_open_files(files: int) -> None:
    """The hub also has a session with each router that it dials."""
    assert session_bounds(files) == [(1000, 1000), (1000, 1000), (1003, 1000)]


@pytest.mark.parametrize("files", [100, 256, 1024, 4096])
def test_all_sessions_together_leave_open_files(files: int) -> None:
    """Otherwise one container takes all files, and no node of another container connects."""
    bounds = session_bounds(files)
    assert bounds[0] == bounds[1]
    assert bounds[0][0] > bounds[0][1] > 0
    assert sum(map(sum, bounds)) + SPARE_FILES + FILES_OF_ROUTER * len(bounds) <= files


def test_too_few_open_files_are_refused() -> None:
    with pytest.raises(ValueError, match="needs 97 open files, and this process may have 96"):
        session_bounds(96)


@pytest.mark.parametrize(
    ("bind", "listens", "dialed"),
    [
        ("::", "tcp/[::]:7450", ["tcp/[::1]:7448", "tcp/[::1]:7449", "tcp/[::1]:7450"]),
        (
            "127.0.0.2",
            "tcp/127.0.0.2:7450",
            [f"tcp/127.0.0.2:{port}" for port in range(7448, 7451)],
        ),
    ],
)
def test_outside_has_a_router_that_the_hub_reaches_at_the_bound_address(
    bind: str, listens: str, dialed: list[str]
) -> None:
    plan = RouterPlan(bind, PORTS, 7450, ())
    *_, for_outside, hub = plan.configs({})
    assert endpoints(for_outside, "listen") == [listens]
    assert endpoints(hub, "listen") == []
    assert endpoints(hub, "connect") == dialed
    assert plan.all_ports == [7448, 7449, 7450]


HUBS = (HostPort("hub-b.hubs.svc", 7447), HostPort("robot", 7447))


def test_hubs_without_a_certificate_use_plain_tcp() -> None:
    peers = (HostPort("robot", 7447), HostPort("arm", 7447))
    plan = RouterPlan("0.0.0.0", PORTS, None, peers, hub_listen=7446, hubs=HUBS)
    hub = plan.configs({})[-1]
    assert endpoints(hub, "listen") == ["tcp/0.0.0.0:7446"]
    outside = ["tcp/arm:7447", "tcp/hub-b.hubs.svc:7447", "tcp/robot:7447"]
    assert endpoints(hub, "connect")[2:] == outside
    assert not any("tls" in key for key in hub)


def test_hubs_with_a_certificate_demand_the_same_of_other_hubs_alone() -> None:
    certificate = Credentials(b"its certificate", b"the key", b"the CA")
    plan = RouterPlan(
        "::", PORTS, 7450, HUBS[1:], hub_listen=7447, hubs=HUBS[:1], certificate=certificate
    )
    *routers, hub = plan.configs({})
    assert endpoints(hub, "listen") == ["tls/[::]:7447"]
    assert endpoints(hub, "connect")[3:] == ["tcp/robot:7447", "tls/hub-b.hubs.svc:7447"]
    tls = {key[len("transport/link/tls/") :]: v for key, v in hub.items() if "/tls/" in key}
    assert tls["enable_mtls"] == tls["verify_name_on_connect"] == "true"
    decoded = {k: base64.b64decode(json.loads(v)) for k, v in tls.items() if k.endswith("base64")}
    assert decoded == {
        "root_ca_certificate_base64": b"the CA",
        **dict.fromkeys(("listen_private_key_base64", "connect_private_key_base64"), b"the key"),
        "listen_certificate_base64": b"its certificate",
        "connect_certificate_base64": b"its certificate",
    }
    assert not any("tls" in key for router in routers for key in router)


def test_every_value_is_json() -> None:
    for config in RouterPlan("0.0.0.0", PORTS, 7447, ()).configs({}):
        assert config["mode"] == '"router"'
        assert {key: json.loads(value) for key, value in config.items()}


def test_the_hub_dials_by_sockets_of_a_directory() -> None:
    peers = (HostPort("robot", 7447),)
    access = {7449: {"enabled": True}}
    plan = RouterPlan("0.0.0.0", PORTS, None, peers, "/dev/shm/sockets")
    first, second, hub = plan.configs(access)
    assert endpoints(first, "listen") == [
        "tcp/0.0.0.0:7448",
        "unixsock-stream//dev/shm/sockets/7448",
    ]
    assert endpoints(hub, "connect") == [
        "unixsock-stream//dev/shm/sockets/7448",
        "unixsock-stream//dev/shm/sockets/7449",
        "tcp/robot:7447",
    ]
    assert "access_control" not in first
    assert json.loads(second["access_control"]) == access[7449]
    assert "access_control" not in hub


def test_without_a_directory_there_is_no_access_control() -> None:
    """The routers could not tell the hub from nodes."""
    with pytest.raises(ValueError, match="need a directory"):
        RouterPlan("0.0.0.0", PORTS, None, ()).configs({7448: {"enabled": True}})


def test_another_opening_changes_the_routers_that_dial_alone() -> None:
    links = {"connect/endpoints": '["tls/cloud:7447"]'}
    plan = RouterPlan("0.0.0.0", PORTS, 7447, (), "/run/r")
    first = plan.configs({}, links)
    again = replace(plan, opening=1).configs({}, links)
    changed = [before != after for before, after in zip(first, again, strict=True)]
    assert changed == [False, False, False, True, True]
