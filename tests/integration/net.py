"""Addresses, raw connections, XML-RPC and TCPROS headers for the tests.

All of 127.0.0.0/8 is loopback on Linux: each host of a test has a different address there.
"""

import asyncio
import socket
import struct
import xmlrpc.client
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from typing import Any

from examples.demo.fake_http import Address, call, host_and_port
from examples.demo.fake_master import FakeMaster
from examples.demo.fake_node import Header
from rosproxy.ros1.protocol.tcpros import decode_header, encode_header

MASTER = "127.0.1.1"
OUTSIDE = "127.0.1.9"
PROXY = "127.0.2.1"
NODE = "127.0.2.11"
OTHER_NODE = "127.0.2.12"
THIRD_NODE = "127.0.2.13"
HOST = "127.0.3.1"
"""The advertised host: the outside address of the proxy's machine."""

PATIENCE = 30.0
"""Seconds after which something awaited counts as missing, on however busy a machine."""


async def until(
    condition: Callable[[], Any], expectation: str | Callable[[], str], within: float = PATIENCE
) -> None:
    """Wait for a condition, which may be a coroutine function."""
    clock = asyncio.get_running_loop().time
    end = clock() + within
    while True:
        result = condition()
        if await result if isinstance(result, Awaitable) else result:
            return
        if clock() >= end:
            told = expectation if isinstance(expectation, str) else expectation()
            raise AssertionError(f"waited {within:g} s in vain: {told}")
        await asyncio.sleep(0.01)


async def looks(master: FakeMaster, count: int = 3) -> None:
    """Wait for this number of looks at the master, so that the proxy has time to act."""
    so_far = len(master.named("getPid"))
    await until(lambda: len(master.named("getPid")) >= so_far + count, "the proxy looks")


async def refuses(address: Address, source: str = OUTSIDE) -> bool:
    """Whether no program listens there."""
    try:
        async with connect(address, source):
            return False
    except ConnectionResetError:
        return False  # the listener is just closing
    except ConnectionRefusedError:
        return True


async def knock(address: Address, data: bytes, source: str = OUTSIDE) -> str:
    """Connect, send, and wait for the outcome: ``refused``, ``reset``, ``closed`` or ``answered``.

    To prove that there is *no* answer, wait for a later event.
    """
    try:
        async with connect(address, source) as wire:
            await wire.send(data)
            return await wire.outcome()
    except ConnectionRefusedError:
        return "refused"
    except ConnectionResetError:
        return "reset"  # the listener is just closing


@dataclass
class Reply:
    """An HTTP response; header names in lower case."""

    status: int
    headers: dict[str, str] = field(default_factory=dict)
    body: bytes = b""

    @property
    def value(self) -> Any:
        """The value of an XML-RPC response. Raises Fault."""
        return xmlrpc.client.loads(self.body)[0][0]

    @property
    def fault(self) -> int:
        """The fault code of a fault response."""
        try:
            value = self.value
        except xmlrpc.client.Fault as fault:
            return fault.faultCode
        raise AssertionError(f"no fault but {value!r}")


class Wire:
    """A raw TCP connection."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader = reader
        self.writer = writer

    @property
    def sock(self) -> socket.socket:
        """The socket, for options."""
        sock: socket.socket = self.writer.get_extra_info("socket")
        return sock

    async def send(self, data: bytes, slices: int = 0) -> None:
        """Send in slices of this size, each in a separate segment."""
        if not slices:
            self.writer.write(data)
            await self.writer.drain()
            return
        self.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        for start in range(0, len(data), slices):
            self.writer.write(data[start : start + slices])
            await self.writer.drain()
            await asyncio.sleep(0)

    async def exactly(self, size: int) -> bytes:
        """The next ``size`` bytes."""
        async with asyncio.timeout(PATIENCE):
            return await self.reader.readexactly(size)

    async def reply(self, head: bool = False) -> Reply:
        """The next HTTP response, which must have a Content-Length. With ``head`` no body
        follows.
        """
        async with asyncio.timeout(PATIENCE):
            raw = await self.reader.readuntil(b"\r\n\r\n")
            reply = _parse_head(raw)
            if not head and reply.status != 100:
                reply.body = await self.reader.readexactly(int(reply.headers["content-length"]))
        return reply

    async def end(self) -> str:
        """How the peer ends the connection, without data before: ``closed`` or ``reset``."""
        try:
            async with asyncio.timeout(PATIENCE):
                rest = await self.reader.read()
        except ConnectionResetError:
            return "reset"
        assert rest == b"", f"{len(rest)} bytes instead of an end: {rest[:200]!r}"
        return "closed"

    async def outcome(self) -> str:
        """The outcome of a request: ``answered``, ``closed`` or ``reset``."""
        try:
            async with asyncio.timeout(PATIENCE):
                return "answered" if await self.reader.read(1) else "closed"
        except ConnectionResetError:
            return "reset"

    async def stalls(self) -> None:
        """Wait until the peer takes nothing of what is being sent any more."""
        left: list[int] = []

        def stuck() -> bool:
            left.append(self.writer.transport.get_write_buffer_size())
            return left[-1] > 0 and left[-10:] == [left[-1]] * 10

        await until(stuck, "the peer stops reading")

    async def half_close(self) -> None:
        """End the outgoing direction."""
        self.writer.write_eof()
        await asyncio.sleep(0)

    def reset(self) -> None:
        """Reset the connection."""
        self.sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.writer.transport.abort()


def _parse_head(raw: bytes) -> Reply:
    first, *lines = raw.decode("latin-1").split("\r\n")
    headers = {}
    for line in filter(None, lines):
        name, _, value = line.partition(":")
        assert name.lower() not in headers, f"{name} twice"
        headers[name.lower()] = value.strip()
    return Reply(int(first.split(" ")[1]), headers)


@asynccontextmanager
async def connect(address: Address, source: str = OUTSIDE) -> AsyncIterator[Wire]:
    """A connection from an address of this machine; closed at the end."""
    local = None if ":" in address[0] else (source, 0)
    async with asyncio.timeout(PATIENCE):
        reader, writer = await asyncio.open_connection(*address, local_addr=local)
    try:
        yield Wire(reader, writer)
    finally:
        writer.close()
        with suppress(OSError):  # a reset, which the test has seen or meant
            await writer.wait_closed()


def xml(method: str, *params: Any) -> bytes:
    """A method call."""
    return xmlrpc.client.dumps(params, method).encode()


def post(body: bytes, *headers: str, path: str = "/", version: str = "1.1") -> bytes:
    """An HTTP POST. ``headers`` are whole lines. A missing Content-Length is added."""
    lines = [f"POST {path} HTTP/{version}", "Host: somewhere", "Content-Type: text/xml", *headers]
    if not any(line.lower().startswith(("content-length:", "transfer-enc")) for line in headers):
        lines.append(f"Content-Length: {len(body)}")
    return "\r\n".join([*lines, "", ""]).encode() + body


async def exchange(
    address: Address, request: bytes, source: str = OUTSIDE, slices: int = 0
) -> Reply:
    """The response to a raw request."""
    async with connect(address, source) as wire:
        await wire.send(request, slices)
        return await wire.reply()


async def rpc(
    address: Address | str, method: str, *params: Any, source: str = OUTSIDE, host: str = ""
) -> Any:
    """The value of an XML-RPC call. Raises Fault, OSError, EOFError.

    ``host`` is the caller's name for the peer, for example behind NAT.
    """
    return await call(address, method, *params, source=source, host=host)


def topic_header(topic: str = "/chatter", caller: str = "/outside") -> bytes:
    """The connection header of a subscriber."""
    return encode_header({"callerid": caller, "topic": topic, "md5sum": "*", "type": "*"})


def service_header(service: str = "/add", caller: str = "/outside") -> bytes:
    """The connection header of a service client."""
    return encode_header({"callerid": caller, "service": service, "md5sum": "*"})


async def read_header(wire: Wire) -> Header:
    """The next TCPROS header."""
    size = int.from_bytes(await wire.exactly(4), "little")
    return decode_header(await wire.exactly(size))


async def greet(address: Address | str, header: bytes) -> Header:
    """The answer to a TCPROS header."""
    target = host_and_port(address) if isinstance(address, str) else address
    async with connect(target) as wire:
        await wire.send(header)
        return await read_header(wire)
