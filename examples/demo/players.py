"""The demonstration's nodes: a talker, a listener and an adder, over real TCPROS.

When a connection to a publisher ends, roscpp tries again after 0.1 s, and then after twice as long
each time. rospy tries again when the master's next publisherUpdate names the publisher. The
listener does both.
"""

from __future__ import annotations

import asyncio
import os
import struct
from contextlib import suppress
from time import monotonic
from typing import Any

from examples.demo.fake_http import Address, Streams, connect, host_and_port
from examples.demo.fake_master import CALL_ERRORS
from examples.demo.fake_node import STRING, FakeNode, Header, read_header
from rosproxy.ros1.protocol.tcpros import encode_header

RATE = 20
"""Messages a second that each talker publishes."""
FIRST_RETRY = 0.1
LONGEST_RETRY = 20.0
"""Seconds between a listener's attempts to connect."""

ADD_TWO_INTS = {"type": "rospy_tutorials/AddTwoInts", "md5sum": "6a2e34150c00229791cc89ff309fff21"}
OPERANDS = struct.Struct("<Iqq")
SUM = struct.Struct("<Iq")
LENGTH = struct.Struct("<I")


class Refused(ConnectionError):
    """A node refused a request; the text is the node's reason."""


def in_words(problem: BaseException) -> str:
    """The text of an error, for people."""
    if isinstance(problem, OSError) and problem.errno:
        # asyncio puts addresses into the text, and look-ups have negative error numbers.
        return os.strerror(problem.errno) if problem.errno > 0 else problem.strerror or ""
    return str(problem) or type(problem).__name__


class Player(FakeNode):
    """A node that connects to other nodes."""

    async def register(self, master: str) -> None:
        """Register at the master; like every ROS node, as a publisher of /rosout."""
        await self._register(master, "registerPublisher", "/rosout", self.published["/rosout"])

    async def ask(self, uri: str, method: str, *params: Any) -> Any:
        """The value of a ROS call under this node's name. Raises Refused, and CALL_ERRORS."""
        code, message, value = await self.call(uri, method, *params)
        if code != 1:
            raise Refused(f"{method}: {message}")
        return value

    async def greet(self, address: Address, **fields: str) -> Streams:
        """Open a TCPROS connection and exchange headers. Raises Refused, and CALL_ERRORS."""
        reader, writer = await connect(address, self.address)
        try:
            writer.write(encode_header({"callerid": self.name, **fields}))
            answer = await read_header(reader)
            if "error" in answer:
                raise Refused(answer["error"])
        except BaseException:
            writer.close()
            raise
        return reader, writer

    async def add(self, master: str, service: str, a: int, b: int) -> int:
        """Look up an adder at the master and call the service. Raises Refused, and CALL_ERRORS."""
        address = host_and_port(await self.ask(master, "lookupService", service))
        async with asyncio.timeout(2.0):
            reader, writer = await self.greet(address, service=service, **ADD_TWO_INTS)
            try:
                writer.write(OPERANDS.pack(16, a, b))
                if await reader.readexactly(1) != b"\x01":
                    raise Refused(f"{service} failed")
                return int(SUM.unpack(await reader.readexactly(SUM.size))[1])
            finally:
                writer.close()


class Talker(Player):
    """Publishes the numbers from 1. `sent` has the numbers for which a subscriber was connected.

    `connections` counts the subscribers so far. `sent_over` has this count for each sent number.
    """

    def __init__(self, *who: str, topic: str) -> None:
        super().__init__(*who)
        self.topic = topic
        self.stream = self._admit
        self.number = 0
        self.sent: dict[int, float] = {}
        self.connections = 0
        self.sent_over: dict[int, int] = {}
        self.subscribers: set[asyncio.StreamWriter] = set()

    @property
    def connected(self) -> bool:
        """Whether a subscriber is connected."""
        return bool(self.subscribers)

    async def register(self, master: str) -> None:
        """Offer the topic."""
        await super().register(master)
        await self.publish(master, self.topic)

    async def talk(self) -> None:
        """Publish until cancelled."""
        while True:
            self.number += 1
            if self.subscribers:
                self.sent[self.number] = monotonic()
                self.sent_over[self.number] = self.connections
            text = str(self.number).encode()
            for writer in self.subscribers:
                writer.write(LENGTH.pack(len(text) + 4) + LENGTH.pack(len(text)) + text)
            await asyncio.sleep(1 / RATE)

    async def _admit(
        self, _node: FakeNode, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, _: Header
    ) -> None:
        writer.write(encode_header({"callerid": self.name, "topic": self.topic, **STRING}))
        self.connections += 1
        self.subscribers.add(writer)
        try:
            while await reader.read(1024):
                pass
        finally:
            self.subscribers.discard(writer)


class Listener(Player):
    """Subscribes. `received` has each number with its time, `problem` the last error."""

    def __init__(self, *who: str, topic: str) -> None:
        super().__init__(*who)
        self.topic = topic
        self.received: list[tuple[int, float]] = []
        self.problem = ""
        self.connected: set[str] = set()
        self._publishers: dict[str, tuple[asyncio.Task[None], asyncio.Event]] = {}

    async def register(self, master: str) -> None:
        """Subscribe, and follow the topic's publishers from now on."""
        await super().register(master)
        answer = await self.subscribe(master, self.topic)
        if not self.updates(self.topic):  # an update that overtook the answer is newer
            self._follow(answer[2])

    def run(self, method: str, params: tuple[Any, ...]) -> list[Any]:
        """Answer a slave API call."""
        if method == "publisherUpdate" and params[1] == self.topic:
            self._follow(params[2])
        return super().run(method, params)

    async def stop(self) -> None:
        """End all connections."""
        tasks = [task for task, _ in self._publishers.values()]
        self._follow([])
        await asyncio.gather(*tasks, return_exceptions=True)
        await super().stop()

    def _follow(self, publishers: list[str]) -> None:
        for uri in publishers:
            if uri in self._publishers:
                self._publishers[uri][1].set()
            else:
                named = asyncio.Event()
                task = asyncio.ensure_future(self._keep_connected(uri, named))
                self._publishers[uri] = task, named
        for uri in self._publishers.keys() - {*publishers}:
            self._publishers.pop(uri)[0].cancel()

    async def _keep_connected(self, uri: str, named: asyncio.Event) -> None:
        pause = FIRST_RETRY
        while True:
            named.clear()
            try:
                _, host, port = await self.ask(uri, "requestTopic", self.topic, [["TCPROS"]])
                reader, writer = await self.greet((host, port), topic=self.topic, **STRING)
                pause = FIRST_RETRY
                await self._listen(uri, reader, writer)
            except CALL_ERRORS as problem:
                self.problem = in_words(problem)
            with suppress(TimeoutError):
                await asyncio.wait_for(named.wait(), pause)
            pause = min(pause * 2, LONGEST_RETRY)

    async def _listen(
        self, uri: str, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        self.connected.add(uri)
        try:
            while True:
                body = await reader.readexactly(LENGTH.unpack(await reader.readexactly(4))[0])
                self.received.append((int(body[4:]), monotonic()))
        finally:
            self.connected.discard(uri)
            writer.close()


class Adder(Player):
    """Offers a service that adds two integers; `answered` counts the calls."""

    def __init__(self, *who: str, service: str) -> None:
        super().__init__(*who)
        self.service = service
        self.stream = self._answer
        self.answered = 0

    async def register(self, master: str) -> None:
        """Offer the service."""
        await super().register(master)
        await self.serve(master, self.service)

    async def _answer(
        self, _node: FakeNode, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, _: Header
    ) -> None:
        writer.write(encode_header({"callerid": self.name, **ADD_TWO_INTS}))
        while True:
            _size, a, b = OPERANDS.unpack(await reader.readexactly(OPERANDS.size))
            self.answered += 1
            writer.write(b"\x01" + SUM.pack(8, a + b))
            await writer.drain()


Actor = Talker | Listener | Adder
