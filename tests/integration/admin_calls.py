"""Calls to the admin endpoint of a test's proxy."""

import json
from typing import Any

from tests.integration.net import Reply, exchange
from tests.integration.proxy import Proxy


async def post(proxy: Proxy, path: str, body: bytes | str = b"", *headers: str) -> Reply:
    """The response to a POST; ``headers`` are whole lines."""
    data = body.encode() if isinstance(body, str) else body
    lines = [f"POST {path} HTTP/1.1", "Host: x", *headers, f"Content-Length: {len(data)}"]
    address = (proxy.settings.admin.host, proxy.settings.admin.port)
    return await exchange(address, "\r\n".join([*lines, "", ""]).encode() + data)


async def tell(proxy: Proxy, path: str, **fields: Any) -> dict[str, Any]:
    """The answer to a POST that must succeed."""
    reply = await post(proxy, path, json.dumps(fields))
    assert reply.status == 200, reply.body
    answer: dict[str, Any] = json.loads(reply.body)
    return answer


async def update(proxy: Proxy, **fields: Any) -> tuple[int, int, int]:
    """Send an update of containers. Return the numbers of unregistered, moved and adopted nodes."""
    answer = await tell(proxy, "/containers", **fields)
    assert set(answer) == {"unregistered", "moved", "adopted"}
    return answer["unregistered"], answer["moved"], answer["adopted"]
