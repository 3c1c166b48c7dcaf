"""Can the advertised ports be reached? A probe over a free port of the range."""

import asyncio
import secrets
from typing import Any

from rosproxy.acceptor import Acceptor
from rosproxy.context import Context

TIMEOUT = 3.0


async def probe_range(context: Context) -> dict[str, Any]:
    """Connect to a free port through the advertised host and port and see who answers.

    The result has ``outcome`` (ok, refused, silent, stranger, unresolvable or full), the ``port``
    that listened and the ``advertised`` address that was dialled. Whether outside gets through
    as well is more than a probe from the proxy itself can tell.
    """
    port = context.registry.pool.peek()
    if port is None:
        return {"outcome": "full", "port": None, "advertised": None}
    where = context.addressing.outside(port)
    result = {"port": port, "advertised": str(where)}
    context.registry.pool.claim(port)
    try:
        return {**result, "outcome": await _probe(context, port, where.host, where.port)}
    finally:
        context.registry.pool.give_back(port)


async def _probe(context: Context, port: int, host: str, advertised: int) -> str:
    nonce = secrets.token_hex(16).encode()

    async def greet(conn: Any, peer: str) -> None:
        await asyncio.get_running_loop().sock_sendall(conn, nonce)
        conn.close()

    acceptor = Acceptor(context.tasks, context.bank.open(port), greet)
    try:
        return await _dial(host, advertised, nonce)
    finally:
        acceptor.stop()
        context.bank.close(port, acceptor.sock)


async def _dial(host: str, port: int, nonce: bytes) -> str:
    try:
        async with asyncio.timeout(TIMEOUT):
            reader, writer = await asyncio.open_connection(host, port)
            try:
                answer = await reader.read(len(nonce))
            finally:
                writer.close()
    except TimeoutError:
        return "silent"
    except ConnectionRefusedError:
        return "refused"
    except OSError as error:
        return (
            "unresolvable"
            if "getaddrinfo" in str(error) or error.errno in (-2, -3, -5)
            else "silent"
        )
    return "ok" if answer == nonce else "stranger"
