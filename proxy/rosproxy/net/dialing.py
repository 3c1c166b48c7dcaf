"""Connecting to nodes for a relay."""

import asyncio
import socket

from rosproxy.net.addresses import HostPort

CONNECT_TIMEOUT = 5.0
"""Seconds that a node has to accept a connection."""


async def dial(where: HostPort, within: float = CONNECT_TIMEOUT) -> socket.socket:
    """A non-blocking connection to an IP address and port. Raises OSError, TimeoutError."""
    family = socket.AF_INET6 if ":" in where.host else socket.AF_INET
    sock = socket.socket(family, socket.SOCK_STREAM)
    sock.setblocking(False)
    try:
        async with asyncio.timeout(within):
            await asyncio.get_running_loop().sock_connect(sock, (where.host, where.port))
    except BaseException:
        sock.close()
        raise
    return sock
