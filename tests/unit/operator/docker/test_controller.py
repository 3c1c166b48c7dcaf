"""The controller with a fake engine."""

import asyncio
from dataclasses import replace
from typing import Any

import pytest
from msgspec import structs

from rosproxy.shared.addresses import HostPort
from rosproxy_operator.common.control_loop import LookFailed
from rosproxy_operator.common.master_resolver import MasterResolver
from rosproxy_operator.common.operator_metrics import DockerMetrics
from rosproxy_operator.common.problem import Problem
from rosproxy_operator.docker import snapshot
from rosproxy_operator.docker.controller import DockerController
from rosproxy_operator.docker.engine_client import DockerClient
from rosproxy_operator.docker.planner.actions import Create, CreateRedirect, CreateSandbox
from rosproxy_operator.docker.planner.plan import plan
from rosproxy_operator.docker.planner.redirect import _with_fingerprint, redirect_config
from rosproxy_operator.docker.planner.specs import (
    container_config,
    own_labels,
    proxy_name,
    proxy_token,
    sandbox_config,
    sandbox_name,
)
from rosproxy_operator.docker.planner.state import DockerMemory
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.docker.snapshot import DockerObserver
from tests.unit.operator.docker import captured
from tests.unit.operator.docker.builders import IMAGE, PLACE, RANGE, inspection
from tests.unit.operator.docker.conftest import FakeEngine

SETTINGS = PlanSettings(advertise_host=PLACE.advertise_host, secret="secret")
BOX = CreateSandbox(sandbox_name(PLACE), PLACE, RANGE, fingerprint="f")
PROCESS = Create(proxy_name(PLACE), PLACE, RANGE, sandbox_name(PLACE), fingerprint="f")
TOKEN = proxy_token(PLACE, "secret")


def own(
    spec: CreateSandbox | Create | CreateRedirect, number: str, network: str, address: str
) -> dict[str, Any]:
    ends = {network: captured.end("e", address)} if address else {}
    return captured.running() | {
        "Id": number,
        "Names": [f"/{spec.name}"],
        "Labels": own_labels(spec),
        "HostConfig": {"NetworkMode": network},
        "NetworkSettings": {"Networks": ends},
    }


@pytest.fixture(autouse=True)
def containers(engine: FakeEngine) -> None:
    """A labelled container with the name of its master, and a proxy in a sandbox."""
    engine.knows["/networks"] = [captured.network()]
    state = {"State": {"Status": "running", "StartedAt": "1"}}
    details = captured.inspected() | state
    details["NetworkSettings"] = {"Networks": {"app": {"Aliases": ["robot"]}}}
    engine.add(captured.running(), details)
    made = inspection(sandbox_config(BOX, SETTINGS)) | state
    engine.add(own(BOX, "b" * 64, SETTINGS.uplink, "172.30.0.2"), made)
    process = inspection(container_config(PROCESS, SETTINGS, "secret", "")) | state
    engine.add(own(PROCESS, "p" * 64, f"container:{'b' * 64}", ""), process)


def observer() -> DockerObserver:
    return DockerObserver(DockerClient(), SETTINGS, MasterResolver(lambda: None), lambda: None)


async def test_a_look_finds_containers_labels_masters_and_proxies() -> None:
    look = await observer().look(5.0)
    state = look.state
    name = proxy_name(PLACE)
    assert [container.name for container in state.containers] == ["talker"]
    assert [box.container.name for box in state.sandboxes] == [sandbox_name(PLACE)]
    assert [(proxy.place, proxy.range) for proxy in state.proxies] == [(PLACE, RANGE)]
    assert [request.place.master.uri for request in look.labels.requests] == [PLACE.master.uri]
    assert state.masters == {"robot": "172.29.0.2"}  # the name of a container, not of a name server
    assert not state.busy
    assert state.addresses >= {"172.29.0.2", "172.30.0.2"}
    access = look.access[name]
    assert (str(access.admin), access.token) == ("172.30.0.2:11312", TOKEN)
    assert "secret" not in repr(look)
    assert TOKEN not in repr(look)


async def test_a_proxy_that_was_made_with_its_token_is_told_it(engine: FakeEngine) -> None:
    engine.knows[f"/containers/{'p' * 64}/json"]["Config"]["Env"] = ["ROSPROXY_ADMIN_TOKEN=old"]
    look = await observer().look(5.0)
    assert [access.token for access in look.access.values()] == ["old"]


async def test_without_a_file_the_secret_is_the_uplinks(engine: FakeEngine) -> None:
    settings = replace(SETTINGS, secret="")
    looking = DockerObserver(DockerClient(), settings, MasterResolver(print), print)
    fresh = (await looking.look(5.0)).state.secret
    assert fresh == (await looking.look(5.0)).new_secret  # for the network that is going to be made
    uplink = captured.network() | {"Name": SETTINGS.uplink}
    engine.knows["/networks"].append(uplink | {"Labels": {"io.rosproxy.secret": "kept"}})
    assert (await looking.look(5.0)).state.secret == "kept"
    assert (await observer().look(5.0)).state.secret == "secret"


def forged(number: str, name: str, **more: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    """A container of an image that has all that an image can have of a sandbox."""
    row = own(structs.replace(BOX, name=name), number, "app", "172.29.0.66")
    body = {**sandbox_config(BOX, SETTINGS), "HostConfig": {"NetworkMode": "app"}}
    return row, inspection(body, State={"Status": "running", "StartedAt": "1"}, **more)


@pytest.mark.parametrize("name", ["evil", BOX.name])
async def test_a_forged_container_is_told_and_left_alone(engine: FakeEngine, name: str) -> None:
    """Also if only the name is forged."""
    del engine.rows[1:]
    engine.knows[f"/images/{SETTINGS.proxy_image}/json"] = {"Id": IMAGE}
    row, inspected = forged("e" * 64, name)
    inspected["HostConfig"]["PortBindings"] = {"80/tcp": [{"HostPort": "11400"}]}
    engine.add(row, inspected)
    look = await observer().look(5.0)
    assert not look.state.own
    assert not look.state.busy
    assert not look.access
    container = next(c for c in look.state.containers if c.name == name)
    assert container.host_ports == {18080, 11400}
    planned = plan(look.state, look.labels, SETTINGS, DockerMemory(), 0.0)
    assert CreateSandbox in map(type, planned.actions)
    assert name not in {action.name for action in planned.actions}
    (told,) = [
        problem.message for problem in planned.problems if problem.subject == f"container {name}"
    ]
    assert "ignores them" in told
    assert f"docker rm -f {name}" in told
    assert not any(11400 in ports for ports in planned.memory.planned.values())


async def test_a_forged_container_does_not_delay_own_containers(engine: FakeEngine) -> None:
    """The container claims to be a sandbox of the same place, and is not inspected yet."""
    row, _ = forged("e" * 64, "evil")
    engine.rows.append(row)
    look = await observer().look(5.0)
    assert [box.container.name for box in look.state.sandboxes] == [BOX.name]
    assert not look.state.busy


async def test_what_is_not_inspected_yet_is_busy_or_left_out(engine: FakeEngine) -> None:
    for row in engine.rows:
        del engine.knows[f"/containers/{row['Id']}/json"]
    look = await observer().look(5.0)
    assert not look.state.containers
    assert look.state.busy == {proxy_name(PLACE), sandbox_name(PLACE)}
    assert look.state.masters == {"robot": ""}


async def test_a_container_in_the_network_of_an_uninspected_container_waits(
    engine: FakeEngine,
) -> None:
    """This is no fault of the user: Compose starts both at the same moment."""
    talker = engine.rows[0]["Id"]
    inspected = engine.knows.pop(f"/containers/{talker}/json")
    beside = captured.running() | {
        "Id": "c" * 64,
        "Names": ["/beside"],
        "HostConfig": {"NetworkMode": f"container:{talker}"},
        "NetworkSettings": {"Networks": {}},
    }
    engine.add(beside, {**inspected, "NetworkSettings": {"Networks": {}}})
    looking = observer()
    look = await looking.look(5.0)
    assert not look.labels.problems
    engine.knows[f"/containers/{talker}/json"] = inspected
    look = await looking.look(5.0)
    assert [c.name for c in look.state.containers] == ["talker", "beside"]
    assert not look.labels.problems


@pytest.mark.parametrize(
    "garbage", [[], {"Config": 1}, {"NetworkSettings": {"Networks": {"app": {"Aliases": [5]}}}}]
)
async def test_an_inspection_that_cannot_be_read_harms_no_other_container(
    garbage: object, engine: FakeEngine, caplog: pytest.LogCaptureFixture
) -> None:
    engine.add(captured.running() | {"Id": "c" * 64, "Names": ["/odd"]}, captured.inspected())
    engine.knows[f"/containers/{'c' * 64}/json"] = garbage
    looking = observer()
    for _ in range(2):
        look = await looking.look(5.0)
        assert [container.name for container in look.state.containers] == ["talker"]
        assert not look.state.busy
    (told,) = caplog.messages
    assert told.startswith(f"container {'c' * 12}: the data of docker inspect can't be read: ")
    engine.knows[f"/containers/{'c' * 64}/json"] = captured.inspected()
    assert len((await looking.look(5.0)).state.containers) == 2


async def test_a_list_that_is_behind_the_inspection_makes_busy(engine: FakeEngine) -> None:
    engine.knows[f"/containers/{'p' * 64}/json"]["State"] = {"Status": "exited"}
    look = await observer().look(5.0)
    assert look.state.busy == {proxy_name(PLACE)}


async def test_an_inspection_of_before_makes_busy(engine: FakeEngine) -> None:
    looking = observer()
    await looking.look(5.0)
    del engine.knows[f"/containers/{'p' * 64}/json"]
    looking.note_event("p" * 64)
    look = await looking.look(5.0)
    assert look.state.busy == {proxy_name(PLACE)}
    assert look.access[proxy_name(PLACE)].token == TOKEN


def inspected_again(engine: FakeEngine) -> set[str]:
    """The first letters of the ids of containers that were inspected since the last question."""
    asked = {call.split("/")[2][0] for call in engine.calls if call.endswith("/json")}
    engine.calls.clear()
    return asked & {row["Id"][0] for row in engine.rows}


async def test_what_nothing_happened_to_is_not_inspected_again(engine: FakeEngine) -> None:
    looking = observer()
    await looking.look(5.0)
    assert inspected_again(engine) == {row["Id"][0] for row in engine.rows}
    await looking.look(5.0)
    assert inspected_again(engine) == set()
    for container, again in (("p" * 64, {"p"}), ("x" * 64, {"p"}), (None, {"p", "b"})):
        looking.note_event(container)
        assert not (await looking.look(5.0)).state.busy
        assert inspected_again(engine) == again


async def test_a_doubt_is_good_for_one_look_however_late(
    engine: FakeEngine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(snapshot, "REINSPECTED_FOR_S", 0.0)
    looking = observer()
    first = (await looking.look(5.0)).access[proxy_name(PLACE)].run
    engine.knows[f"/containers/{'p' * 64}/json"]["State"]["StartedAt"] = "2"
    for container in ("p" * 64, None):
        looking.note_event(container)
        await asyncio.sleep(0.01)
        assert (await looking.look(5.0)).access[proxy_name(PLACE)].run != first
        engine.calls.clear()
        await looking.look(5.0)
        assert not inspected_again(engine)


async def test_a_redirect_that_was_run_again_is_inspected_again(engine: FakeEngine) -> None:
    """In the list of containers the redirect has exited, before and after."""
    looking = observer()
    seen = replace((await looking.look(5.0)).state, image_id=IMAGE)
    master = HostPort("192.0.2.7", 11311)
    made = CreateRedirect("", PLACE, RANGE, "c" * 64, "1", (master,), HostPort("172.18.0.9", 11311))
    made = _with_fingerprint(made, seen, SETTINGS)
    row = own(made, "r" * 64, f"container:{'c' * 64}", "") | {"State": "exited"}
    state = {"Status": "exited", "StartedAt": "1", "ExitCode": 1}
    engine.add(row, inspection(redirect_config(made, SETTINGS)) | {"State": state})
    assert [redirect.done for redirect in (await looking.look(5.0)).state.redirects] == [False]
    state["ExitCode"] = 0
    looking.note_event("r" * 64)
    assert [redirect.done for redirect in (await looking.look(5.0)).state.redirects] == [True]


async def test_the_list_tells_that_a_proxy_has_ended(engine: FakeEngine) -> None:
    looking = observer()
    await looking.look(5.0)
    engine.rows[2]["State"] = "exited"
    engine.knows[f"/containers/{'p' * 64}/json"]["State"] = {"Status": "exited"}
    look = await looking.look(5.0)
    assert not look.state.busy
    assert not look.access
    assert inspected_again(engine) >= {"p"}


async def test_a_start_that_no_event_told_is_found(
    engine: FakeEngine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By a separate check, which causes a look only after a change."""
    monkeypatch.setattr(snapshot, "CHECK_INTERVAL_S", 0.0)
    told: list[bool] = []
    resolver = MasterResolver(lambda: None)
    looking = DockerObserver(DockerClient(), SETTINGS, resolver, lambda: told.append(True))

    async def look() -> str:
        host_snapshot = await looking.look(5.0)
        assert not looking.waiting
        return host_snapshot.access[proxy_name(PLACE)].run

    first = await look()
    assert inspected_again(engine) >= {"p"}
    while not inspected_again(engine):
        assert await look() == first
        await asyncio.sleep(0.01)
    assert not told
    engine.knows[f"/containers/{'p' * 64}/json"]["State"]["StartedAt"] = "2"
    async with asyncio.timeout(5.0):
        while not told:
            await look()
            await asyncio.sleep(0.01)
    assert await look() != first


@pytest.mark.parametrize(("state", "is_told"), [("exited", True), ("created", False)])
async def test_the_page_tells_of_a_proxy_that_has_ended(
    engine: FakeEngine, state: str, is_told: bool
) -> None:
    """A proxy that has not started yet is not broken."""
    engine.rows[-1]["State"] = state
    controller = DockerController(SETTINGS, 30.0, DockerMetrics())
    assert await controller.documents() == {}
    await controller.look()
    wanted = {proxy_name(PLACE): "the proxy's container is exited"} if is_told else {}
    assert await controller.documents() == wanted


async def test_the_page_tells_of_problems_of_the_operator(engine: FakeEngine) -> None:
    """An unknown variable, and a container with an unknown label."""
    mistake = Problem("variable ROSPROXY_X", "unknown", fatal=False, reason="X")
    controller = DockerController(SETTINGS, 30.0, DockerMetrics(), mistakes=[mistake])
    assert controller.problems() == {}
    row = captured.running() | {"Id": "c" * 64, "Names": ["/odd"]}
    row["Labels"] = {"ros-proxy.enable": "true"}
    inspected = captured.inspected()
    inspected["Config"]["Labels"] = row["Labels"]
    engine.add(row, inspected)
    await controller.look()
    subjects = {problem.subject for problem in controller.problems()}
    assert subjects >= {"variable ROSPROXY_X", "container odd"}


async def test_once_tells_what_is_not_as_wanted(engine: FakeEngine) -> None:
    del engine.rows[1:]
    metrics = DockerMetrics()
    controller = DockerController(SETTINGS, 30.0, metrics)
    problems = await controller.run_once(0.5)
    assert [problem.subject for problem in problems] == [
        f"proxy image {SETTINGS.proxy_image}",
        f"proxy {proxy_name(PLACE)}",
    ]
    assert controller.unready() is None
    assert metrics.registry.get_sample_value("rosproxy_operator_engine_up") == 1.0
    assert metrics.registry.get_sample_value("rosproxy_operator_containers") == 1.0
    for state in ("busy", "failed"):
        assert metrics.registry.get_sample_value("rosproxy_operator_jobs", {"state": state}) == 0


async def test_once_without_an_engine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DOCKER_HOST", "unix:///nowhere")
    with pytest.raises(LookFailed, match="socket /nowhere of the Docker engine does not exist"):
        await DockerController(SETTINGS, 30.0, DockerMetrics()).run_once(5.0)
