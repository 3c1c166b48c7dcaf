"""A proxy that has retired, but was not removed, is replaced if a container needs it again."""

import asyncio
from collections.abc import AsyncIterator, Mapping
from typing import Any

import pytest

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.documents.status_document import ProxyStatus
from rosproxy_operator.common.operator_metrics import DockerMetrics
from rosproxy_operator.common.proxy_client import ProxyClient, ProxyError
from rosproxy_operator.docker import controller, host_status
from rosproxy_operator.docker.controller import DockerController
from rosproxy_operator.docker.host_status import survey
from rosproxy_operator.docker.planner.actions import Create, CreateSandbox
from rosproxy_operator.docker.planner.specs import (
    container_config,
    own_labels,
    proxy_name,
    sandbox_config,
)
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.proxy_spec.place import Master, Place
from tests.unit.operator.docker import captured
from tests.unit.operator.docker.builders import HERE, IMAGE, inspection
from tests.unit.operator.docker.conftest import FakeEngine

SETTINGS = PlanSettings(advertise_host=HERE, secret="secret", grace=0.0)
PLACE = Place(Master("http://192.0.2.7:11311"), HERE)
BOX_ID = "b" * 64
NAME = proxy_name(PLACE)
CREATION = "POST /containers/create"
REMOVAL = f"DELETE /containers/{NAME}"
REASON = "the proxy has unregistered its nodes, and accepts no others"


class Proxies(ProxyClient):
    """A proxy that retires, and then refuses changes of containers."""

    def __init__(self) -> None:
        super().__init__()
        self.known_status = ProxyStatus()

    async def status(self, admin: HostPort) -> ProxyStatus:
        return self.known_status

    async def retire(self, admin: HostPort, token: str) -> dict[str, Any]:
        self.known_status = ProxyStatus(retired=True)
        return {"unregistered": 1}

    async def send_policy(self, *_: object) -> None:
        pass

    async def send_selected(self, *_: object) -> None:
        pass

    async def send_containers(
        self, admin: HostPort, token: str, body: Mapping[str, Any]
    ) -> dict[str, Any]:
        if self.known_status.retired:
            raise ProxyError("retired")
        return {}


@pytest.fixture
def proxies(monkeypatch: pytest.MonkeyPatch) -> Proxies:
    client = Proxies()
    for module in (controller, host_status):
        monkeypatch.setattr(module, "ProxyClient", lambda: client)
    return client


@pytest.fixture
async def operator(engine: FakeEngine, proxies: Proxies) -> AsyncIterator[DockerController]:
    """An operator on a host with a labelled container and its proxy, as the operator plans it."""
    engine.knows["/version"] = {"ApiVersion": "1.42"}  # the operator need not delete UDP entries
    engine.knows["/networks"] = [
        captured.network(),
        {**captured.network(), "Name": SETTINGS.uplink, "Id": "u" * 64},
    ]
    engine.knows[f"/images/{SETTINGS.proxy_image}/json"] = {"Id": IMAGE}
    talker = captured.running()
    talker["Labels"] |= {"rosproxy.master-uri": PLACE.master.uri}
    inspected = captured.inspected()
    inspected["Config"]["Env"] = ["ROS_MASTER_URI=http://rosproxy:11311"]
    engine.add(talker, inspected)
    operator = DockerController(SETTINGS, 30.0, DockerMetrics())
    await operator.look()
    assert operator._last
    planned = operator._last[1].actions
    (box,) = [action for action in planned if isinstance(action, CreateSandbox)]
    (process,) = [action for action in planned if isinstance(action, Create)]
    await operator._close()
    ends = {
        "app": captured.end("e", "172.29.0.9"),
        SETTINGS.uplink: captured.end("f", "172.30.0.2"),
    }
    add(engine, box, BOX_ID, sandbox_config(box, SETTINGS), ends)
    add(engine, process, "p" * 64, container_config(process, SETTINGS, "secret", ""), {})
    engine.calls.clear()
    operator = DockerController(SETTINGS, 30.0, DockerMetrics())
    yield operator
    await operator._close()


def add(
    engine: FakeEngine,
    spec: CreateSandbox | Create,
    number: str,
    body: dict[str, Any],
    ends: dict[str, Any],
) -> None:
    mode = f"container:{BOX_ID}" if isinstance(spec, Create) else SETTINGS.uplink
    row = captured.running() | {
        "Id": number,
        "Names": [f"/{spec.name}"],
        "Labels": own_labels(spec),
        "HostConfig": {"NetworkMode": mode},
        "NetworkSettings": {"Networks": ends},
    }
    body = {**body, "HostConfig": {**body["HostConfig"], "NetworkMode": mode}}
    names = {"Aliases": [spec.name, "rosproxy", NAME]}
    made = inspection(body) | {
        "State": {"Status": "running", "StartedAt": "2026-01-01T10:00:00Z"},
        "NetworkSettings": {"Networks": dict.fromkeys(ends, names)},
    }
    engine.add(row, made)
    engine.knows[f"/containers/{spec.name}/json"] = made


async def look_until(operator: DockerController, engine: FakeEngine, call: str) -> None:
    """Look again and again until the operator has made a call to the engine, and is idle."""
    async with asyncio.timeout(30):
        while call not in engine.calls or operator._executor.busy:
            await operator.look()
            await asyncio.sleep(0.01)


async def test_a_container_that_is_labelled_again_gets_another_proxy(
    operator: DockerController, engine: FakeEngine
) -> None:
    """The engine fails to remove the proxy once, after the proxy has retired."""
    await operator.look()
    assert operator._last
    assert not operator._last[1].actions

    talker = engine.rows[0]
    labels = talker["Labels"]
    talker["Labels"] = {}
    engine.refuses[REMOVAL] = (500, "driver failed")
    await look_until(operator, engine, REMOVAL)
    assert CREATION not in engine.calls

    engine.refuses.clear()
    engine.knows[f"/containers/{NAME}-old/json"] = engine.knows[f"/containers/{NAME}/json"]
    talker["Labels"] = labels
    await look_until(operator, engine, f"DELETE /containers/{NAME}-old")
    assert [action for action in map(str, operator._last[1].actions) if REASON in action]
    assert engine.calls.keys() >= {CREATION, f"POST /containers/{NAME}/rename"}


async def test_an_operator_that_has_just_started_finds_a_proxy_that_has_retired(
    operator: DockerController, engine: FakeEngine, proxies: Proxies
) -> None:
    """Also after the container has another name, since the former name leads to no status."""
    proxies.known_status = ProxyStatus(retired=True)
    await look_until(operator, engine, CREATION)
    engine.rows[-1]["Names"] = [f"/{NAME}-old"]
    await operator.look()
    assert operator._last
    assert operator._last[0].state.retired == {f"{NAME}-old"}


async def test_the_command_plan_knows_it_without_an_operator(
    operator: DockerController, proxies: Proxies
) -> None:
    assert not (await survey(SETTINGS))["actions"]
    proxies.known_status = ProxyStatus(retired=True)
    assert REASON in str((await survey(SETTINGS))["actions"])
