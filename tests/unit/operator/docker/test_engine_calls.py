"""Calls to an engine on loopback, and its answers."""

import re
from pathlib import Path
from typing import Any

import pytest

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.setting_kinds import hash_token
from rosproxy_operator.common.proxy_client import ProxyClient
from rosproxy_operator.docker.engine_client import DockerClient
from rosproxy_operator.docker.engine_json import uplink_secret
from rosproxy_operator.docker.errors import EngineError
from rosproxy_operator.docker.executor import DockerActions
from rosproxy_operator.docker.planner.actions import (
    Action,
    Connect,
    Create,
    CreateFlush,
    CreateLanRelay,
    CreateNetwork,
    CreateRedirect,
    CreateSandbox,
    Disconnect,
    Remove,
    RemoveNetwork,
    Rename,
    Restart,
    Run,
    Start,
    Unpause,
)
from rosproxy_operator.docker.planner.labels.members import LabelReading
from rosproxy_operator.docker.planner.specs import (
    lan_relay_config,
    own_labels,
    proxy_token,
    sandbox_config,
    sandbox_name,
)
from rosproxy_operator.docker.snapshot import DockerSnapshot
from rosproxy_operator.proxy_spec.place import Domain, Place
from tests.unit.operator.docker.builders import (
    PLACE,
    RANGE,
    SECRET,
    SETTINGS,
    inspection,
    observed,
)
from tests.unit.operator.docker.conftest import FakeEngine

PERMISSIONS = Path(__file__).parents[4] / "docs/reference/permissions.md"
BOX = CreateSandbox(sandbox_name(PLACE), PLACE, RANGE)
SEEN = observed(masters={"robot": "192.0.2.7"})
LOOK = DockerSnapshot(SEEN, LabelReading(), {}, at_host=True, new_secret="fresh secret")
ACTIONS: list[Action] = [
    CreateNetwork("0-rosproxy"),
    BOX,
    Create("p", PLACE, RANGE, "box"),
    Start("p"),
    Restart("p"),
    Unpause("p"),
    Rename("p", "q"),
    Connect("box", "app", ("robot",)),
    Disconnect("box", "app"),
    Remove("box", "", stop=True),
    CreateRedirect("r", PLACE, RANGE, "talker", "2026-01-01T10:00:00Z"),
    Run("box"),
    CreateFlush("f", PLACE, RANGE),
]


@pytest.fixture(autouse=True)
def container_on_two_networks(engine: FakeEngine) -> None:
    networks: dict[str, Any] = {"app": {}, SETTINGS.uplink: {}}
    ended = {"Running": False, "ExitCode": 0}
    body = sandbox_config(BOX, SETTINGS)
    box = inspection(body, NetworkSettings={"Networks": networks}, State=ended)
    for name in (BOX.name, "box"):
        engine.knows[f"/containers/{name}/json"] = box
    engine.knows["/images/rosproxy:latest/json"] = {"Id": "sha256:1"}


async def carry_out(action: Action) -> None:
    await DockerActions(DockerClient(), SETTINGS, ProxyClient()).carry_out(action, LOOK)


async def test_the_documentation_lists_exactly_what_is_called(engine: FakeEngine) -> None:
    client = DockerClient()
    assert client.containers() == client.networks() == []
    assert client.image_id("rosproxy:latest") == "sha256:1"
    assert list(client.events()) == [{"Action": "start"}]
    for action in ACTIONS:
        await carry_out(action)
    listed = re.findall(r"^(?:GET|POST|DELETE) /\S+$", PERMISSIONS.read_text(), re.M)
    assert [
        pattern
        for pattern in listed
        if not any(re.fullmatch(pattern, call) for call in engine.calls)
    ] == []
    assert [
        call for call in engine.calls if not any(re.fullmatch(pattern, call) for pattern in listed)
    ] == []


@pytest.mark.parametrize(("version", "deletes"), [("1.41", False), ("1.42", True), ("1.50", True)])
def test_engines_since_23_delete_conntrack_entries(
    version: str, deletes: bool, engine: FakeEngine
) -> None:
    engine.knows["/version"] = {"ApiVersion": version}
    client = DockerClient()
    assert client.containers() == []
    assert client.deletes_udp_entries is deletes


async def test_uninstall_removes_a_network_besides(engine: FakeEngine) -> None:
    await carry_out(RemoveNetwork("0-rosproxy"))
    engine.refuses["DELETE /networks/gone"] = (404, "network gone not found")
    await carry_out(RemoveNetwork("gone"))
    assert [call for call in engine.calls if call.startswith("DELETE")] == [
        "DELETE /networks/0-rosproxy",
        "DELETE /networks/gone",
    ]
    engine.refuses["DELETE /networks/busy"] = (403, "network busy has active endpoints")
    with pytest.raises(EngineError, match="has active endpoints"):
        await carry_out(RemoveNetwork("busy"))


async def test_what_does_not_do_its_one_thing_is_told(engine: FakeEngine) -> None:
    state = engine.knows["/containers/box/json"]["State"]
    state["ExitCode"] = 1
    with pytest.raises(EngineError, match="ended with exit code 1"):
        await carry_out(Run("box"))


async def test_what_does_not_end_is_removed(
    engine: FakeEngine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rosproxy_operator.docker.executor.LONGEST_HELPER_RUN_S", 0.0)
    engine.knows["/containers/box/json"]["State"]["Running"] = True
    with pytest.raises(EngineError, match="not ended after 0 s, and removed by the operator"):
        await carry_out(Run("box"))
    assert "DELETE /containers/box" in engine.calls


async def test_a_proxy_gets_its_tokens_hash_and_its_masters_address(engine: FakeEngine) -> None:
    await carry_out(ACTIONS[2])
    variables = engine.calls["POST /containers/create"]["Env"]
    expected = hash_token(proxy_token(PLACE, SECRET))
    assert f"ROSPROXY_ADMIN_TOKEN_HASH={expected}" in variables
    assert "ROSPROXY_MASTER_ADDRESS=192.0.2.7" in variables


async def test_a_lan_relay_gets_what_it_shares_with_its_proxy(engine: FakeEngine) -> None:
    place = Place(Domain(0), "192.0.2.1")
    near = HostPort("172.30.0.1", RANGE.last)
    relay = CreateLanRelay(
        "e", place, RANGE, "192.0.2.1", near, HostPort("172.30.0.2", RANGE.first)
    )
    await carry_out(relay)
    variables = engine.calls["POST /containers/create"]["Env"]
    assert variables == lan_relay_config(relay, SETTINGS, SECRET)["Env"]


async def test_the_uplink_holds_the_secret(engine: FakeEngine) -> None:
    await carry_out(ACTIONS[0])
    labels = engine.calls["POST /networks/create"]["Labels"]
    assert labels == {"io.rosproxy.managed": "true", "io.rosproxy.secret": "fresh secret"}
    rows = [{"Name": "app", "Id": "1"}, {"Name": "0-rosproxy", "Id": "2", "Labels": labels}]
    assert uplink_secret(rows, "0-rosproxy") == "fresh secret"
    assert uplink_secret([{**rows[1], "Labels": None}], "0-rosproxy") == "2"  # made by hand
    assert uplink_secret(rows[:1], "0-rosproxy") == ""


async def test_what_is_removed_leaves_its_networks_but_the_uplink(engine: FakeEngine) -> None:
    engine.refuses["POST /networks/app/disconnect"] = (404, "network app not found")
    await carry_out(ACTIONS[9])
    assert list(engine.calls)[1:] == [
        "POST /containers/box/stop",
        "GET /containers/box/json",
        "POST /networks/app/disconnect",
        "DELETE /containers/box",
    ]


@pytest.mark.parametrize(
    ("action", "call", "status", "said"),
    [
        (ACTIONS[0], "POST /networks/create", 409, "network 0-rosproxy already exists"),
        (ACTIONS[1], "POST /containers/create", 409, "The name is already in use"),
        (ACTIONS[3], "POST /containers/p/start", 500, "container b is not running"),
        (ACTIONS[4], "POST /containers/p/restart", 404, "No such container: p"),
        (ACTIONS[5], "POST /containers/p/unpause", 500, "Container p is not paused"),
        (ACTIONS[6], "POST /containers/p/rename", 400, "same name as its current name"),
        (ACTIONS[7], "POST /networks/app/connect", 403, "endpoint already exists in network app"),
        (ACTIONS[8], "POST /networks/app/disconnect", 500, "box is not connected to network app"),
        (ACTIONS[9], "POST /containers/box/stop", 500, "can't stop"),
        (ACTIONS[9], "DELETE /containers/box", 409, "removal of box is already in progress"),
    ],
)
async def test_what_is_done_already_is_no_error(
    engine: FakeEngine, action: Action, call: str, status: int, said: str
) -> None:
    engine.refuses[call] = (status, said)
    await carry_out(action)
    assert call in engine.calls


@pytest.mark.parametrize("action", ACTIONS)
async def test_anything_else_is_an_error(engine: FakeEngine, action: Action) -> None:
    await carry_out(action)
    engine.refuses = dict.fromkeys(engine.calls.keys() - {"GET /version"}, (500, "no"))
    with pytest.raises(EngineError, match="no"):
        await carry_out(action)


@pytest.mark.parametrize(
    "inspected",
    [
        {"Config": {"Labels": None}},
        {"Config": {"Labels": own_labels(BOX), "User": "root"}, "HostConfig": {}},
    ],
    ids=["without labels", "with forged labels"],
)
async def test_a_name_that_a_stranger_has(engine: FakeEngine, inspected: dict[str, Any]) -> None:
    engine.refuses["POST /containers/create"] = (409, "in use")
    engine.knows[f"/containers/{BOX.name}/json"] = inspected
    with pytest.raises(EngineError, match=f"{BOX.name} exists already that this operator"):
        await carry_out(ACTIONS[1])
