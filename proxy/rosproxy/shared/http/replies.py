"""Replies of the admin endpoint and the live page whose bytes many readers share.

A reader that takes nothing causes no copy of the reply: the proxy writes the next piece once the
reader has taken most of the earlier pieces. The proxy ends the connection of a reader that is too
slow.
"""

import asyncio
import contextlib
from collections.abc import Mapping, Sequence

from aiohttp import web

PIECE_BYTES = 64 * 1024
"""Size of a piece; aiohttp waits for the reader after two pieces at the latest."""
REPLY_TIMEOUT = 60.0
"""Seconds in which a reader must take a reply: 1 MiB at 140 kbit/s."""


async def write_pieces(response: web.StreamResponse, body: bytes) -> None:
    """Write bytes at the speed of the reader. Raises ConnectionError."""
    shared = memoryview(body)
    for start in range(0, len(shared), PIECE_BYTES):
        await response.write(shared[start : start + PIECE_BYTES])


async def send_shared(
    request: web.BaseRequest, parts: Sequence[bytes], headers: Mapping[str, str]
) -> web.StreamResponse:
    """Send a reply with these parts, in order; end the connection after REPLY_TIMEOUT."""
    response = web.StreamResponse(headers=headers)
    response.content_length = sum(map(len, parts))
    # A reader that has gone needs no reply.
    with contextlib.suppress(ConnectionError):
        try:
            async with asyncio.timeout(REPLY_TIMEOUT):
                await response.prepare(request)
                for part in parts if request.method != "HEAD" else ():
                    await write_pieces(response, part)
                await response.write_eof()
        except TimeoutError:
            if request.transport is not None:
                request.transport.abort()
    return response


def unavailable(reason: object, headers: Mapping[str, str] | None = None) -> web.Response:
    """The reply to a caller that the proxy can't serve now: 503, with ``Retry-After``."""
    text = f"rosproxy: {reason}\n"
    return web.Response(status=503, text=text, headers={**(headers or {}), "Retry-After": "10"})
