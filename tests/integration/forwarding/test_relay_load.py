"""The relay under load, in a separate process: memory, fairness, descriptors, threads.

ROSPROXY_TEST_STALL is the time in seconds for which a reader stalls; 60 for a thorough run.
"""

import asyncio
import gzip
import os
import selectors
import socket
import threading
from collections.abc import Iterator
from contextlib import AsyncExitStack, ExitStack, contextmanager, suppress
from typing import Any

from examples.demo.fake_http import Address, host_and_port, value
from rosproxy.ros1.protocol.tcpros import encode_header
from tests.integration.net import OUTSIDE, connect, exchange, post, read_header, topic_header, until

STALL = float(os.environ.get("ROSPROXY_TEST_STALL", "1"))
OFFERED = 1 << 30
MIB = 1 << 20
WELCOME = encode_header({"callerid": "/talker"})
BLOCK = bytes(MIB)


class BlockingNode:
    """The TCPROS side of a node, in threads: each connection is handed to ``serve``."""

    def __init__(self, address: str, serve: Any) -> None:
        self._listener = socket.create_server((address, 0), backlog=256)
        self.port = self._listener.getsockname()[1]
        self._serve = serve
        self._threads: list[threading.Thread] = []
        self._accepting = self._start(self._accept)

    def close(self) -> None:
        """Stop and wait for all threads."""
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        for thread in self._threads:
            thread.join(10)

    def _start(self, function: Any, *args: Any) -> threading.Thread:
        thread = threading.Thread(target=function, args=args, daemon=True)
        self._threads.append(thread)
        thread.start()
        return thread

    def _accept(self) -> None:
        while True:
            try:
                conn, _ = self._listener.accept()
            except OSError:
                return
            self._start(self._run, conn)

    def _run(self, conn: socket.socket) -> None:
        with conn:
            try:
                conn.recv(int.from_bytes(receive(conn, 4), "little"), socket.MSG_WAITALL)
                conn.sendall(WELCOME)
                self._serve(conn)
            except OSError:
                return  # the peer ended the connection


def receive(conn: socket.socket, size: int) -> bytes:
    return conn.recv(size, socket.MSG_WAITALL)


@contextmanager
def blocking_node(node: Any, serve: Any) -> Iterator[None]:
    """Let a node's topics be served by threads."""
    made = BlockingNode(node.address, serve)
    node.answers["requestTopic"] = value([1, "ready", ["TCPROS", node.address, made.port]])
    try:
        yield
    finally:
        made.close()
        del node.answers["requestTopic"]


def subscribe(address: Address) -> socket.socket:
    """A blocking connection to a topic, the headers exchanged."""
    conn = socket.create_connection(address, 10, (OUTSIDE, 0))
    conn.sendall(topic_header())
    receive(conn, int.from_bytes(receive(conn, 4), "little"))
    conn.settimeout(STALL + 30)
    return conn


def drain(conn: socket.socket, stall: float = 0.0) -> int:
    """Stall, then read to the end; how many bytes came."""
    stop = threading.Event()
    total = 0
    buffer = bytearray(MIB)
    stop.wait(stall)
    while size := conn.recv_into(buffer):
        total += size
    return total


def offer(conn: socket.socket) -> None:
    for _ in range(OFFERED // MIB):
        conn.sendall(BLOCK)


async def lease_of(process: Any, master: Any, node: Any) -> Address:
    await node.publish(process.master)
    return host_and_port(master.holds("publishers", "/chatter")[0])


async def watch(process: Any, task: "asyncio.Task[Any]") -> int:
    """The most memory that a process holds while a task runs, compared with now; in bytes."""
    before = most = process.resident()
    while not task.done():
        most = max(most, process.resident())
        await asyncio.sleep(0.05)
    return int(most - before)


async def test_a_stalled_subscriber_does_not_move_the_proxys_memory(start_process, master, node):
    process = start_process()
    lease = await lease_of(process, master, node)
    with blocking_node(node, offer), await asyncio.to_thread(subscribe, lease) as conn:
        reading = asyncio.create_task(asyncio.to_thread(drain, conn, STALL))
        grown = await watch(process, reading)
        assert await reading == OFFERED
    assert grown < 4 * MIB


async def test_a_stalled_node_does_not_move_the_proxys_memory(start_process, master, node):
    process = start_process()
    got = []
    lease = await lease_of(process, master, node)

    def give() -> None:
        with subscribe(lease) as conn:
            offer(conn)

    with blocking_node(node, lambda conn: got.append(drain(conn, STALL))):
        giving = asyncio.create_task(asyncio.to_thread(give))
        grown = await watch(process, giving)
        await giving
        await until(lambda: got, "the node has read all")
    assert got == [OFFERED]
    assert grown < 4 * MIB


class Streams:
    """A thread that writes to, or reads from, many connections in fair turns."""

    def __init__(self, conns: list[socket.socket], event: int, turn: Any) -> None:
        self.moved = dict.fromkeys(conns, 0)
        self._selector = selectors.DefaultSelector()
        for conn in conns:
            conn.setblocking(False)
            self._selector.register(conn, event)
        self._turn = turn
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def close(self) -> None:
        """Stop; the connections stay open."""
        self._stop.set()
        self._thread.join()
        self._selector.close()

    def _run(self) -> None:
        while not self._stop.is_set():
            for key, _ in self._selector.select(0.1):
                conn: Any = key.fileobj
                with suppress(BlockingIOError):
                    self.moved[conn] += self._turn(conn)


async def test_a_hundred_streams_all_make_progress(start_process, master, node):
    process = start_process()
    over = threading.Event()
    lease = await lease_of(process, master, node)
    inside: list[socket.socket] = []
    buffer = bytearray(65536)

    def hold(conn: socket.socket) -> None:
        inside.append(conn)
        over.wait(30)

    with blocking_node(node, hold), ExitStack() as stack:
        outside = [
            stack.enter_context(await asyncio.to_thread(subscribe, lease)) for _ in range(100)
        ]
        stack.callback(over.set)
        await until(lambda: len(inside) == 100, "all arrive")
        writing = Streams(inside, selectors.EVENT_WRITE, lambda conn: conn.send(buffer))
        stack.callback(writing.close)
        reading = Streams(outside, selectors.EVENT_READ, lambda conn: conn.recv_into(buffer))
        stack.callback(reading.close)
        await until(lambda: min(reading.moved.values()) > MIB, "all streams flow")
        before = dict(reading.moved)

        def moved() -> list[int]:
            return [reading.moved[conn] - before[conn] for conn in outside]

        await until(lambda: min(moved()) > MIB, "all streams go on")
        moved_by_then = moved()
    average = sum(moved_by_then) / len(moved_by_then)
    assert min(moved_by_then) > average / 10, sorted(moved_by_then)


async def test_250_connections_leave_neither_descriptors_nor_threads(start_process, master, node):
    process = start_process()
    lease = await lease_of(process, master, node)

    async def use(count: int) -> None:
        async with AsyncExitStack() as stack:
            wires = [await stack.enter_async_context(connect(lease)) for _ in range(count)]
            await asyncio.gather(*(wire.send(topic_header()) for wire in wires))
            await asyncio.gather(*(read_header(wire) for wire in wires))
            await asyncio.gather(*(wire.send(b"x" * 40_000) for wire in wires))
            await asyncio.gather(*(wire.exactly(40_000) for wire in wires))
            assert process.threads() >= 2 * count

    await use(5)
    await until(lambda: process.threads() < 10, "the first relays end")
    before = process.descriptors(), process.threads()
    await use(250)
    await until(lambda: process.threads() <= before[1], "all threads end")
    await until(lambda: process.descriptors() <= before[0] + 2, "all connections end")


async def test_a_decompression_bomb_costs_little_memory(start_process):
    process = start_process()
    bomb = gzip.compress(bytes(300 * MIB), 1)
    before = process.most_memory()
    reply = await exchange(process.master, post(bomb, "Content-Encoding: gzip"))
    assert reply.status == 415
    assert process.most_memory() - before < 100 * MIB


async def test_the_soft_limit_of_descriptors_is_no_limit(start_process, master, node):
    process = start_process(prefix=["sh", "-c", 'ulimit -Sn 64; exec "$@"', "sh"])
    lease = await lease_of(process, master, node)
    async with AsyncExitStack() as stack:
        for _ in range(40):
            wire = await stack.enter_async_context(connect(lease))
            await wire.send(topic_header())
            await read_header(wire)


async def test_a_process_with_stalled_connections_ends(start_process, master, node):
    process = start_process()
    lease = await lease_of(process, master, node)
    with blocking_node(node, offer), await asyncio.to_thread(subscribe, lease) as conn:
        await asyncio.sleep(0.3)
        # The subscriber reads nothing.
        assert await asyncio.to_thread(process.terminate) == 0
        conn.close()
