"""The inside nodes of a test: a slave API and a TCPROS server, with knobs."""

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

from rosproxy.demo.wire import STRING
from rosproxy.ros1.protocol.tcpros import decode_header, encode_header
from tests.integration.http_fake import Answer, End, HttpFake, Request, settle, value
from tests.integration.net import NODE, Where, Wire, bracketed, connect, rpc, where

Header = dict[str, str]
Stream = Callable[["Node", Wire, Header], Awaitable[None]]


async def echo(node: "Node", wire: Wire, header: Header) -> None:
    """Answer a TCPROS header and send back all that follows, until the peer ends it."""
    await wire.send(encode_header({"callerid": node.name, "md5sum": "*", "node_uri": node.uri}))
    while data := await wire.reader.read(65536):
        await wire.send(data)


class Node:
    """An inside node that lives at ``address`` and calls itself ``host``.

    ``answers`` replaces the answer to a slave API method; ``calls`` are all calls that came;
    ``headers`` are those of all TCPROS connections. ``hang``: accept and never answer.
    """

    def __init__(self, name: str, address: str = NODE, host: str = "") -> None:
        self.name, self.address, self.host = name, address, host or address
        self.slave = HttpFake(self._respond)
        self._tcpros: asyncio.Server | None = None
        self._streams: set[asyncio.Task[None]] = set()
        self.stream: Stream = echo
        self.tcpros_port = 0
        self.pid = 100
        self.published = {"/rosout": "rosgraph_msgs/Log"}
        self.subscribed: dict[str, str] = {}
        self.hang = False
        self.answers: dict[str, Answer] = {}
        self.calls: list[tuple[str, tuple[Any, ...]]] = []
        self.requests: list[Request] = []
        self.headers: list[Header] = []

    @property
    def uri(self) -> str:
        """What it calls itself."""
        return f"http://{bracketed(self.host)}:{self.slave.address[1]}/"

    @property
    def service_api(self) -> str:
        """Where it says its services are."""
        return f"rosrpc://{bracketed(self.host)}:{self.tcpros_port}"

    async def start(self) -> None:
        """Listen; the slave API on the same port as before if there was one."""
        await self.slave.start(self.address, self.slave.address[1])
        await self.start_tcpros()

    async def start_tcpros(self) -> None:
        """Listen for TCPROS on another port than before."""
        self._tcpros = await asyncio.start_server(self._serve, self.address, 0, backlog=256)
        self.tcpros_port = self._tcpros.sockets[0].getsockname()[1]

    async def stop(self) -> None:
        """End, without a word to anybody."""
        await self.stop_tcpros()
        await self.slave.stop()

    async def stop_tcpros(self) -> None:
        """Close the TCPROS server and all its connections."""
        if self._tcpros is None:
            return
        self._tcpros.close()
        self._tcpros = None
        for task in self._streams:
            task.cancel()
        await asyncio.gather(*self._streams, return_exceptions=True)
        await settle()

    async def call(self, master: Where, method: str, *params: Any) -> Any:
        """Call its master, under its own name and from its own address."""
        return await rpc(master, method, self.name, *params, source=self.address)

    async def publish(self, master: Where, topic: str = "/chatter") -> list[Any]:
        """Register as a publisher; the ROS triple."""
        self.published[topic] = STRING.name
        return await self._register(master, "registerPublisher", topic, STRING.name)

    async def subscribe(self, master: Where, topic: str = "/chatter") -> list[Any]:
        """Register as a subscriber; the ROS triple."""
        self.subscribed[topic] = STRING.name
        return await self._register(master, "registerSubscriber", topic, STRING.name)

    async def serve(self, master: Where, service: str = "/add") -> list[Any]:
        """Register a service; the ROS triple."""
        return await self._register(master, "registerService", service, self.service_api)

    async def _register(self, master: Where, method: str, *params: str) -> list[Any]:
        triple: list[Any] = await self.call(master, method, *params, self.uri)
        return triple

    def updates(self, topic: str = "/chatter") -> list[list[str]]:
        """The publishers of each publisherUpdate that came for a topic."""
        return [p[2] for method, p in self.calls if method == "publisherUpdate" and p[1] == topic]

    async def _respond(self, request: Request) -> Answer:
        self.requests.append(request)
        method, params = request.call
        if self.hang:
            return End.HANG
        self.calls.append((method, params))
        return self.answers.get(method) or value(self._run(method, params))

    def _run(self, method: str, params: tuple[Any, ...]) -> list[Any]:
        lists = {"getPublications": self.published, "getSubscriptions": self.subscribed}
        if method in lists:
            return [1, "topics", [list(item) for item in lists[method].items()]]
        if method == "getPid":
            return [1, "", self.pid]
        if method == "requestTopic" and len(params) == 3 and isinstance(params[1], str):
            return self._request_topic(*params)
        return [1, "", 0]

    def _request_topic(self, _caller: str, topic: str, _offer: list[Any]) -> list[Any]:
        if topic not in self.published:
            return [-1, f"Not a publisher of [{topic}]", []]
        where = f"{self.host}:{self.tcpros_port}"
        return [1, f"ready on {where}", ["TCPROS", self.host, self.tcpros_port]]

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task
        if self._tcpros is None:  # accepted while it was stopped
            writer.transport.abort()
            return
        self._streams.add(task)
        try:
            size = int.from_bytes(await reader.readexactly(4), "little")
            header = decode_header(await reader.readexactly(size))
            self.headers.append(header)
            await self.stream(self, Wire(reader, writer), header)
        except (OSError, asyncio.IncompleteReadError, asyncio.CancelledError):
            pass  # the peer, or the test, ended it
        finally:
            self._streams.discard(task)
            writer.close()


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


async def greet(address: Where | str, header: bytes) -> Header:
    """What a TCPROS header is answered with."""
    target = where(address) if isinstance(address, str) else address
    async with connect(target) as wire:
        await wire.send(header)
        return await read_header(wire)
