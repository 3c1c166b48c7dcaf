"""The live page of an operator, over proxies that run."""

import json
import time
from collections.abc import AsyncIterator

import aiohttp
import pytest
from aiohttp import web
from prometheus_client import CollectorRegistry

from examples.demo.fake_http import free_ports
from examples.demo.fake_node import FakeNode
from rosproxy.page.page_document import Document
from rosproxy.shared.addresses import HostPort
from rosproxy_operator.common.operator_admin import OperatorAdminServer
from rosproxy_operator.common.operator_page import operator_page
from rosproxy_operator.common.problem import Problem
from rosproxy_operator.common.proxy_client import ProxyClient
from tests.integration.conftest import MakeProxy
from tests.integration.net import NODE, until
from tests.integration.proxy import Proxy

TOKEN = "0123456789abcdef"
MISSPELT = Problem(
    "container talker-1", "label x is unknown", "Remove the label", fatal=False, reason="X"
)
MISSPELT_SINCE = time.monotonic() - 7200
"""The monotonic time at which the operator first saw the problem."""


@pytest.fixture
async def client() -> AsyncIterator[ProxyClient]:
    made = ProxyClient()
    yield made
    await made.close()


async def opened(
    proxies: dict[str, tuple[HostPort, str]], client: ProxyClient
) -> OperatorAdminServer:
    """An operator's endpoint over these proxies."""

    async def documents() -> dict[str, Document | str]:
        return await client.documents(proxies)

    return OperatorAdminServer(
        CollectorRegistry(),
        lambda: None,
        lambda: None,
        operator_page(
            documents,
            "docker logs {}".format,
            lambda: {NODE: "talker-1"},
            lambda: {MISSPELT: MISSPELT_SINCE},
        ),
    )


async def test_all_proxies_stand_on_one_page(
    make_proxy: MakeProxy, node: FakeNode, client: ProxyClient
) -> None:
    first = await make_proxy(admin_token=TOKEN)
    second = await make_proxy()
    await node.publish(first.master)
    gone = HostPort("127.0.0.1", free_ports(1))
    proxies = {
        "one": (first.settings.admin, TOKEN),
        "two": (second.settings.admin, ""),
        "gone": (gone, ""),
    }
    server = await opened(proxies, client)
    address = HostPort("127.0.0.1", free_ports(1))
    await server.start(address)
    try:
        async with aiohttp.ClientSession() as session:
            async with session.get(f"http://{address}/graph") as reply:
                document = json.loads(await reply.read())
            nodes = document["nodes"]
            assert nodes["one /talker"]["label"] == "/talker"
            assert nodes["one /talker"]["place"] == "talker-1"
            assert nodes["two rosproxy"]["label"] == "two"
            assert nodes["gone"]["state"] == "broken"
            assert f"{gone} refuses connections" in nodes["gone"]["text"]
            (own,) = (f for f in document["findings"] if f["subject"] == MISSPELT.subject)
            shown = (own["severity"], own["text"], own["fix"])
            assert shown == ("warning", MISSPELT.text, MISSPELT.fix)
            assert nodes["gone"]["wrong_since"] - own["wrong_since"] >= 7200 - 1
            async with session.get(f"http://{address}/", headers={"Host": "evil.example"}) as reply:
                assert reply.status == 403
            async with session.get(f"http://{address}/events") as reply:
                assert reply.status == 200
                assert looked_at(first)
    finally:
        await server.stop()


def looked_at(proxy: Proxy) -> bool:
    """Whether a proxy makes documents."""
    return not proxy.app.page.feed.idle


async def test_a_proxy_of_a_former_release_says_so(client: ProxyClient) -> None:
    former = web.AppRunner(web.Application())
    await former.setup()
    address = HostPort("127.0.0.1", free_ports(1))
    await web.TCPSite(former, address.host, address.port).start()
    try:
        documents = await client.documents({"old": (address, TOKEN)})
        assert documents == {"old": "the proxy has no live page: its image is of a former release"}
    finally:
        await former.cleanup()


async def test_nobody_is_asked_while_nobody_looks(
    make_proxy: MakeProxy, client: ProxyClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rosproxy.page.feed.LINGER_S", 0.05)
    proxy = await make_proxy()
    server = await opened({"one": (proxy.settings.admin, "")}, client)
    address = HostPort("127.0.0.1", free_ports(1))
    await server.start(address)
    assert not looked_at(proxy)
    try:
        async with aiohttp.ClientSession() as session, session.get(f"http://{address}/events"):
            await until(lambda: looked_at(proxy), "the proxy is asked")
        await until(lambda: not looked_at(proxy), "the proxy is left alone")
    finally:
        await server.stop()
