"""TCP sockets: bound, listening, connected, looked into and closed.

Everything here is non-blocking and belongs to one event loop. A bound socket that does not listen
refuses connections and keeps its port from everybody else; `leases` builds on that.
"""

import asyncio
import contextlib
import socket
import struct

from rosproxy.net.addresses import HostPort

BACKLOG = 256
CONNECT_TIMEOUT = 5.0
"""Seconds that a peer has to accept a connection."""
SILENCE_TIMEOUT = 30.0
"""Seconds in which a client has to send what is waited for before its connection is closed."""

_LINGER_RESET = struct.pack("ii", 1, 0)


def bind(address: str, port: int) -> socket.socket:
    """A bound, non-blocking TCP socket that does not listen yet. Raises OSError."""
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    sock = socket.socket(family, socket.SOCK_STREAM)
    try:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if family == socket.AF_INET6:
            sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)
        sock.bind((address, port))
    except OSError:
        sock.close()
        raise
    sock.setblocking(False)
    return sock


def listen(address: str, port: int) -> socket.socket:
    """A listening, non-blocking TCP socket. Raises OSError."""
    sock = bind(address, port)
    sock.listen(BACKLOG)
    return sock


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


async def peek(conn: socket.socket, size: int) -> bytes:
    """The first bytes of a connection, left where they are; fewer if it ends before.

    The kernel wakes the reader only at that many bytes (SO_RCVLOWAT), however small the slices in
    which they come. Raises TimeoutError after SILENCE_TIMEOUT, OSError.
    """
    conn.setsockopt(socket.SOL_SOCKET, socket.SO_RCVLOWAT, size)
    async with asyncio.timeout(SILENCE_TIMEOUT):
        await _readable(conn)
        first = conn.recv(size, socket.MSG_PEEK)
    conn.setsockopt(socket.SOL_SOCKET, socket.SO_RCVLOWAT, 1)
    return first


async def read_exactly(conn: socket.socket, size: int) -> bytes:
    """So many bytes, taken off a connection. Raises EOFError if it ends before, OSError."""
    loop, parts = asyncio.get_running_loop(), []
    while size:
        part = await loop.sock_recv(conn, min(size, 65536))
        if not part:
            raise EOFError("the connection ended too early")
        parts.append(part)
        size -= len(part)
    return b"".join(parts)


def reset_on_close(sock: socket.socket) -> None:
    """Make closing a socket send a reset instead of an orderly end."""
    with contextlib.suppress(OSError):
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _LINGER_RESET)


async def _readable(conn: socket.socket) -> None:
    loop = asyncio.get_running_loop()
    ready = asyncio.Event()
    loop.add_reader(conn, ready.set)
    try:
        await ready.wait()
    finally:
        loop.remove_reader(conn)
