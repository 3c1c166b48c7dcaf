"""Looks at an engine that is given by the test, and what the controller makes of them."""

import pytest

from rosproxy_operator.common.control_loop import LookFailed
from rosproxy_operator.common.metrics import DockerMetrics
from rosproxy_operator.common.resolver import MasterResolver
from rosproxy_operator.docker import controller as module
from rosproxy_operator.docker.client import DockerClient, Json
from rosproxy_operator.docker.controller import DockerController
from rosproxy_operator.docker.errors import Gone, Unavailable
from rosproxy_operator.docker.planner.actions import Create, CreateSandbox
from rosproxy_operator.docker.planner.model import PlanSettings
from rosproxy_operator.docker.planner.specs import own_labels, proxy_name, sandbox_name
from rosproxy_operator.docker.settings import DockerSettings
from rosproxy_operator.docker.snapshot import DockerObserver
from tests.unit.operator.docker import captured
from tests.unit.operator.docker.builders import KEY, RANGE

SETTINGS = PlanSettings(advertise_host=KEY.advertise_host)


class FakeEngine(DockerClient):
    """Lists ``rows`` and inspects ``inspected``; there is no image."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[Json] = []
        self.inspected: dict[str, Json] = {}
        self.away = False

    def containers(self) -> list[Json]:
        if self.away:
            raise Unavailable("no engine")
        return self.rows

    def container(self, name: str) -> Json:
        if name not in self.inspected:
            raise Gone(f"no such container: {name}")
        return self.inspected[name]

    def networks(self) -> list[Json]:
        return [captured.network()]

    def image_id(self, image: str) -> str:
        return ""

    def add(self, row: Json, inspected: Json) -> None:
        self.rows.append(row)
        self.inspected[row["Id"]] = inspected


def own(spec: CreateSandbox | Create, number: str, network: str, address: str) -> Json:
    ends = {network: captured.end("e", address)} if address else {}
    return captured.running() | {
        "Id": number,
        "Names": [f"/{spec.name}"],
        "Labels": own_labels(spec),
        "HostConfig": {"NetworkMode": network},
        "NetworkSettings": {"Networks": ends},
    }


@pytest.fixture
def engine() -> FakeEngine:
    """A labelled container, which is called as its master is, and a proxy in its sandbox."""
    engine = FakeEngine()
    details = captured.inspected() | {"State": {"Status": "running", "StartedAt": "1"}}
    details["NetworkSettings"] = {"Networks": {"app": {"Aliases": ["robot"]}}}
    engine.add(captured.running(), details)
    box = CreateSandbox(sandbox_name(KEY), KEY, RANGE, "f")
    engine.add(own(box, "b" * 64, SETTINGS.uplink, "172.30.0.2"), details)
    process = Create(proxy_name(KEY), KEY, RANGE, sandbox_name(KEY), fingerprint="f")
    token = {"Config": {"Env": ["ROSPROXY_ADMIN_TOKEN=secret"]}, "State": details["State"]}
    engine.add(own(process, "p" * 64, f"container:{'b' * 64}", ""), token)
    return engine


def observer(engine: FakeEngine) -> DockerObserver:
    return DockerObserver(engine, SETTINGS, MasterResolver(lambda: None), lambda: None)


async def test_a_look_finds_containers_labels_masters_and_proxies(engine: FakeEngine) -> None:
    look = await observer(engine).look(5.0)
    state, name = look.state, proxy_name(KEY)
    assert [container.name for container in state.containers] == ["talker"]
    assert [box.container.name for box in state.sandboxes] == [sandbox_name(KEY)]
    assert [(proxy.key, proxy.range) for proxy in state.proxies] == [(KEY, RANGE)]
    assert [request.key.master_uri for request in look.labels.requests] == [KEY.master_uri]
    assert look.masters == {"robot": "172.29.0.2"}  # no name server has it, but a container
    assert not state.unresolved
    assert not state.busy
    assert state.addresses >= {"172.29.0.2", "172.30.0.2"}
    access = look.access[name]
    assert (str(access.admin), access.token) == ("172.30.0.2:11312", "secret")
    assert look.tokens == {name: "secret"}


async def test_what_is_not_inspected_yet_is_busy_or_left_out(engine: FakeEngine) -> None:
    engine.inspected.clear()
    look = await observer(engine).look(5.0)
    assert not look.state.containers
    assert look.state.busy == {proxy_name(KEY), sandbox_name(KEY)}
    assert look.state.unresolved == {"robot"}


async def test_a_list_that_is_behind_the_inspection_makes_busy(engine: FakeEngine) -> None:
    engine.inspected["p" * 64]["State"] = {"Status": "exited"}
    look = await observer(engine).look(5.0)
    assert look.state.busy == {proxy_name(KEY)}


async def test_once_tells_what_is_not_as_wanted(
    engine: FakeEngine, monkeypatch: pytest.MonkeyPatch
) -> None:
    del engine.rows[1:]
    monkeypatch.setattr(module, "DockerClient", lambda: engine)
    monkeypatch.setattr(engine, "events", lambda _: iter(()))
    metrics = DockerMetrics()
    controller = DockerController(DockerSettings(SETTINGS), metrics)
    problems = await controller.run_once(0.3)
    assert [problem.subject for problem in problems] == [
        f"proxy image {SETTINGS.image}",
        f"proxy {proxy_name(KEY)}",
    ]
    assert controller.unready() is None
    assert metrics.registry.get_sample_value("rosproxy_operator_engine_up") == 1.0
    assert metrics.registry.get_sample_value("rosproxy_operator_containers") == 1.0


async def test_once_without_an_engine(engine: FakeEngine, monkeypatch: pytest.MonkeyPatch) -> None:
    engine.away = True
    monkeypatch.setattr(module, "DockerClient", lambda: engine)
    monkeypatch.setattr(engine, "events", lambda _: iter(()))
    controller = DockerController(DockerSettings(SETTINGS), DockerMetrics())
    with pytest.raises(LookFailed, match="no engine"):
        await controller.run_once(5.0)
