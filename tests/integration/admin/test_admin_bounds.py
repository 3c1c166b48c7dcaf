"""Requests to the admin endpoint: host names, frequency, and readers that read nothing."""

import asyncio
import json
import socket
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from typing import Any

import pytest
from aiohttp import web
from msgspec.structs import replace

from examples.demo.fake_node import FakeNode
from rosproxy.admin.admin_server import MOST_CONNECTIONS, MOST_REPLIES, MOST_REPLIES_EACH
from rosproxy.shared.documents.status_bounds import MOST_BYTES
from rosproxy.shared.documents.status_document import ProblemStatus
from rosproxy.shared.http.admin_client import AdminClient
from rosproxy.shared.http.bounded_server import BoundedServer
from rosproxy.shared.http.replies import PIECE_BYTES, REPLY_TIMEOUT
from tests.clock import pass_time
from tests.integration.admin_calls import tell
from tests.integration.conftest import MakeProxy
from tests.integration.net import HOST, OUTSIDE, Reply, Wire, connect, exchange, until
from tests.integration.proxy import Proxy

TOKEN = "0123456789abcdef"
STRANGE = "evil.example:11312"
GETS = ("/", "/graph", "/events", "/page.js", "/status", "/status/changes", "/metrics")
POSTS = ("/containers", "/policy", "/probe", "/retire", "/page-key", "/login")


async def ask(
    proxy: Proxy,
    path: str,
    *headers: str,
    verb: str = "GET",
    host: str = "x",
    source: str = OUTSIDE,
) -> Reply:
    address = (proxy.settings.admin.host, proxy.settings.admin.port)
    lines = [f"{verb} {path} HTTP/1.1", f"Host: {host}", *headers, "", ""]
    return await exchange(address, "\r\n".join(lines).encode(), source)


@pytest.mark.parametrize("path", [*GETS, "/healthz", "/readyz", "/nothing"])
async def test_a_strangers_name_is_refused_at_every_path(proxy: Proxy, path: str) -> None:
    """A web page with a name for the proxy's address must not read /status and /metrics (DNS
    rebinding).
    """
    refused = await ask(proxy, path, host=STRANGE)
    assert refused.status == 403
    assert refused.body.startswith(b"rosproxy: evil.example:11312: the admin endpoint does not")


@pytest.mark.parametrize("path", POSTS)
async def test_a_strangers_name_is_refused_for_actions(proxy: Proxy, path: str) -> None:
    assert (await ask(proxy, path, "Content-Length: 0", verb="POST", host=STRANGE)).status == 403


async def test_a_name_that_the_proxy_is_known_by(make_proxy: MakeProxy) -> None:
    proxy = await make_proxy(advertise_host="robot.lab.example")
    assert (await ask(proxy, "/status", host="Robot.lab.example:11312")).status == 200
    assert (await ask(proxy, "/", host="robot.lab.example:11312")).status == 200
    assert (await ask(proxy, "/status", host="lab.example")).status == 403


async def test_the_token_is_good_by_any_name(make_proxy: MakeProxy) -> None:
    proxy = await make_proxy(admin_token=TOKEN)
    for path in ("/status", "/metrics", "/status/changes", "/graph"):
        good = await ask(proxy, path, f"Authorization: Bearer {TOKEN}", host=STRANGE)
        assert good.status == 200
        wrong = await ask(proxy, path, "Authorization: Bearer wrong", host=STRANGE)
        assert wrong.status == 403
    form = await ask(proxy, "/", host=STRANGE)
    assert (form.status, b'name="token"' in form.body) == (401, True)


async def test_a_hostile_name_is_repeated_in_short_and_harmless(proxy: Proxy) -> None:
    refused = await ask(proxy, "/status", host=f"evil\x9b.{'x' * 5000}.example")
    assert refused.status == 403
    assert refused.body.isascii() or refused.body.decode().replace("\n", "").isprintable()
    assert len(refused.body) < 500


async def test_readers_that_ask_at_once_share_one_status(
    proxy: Proxy, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = 0
    state = proxy.app._admin._status

    def counted() -> Any:
        nonlocal made
        made += 1
        return state()

    monkeypatch.setattr(proxy.app._admin, "_status", counted)
    sources = [f"127.0.5.{number}" for number in range(MOST_REPLIES)]
    replies = await asyncio.gather(*(ask(proxy, "/status", source=source) for source in sources))
    assert {reply.status for reply in replies} == {200}
    assert 0 < made < MOST_REPLIES / 2


async def test_a_reader_sees_what_was_done_before_it_asked(proxy: Proxy, node: FakeNode) -> None:
    for number in range(5):
        await node.publish(proxy.master, f"/topic_{number}")
        shown = json.loads((await ask(proxy, "/status")).body)
        assert f"/topic_{number}" in shown["nodes"][0]["publishes"]
        layer = {"name": f"layer {number}", "mode": "audit", "rules": ["deny publish /x"]}
        await tell(proxy, "/policy", layers=[layer])
        shown = json.loads((await ask(proxy, "/status")).body)
        assert shown["policy"]["layers"][-1]["name"] == f"layer {number}"


@pytest.fixture
def large(proxy: Proxy, monkeypatch: pytest.MonkeyPatch) -> Proxy:
    """A proxy with the largest possible status."""
    state = proxy.app._admin._status
    problems = (ProblemStatus(text="x" * 1000),) * 1000
    monkeypatch.setattr(proxy.app._admin, "_status", lambda: replace(state(), problems=problems))
    return proxy


@asynccontextmanager
async def stalled(proxy: Proxy, count: int, source: str = OUTSIDE) -> AsyncIterator[list[Wire]]:
    """Readers that ask for the status and read nothing."""
    address = (proxy.settings.admin.host, proxy.settings.admin.port)
    async with AsyncExitStack() as stack:
        wires = []
        for _ in range(count):
            wire = await stack.enter_async_context(connect(address, source))
            wire.reader._transport.pause_reading()  # type: ignore[attr-defined]
            await wire.send(b"GET /status HTTP/1.1\r\nHost: x\r\n\r\n")
            wires.append(wire)
        yield wires


def buffered(proxy: Proxy) -> list[int]:
    """The buffered bytes of each connection to the admin endpoint."""
    runner = proxy.app._admin._runner
    assert runner
    assert runner.server
    transports = [connection.transport for connection in runner.server.connections]
    return [transport.get_write_buffer_size() for transport in transports if transport]


async def test_readers_that_take_nothing_share_the_document(large: Proxy) -> None:
    """With a copy each, 32 readers of a status of 20 MB take 1.4 GB."""
    replies = large.app._admin._replies
    async with stalled(large, MOST_REPLIES_EACH) as wires:
        await until(lambda: replies.taken == MOST_REPLIES_EACH, "the readers are served")
        await until(lambda: all(buffered(large)), "the readers stall")
        assert max(buffered(large)) <= 3 * PIECE_BYTES
        for wire in wires:
            wire.reader._transport.resume_reading()  # type: ignore[attr-defined]
            body = (await wire.reply()).body
            assert len(body) > 0.9 * MOST_BYTES
            assert len(json.loads(body)["problems"]) == 1000
    await until(lambda: not replies.taken, "all replies end")


async def test_one_address_keeps_nothing_from_others(large: Proxy) -> None:
    replies = large.app._admin._replies
    async with stalled(large, MOST_REPLIES_EACH):
        await until(lambda: replies.taken == MOST_REPLIES_EACH, "the readers are served")
        for path in ("/status", "/metrics"):
            refused = await ask(large, path)
            assert (refused.status, refused.headers["retry-after"]) == (503, "10")
            assert b"4 replies with the status or the metrics are under way" in refused.body
            assert b"read one to its end before you ask again" in refused.body
            assert (await ask(large, path, source=HOST)).status == 200
        assert (await ask(large, "/healthz")).status == 200
        assert (await ask(large, "/readyz")).status in (200, 503)


async def test_there_is_a_bound_for_all_addresses_together(large: Proxy) -> None:
    replies = large.app._admin._replies
    async with AsyncExitStack() as stack:
        for number in range(MOST_REPLIES // MOST_REPLIES_EACH):
            source = f"127.0.5.{number}"
            await stack.enter_async_context(stalled(large, MOST_REPLIES_EACH, source))
        await until(lambda: replies.taken == MOST_REPLIES, "the readers are served")
        assert (await ask(large, "/status")).status == 503
        assert (await ask(large, "/healthz")).status == 200


async def test_a_reader_that_takes_nothing_is_cut_off(large: Proxy) -> None:
    replies = large.app._admin._replies
    async with stalled(large, 2) as wires:
        await until(lambda: replies.taken == 2, "the readers are served")
        await pass_time(REPLY_TIMEOUT + 1)
        await until(lambda: not replies.taken, "the proxy ends the replies")
        wires[0].reader._transport.resume_reading()  # type: ignore[attr-defined]
        with pytest.raises((ConnectionResetError, asyncio.IncompleteReadError)):
            await wires[0].reply()


async def test_a_connection_too_many_ends_the_oldest_with_what_it_has_not_taken(
    large: Proxy,
) -> None:
    """An orderly close would keep the written bytes until the kernel gives up."""
    replies = large.app._admin._replies
    address = (large.settings.admin.host, large.settings.admin.port)
    async with stalled(large, 1), AsyncExitStack() as stack:
        await until(lambda: any(buffered(large)), "the reader stalls")
        for _ in range(MOST_CONNECTIONS):
            await stack.enter_async_context(connect(address))
        await until(lambda: not any(buffered(large)), "no bytes are buffered")
        await until(lambda: not replies.taken, "the reply ends")


async def test_a_head_has_no_body(proxy: Proxy) -> None:
    address = (proxy.settings.admin.host, proxy.settings.admin.port)
    async with connect(address) as wire:
        for path in ("/status", "/metrics", "/healthz"):
            await wire.send(f"HEAD {path} HTTP/1.1\r\nHost: x\r\n\r\n".encode())
            assert (await wire.reply(head=True)).status == 200


async def test_the_proxys_own_commands_may_use_any_name_of_the_proxy(
    proxy: Proxy, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Commands send the address as Host: ``rosproxy status --admin robot.example:11312`` works."""
    host = proxy.settings.admin.host
    port = proxy.settings.admin.port

    def resolve(name: str, *rest: Any, **options: Any) -> Any:
        assert name == "robot.example"
        return original(host, *rest, **options)

    original = socket.getaddrinfo
    monkeypatch.setattr(socket, "getaddrinfo", resolve)
    client = AdminClient(f"http://robot.example:{port}")
    status = await asyncio.to_thread(client.status)
    assert status.instance == proxy.app.runtime.instance


async def test_many_addresses_have_so_many_connections_in_all(
    proxy: Proxy, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each address had its own bound, and addresses are many."""
    monkeypatch.setattr("rosproxy.shared.http.bounded_server.MOST_IN_ALL", 4)
    address = (proxy.settings.admin.host, proxy.settings.admin.port)
    async with AsyncExitStack() as stack:
        wires = []
        for number in (1, 2, 2, 3, 4, 5):
            source = f"127.0.5.{number}"
            wires.append(await stack.enter_async_context(connect(address, source)))
            await wires[-1].send(b"GET /healthz HTTP/1.1\r\nHost: x\r\n\r\n")
            assert (await wires[-1].reply()).status == 200
        # The address with two loses one, and then the address that came first.
        assert [await wire.outcome() for wire in (wires[1], wires[0])] == ["closed", "closed"]
        for wire in wires[2:]:
            await wire.send(b"GET /healthz HTTP/1.1\r\nHost: x\r\n\r\n")
            assert (await wire.reply()).status == 200


async def test_many_addresses_of_a_network_end_no_connection_of_another_network(
    proxy: Proxy, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A machine may have any number of IPv6 addresses."""

    def network(address: str) -> str:
        return "127.0.6.0/24" if address.startswith("127.0.6.") else address

    monkeypatch.setattr("rosproxy.shared.http.bounded_server.MOST_IN_ALL", 4)
    monkeypatch.setattr("rosproxy.shared.http.bounded_server.subnet", network, raising=False)
    address = (proxy.settings.admin.host, proxy.settings.admin.port)
    async with AsyncExitStack() as stack:
        wires = []
        for source in ("127.0.5.1", *(f"127.0.6.{number}" for number in range(1, 10))):
            wires.append(await stack.enter_async_context(connect(address, source)))
            await wires[-1].send(b"GET /healthz HTTP/1.1\r\nHost: x\r\n\r\n")
            assert (await wires[-1].reply()).status == 200
        await wires[0].send(b"GET /healthz HTTP/1.1\r\nHost: x\r\n\r\n")
        assert (await wires[0].reply()).status == 200


async def test_many_addresses_end_no_request_that_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    """An operator that waits for changes was the first to go: it had connected first."""
    monkeypatch.setattr("rosproxy.shared.http.bounded_server.MOST_IN_ALL", 4)
    is_asked = asyncio.Event()
    is_changed = asyncio.Event()

    async def answer(request: web.BaseRequest) -> web.Response:
        if request.path == "/changes":
            is_asked.set()
            await is_changed.wait()
        return web.Response()

    runner = web.ServerRunner(BoundedServer(answer, 2))
    await runner.setup()
    await web.TCPSite(runner, HOST, 0).start()
    address = runner.addresses[0][:2]
    async with AsyncExitStack() as stack:
        stack.push_async_callback(runner.cleanup)
        operator = await stack.enter_async_context(connect(address, "127.0.5.1"))
        await operator.send(b"GET /changes HTTP/1.1\r\nHost: x\r\n\r\n")
        await is_asked.wait()
        for number in range(2, 10):
            wire = await stack.enter_async_context(connect(address, f"127.0.5.{number}"))
            await wire.send(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n")
            assert (await wire.reply()).status == 200
        is_changed.set()
        assert (await operator.reply()).status == 200
