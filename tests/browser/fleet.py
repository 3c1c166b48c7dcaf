"""Serves a live page of an operator with three proxies and any number of made-up nodes.

python -m tests.browser.fleet PORT NODES

A third of the nodes uses ROS 1. The other nodes use two domains of ROS 2. Each third has a separate
proxy. Containers have up to five nodes. A fifth of the outside nodes of ROS 1 is on the host. A
twelfth of the links is broken. The code of the operator makes the document, and the code of the
proxy serves the document.
"""

from __future__ import annotations

import asyncio
import sys
import time
from collections.abc import AsyncGenerator, Callable, Iterator
from functools import partial
from typing import Any

from aiohttp import web
from msgspec.structs import replace

from rosproxy.page.feed import Feed
from rosproxy.page.page_document import (
    BROKEN,
    CONTAINER,
    HOST,
    OK,
    ROBOT,
    WARNING,
    Document,
    PageLink,
    PageNode,
    PageProxy,
)
from rosproxy.page.routes import Page
from rosproxy.page.visitors import Visitors
from rosproxy.shared.tasks import Tasks
from rosproxy_operator.common.merged_page import merged

PROXIES = {"ros1": "", "domain-0": "0", "domain-7": "7"}
"""The domain of each proxy. The first proxy is for ROS 1."""
EACH = 5
"""Nodes of a container, and of a machine outside."""
PARTS = ("arm", "base", "camera", "lidar", "planner", "teleop", "battery", "gripper")
ENDED = 3
"""Nodes in the first container of ROS 1 that have ended."""
SINCE = time.time() - 300
"""The Unix time in seconds of the last message on idle links, and of all problems."""


def documents(nodes: int) -> dict[str, Document | str]:
    """The documents of the proxies, with ``nodes`` nodes in all."""
    return {
        name: _document(number, domain, [*range(number, nodes, len(PROXIES))])
        for number, (name, domain) in enumerate(PROXIES.items())
    }


def _document(proxy: int, domain: str, numbers: list[int]) -> Document:
    inside = {_key(domain, n): _node(proxy, domain, i, True) for i, n in enumerate(numbers[::2])}
    outside = {_key(domain, n): _node(proxy, domain, i, False) for i, n in enumerate(numbers[1::2])}
    links = {link.key: link for link in _links(domain, [*inside], [*outside])}
    ports = "11412-11443, 9 used, 23 free"
    version = f"ROS 2, domain {domain}" if domain else "ROS 1"
    nodes = {"rosproxy": PageNode(HOST, "proxy", "rosproxy", ports=ports, detail=version)}
    if not domain:
        nodes["master"] = PageNode(ROBOT, "master", "master", address="http://robot:11311/")
    return Document(
        {**nodes, **inside, **outside}, links, proxy=PageProxy("laptop", "http://robot:11311")
    )


def _key(domain: str, number: int) -> str:
    """The key of a node: a name, or the domain and the GUID prefix of a participant."""
    if domain:
        return f"{domain} 01.0f.{number:08x}"
    return f"/{PARTS[number % len(PARTS)]}/driver_of_the_unit_{number}"


def _node(proxy: int, domain: str, index: int, is_inside: bool) -> PageNode:
    place = index // EACH
    host = f"172.{18 + proxy}.{place // 250}.{2 + place % 250}"
    if not is_inside:
        host = f"10.94.{10 * proxy + place // 250}.{2 + place % 250}"
    lane = CONTAINER if is_inside else ROBOT
    if domain:
        label = f"/unit_{index}/driver_of_the_robot"
        detail = f"participant 01.0f.{index:08x}"
        node = PageNode(lane, "participant", label, address=f"{host}, Fast DDS", ports="11420")
        return replace(node, detail=detail)
    port = 35000 + index
    if not is_inside and index % EACH == EACH - 1:
        return PageNode(HOST, address=f"http://laptop:{port}/")
    if not is_inside:
        return PageNode(lane, address=f"http://{host}:{port}/")
    node = PageNode(lane, address=f"{host}:{port}")
    if index >= ENDED:
        return node
    text = f"registered as http://{host}:{port}/, but nothing answers there"
    fix = "run rosnode cleanup (answer y)"
    return replace(node, state=BROKEN, text=text, fix=fix, wrong_since=SINCE)


def _links(domain: str, inside: list[str], outside: list[str]) -> Iterator[PageLink]:
    """Two links of each node inside to nodes outside, and links between some nodes inside.

    The first link leads outwards. The second link leads inwards for two thirds of the nodes.
    """
    for i, node in enumerate(inside):
        if not outside:
            return
        yield _link(domain, i, node, outside[i % len(outside)])
        other = outside[(i + 1) % len(outside)]
        yield _link(domain, i + 1, *((other, node) if i % 3 else (node, other)))
        if i % 4 == 3:
            yield _link(domain, i, node, inside[i - 3], is_direct=True)


def _link(domain: str, i: int, source: str, target: str, is_direct: bool = False) -> PageLink:
    name = f"/{PARTS[i % len(PARTS)]}/a_topic_with_a_long_name/state_{i}"
    state = BROKEN if i % 12 == 5 else WARNING if i % 30 == 7 else OK
    text = ""
    fix = ""
    if state != OK:
        text = f"{target} has not connected to 10.94.0.1:11420"
        fix = f"test on the machine of {target}: nc -vz 10.94.0.1 11420"
    flows = state == OK and not domain and i % 3 > 0
    return PageLink(
        "topic",
        name,
        source,
        target,
        carried="direct" if is_direct else "" if state == BROKEN else "splice",
        port=None if is_direct else 11412 + i % 32,
        hz=None if domain else 5.0 * flows,
        rate=1200.0 * (i % 3 > 0 if domain else flows),
        datagrams=5.0 * (i % 3 > 0) if domain else None,
        shared=2 if domain else 0,
        since=None if domain or flows else SINCE,
        flows=flows,
        state=state,
        text=text,
        fix=fix,
        wrong_since=None if state == OK else SINCE,
    )


async def unchanged(nodes: int) -> AsyncGenerator[dict[str, Any]]:
    """Yield a document that never changes."""
    while True:
        yield merged(documents(nodes), "0", "docker logs {}".format)
        await asyncio.sleep(3600)


async def serve(port: int, make: Callable[[], AsyncGenerator[dict[str, Any]]]) -> None:
    """Serve a page with these documents for good."""
    page = Page(Feed(Tasks(), make), Visitors(None, time.monotonic))
    app = web.Application()
    for (method, path), handler in page.routes.items():
        app.router.add_route(method, path, handler)
    runner = web.AppRunner(app, access_log=None)
    await runner.setup()
    await web.TCPSite(runner, "127.0.0.1", port).start()
    print("serving", flush=True)
    await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(serve(int(sys.argv[1]), partial(unchanged, int(sys.argv[2]))))
