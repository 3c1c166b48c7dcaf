"""Serves the live page of an operator for some proxies, without an engine.

python -m tests.browser.merged PORT TOKEN PLACES NAME=ADDRESS...

The engine tells a real operator the proxies and the containers. Here the arguments name the
proxies. PLACES is a JSON object with the names of containers by address. The operator's code asks
for the documents, merges the documents, and serves the page.
"""

from __future__ import annotations

import asyncio
import json
import sys

from prometheus_client import CollectorRegistry

from rosproxy.page.page_document import Document
from rosproxy.shared.addresses import HostPort, parse_host_port
from rosproxy_operator.common.operator_admin import OperatorAdminServer
from rosproxy_operator.common.operator_page import operator_page
from rosproxy_operator.common.proxy_client import ProxyClient


async def serve(
    port: int, token: str, places: dict[str, str], proxies: dict[str, HostPort]
) -> None:
    """Serve the page for good."""
    client = ProxyClient()

    async def documents() -> dict[str, Document | str]:
        return await client.documents({name: (admin, token) for name, admin in proxies.items()})

    page = operator_page(documents, "docker logs {}".format, lambda: places)
    server = OperatorAdminServer(CollectorRegistry(), lambda: None, lambda: None, page)
    await server.start(HostPort("127.0.0.1", port))
    print("serving", flush=True)
    await asyncio.Event().wait()


def read_proxies(words: list[str]) -> dict[str, HostPort]:
    """The admin endpoints of the proxies by name."""
    proxies = {}
    for word in words:
        name, _, address = word.partition("=")
        admin = parse_host_port(address)
        assert admin, word
        proxies[name] = admin
    return proxies


if __name__ == "__main__":
    asyncio.run(
        serve(int(sys.argv[1]), sys.argv[2], json.loads(sys.argv[3]), read_proxies(sys.argv[4:]))
    )
