"""TCP and HTTP servers of the fakes, over asyncio streams.

A fake master or node is an XML-RPC server, and a node has a TCPROS server, too. Both servers are a
:class:`FakeTcpServer`, which ends all connections when stopped. The HTTP server reads requests, and
a function writes the whole response, so that a test can give any answer. `call` is the client.
"""

from __future__ import annotations

import asyncio
import random
import socket
import struct
import xmlrpc.client
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from enum import Enum
from typing import Any
from urllib.parse import urlsplit

from rosproxy.shared.machine.resolver import resolve

Address = tuple[str, int]
"""Host and port."""
Streams = tuple[asyncio.StreamReader, asyncio.StreamWriter]
ServeConnection = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]

CALL_SECONDS = 20.0
"""Time limit of a call."""


class End(Enum):
    """Ways to end a call without an answer."""

    RESET = "reset the connection"
    CLOSE = "close the connection"
    HANG = "never answer"


Answer = bytes | End
"""A whole HTTP response, or a way to end without a response."""


@dataclass
class FakeRequest:
    """An HTTP request; header names in lower case."""

    verb: str
    path: str
    headers: dict[str, str]
    body: bytes
    source: str

    @property
    def call(self) -> tuple[str, tuple[Any, ...]]:
        """Method and parameters of an XML-RPC call."""
        params, method = xmlrpc.client.loads(self.body)
        return str(method), params


Respond = Callable[[FakeRequest], Awaitable[Answer]]


def ok(body: bytes, *headers: str) -> bytes:
    """A whole response with status 200; `headers` are whole lines."""
    lines = ["HTTP/1.1 200 OK", "Content-Type: text/xml", *headers]
    if not any(line.lower().startswith(("content-length:", "transfer-enc")) for line in headers):
        lines.append(f"Content-Length: {len(body)}")
    return "\r\n".join([*lines, "", ""]).encode() + body


def value(result: Any) -> bytes:
    """A whole response that holds an XML-RPC value, or a Fault."""
    params = result if isinstance(result, xmlrpc.client.Fault) else (result,)
    return ok(xmlrpc.client.dumps(params, methodresponse=True).encode())


def host_and_port(uri: str) -> Address:
    """Host and port of a URI. Raises ValueError if either is missing."""
    parts = urlsplit(uri)
    if not parts.hostname or not parts.port:
        raise ValueError(f"no host and port in {uri!r}")
    return parts.hostname, parts.port


def is_free(port: int, address: str = "", kind: int = socket.SOCK_STREAM) -> bool:
    """Whether a port is free, for TCP or UDP. Port 0: whether this machine has the address."""
    with socket.socket(type=kind) as probe:
        try:
            probe.bind((address, port))
        except OSError:
            return False
    return True


class PortDraws:
    """Draws ports that are free for TCP and UDP from a range, in order.

    So a freed port comes again only after many other ports: peers may still look for its former
    program. The first port is random. The process reserves each block of ports that it draws from:
    another process that draws from this range, such as a second demonstration, uses other blocks.
    """

    def __init__(self, ports: range) -> None:
        self.ports = ports
        self._next = random.choice(ports)  # noqa: S311
        self._reserved: set[int] = set()

    def draw(self, count: int) -> int:
        """The first of `count` ports in a row. Raises OSError if there are none."""
        kinds = socket.SOCK_STREAM, socket.SOCK_DGRAM
        for _ in self.ports:
            if self._next + count > self.ports.stop:
                self._next = self.ports.start
            row = range(self._next, self._next + count)
            self._next = row.stop
            if not all(self._reserve(block) for block in {port // BLOCK for port in row}):
                continue
            if all(is_free(port, kind=kind) for port in row for kind in kinds):
                return row.start
        raise OSError(f"no {count} ports in a row are free in {self.ports}")

    def _reserve(self, block: int) -> bool:
        """Reserve a block until this process ends.

        False if another process has the block, or if this process has MOST_BLOCKS.
        """
        if block in self._reserved:
            return True
        if len(self._reserved) == MOST_BLOCKS:
            return False
        reservation = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            reservation.bind(f"\0rosproxy-demo-ports-{block}")
        except OSError:
            reservation.close()
            return False
        reservation.detach()
        self._reserved.add(block)
        return True


BLOCK = 100
"""Ports that a process reserves together."""
MOST_BLOCKS = 16
"""The highest number of blocks of a process: so there are blocks for ten processes."""
PORTS = PortDraws(range(15000, 32000))
"""Below the ephemeral range, from which the kernel chooses ports for clients."""
free_ports = PORTS.draw


async def call(
    address: Address | str, method: str, *params: Any, source: str = "", host: str = ""
) -> Any:
    """The value of an XML-RPC call. Raises Fault, ValueError, OSError, EOFError, TimeoutError.

    `source` is the address to call from. `host` replaces the address in the Host header.
    """
    target = host_and_port(address) if isinstance(address, str) else address
    body = xmlrpc.client.dumps(params, method).encode()
    head = f"POST / HTTP/1.1\r\nHost: {host or authority(target)}\r\n"
    async with asyncio.timeout(CALL_SECONDS):
        reader, writer = await connect(target, source)
        try:
            writer.write(f"{head}Content-Length: {len(body)}\r\n\r\n".encode() + body)
            answer = (await reader.readuntil(b"\r\n\r\n")).lower()
            size = int(answer.partition(b"content-length:")[2].split(b"\r\n")[0])
            return xmlrpc.client.loads(await reader.readexactly(size))[0][0]
        finally:
            writer.close()


def authority(address: Address) -> str:
    """Host and port in the form of a URI."""
    host, port = address
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


async def connect(address: Address, source: str = "") -> Streams:
    """Open a connection, from `source` if the family is the same. Raises OSError."""
    # Not by the event loop: uvloop's look-up logs a traceback when the waiting task is cancelled.
    addresses = await resolve(address[0])
    if not addresses:
        raise OSError(f"{address[0]} has no address")
    local = (source, 0) if source and ":" not in addresses[0] else None
    return await asyncio.open_connection(addresses[0], address[1], local_addr=local)


class FakeTcpServer:
    """A server that ends all connections when stopped, like a process that ends.

    `admits` decides by the peer's address. `connections` counts the accepted connections.
    """

    def __init__(self, serve: ServeConnection) -> None:
        self._serve = serve
        self._server: asyncio.Server | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self._is_stopped = False
        self.admits: Callable[[str], bool] = lambda _peer: True
        self.connections = 0
        self.address: Address = ("", 0)

    @property
    def listening(self) -> bool:
        """Whether the server accepts connections."""
        return self._server is not None

    async def start(self, address: str, port: int = 0) -> None:
        """Listen; on a free port if `port` is 0."""
        port = port or free_ports(1)
        self._is_stopped = False
        self._server = await asyncio.start_server(self._accept, address, port, backlog=256)
        self.address = self._server.sockets[0].getsockname()[:2]

    def stop_listening(self) -> None:
        """Accept no more connections. Open connections stay."""
        if self._server is not None:
            self._server.close()
            self._server = None

    async def stop(self) -> None:
        """Stop listening and close all connections."""
        self.stop_listening()
        self._is_stopped = True
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        for _ in range(10):  # connections that were just accepted end, too
            await asyncio.sleep(0)

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        peer = writer.get_extra_info("peername")
        if task is None or peer is None or self._server is None or not self.admits(peer[0]):
            writer.transport.abort()
            return
        self._tasks.add(task)
        self.connections += 1
        try:
            await self._serve(reader, writer)
        except (OSError, EOFError, asyncio.CancelledError):
            pass  # the peer has ended the connection, or `stop` has
        finally:
            await self._close(writer)
            self._tasks.discard(task)

    async def _close(self, writer: asyncio.StreamWriter) -> None:
        """Close a connection after the written data is sent; at once after `stop`."""
        if self._is_stopped:
            writer.transport.abort()
        else:
            writer.close()
        try:
            await writer.wait_closed()
        except asyncio.CancelledError:  # the peer does not read, and `stop` was called
            writer.transport.abort()
        except OSError:
            pass


class FakeHttpServer(FakeTcpServer):
    """An HTTP server with keep-alive."""

    def __init__(self, respond: Respond) -> None:
        super().__init__(self._converse)
        self._respond = respond

    async def _converse(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while True:
            answer = await self._respond(await _read(reader, writer))
            if answer is End.HANG:
                await asyncio.Event().wait()
            if answer is End.RESET:
                sock = writer.get_extra_info("socket")
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            if isinstance(answer, End):
                return
            writer.write(answer)
            await writer.drain()
            if b"Connection: close\r\n" in answer:
                return


async def _read(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> FakeRequest:
    head = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1")
    first, *lines = head.split("\r\n")
    verb, path, _ = first.split(" ")
    pairs = (line.partition(":") for line in lines if line)
    headers = {name.lower(): text.strip() for name, _, text in pairs}
    body = await reader.readexactly(int(headers.get("content-length", 0)))
    return FakeRequest(verb, path, headers, body, writer.get_extra_info("peername")[0])
