"""Serves a live page of a proxy with any number of made-up nodes that send messages.

python -m tests.browser.many PORT NODES

Half of the nodes are inside. Each node inside publishes two topics, for two nodes outside. The rate
of each topic changes every second. The code of the proxy serves the page. ``/cost`` returns the
duration of each document in seconds.
"""

from __future__ import annotations

import asyncio
import sys
import time
from collections.abc import AsyncGenerator
from typing import Any

from aiohttp import web

from rosproxy.doctor.facts import SystemState
from rosproxy.page.feed import Feed
from rosproxy.page.graph_document import graph_document, relayed
from rosproxy.page.measures import Measures
from rosproxy.page.routes import Page
from rosproxy.page.visitors import Visitors
from rosproxy.shared.documents.status_document import (
    ConnectionStatus,
    EndpointStatus,
    MasterStatus,
    PortsStatus,
    ProxyStatus,
    StatusSettings,
)
from rosproxy.shared.tasks import Tasks

FIRST_PORT = 11000


def status_of(nodes: int, second: int) -> ProxyStatus:
    """The status of a proxy after ``second`` seconds. Half of the ``nodes`` are inside."""
    inside = max(nodes // 2, 1)
    return ProxyStatus(
        version="0",
        settings=StatusSettings(ros=("1",), advertise_host="10.0.0.1"),
        master=MasterStatus(uri="http://10.0.0.2:11311", up=True),
        ports=PortsStatus(
            f"{FIRST_PORT}-{FIRST_PORT + nodes}", f"{FIRST_PORT}-{FIRST_PORT + nodes}"
        ),
        nodes=tuple(_endpoint(number, inside, second) for number in range(inside)),
    )


def _endpoint(number: int, inside: int, second: int) -> EndpointStatus:
    """A node that publishes two topics. Each topic has a subscriber outside."""
    topics = tuple(f"/group{number % 20}/node{number}/topic{k}" for k in range(2))
    hearers = (f"/outside{number}", f"/outside{(number + 1) % inside}")
    sent = 1000 * (50 * second + second * (7 * number + 3) % 40)
    connections = tuple(
        ConnectionStatus(kind="topic", name=topic, caller_id=hearer, peer="10.0.0.2", sent=sent)
        for topic, hearer in zip(topics, hearers, strict=True)
    )
    port = FIRST_PORT + number
    return EndpointStatus(
        nodes=(f"/group{number % 20}/node{number}",),
        uri=f"http://172.18.0.2:{port}/",
        address=f"172.18.0.2:{port}",
        advertised_uri=f"http://10.0.0.1:{port}/",
        port=port,
        state="ok",
        publishes=topics,
        connections=connections,
    )


class MadeUpProxy:
    """Makes documents as `PageWatch` does. ``took``: the seconds for each document."""

    def __init__(self, nodes: int) -> None:
        self._nodes = nodes
        self.took: list[float] = []

    async def documents(self) -> AsyncGenerator[dict[str, Any]]:
        measures = Measures()
        epoch = time.time() - time.monotonic()
        for second in range(10**9):
            now = time.monotonic()
            status = status_of(self._nodes, second)
            measures.read_relays(relayed(status, SystemState()), now)
            document = await asyncio.to_thread(
                graph_document, status, None, measures, (), now, epoch
            )
            self.took.append(time.monotonic() - now)
            yield document
            await asyncio.sleep(1.0)

    async def tell(self, _: web.Request) -> web.Response:
        return web.json_response(self.took)


async def serve(port: int, nodes: int) -> None:
    """Serve the page for good."""
    proxy = MadeUpProxy(nodes)
    page = Page(Feed(Tasks(), proxy.documents), Visitors(None, time.monotonic))
    app = web.Application()
    for (method, path), handler in page.routes.items():
        app.router.add_route(method, path, handler)
    app.router.add_get("/cost", proxy.tell)
    runner = web.AppRunner(app, access_log=None)
    await runner.setup()
    await web.TCPSite(runner, "127.0.0.1", port).start()
    print("serving", flush=True)
    await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(serve(int(sys.argv[1]), int(sys.argv[2])))
