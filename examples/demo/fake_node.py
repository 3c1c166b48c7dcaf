"""A small ROS node: slave API, TCPROS server, and calls to the master.

The node listens at `address` and registers as `host`, which need not resolve. After the header,
`stream` handles a TCPROS connection: in the tests `stream` echoes, in the demonstration
(:mod:`.players`) the nodes publish and serve.

For tests, `answers` replaces the answer to a slave API method (a function gets the parameters),
`delay` delays all answers, and with `hang` the node never answers. `calls` are the received calls,
`requests` the same on the wire, `headers` the headers of all TCPROS connections. `own_ports` has
the servers of topics and services with a separate port, as in some client libraries.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

from examples.demo.fake_http import (
    Address,
    Answer,
    End,
    FakeHttpServer,
    FakeRequest,
    FakeTcpServer,
    authority,
    call,
    value,
)
from rosproxy.ros1.protocol.tcpros import decode_header, encode_header

Header = dict[str, str]
Stream = Callable[["FakeNode", asyncio.StreamReader, asyncio.StreamWriter, Header], Awaitable[None]]

STRING = {"type": "std_msgs/String", "md5sum": "992ce8a1687cec8c8bd883ec73ca41d1"}
"""The fields of a connection header for the only message type in use here."""


async def read_header(reader: asyncio.StreamReader) -> Header:
    """The next TCPROS connection header; raises HeaderError, EOFError, OSError."""
    size = int.from_bytes(await reader.readexactly(4), "little")
    return decode_header(await reader.readexactly(size))


async def echo(
    node: FakeNode, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, _header: Header
) -> None:
    """Answer a TCPROS header and echo all data until the peer ends the connection."""
    writer.write(encode_header({"callerid": node.name, "md5sum": "*", "node_uri": node.uri}))
    while data := await reader.read(65536):
        writer.write(data)
        await writer.drain()


class FakeNode:
    """A ROS node; see the module."""

    def __init__(self, name: str, address: str, host: str = "") -> None:
        self.name = name
        self.address = address
        self.host = host or address
        self.slave = FakeHttpServer(self._respond)
        self.tcpros = FakeTcpServer(self._serve)
        self.stream: Stream = echo
        self.pid = 100
        self.uri_form = "http://{}/"
        # Every ROS node publishes /rosout. A restarted proxy asks for this topic to find the TCPROS
        # port.
        self.published = {"/rosout": "rosgraph_msgs/Log"}
        self.subscribed: dict[str, str] = {}
        self.hang = False
        self.delay = 0.0
        self.answers: dict[str, Answer | Callable[..., Answer]] = {}
        self.calls: list[tuple[str, tuple[Any, ...]]] = []
        self.requests: list[FakeRequest] = []
        self.headers: list[Header] = []
        self.own_ports: dict[str, FakeTcpServer] = {}

    @property
    def uri(self) -> str:
        """The slave URI."""
        return self.uri_form.format(authority((self.host, self.slave.address[1])))

    @property
    def service_api(self) -> str:
        """The `service_api` of all services without a separate port."""
        return f"rosrpc://{authority((self.host, self.tcpros_port))}"

    @property
    def tcpros_port(self) -> int:
        """The port of the TCPROS server."""
        return self.tcpros.address[1]

    def port_of(self, name: str) -> int:
        """The port of a topic or service."""
        return self.own_ports.get(name, self.tcpros).address[1]

    async def start(self) -> None:
        """Listen; the slave API on the same port as before, if any."""
        await self.slave.start(self.address, self.slave.address[1])
        await self.tcpros.start(self.address)

    async def stop(self) -> None:
        """End without unregistering."""
        for server in (self.tcpros, *self.own_ports.values()):
            await server.stop()
        await self.slave.stop()

    async def call(self, master: Address | str, method: str, *params: Any) -> Any:
        """Call the master, with the node's name and from the node's address."""
        return await call(master, method, self.name, *params, source=self.address)

    async def publish(self, master: Address | str, topic: str = "/chatter") -> list[Any]:
        """Register as a publisher; the ROS triple."""
        self.published[topic] = STRING["type"]
        return await self._register(master, "registerPublisher", topic, STRING["type"])

    async def subscribe(self, master: Address | str, topic: str = "/chatter") -> list[Any]:
        """Register as a subscriber; the ROS triple."""
        self.subscribed[topic] = STRING["type"]
        return await self._register(master, "registerSubscriber", topic, STRING["type"])

    async def serve(self, master: Address | str, service: str = "/add") -> list[Any]:
        """Register a service; the ROS triple."""
        api = f"rosrpc://{authority((self.host, self.port_of(service)))}"
        return await self._register(master, "registerService", service, api)

    async def open_own_port(self, name: str) -> None:
        """Serve a topic or service on a separate port, which is for nothing else."""

        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            header = await read_header(reader)
            if name in (header.get("topic"), header.get("service")):
                self.headers.append(header)
                await self.stream(self, reader, writer, header)
            else:
                writer.write(encode_header({"error": f"{name} alone is here"}))

        await self.close_own_port(name)
        server = self.own_ports[name] = FakeTcpServer(serve)
        await server.start(self.address)

    def name_port_for_any_topic(self) -> None:
        """Answer ``requestTopic`` for topics that the node does not publish, too, like roscpp."""
        protocol = ["TCPROS", self.host, self.tcpros_port]
        self.answers["requestTopic"] = value([1, "", protocol])

    async def close_own_port(self, name: str) -> None:
        """Close the separate port of a topic or service."""
        if name in self.own_ports:
            await self.own_ports.pop(name).stop()

    async def _register(self, master: Address | str, method: str, *params: str) -> list[Any]:
        triple: list[Any] = await self.call(master, method, *params, self.uri)
        return triple

    def updates(self, topic: str = "/chatter") -> list[list[str]]:
        """The publishers of each received publisherUpdate for a topic."""
        return [p[2] for method, p in self.calls if method == "publisherUpdate" and p[1] == topic]

    async def _respond(self, request: FakeRequest) -> Answer:
        self.requests.append(request)
        await asyncio.sleep(self.delay)
        method, params = request.call
        if self.hang:
            return End.HANG
        self.calls.append((method, params))
        answer = self.answers.get(method)
        if answer is None:
            return value(self.run(method, params))
        return answer(*params) if callable(answer) else answer

    def run(self, method: str, params: tuple[Any, ...]) -> list[Any]:
        """Answer a slave API call: the ROS triple."""
        match method, params:
            case (("getPublications" | "getSubscriptions"), _):
                topics = self.published if method == "getPublications" else self.subscribed
                return [1, "topics", [list(item) for item in topics.items()]]
            case "getPid", _:
                return [1, "", self.pid]
            case "requestTopic", (_, str(topic), _):
                if topic not in self.published:
                    return [-1, f"Not a publisher of [{topic}]", []]
                port = self.port_of(topic)
                return [1, f"ready on {self.host}:{port}", ["TCPROS", self.host, port]]
        return [1, "", 0]

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        header = await read_header(reader)
        self.headers.append(header)
        await self.stream(self, reader, writer, header)
