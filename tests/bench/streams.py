"""Bytes: rate, CPU, fairness, latency and memory of every way to a node on the other side."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

from tests.bench.book import Book, in_turn, percentile, smallest_share
from tests.bench.compiled import compiled
from tests.bench.ways import PEERS, PLANES, Way, all_ways
from tests.bench.world import cpu_seconds, cpu_seconds_of, family, machine_cpu_seconds, resident

SIZES = (1, 10, 100, 1000)
STREAM_SECONDS = 0.8
PING_SECONDS = 0.3
QUICK_SECONDS = 0.3
MESSAGE = 1024
STALL_SECONDS = 1.0
MEMORY_ROUNDS = 2
LEAST_CONNECTIONS = 10
"""With fewer connections, the noise of the process exceeds the memory of the connections."""
GIB = 2**30
LATEST = 0.7
"""The part of a measurement that has to lie between two readings of CPU time."""


def run(book: Book, rounds: int, quick: bool) -> None:
    sizes = SIZES[:3] if quick else SIZES
    with all_ways(book) as ways:
        for number in range(rounds):
            turns = in_turn(ways, number)
            for size in sizes:
                measure_ways(book, turns, size, stream, QUICK_SECONDS if quick else STREAM_SECONDS)
                measure_ways(book, turns, size, ping, QUICK_SECONDS if quick else PING_SECONDS)
    memory(book, 1 if quick else min(rounds, MEMORY_ROUNDS), quick)


Measure = Callable[[Book, Way, int, float], None]


def measure_ways(book: Book, ways: list[Way], size: int, measure: Measure, seconds: float) -> None:
    """Make a measurement on each way. A note names a failed way, and the others go on."""
    for way in ways:
        try:
            measure(book, way, size, seconds)
        except RuntimeError as error:
            book.note(f"{way.name} failed with {size} connections: {error}")
        settle(way)


def settle(way: Way) -> None:
    """Wait until the relay has finished the work of the last measurement."""
    deadline = time.monotonic() + 3
    while way.pid and time.monotonic() < deadline:
        before = cpu_seconds(way.pid)
        time.sleep(0.05)
        if cpu_seconds(way.pid) - before < 0.01:
            return


def stream(book: Book, way: Way, size: int, seconds: float) -> None:
    """Endless streams on all connections at the same time."""
    with wire(way, "sink", size, warm_up(size), seconds) as process:
        expect(process, "connected")
        relay = family(way.pid) if way.pid else []
        with urgently():
            go_on(process)
            expect(process, "begin")
            before = spent(relay)
            expect(process, "end")
            after = spent(relay)
        took = float(line(process))
        counts = [float(count) for count in line(process).split()]
    total = sum(counts)
    book.add("rate, MB/s", way.name, total / took / 1e6, size)
    if size > 1:
        book.add("smallest share of the mean", way.name, smallest_share(counts), size)
    if after.when - before.when < took * LATEST:
        raise RuntimeError("the CPU time could not be read in time")
    of_relay, of_all = (cost * took / total * GIB for cost in per_second(before, after))
    if way.pid:
        book.add("CPU of the relay, s/GiB", way.name, of_relay, size)
    book.add("CPU of the whole machine, s/GiB", way.name, of_all, size)


@contextmanager
def urgently() -> Iterator[None]:
    """Give this process priority over a relay's thousand busy processes, or it reads too late."""
    os.setpriority(os.PRIO_PROCESS, 0, -15)
    try:
        yield
    finally:
        os.setpriority(os.PRIO_PROCESS, 0, 0)


def warm_up(size: int) -> float:
    """Seconds until the buffers of a stream have grown, which takes longer with many streams."""
    return 0.3 if size < 100 else 0.6


class Spent(NamedTuple):
    """CPU seconds of the relay and of the machine, and the time of reading."""

    when: float
    relay: float
    machine: float


def spent(relay: list[int]) -> Spent:
    relay_seconds = cpu_seconds_of(relay)
    return Spent(time.monotonic(), relay_seconds, machine_cpu_seconds())


def per_second(before: Spent, after: Spent) -> tuple[float, float]:
    """CPU seconds of the relay and of the machine a second, independent of late readings."""
    elapsed = after.when - before.when
    return (after.relay - before.relay) / elapsed, (after.machine - before.machine) / elapsed


def ping(book: Book, way: Way, size: int, seconds: float) -> None:
    """Measure a message there and back, on the connections in turn."""
    with wire(way, "ping", size, seconds, MESSAGE) as process:
        times = [float(duration) / 1000 for duration in line(process).split()]
    book.add("1 KiB ping p50, us", way.name, percentile(times, 50), size)
    book.add("1 KiB ping p99, us", way.name, percentile(times, 99), size)


def memory(book: Book, rounds: int, quick: bool) -> None:
    """Measure new processes each time: older processes could reuse freed memory."""
    for _ in range(rounds):
        with all_ways(book, only=(*PLANES, *PEERS)) as ways:
            for way in ways:
                stalled_reader(book, way)
                connections(book, way, SIZES[:3] if quick else SIZES)


def stalled_reader(book: Book, way: Way) -> None:
    before = resident(way.pid or 0)
    book.add("memory idle, MiB", way.name, before / 1024)
    with wire(way, "hold", 1, "/stream") as process:
        expect(process, "connected")
        time.sleep(STALL_SECONDS)
        added = resident(way.pid or 0) - before
    book.add("memory behind a stalled reader, KiB", way.name, added)


def connections(book: Book, way: Way, sizes: tuple[int, ...]) -> None:
    for size in sizes:
        settle(way)
        before = resident(way.pid or 0)
        with wire(way, "hold", size, "/echo") as process:
            expect(process, "connected")
            added = resident(way.pid or 0) - before
        if size >= LEAST_CONNECTIONS:
            book.add("memory of a connection, KiB", way.name, added / size, size)


@contextmanager
def wire(way: Way, role: str, *arguments: object) -> Iterator[subprocess.Popen[str]]:
    """The connecting end. Raises RuntimeError with the program's output."""
    address, port = way.address
    words = [str(argument) for argument in (role, address, port, *arguments)]
    command = way.world.command(way.end, str(compiled("wire")), *words)
    pipe: Any = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True) as process:
        try:
            yield process
        finally:
            process.stdin.close()  # type: ignore[union-attr]
            process.wait(30)


def expect(process: subprocess.Popen[str], expected: str) -> None:
    if (got := line(process)) != expected:
        raise RuntimeError(f"{expected} was expected, {got!r} came")


def go_on(process: subprocess.Popen[str]) -> None:
    assert process.stdin
    process.stdin.write("\n")
    process.stdin.flush()


def line(process: subprocess.Popen[str]) -> str:
    assert process.stdout
    assert process.stderr
    if text := process.stdout.readline().strip():
        return text
    process.wait(30)
    raise RuntimeError(process.stderr.read().strip() or f"exit code {process.returncode}")
