"""A small HTTP server whose answers a test can make as odd as it likes."""

import asyncio
import socket
import struct
import xmlrpc.client
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from enum import Enum
from typing import Any


class End(Enum):
    """What to do instead of answering."""

    RESET = "reset the connection"
    CLOSE = "close the connection"
    HANG = "never answer"


@dataclass
class Request:
    """An HTTP request; header names in lower case."""

    verb: str
    path: str
    headers: dict[str, str] = field(default_factory=dict)
    body: bytes = b""
    source: str = ""

    @property
    def call(self) -> tuple[str, tuple[Any, ...]]:
        """Method and parameters of an XML-RPC call."""
        params, method = xmlrpc.client.loads(self.body)
        return str(method), params


Answer = bytes | End
Respond = Callable[[Request], Awaitable[Answer]]


async def settle() -> None:
    """Let connections end that were accepted in the moment in which a server stopped."""
    for _ in range(10):
        await asyncio.sleep(0)


def ok(body: bytes, *headers: str) -> bytes:
    """A whole response with status 200."""
    lines = ["HTTP/1.1 200 OK", "Content-Type: text/xml", *headers]
    if not any(line.lower().startswith(("content-length:", "transfer-enc")) for line in headers):
        lines.append(f"Content-Length: {len(body)}")
    return "\r\n".join([*lines, "", ""]).encode() + body


def value(result: Any) -> bytes:
    """A whole response that holds an XML-RPC value."""
    return ok(xmlrpc.client.dumps((result,), methodresponse=True).encode())


class HttpFake:
    """An HTTP server with keep-alive."""

    def __init__(self, respond: Respond) -> None:
        self._respond = respond
        self._server: asyncio.Server | None = None
        self._open: dict[asyncio.StreamWriter, asyncio.Task[None]] = {}
        self.connections = 0
        self.address: tuple[str, int] = ("", 0)

    @property
    def open(self) -> int:
        """How many connections there are now."""
        return len(self._open)

    async def start(self, address: str, port: int = 0) -> None:
        """Listen; on a free port if none is given."""
        self._server = await asyncio.start_server(self._serve, address, port, backlog=256)
        self.address = self._server.sockets[0].getsockname()[:2]

    async def stop(self) -> None:
        """Stop listening and close all connections."""
        if self._server is None:
            return
        self._server.close()
        self._server = None
        tasks = list(self._open.values())
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await settle()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task
        if self._server is None:  # accepted while it was stopped
            writer.transport.abort()
            return
        self._open[writer] = task
        self.connections += 1
        try:
            while request := await _read(reader, writer):
                await self._answer(request, writer)
        except (OSError, asyncio.IncompleteReadError, asyncio.CancelledError):
            pass  # the peer, or the test, ended it
        finally:
            del self._open[writer]
            writer.close()

    async def _answer(self, request: Request, writer: asyncio.StreamWriter) -> None:
        answer = await self._respond(request)
        if isinstance(answer, bytes):
            writer.write(answer)
            await writer.drain()
            if b"Connection: close\r\n" in answer:
                raise ConnectionAbortedError
            return
        if answer is End.HANG:
            await asyncio.Event().wait()
        if answer is End.RESET:
            sock = writer.get_extra_info("socket")
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        raise ConnectionAbortedError


async def _read(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> Request | None:
    try:
        head = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1")
    except asyncio.IncompleteReadError:
        return None
    first, *lines = head.split("\r\n")
    verb, path, _ = first.split(" ")
    pairs = (line.partition(":") for line in lines if line)
    headers = {name.lower(): text.strip() for name, _, text in pairs}
    body = await reader.readexactly(int(headers.get("content-length", 0)))
    return Request(verb, path, headers, body, writer.get_extra_info("peername")[0])
