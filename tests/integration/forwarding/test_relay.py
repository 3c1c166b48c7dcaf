"""The relay: every byte, in order, both ways; ends, resets and back-pressure passed on."""

import asyncio
import errno
import fcntl
import hashlib
import os
import random
import socket
import threading
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

from rosproxy.forwarding import relay, relay_set
from tests.integration.net import (
    PATIENCE,
    Wire,
    connect,
    read_header,
    refuses,
    topic_header,
    until,
)

BOTH_LOOPS = True
THRESHOLDS = [relay.COPY_BYTES, 4 * relay.COPY_BYTES, relay.BLOCK_BYTES, relay.PIPE_BYTES]


class Ends:
    """Both ends of a relayed connection, as raw connections of the test."""

    def __init__(self, outside: Wire, inside: Wire) -> None:
        self.outside = outside
        self.inside = inside


@pytest.fixture
async def lease(proxy, node) -> Any:
    await node.publish(proxy.master)
    return proxy.lease(node)


@asynccontextmanager
async def relayed(node: Any, lease: Any) -> AsyncIterator[Ends]:
    """A relayed connection; the node's end stays in the hands of the test."""
    arrived: asyncio.Future[Wire] = asyncio.get_running_loop().create_future()
    over = asyncio.Event()

    async def hold(
        node: Any, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, header: Any
    ) -> None:
        arrived.set_result(Wire(reader, writer))
        await over.wait()

    before = node.stream
    node.stream = hold
    async with connect(lease) as outside:
        await outside.send(topic_header())
        try:
            yield Ends(outside, await arrived)
        finally:
            node.stream = before
            over.set()


async def test_a_half_close_passes_and_the_other_way_stays_open(proxy, node, lease):
    async with relayed(node, lease) as ends:
        for sender, receiver in ((ends.outside, ends.inside), (ends.inside, ends.outside)):
            await sender.send(b"last words")
            await sender.half_close()
            async with asyncio.timeout(PATIENCE):
                assert await receiver.reader.read() == b"last words"
            if sender is ends.outside:
                await ends.inside.send(b"still here")
                assert await ends.outside.exactly(10) == b"still here"
    await proxy.quiet()


@pytest.mark.parametrize("who", ["outside", "inside"])
@pytest.mark.parametrize("after", ["nothing", "data", "a half close"])
async def test_a_reset_passes_as_a_reset(proxy, node, lease, who, after):
    async with relayed(node, lease) as ends:
        resetting = getattr(ends, who)
        other = ends.inside if who == "outside" else ends.outside
        if after == "data":
            await resetting.send(b"x" * 100_000)
            assert await other.exactly(100_000) == b"x" * 100_000
        elif after == "a half close":
            await other.half_close()
            await until(resetting.reader.at_eof, "the half close arrives")
        resetting.reset()
        assert await other.end() == "reset"
    await proxy.quiet()


@pytest.mark.parametrize("who", ["outside", "inside"])
async def test_a_reset_passes_once_the_other_side_reads_on(proxy, node, lease, who):
    async with relayed(node, lease) as ends:
        resetting = getattr(ends, who)
        other = ends.inside if who == "outside" else ends.outside
        resetting.sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 65536)
        flood = asyncio.create_task(resetting.send(b"x" * 50_000_000))
        await resetting.stalls()
        resetting.reset()
        await asyncio.gather(flood, return_exceptions=True)
        with pytest.raises(ConnectionResetError):
            await digest(other)
    await proxy.quiet()


@pytest.mark.parametrize("stalled", ["outside", "inside"])
async def test_a_reader_that_stalls_and_leaves_ends_the_writer(proxy, node, lease, stalled):
    async with relayed(node, lease) as ends:
        reader = getattr(ends, stalled)
        writer = ends.inside if stalled == "outside" else ends.outside
        flood = asyncio.create_task(writer.send(b"x" * 50_000_000))
        await writer.stalls()
        reader.reset()
        with pytest.raises(ConnectionError):
            await flood
    await proxy.quiet()


def slices(data: bytes, seed: int) -> list[bytes]:
    """The same bytes in pieces of random sizes, mostly near the thresholds of the relay."""
    chooser = random.Random(seed)
    parts = []
    start = 0
    while start < len(data):
        near = chooser.choice([1, 100, 3000, *THRESHOLDS])
        size = max(1, near + chooser.choice([-1, 0, 1, chooser.randrange(50)]))
        parts.append(data[start : start + size])
        start += size
    return parts


async def write(wire: Wire, chunks: list[bytes]) -> None:
    for chunk in chunks:
        await wire.send(chunk)
        if len(chunk) % 3 == 0:
            await asyncio.sleep(0.0005)
    await wire.half_close()


async def digest(wire: Wire) -> str:
    seen = hashlib.sha256()
    while data := await wire.reader.read(1 << 20):
        seen.update(data)
    return seen.hexdigest()


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("least_pipe", [relay.LEAST_PIPE_BYTES, 1 << 40], ids=["splice", "copies"])
async def test_bytes_arrive_intact_both_ways_at_once(
    proxy, node, lease, seed, least_pipe, monkeypatch
):
    monkeypatch.setattr(relay, "LEAST_PIPE_BYTES", least_pipe)
    outward = random.Random(seed).randbytes(3_000_001)
    inward = os.urandom(2_000_003)
    async with relayed(node, lease) as ends, asyncio.timeout(PATIENCE):
        *_, got_outside, got_inside = await asyncio.gather(
            write(ends.inside, slices(outward, seed)),
            write(ends.outside, slices(inward, seed + 100)),
            digest(ends.outside),
            digest(ends.inside),
        )
    assert got_outside == hashlib.sha256(outward).hexdigest()
    assert got_inside == hashlib.sha256(inward).hexdigest()
    await proxy.quiet()
    for direction, size in (("outward", len(outward)), ("inward", len(inward))):
        series = {"kind": "topic", "name": "/chatter", "direction": direction}
        assert proxy.metric("relayed_bytes_total", **series) == size


async def test_without_a_descriptor_for_a_pipe_bytes_are_copied(node, lease, monkeypatch):
    def fail() -> None:
        raise OSError(errno.EMFILE, "no descriptor left")

    monkeypatch.setattr(os, "pipe", fail)
    async with relayed(node, lease) as ends:
        data = os.urandom(500_000)
        _, got = await asyncio.gather(ends.inside.send(data), ends.outside.exactly(len(data)))
        assert got == data


async def test_single_messages_of_every_size_around_the_thresholds(node, lease):
    async with relayed(node, lease) as ends:
        for size in sorted({t + d for t in THRESHOLDS for d in (-1, 0, 1)} | {1, 1_000_000}):
            data = os.urandom(size)
            for sender, receiver in ((ends.outside, ends.inside), (ends.inside, ends.outside)):
                _, got = await asyncio.gather(sender.send(data), receiver.exactly(size))
                assert got == data, size


async def test_a_port_that_many_want_is_asked_for_once(node, lease):
    async with AsyncExitStack() as stack:
        wires = [await stack.enter_async_context(connect(lease)) for _ in range(20)]
        await asyncio.gather(*(wire.send(topic_header()) for wire in wires))
        await asyncio.gather(*(read_header(wire) for wire in wires))
    assert [name for name, _ in node.calls].count("requestTopic") == 1


async def test_the_status_tells_of_open_connections(proxy, node, lease):
    async with relayed(node, lease) as ends:
        await ends.inside.send(b"x" * 1000)
        await ends.outside.exactly(1000)

        def shown() -> dict[str, Any]:
            (connection,) = proxy.app.status()["nodes"][0]["connections"]
            return dict(connection)

        await until(lambda: shown()["sent"], "the bytes are counted")
        assert {**shown(), "sent_rate": 0, "received_rate": 0} == {
            "kind": "topic",
            "name": "/chatter",
            "caller_id": "/outside",
            "peer": "127.0.1.9",
            "sent": 1000,
            "received": 0,
            "sent_rate": 0,
            "received_rate": 0,
        }


async def test_connections_leave_neither_descriptors_nor_threads(proxy, node, lease):
    async def once(i: int) -> None:
        async with connect(lease) as wire:
            await wire.send(topic_header())
            await read_header(wire)
            await wire.send(b"x" * 40_000)
            await wire.exactly(40_000)
            if i % 3 == 0:
                wire.reset()

    for round_ in range(2):
        await proxy.quiet()
        before = len(os.listdir("/proc/self/fd")), threading.active_count()
        for _ in range(4):
            await asyncio.gather(*(once(i) for i in range(30 * (1 + round_))))
        await proxy.quiet()
    await until(lambda: len(os.listdir("/proc/self/fd")) <= before[0] + 2, "all are closed")
    assert threading.active_count() <= before[1]
    assert proxy.endpoint(node).connections == 0


@pytest.mark.parametrize("started", [0, 1])
async def test_without_a_thread_left_a_connection_is_reset(
    proxy, node, lease, monkeypatch, started
):
    async with relayed(node, lease):
        pass
    await proxy.quiet()
    real = threading.Thread.start
    budget = [started]

    def start(thread: threading.Thread) -> None:
        if thread.name.startswith("relay"):
            if not budget[0]:
                raise RuntimeError("can't start new thread")
            budget[0] -= 1
        real(thread)

    monkeypatch.setattr(threading.Thread, "start", start)
    before = len(os.listdir("/proc/self/fd"))
    async with connect(lease) as wire:
        await wire.send(topic_header() + b"says more")
        assert await wire.end() == "reset"
    await proxy.quiet()
    assert proxy.endpoint(node).connections == 0
    await until(lambda: len(os.listdir("/proc/self/fd")) <= before, "all is closed")


async def test_a_lease_that_closes_keeps_its_connections(proxy, node, lease):
    async with relayed(node, lease) as ends:
        await node.slave.stop()
        await until(lambda: refuses(lease), "the port refuses")
        await ends.inside.send(b"still here")
        assert await ends.outside.exactly(10) == b"still here"


async def test_stopping_the_proxy_ends_its_connections(make_proxy, node):
    proxy = await make_proxy()
    await node.publish(proxy.master)
    async with AsyncExitStack() as stack:
        both = [await stack.enter_async_context(relayed(node, proxy.lease(node))) for _ in range(3)]
        flood = asyncio.create_task(both[0].inside.send(b"x" * 50_000_000))
        await proxy.stop()  # does not wait for a reader of the flood
        for ends in both[1:]:
            assert await ends.outside.end() == "closed"
            assert await ends.inside.end() == "closed"
        await asyncio.gather(flood, return_exceptions=True)


async def test_in_copy_mode_nothing_is_spliced(make_proxy, node, monkeypatch):
    def fail(*_: Any) -> None:
        raise AssertionError("spliced")

    monkeypatch.setattr(os, "pipe", fail)
    monkeypatch.setattr(os, "splice", fail)
    proxy = await make_proxy(data_plane="copy")
    await node.publish(proxy.master)
    async with relayed(node, proxy.lease(node)) as ends:
        data = random.Random(8).randbytes(3 * relay.BLOCK_BYTES + 17)
        for sender, receiver in ((ends.outside, ends.inside), (ends.inside, ends.outside)):
            _, got = await asyncio.gather(sender.send(data), receiver.exactly(len(data)))
            assert got == data


async def test_a_subscriber_that_says_nothing_costs_one_thread(proxy, node, lease):
    former = set(threading.enumerate())

    def relaying() -> int:
        return sum(
            thread.name.startswith("relay ") for thread in set(threading.enumerate()) - former
        )

    async with relayed(node, lease) as ends:
        await ends.inside.send(b"message")
        assert await ends.outside.exactly(7) == b"message"
        assert relaying() == 1
        await ends.outside.send(b"says something")
        assert await ends.inside.exactly(14) == b"says something"
        assert relaying() == 2
    await proxy.quiet()


async def test_many_subscribers_that_leave_at_once_are_all_noticed(proxy, node, lease, monkeypatch):
    monkeypatch.setattr(relay_set, "STARTS_PER_TURN", 3)
    async with AsyncExitStack() as stack:
        for _ in range(10):
            await stack.enter_async_context(relayed(node, lease))
        assert proxy.metric("open_connections") == 10
    await proxy.quiet()


async def test_further_streams_have_smaller_pipes(node, lease, monkeypatch):
    """The user's pages for pipes are not used up by the first streams."""
    monkeypatch.setattr(relay, "MOST_LARGE_PIPES", 1)
    sizes: list[int] = []
    real = os.splice

    def splice(source: int, target: int, size: int) -> int:
        with suppress(OSError):
            sizes.append(fcntl.fcntl(target, fcntl.F_GETPIPE_SZ))
        return real(source, target, size)

    monkeypatch.setattr(os, "splice", splice)
    async with AsyncExitStack() as stack:
        floods = []
        for _ in range(3):
            ends = await stack.enter_async_context(relayed(node, lease))
            floods.append(asyncio.create_task(ends.inside.send(b"x" * 50_000_000)))
        await until(lambda: len(set(sizes)) > 1, "a second stream is spliced")
        for flood in floods:
            flood.cancel()
        await asyncio.gather(*floods, return_exceptions=True)
    assert set(sizes) == {relay.PIPE_BYTES, relay.FURTHER_PIPE_BYTES}


@pytest.mark.parametrize("plane", ["splice", "copy"])
async def test_many_streams_do_not_exhaust_the_memory_of_tcp(make_proxy, node, monkeypatch, plane):
    """At 1,000 saturated streams Linux dropped packets, and some streams got nothing."""
    monkeypatch.setattr(relay, "MOST_UNBOUNDED_DIRECTIONS", 1)
    proxy = await make_proxy(data_plane=plane)
    await node.publish(proxy.master)
    async with AsyncExitStack() as stack:
        streams = [await stack.enter_async_context(relayed(node, proxy.lease(node)))]
        read_on = asyncio.Event()
        floods = [asyncio.create_task(flood(streams[0], read_on))]
        await streams[0].inside.stalls()
        assert buffers(streams) != {BOUNDED}
        streams.append(await stack.enter_async_context(relayed(node, proxy.lease(node))))
        floods.append(asyncio.create_task(flood(streams[1], read_on)))
        await streams[1].inside.stalls()
        read_on.set()
        await until(lambda: buffers(streams) == {BOUNDED}, "both are bounded")
        assert await asyncio.gather(*floods) == [FLOOD, FLOOD]
    await proxy.quiet()


BOUNDED = (2 * relay.RECEIVE_BUFFER_BYTES, 2 * relay.SEND_BUFFER_BYTES)
"""Linux doubles what is asked for."""
FLOOD = 100_000_000


async def flood(ends: Ends, read_on: asyncio.Event) -> int:
    """Send many bytes from inside, and read outside after ``read_on``. Return the number of
    bytes.
    """
    sending = asyncio.create_task(ends.inside.send(bytes(FLOOD)))
    await read_on.wait()
    size = len(await ends.outside.exactly(FLOOD))
    await sending
    return size


def buffers(streams: list[Ends]) -> set[tuple[int, int]]:
    """The sizes of the proxy's buffers towards outside, as (receive, send) of each stream."""
    return {
        (
            peer_option(ends.inside, socket.SO_RCVBUF),
            peer_option(ends.outside, socket.SO_SNDBUF),
        )
        for ends in streams
    }


def peer_option(wire: Wire, option: int) -> int:
    """An option of the proxy's socket at the other end; the proxy runs in this process."""
    for entry in Path("/proc/self/fd").iterdir():
        if not entry.is_socket():
            continue
        with suppress(OSError), socket.socket(fileno=os.dup(int(entry.name))) as sock:
            if sock.getpeername() == wire.sock.getsockname():
                return sock.getsockopt(socket.SOL_SOCKET, option)
    raise AssertionError("the proxy has no such connection")


async def test_without_large_pipes_bulk_is_copied(proxy, node, lease, monkeypatch):
    """An unprivileged user's pipes may shrink to two pages, and splicing would be slow."""
    monkeypatch.setattr(relay, "LEAST_PIPE_BYTES", 2 * relay.PIPE_BYTES)
    payload = random.Random(7).randbytes(3 * relay.BLOCK_BYTES + 17)
    async with relayed(node, lease) as ends:
        sending = asyncio.create_task(ends.inside.send(payload))
        assert await ends.outside.exactly(len(payload)) == payload
        await sending
