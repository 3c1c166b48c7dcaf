"""The status of a running operator, and allowed callers."""

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack
from typing import Any

import aiohttp
import pytest
from prometheus_client import CollectorRegistry
from prometheus_client.exposition import generate_latest

from examples.demo.fake_http import free_ports
from rosproxy import __version__
from rosproxy.shared.addresses import HostPort
from rosproxy_operator.common import operator_admin
from rosproxy_operator.common.control_loop import LookFailed
from rosproxy_operator.common.operator_admin import MOST_CONNECTIONS, OperatorAdminServer
from rosproxy_operator.common.operator_page import operator_page
from rosproxy_operator.docker import host_status
from rosproxy_operator.docker.host_status import HostStatus
from rosproxy_operator.docker.settings import PlanSettings
from tests.integration.net import connect, exchange
from tests.integration.proxy import Proxy

ASK = b"GET /healthz HTTP/1.1\r\nHost: x\r\n\r\n"
SETTINGS = PlanSettings()
DOCUMENT = {"version": __version__, "uplink": "0-rosproxy", "actions": ["start container x"]}


class RunningOperator:
    """The endpoint of an operator with ``document``, or with an error."""

    def __init__(self) -> None:
        self.document: dict[str, Any] = DOCUMENT
        self.error: LookFailed | None = None
        self.address = HostPort("127.0.0.1", free_ports(1))

        async def status() -> dict[str, Any]:
            if self.error:
                raise self.error
            return self.document

        async def documents() -> dict[str, Any]:
            return {}

        page = operator_page(documents, "docker logs {}".format)
        self.server = OperatorAdminServer(
            CollectorRegistry(), lambda: None, lambda: None, page, status
        )


@pytest.fixture
async def operator() -> AsyncIterator[RunningOperator]:
    running = RunningOperator()
    await running.server.start(running.address)
    yield running
    await running.server.stop()


@pytest.fixture(autouse=True)
def own_look(monkeypatch: pytest.MonkeyPatch) -> None:
    """A fake look of the command itself."""

    async def survey(settings: PlanSettings) -> dict[str, Any]:
        assert settings is SETTINGS
        return {"actions": []}

    monkeypatch.setattr(host_status, "survey", survey)


async def test_the_operator_that_runs_is_asked(operator: RunningOperator) -> None:
    told = await HostStatus(SETTINGS, operator.address).now()
    assert told == {**DOCUMENT, "operator": f"http://{operator.address}"}


async def test_one_that_listens_everywhere_is_asked_on_loopback(operator: RunningOperator) -> None:
    told = await HostStatus(SETTINGS, HostPort("0.0.0.0", operator.address.port)).now()
    assert told["operator"] == f"http://{operator.address}"


async def test_without_one_the_command_looks_by_itself(proxy: Proxy) -> None:
    """Also where something else listens, such as a proxy."""
    for address in (None, HostPort("127.0.0.1", free_ports(1)), proxy.settings.admin):
        assert await HostStatus(SETTINGS, address).now() == {"actions": [], "operator": None}


@pytest.mark.parametrize("document", [{**DOCUMENT, "version": "0.0.1"}, {"uplink": 1}, ["uplink"]])
async def test_what_another_version_tells_is_not_believed(
    document: Any, operator: RunningOperator
) -> None:
    operator.document = document
    assert (await HostStatus(SETTINGS, operator.address).now())["operator"] is None


async def test_one_that_can_not_look_says_why(operator: RunningOperator) -> None:
    operator.error = LookFailed("no engine answers")
    async with (
        aiohttp.ClientSession() as session,
        session.get(f"http://{operator.address}/status") as reply,
    ):
        assert (reply.status, await reply.text()) == (503, "no engine answers\n")
    assert (await HostStatus(SETTINGS, operator.address).now())["operator"] is None


async def test_pages_of_strangers_do_not_get_it(operator: RunningOperator) -> None:
    """By a name of theirs that leads to loopback."""
    async with (
        aiohttp.ClientSession(headers={"Host": "evil.example"}) as session,
        session.get(f"http://{operator.address}/status") as reply,
    ):
        assert reply.status == 403
        assert "uplink" not in await reply.text()


async def test_it_is_json(operator: RunningOperator) -> None:
    async with (
        aiohttp.ClientSession() as session,
        session.get(f"http://{operator.address}/status") as reply,
    ):
        assert json.loads(await reply.read()) == DOCUMENT


async def test_a_strangers_name_is_refused_at_every_path(operator: RunningOperator) -> None:
    """A web page with a name for this address must not read /metrics and /readyz (DNS
    rebinding).
    """
    url = f"http://{operator.address}"
    async with aiohttp.ClientSession() as session:
        for path in ("/healthz", "/readyz", "/metrics", "/status", "/", "/page.js"):
            async with session.get(f"{url}{path}", headers={"Host": "evil.example"}) as refused:
                assert refused.status == 403
                assert "does not answer by this name" in await refused.text()
            async with session.get(f"{url}{path}", headers={"Host": "localhost:1"}) as good:
                assert good.status == 200


async def test_an_address_has_a_few_connections(operator: RunningOperator) -> None:
    """Any pod of a cluster could take all files that the operator may open."""
    address = operator.address.host, operator.address.port
    async with AsyncExitStack() as stack:
        other = await stack.enter_async_context(connect(address, "127.0.6.2"))
        wires = [
            await stack.enter_async_context(connect(address, "127.0.6.1"))
            for _ in range(MOST_CONNECTIONS + 1)
        ]
        assert await wires[0].outcome() == "closed"
        for wire in (other, *wires[1:]):
            await wire.send(ASK)
            assert (await wire.reply()).status == 200


async def test_callers_that_ask_at_once_share_one_reply_with_the_metrics(
    operator: RunningOperator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Hundreds of requests for the metrics kept the kubelet's probe waiting for seconds."""
    made = 0

    def counted(registry: CollectorRegistry) -> bytes:
        nonlocal made
        made += 1
        return generate_latest(registry)

    monkeypatch.setattr(operator_admin, "generate_latest", counted)
    address = operator.address.host, operator.address.port
    ask = ASK.replace(b"/healthz", b"/metrics")
    sources = [f"127.0.5.{number}" for number in range(16)]
    replies = await asyncio.gather(*(exchange(address, ask, source) for source in sources))
    assert {reply.status for reply in replies} == {200}
    assert 0 < made < len(sources) / 2


@pytest.mark.parametrize(
    ("verb", "path", "status"),
    [("HEAD", "/healthz", 200), ("POST", "/metrics", 405), ("GET", "/nothing", 404)],
)
async def test_other_requests(operator: RunningOperator, verb: str, path: str, status: int) -> None:
    address = operator.address.host, operator.address.port
    async with connect(address) as wire:
        await wire.send(f"{verb} {path} HTTP/1.1\r\nHost: x\r\n\r\n".encode())
        assert (await wire.reply(head=verb == "HEAD")).status == status
