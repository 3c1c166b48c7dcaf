"""What is called at an engine on loopback, and what is made of its answers."""

import re
from pathlib import Path
from typing import Any

import pytest

from rosproxy_operator.common.proxy_client import ProxyClient
from rosproxy_operator.docker.client import DockerClient
from rosproxy_operator.docker.errors import EngineError
from rosproxy_operator.docker.executor import DockerApplier
from rosproxy_operator.docker.planner.actions import (
    Action,
    Connect,
    Create,
    CreateNetwork,
    CreateSandbox,
    Disconnect,
    Remove,
    Rename,
    Restart,
    Start,
    Unpause,
)
from rosproxy_operator.docker.planner.labels.members import LabelReading
from rosproxy_operator.docker.planner.specs import own_labels
from rosproxy_operator.docker.snapshot import DockerSnapshot
from tests.unit.operator.docker.builders import KEY, RANGE, SETTINGS, observed
from tests.unit.operator.docker.conftest import FakeEngine

PERMISSIONS = Path(__file__).parents[4] / "docs/reference/permissions.md"
BOX = CreateSandbox("box", KEY, RANGE)
SEEN = observed(masters={"robot": "192.0.2.7"})
LOOK = DockerSnapshot(SEEN, LabelReading(), {}, {KEY: "secret"}, at_host=True)
ACTIONS: list[Action] = [
    CreateNetwork("0-rosproxy"),
    BOX,
    Create("p", KEY, RANGE, "box"),
    Start("p"),
    Restart("p"),
    Unpause("p"),
    Rename("p", "q"),
    Connect("box", "app", ("robot",)),
    Disconnect("box", "app"),
    Remove("box", "", stop=True),
]


@pytest.fixture(autouse=True)
def container_on_two_networks(engine: FakeEngine) -> None:
    networks: dict[str, Any] = {"app": {}, SETTINGS.uplink: {}}
    box = {"Config": {"Labels": own_labels(BOX)}, "NetworkSettings": {"Networks": networks}}
    engine.knows["/containers/box/json"] = box
    engine.knows["/images/rosproxy:latest/json"] = {"Id": "sha256:1"}


async def carry_out(action: Action) -> None:
    await DockerApplier(DockerClient(), SETTINGS, ProxyClient()).carry_out(action, LOOK)


async def test_the_documentation_lists_exactly_what_is_called(engine: FakeEngine) -> None:
    client = DockerClient()
    assert client.containers() == client.networks() == []
    assert client.image_id("rosproxy:latest") == "sha256:1"
    assert list(client.events()) == [{"Action": "start"}]
    for action in ACTIONS:
        await carry_out(action)
    listed = re.findall(r"^(?:GET|POST|DELETE) /\S+$", PERMISSIONS.read_text(), re.M)
    assert [
        call for call in listed if not any(re.fullmatch(call, one) for one in engine.calls)
    ] == []
    assert [
        one for one in engine.calls if not any(re.fullmatch(call, one) for call in listed)
    ] == []


async def test_a_proxy_keeps_its_token_and_is_told_its_masters_address(engine: FakeEngine) -> None:
    await carry_out(ACTIONS[2])
    variables = engine.calls["POST /containers/create"]["Env"]
    assert "ROSPROXY_ADMIN_TOKEN=secret" in variables
    assert "ROSPROXY_MASTER_ADDRESS=192.0.2.7" in variables


async def test_what_is_removed_leaves_its_networks_but_the_uplink(engine: FakeEngine) -> None:
    engine.refuses["POST /networks/app/disconnect"] = (404, "network app not found")
    await carry_out(ACTIONS[-1])
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
        (ACTIONS[1], "POST /containers/create", 409, "The name box is already in use"),
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


async def test_a_name_that_a_stranger_has(engine: FakeEngine) -> None:
    engine.refuses["POST /containers/create"] = (409, "in use")
    engine.knows["/containers/box/json"] = {"Config": {"Labels": None}}
    with pytest.raises(EngineError, match="not this operator's is called box; rename it"):
        await carry_out(ACTIONS[1])
