"""Waiting at the admin endpoint until something has changed."""

import asyncio
import json
from typing import Any
from urllib.parse import quote

import pytest

from examples.demo.fake_master import FakeMaster
from rosproxy.admin import status_changes
from tests.integration.conftest import MakeNode, MakeProxy
from tests.integration.net import HOST, OUTSIDE, Reply, exchange, until
from tests.integration.proxy import Proxy


async def wait(
    proxy: Proxy, since: str = "", within: str = "60", *headers: str, source: str = OUTSIDE
) -> Reply:
    address = (proxy.settings.admin.host, proxy.settings.admin.port)
    path = f"/status/changes?since={quote(since)}&within={within}"
    lines = [f"GET {path} HTTP/1.1", "Host: x", *headers, "", ""]
    return await exchange(address, "\r\n".join(lines).encode(), source)


async def changes(proxy: Proxy, since: str = "", within: str = "60") -> tuple[str, dict[str, Any]]:
    """The version and the state."""
    reply = await wait(proxy, since, within)
    assert reply.status == 200, reply.body
    document = json.loads(reply.body)
    return document["version"], document["status"]


async def test_a_change_is_told(
    make_proxy: MakeProxy, make_node: MakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(status_changes, "POLL_INTERVAL", 0.01)
    proxy = await make_proxy()
    await until(lambda: proxy.ros1.master_monitor.up, "the master is seen")
    version, status = await changes(proxy)
    assert status["nodes"] == []
    waiting = asyncio.create_task(changes(proxy, version))
    node = await make_node("/talker")
    await node.publish(proxy.master, "/chatter")
    another, status = await waiting
    assert another != version
    while status["nodes"][0]["nodes"] != [
        "/talker"
    ]:  # the endpoint has a port before it has a name
        another, status = await changes(proxy, another)
    assert (await changes(proxy, version))[1]["nodes"]  # it has changed by then


async def test_no_change_is_told_after_a_while(make_proxy: MakeProxy, master: FakeMaster) -> None:
    proxy = await make_proxy()
    await until(lambda: proxy.ros1.master_monitor.up, "the master is seen")
    version, _ = await changes(proxy)
    assert (await changes(proxy, version, "0.2"))[0] == version


@pytest.mark.parametrize("within", ["nan", "inf", "-1", "1e999"])
async def test_nonsense_is_no_time(make_proxy: MakeProxy, within: str) -> None:
    proxy = await make_proxy()
    assert (await wait(proxy, "", within)).status == 200
    assert (await wait(proxy, "", "soon")).status == 400


async def test_so_many_may_wait(make_proxy: MakeProxy, monkeypatch: pytest.MonkeyPatch) -> None:
    """A caller that goes away makes room, and the end of the proxy ends the waiting."""
    monkeypatch.setattr(status_changes, "POLL_INTERVAL", 0.01)
    proxy = await make_proxy()
    await until(lambda: proxy.ros1.master_monitor.up, "the master is seen")
    version, _ = await changes(proxy)
    room = proxy.app._admin._changes
    each = room.slots.each
    some = [asyncio.create_task(wait(proxy, version)) for _ in range(each)]
    await until(lambda: room.slots.taken == each, "all wait")
    refused = await wait(proxy, version)
    assert refused.status == 503
    assert b"127.0.1.9: 4 callers wait for a change already; ask /status" in refused.body
    some[0].cancel()
    await until(lambda: room.slots.taken < each, "there is room again")
    room.end()
    assert {(await task).status for task in some[1:]} == {200}


async def test_one_address_does_not_take_all_places(
    make_proxy: MakeProxy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(status_changes, "POLL_INTERVAL", 0.01)
    proxy = await make_proxy()
    await until(lambda: proxy.ros1.master_monitor.up, "the master is seen")
    version, _ = await changes(proxy)
    room = proxy.app._admin._changes
    some = [asyncio.create_task(wait(proxy, version)) for _ in range(status_changes.MOST_WAITING)]
    await until(lambda: room.slots.taken == room.slots.each, "as many wait as may")
    assert (await wait(proxy, "", "0", source=HOST)).status == 200
    room.end()
    statuses = [(await task).status for task in some]
    assert sorted(statuses) == [200] * 4 + [503] * 4


async def test_no_web_page_may_wait(proxy: Proxy) -> None:
    assert (await wait(proxy, "", "0")).status == 200
    for header in ("Origin: http://page.example", "Sec-Fetch-Site: cross-site"):
        refused = await wait(proxy, "", "0", header)
        assert refused.status == 403
        assert refused.body.startswith(b"rosproxy: GET /status/changes is for callers on this host")
