"""The live page: routes, allowed visitors, and the bounded stream of changes."""

import asyncio
import json
import re
import time
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from types import SimpleNamespace
from typing import Any

import aiohttp
import pytest

from examples.demo.fake_http import value
from examples.demo.fake_master import FakeMaster
from examples.demo.fake_node import FakeNode
from rosproxy.page.feed import LINGER_S, MOST_WATCHERS, MOST_WATCHERS_EACH
from tests.clock import pass_time
from tests.integration.admin_calls import post, tell
from tests.integration.commands import admin_url, run
from tests.integration.conftest import MakeNode, MakeProxy
from tests.integration.net import (
    HOST,
    PATIENCE,
    Reply,
    connect,
    exchange,
    read_header,
    topic_header,
    until,
)
from tests.integration.proxy import Proxy
from tests.page_updates import apply_update

TOKEN = "0123456789abcdef"
FILES = (
    "/page.js",
    "/view.js",
    "/picture.js",
    "/findings.js",
    "/history.js",
    "/zoom.js",
    "/page.css",
)
LINK = "topic /chatter /talker /outside"


@pytest.fixture
def from_afar(monkeypatch: pytest.MonkeyPatch) -> None:
    """Count no caller as local, although all callers in these tests are on loopback."""
    for module in ("rosproxy.admin.admin_server", "rosproxy.page.visitors"):
        monkeypatch.setattr(f"{module}.is_loopback", lambda _: False)


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorten all intervals of the feed."""
    for name in ("DOCUMENT_INTERVAL_S", "ROUND_INTERVAL_S", "LINGER_S"):
        monkeypatch.setattr(f"rosproxy.page.feed.{name}", 0.05)
    monkeypatch.setattr("rosproxy.page.feed.QUESTIONS_PER_SECOND", 10_000.0)


async def get(proxy: Proxy, path: str, *headers: str, host: str = "localhost") -> Reply:
    """The response to a GET; ``headers`` are whole lines."""
    address = (proxy.settings.admin.host, proxy.settings.admin.port)
    lines = [f"GET {path} HTTP/1.1", f"Host: {host}", *headers, "", ""]
    return await exchange(address, "\r\n".join(lines).encode())


class Stream:
    """An open page, with the document after all events so far."""

    def __init__(self, reply: aiohttp.ClientResponse) -> None:
        self._reply = reply
        self.kinds: list[str] = []
        self.document: dict[str, Any] = {}

    async def event(self) -> tuple[str, Any]:
        """The next event."""
        kind = ""
        while True:
            async with asyncio.timeout(PATIENCE):
                line = (await self._reply.content.readuntil(b"\n")).decode().rstrip("\n")
            if line.startswith("event: "):
                kind = line.removeprefix("event: ")
            elif line.startswith("data: "):
                return kind, json.loads(line.removeprefix("data: "))

    async def follow(self) -> None:
        """Process the next event."""
        kind, update = await self.event()
        self.kinds.append(kind)
        if kind == "all":
            self.document = update
        elif kind == "change":
            self.document = apply_update(self.document, update)

    async def link(self, key: str, **wanted: Any) -> dict[str, Any]:
        """Wait until a link has these values."""
        async with asyncio.timeout(PATIENCE):
            while True:
                link: dict[str, Any] = self.document.get("links", {}).get(key, {})
                if link and wanted.items() <= link.items():
                    return link
                await self.follow()


@asynccontextmanager
async def opened(proxy: Proxy, **headers: str) -> AsyncIterator[Stream]:
    """The stream of events."""
    async with (
        aiohttp.ClientSession() as session,
        session.get(f"{admin_url(proxy)}/events", headers=headers) as reply,
    ):
        assert reply.status == 200
        assert reply.content_type == "text/event-stream"
        yield Stream(reply)


async def test_the_page_and_its_files(proxy: Proxy) -> None:
    page = await get(proxy, "/")
    assert page.status == 200
    named = set(re.findall(rb'(?:src|href)="([\w.]+)"', page.body))
    named |= set(re.findall(rb'from "\./([\w.]+)"', (await get(proxy, "/page.js")).body))
    assert {f"/{name.decode()}" for name in named} == {*FILES}
    for path in ("/", *FILES):
        reply = await get(proxy, path)
        policy = reply.headers["content-security-policy"]
        assert reply.status == 200
        assert policy.startswith("default-src 'none'; script-src 'self';")
        assert "unsafe" not in policy
        assert reply.headers["x-content-type-options"] == "nosniff"


async def test_no_script_and_no_style_stands_in_the_page(proxy: Proxy) -> None:
    for path in ("/", "/login"):
        page = (await get(proxy, path)).body if path == "/" else (await post(proxy, path)).body
        assert not re.search(rb"<script(?![^>]* src=)|<style|\bstyle=|\bon\w+=", page)
        assert b"://" not in page


async def test_a_file_that_is_known_is_not_sent_again(proxy: Proxy) -> None:
    tag = (await get(proxy, "/page.js")).headers["etag"]
    url = f"{admin_url(proxy)}/page.js"
    headers = {"If-None-Match": tag}
    async with aiohttp.ClientSession() as session, session.get(url, headers=headers) as again:
        assert (again.status, await again.read()) == (304, b"")


async def test_a_link_comes_flows_and_goes(proxy: Proxy, node: FakeNode) -> None:
    await node.publish(proxy.master)
    async with opened(proxy) as page:
        await page.link("topic /chatter /talker ")
        async with connect(proxy.lease(node)) as wire:
            await wire.send(topic_header())
            await read_header(wire)
            link = await page.link(LINK, state="ok", carried="splice")
            assert str(link["port"]) in proxy.uri(node)
        await page.link("topic /chatter /talker ")
        assert page.kinds[:2] == ["clock", "all"]
        assert set(page.kinds[2:]) <= {"change", "clock"}


async def test_where_nothing_changes_the_page_hears_that_it_is_connected(
    proxy: Proxy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rosproxy.page.routes.HEARTBEAT_S", 0.1)
    async with opened(proxy) as page:
        while page.kinds.count("clock") < 3:
            await page.follow()


async def test_hertz_are_those_that_the_node_counts(
    proxy: Proxy, node: FakeNode, make_node: MakeNode
) -> None:
    counted = iter(range(0, 10**6, 5))
    bus = [1, "", [[1, "/listener", "o", "TCPROS", "/chatter", True, ""]]]
    node.answers["getBusInfo"] = value(bus)
    node.answers["getBusStats"] = lambda *_: value(
        [1, "", [[["/chatter", 0, [[1, 0, next(counted), True]]]], [], []]]
    )
    other = await make_node("/listener", HOST)
    await node.publish(proxy.master)
    await other.subscribe(proxy.ros1.settings.master_uri)
    async with opened(proxy) as page:
        link = await page.link("topic /chatter /talker /listener", state="ok")
        while "hz" not in link:
            await page.follow()
            link = page.document["links"]["topic /chatter /talker /listener"]
    assert link["hz"] > 0


async def test_a_pair_that_is_apart_is_broken_until_it_meets(
    proxy: Proxy, node: FakeNode, make_node: MakeNode
) -> None:
    meets = False
    node.answers["getBusInfo"] = lambda *_: value(
        [1, "", [[1, "/listener", "o", "TCPROS", "/chatter", meets, ""]]]
    )
    other = await make_node("/listener", HOST)
    await node.publish(proxy.master)
    await other.subscribe(proxy.ros1.settings.master_uri)
    async with opened(proxy) as page:
        link = await page.link("topic /chatter /talker /listener", state="broken")
        assert "not connected" in link["text"]
        assert link["fix"]
        meets = True
        link = await page.link("topic /chatter /talker /listener", state="ok")
        assert not {"text", "fix"} & link.keys()


async def test_without_an_open_page_no_node_is_asked(proxy: Proxy, node: FakeNode) -> None:
    await node.publish(proxy.master)
    assert json.loads((await get(proxy, "/graph")).body)["nodes"]["/talker"]

    def asked() -> int:
        return sum(method == "getBusInfo" for method, _ in node.calls)

    async with opened(proxy):
        before = asked()
        await until(lambda: asked() > before + 1, "nodes are asked again and again")
    await pass_time(LINGER_S + 1)
    await until(lambda: proxy.app.page.feed.idle, "the feed ends after the last page")
    before = asked()
    await pass_time(10)
    assert asked() == before


async def test_so_many_pages_and_no_more(proxy: Proxy) -> None:
    proxy.app.page.feed.watchers.most = 1
    async with opened(proxy):
        refused = await get(proxy, "/events")
        assert refused.status == 503
        assert refused.headers["retry-after"] == "10"
        assert b"1 pages are open already" in refused.body
        assert (await get(proxy, "/graph")).status == 503
    watchers = proxy.app.page.feed.watchers
    await until(lambda: not watchers.taken, "the proxy notices the end of the page")
    async with opened(proxy) as page:
        await page.follow()


async def test_one_address_does_not_have_all_pages(proxy: Proxy) -> None:
    """Otherwise an address could hold all sixteen, and other people would see none."""
    address = (proxy.settings.admin.host, proxy.settings.admin.port)
    watchers = proxy.app.page.feed.watchers
    async with AsyncExitStack() as stack:
        for _ in range(MOST_WATCHERS):
            wire = await stack.enter_async_context(connect(address))
            await wire.send(b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n")
            assert (await wire.reader.readline()).startswith(b"HTTP/1.1 ")
        assert watchers.taken == MOST_WATCHERS_EACH < MOST_WATCHERS
        assert (await get(proxy, "/graph")).status == 503
        async with opened(proxy) as page:
            await page.follow()


async def test_a_page_that_reads_nothing_misses_documents_and_holds_few(
    proxy: Proxy, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With documents of 8 MB, the proxy encodes no more than the buffers can take."""
    made = 0
    encoded = 0
    page = proxy.app.page
    encode = page._event

    async def documents() -> AsyncIterator[dict[str, Any]]:
        nonlocal made
        while True:
            made += 1
            yield {"nodes": {}, "links": {}, "text": str(made) + "x" * 8_000_000}
            await asyncio.sleep(0.001)

    def counted(*given: Any) -> bytes:
        nonlocal encoded
        encoded += 1
        return encode(*given)

    monkeypatch.setattr(page.feed, "_make", documents)
    monkeypatch.setattr(page, "_event", counted)
    address = (proxy.settings.admin.host, proxy.settings.admin.port)
    async with connect(address) as wire:
        await wire.send(b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n")
        await until(lambda: made > 40, "documents are made")
        assert 0 < encoded <= 4


async def test_a_page_goes_on_after_a_mistake_of_ours(
    proxy: Proxy, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    failures = iter([True, False])
    state = proxy.app.state

    def failing() -> Any:
        if next(failures, False):
            raise ValueError("a mistake")
        return state()

    monkeypatch.setattr(proxy.app, "state", failing)
    async with opened(proxy) as page:
        await page.follow()
        await page.follow()
        assert "rosproxy" in page.document["nodes"]
    assert [record.getMessage() for record in caplog.records if record.exc_info] == [
        "the live page failed; trying again"
    ]
    caplog.clear()


async def test_a_head_has_no_stream(proxy: Proxy) -> None:
    url = f"{admin_url(proxy)}/events"
    async with aiohttp.ClientSession() as session, session.head(url) as reply:
        assert reply.status == 200
    assert not proxy.app.page.feed.watchers.taken


async def test_the_proxy_stops_though_pages_are_open(proxy: Proxy) -> None:
    async with opened(proxy) as page:
        await page.follow()
        await proxy.stop()


async def test_by_a_strangers_name_nothing_is_told(proxy: Proxy) -> None:
    for path in ("/", "/graph", "/events"):
        assert (await get(proxy, path, host="evil.example:11312")).status == 403
    assert b"--admin-token" in (await get(proxy, "/", host="evil.example")).body


@pytest.mark.usefixtures("from_afar")
async def test_who_does_not_know_the_token_sees_nothing(make_proxy: MakeProxy) -> None:
    proxy = await make_proxy(admin_token=TOKEN)
    page = await get(proxy, "/")
    assert page.status == 401
    assert b'name="token"' in page.body
    for path in ("/graph", "/events"):
        for headers in ([], ["Authorization: Bearer wrong"], ["Cookie: rosproxy=x; rosproxy-1=y"]):
            assert (await get(proxy, path, *headers)).status == 403
    told = await get(proxy, "/graph", f"Authorization: Bearer {TOKEN}")
    assert told.status == 200


@pytest.mark.usefixtures("from_afar")
async def test_the_form_gives_a_cookie_that_looks_and_does_nothing_else(
    make_proxy: MakeProxy, caplog: pytest.LogCaptureFixture
) -> None:
    proxy = await make_proxy(admin_token=TOKEN)
    for body in ("token=wrong", "", "token=", "\xff=%ff", "&".join("abcdef"), "x" * 5000):
        assert (await post(proxy, "/login", body.encode("latin-1"))).status in (400, 403)
    let_in = await post(proxy, "/login", f"token={TOKEN}")
    assert (let_in.status, let_in.headers["location"]) == (303, "./")
    cookie, *rules = let_in.headers["set-cookie"].split("; ")
    assert {"HttpOnly", "SameSite=Strict"} <= {*rules}
    assert TOKEN not in cookie
    assert (await get(proxy, "/", f"Cookie: {cookie}", host="x")).status == 200
    assert (await get(proxy, "/graph", f"Cookie: {cookie}", host="x")).status == 200
    assert (await post(proxy, "/retire", "{}", f"Cookie: {cookie}")).status == 403
    assert TOKEN not in caplog.text


@pytest.mark.usefixtures("from_afar")
async def test_a_key_lets_a_browser_in_once(make_proxy: MakeProxy) -> None:
    proxy = await make_proxy(admin_token=TOKEN)
    assert (await post(proxy, "/page-key", "{}")).status == 403
    answer = await post(proxy, "/page-key", "{}", f"Authorization: Bearer {TOKEN}")
    key = json.loads(answer.body)["key"]
    assert (await get(proxy, f"/?key={key}")).status == 303
    assert (await get(proxy, f"/?key={key}")).status == 401


async def test_status_opens_the_page(make_proxy: MakeProxy) -> None:
    proxy = await make_proxy(admin_token=TOKEN)
    words = ("status", "--open", "--admin", admin_url(proxy))
    plain = await run(*words, BROWSER="true")
    assert (plain.code, plain.out) == (0, f"{admin_url(proxy)}/\n")
    keyed = await run(*words, BROWSER="true", ROSPROXY_ADMIN_TOKEN=TOKEN)
    assert (await get(proxy, keyed.out.strip().removeprefix(admin_url(proxy)))).status == 303


async def test_status_has_a_browser_show_it(proxy: Proxy, tmp_path: Any) -> None:
    shown = tmp_path / "shown"
    browser = tmp_path / "browser"
    browser.write_text(f'#!/bin/sh\nprintf %s "$1" > {shown}\n')
    browser.chmod(0o755)
    result = await run("status", "--open", "--admin", admin_url(proxy), BROWSER=str(browser))
    assert shown.read_text() == result.out.strip() == f"{admin_url(proxy)}/"


async def test_status_without_a_browser_tells_of_the_operators_page(proxy: Proxy) -> None:
    result = await run("status", "--open", "--admin", admin_url(proxy), BROWSER="false")
    assert (result.code, result.out) == (0, f"{admin_url(proxy)}/\n")
    assert "rosproxy-operator docker status" in result.err


async def test_a_proxy_whose_master_is_away_is_shown(
    make_proxy: MakeProxy, master: FakeMaster
) -> None:
    await master.stop()
    proxy = await make_proxy()
    async with opened(proxy) as page:
        while page.document.get("nodes", {}).get("master", {}).get("state") != "broken":
            await page.follow()
        while not page.document["findings"]:
            await page.follow()
        assert page.document["findings"][0]["severity"] == "error"


async def test_a_problem_has_the_same_age_on_a_page_that_is_opened_later(
    proxy: Proxy, node: FakeNode, make_node: MakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    bus = [1, "", [[1, "/listener", "o", "TCPROS", "/chatter", False, ""]]]
    node.answers["getBusInfo"] = value(bus)
    other = await make_node("/listener", HOST)
    await node.publish(proxy.master)
    await other.subscribe(proxy.ros1.settings.master_uri)
    with monkeypatch.context() as patched:
        # As if this page had been open for long: its documents show all problems.
        patched.setattr("rosproxy.page.feed.SETTLED_AFTER_S", 0.0)
        patched.setattr("rosproxy.page.feed.SETTLED_AFTER_ROUNDS", 0)
        ages = [await age_of_a_link(proxy)]
    await pass_time(LINGER_S + 1)
    await until(lambda: proxy.app.page.feed.idle, "the feed ends after the last page")
    later = SimpleNamespace(monotonic=lambda: time.monotonic() + 7200, time=time.time)
    monkeypatch.setattr("rosproxy.page.feed.time", later)
    ages.append(await age_of_a_link(proxy))
    assert ages[1] - ages[0] >= 7200 - 2


async def age_of_a_link(proxy: Proxy) -> float:
    """The Unix time now, less the time since which the link is broken."""
    async with opened(proxy) as page:
        link = await page.link("topic /chatter /talker /listener", state="broken")
        return time.time() - float(link["wrong_since"])


async def test_the_age_of_a_node_that_does_not_answer_counts_without_a_page(
    make_proxy: MakeProxy, master: FakeMaster, node: FakeNode
) -> None:
    proxy = await make_proxy(cleanup_after=0.0)
    await node.publish(proxy.master)
    await node.stop()
    (endpoint,) = proxy.ros1.context.registry
    await until(lambda: endpoint.is_down, "the node is down")
    await master.stop()
    await until(lambda: not proxy.app.state().master.up, "the master is down")
    await pass_time(60)
    async with opened(proxy) as page:
        for name in ("master", "/talker"):
            while page.document.get("nodes", {}).get(name, {}).get("state") != "broken":
                await page.follow()
            row = page.document["nodes"][name]
            assert time.time() - row["wrong_since"] >= 60 - 1
            assert "may_be_older" not in row


async def test_updates_of_containers_go_on_while_a_page_is_open(
    proxy: Proxy, node: FakeNode
) -> None:
    await node.publish(proxy.master)
    async with opened(proxy) as page:
        await page.link("topic /chatter /talker ")
        await node.stop()
        assert (await tell(proxy, "/containers", gone=[node.address]))["unregistered"] == 1
        while "/talker" in page.document["nodes"]:
            await page.follow()
