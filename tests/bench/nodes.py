"""The cost of 1 to 1,000 inside nodes with ten topics each, and the proxy's times for all nodes.

Registration is compared with nodes that register at the master itself.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any
from xmlrpc.client import ServerProxy

from tests.bench.book import DIRECT, Book
from tests.bench.world import INSIDE, MASTER, World, cpu_seconds, resident, world
from tests.ros.processes import Process

SIZES = (1, 10, 100, 1000)
QUICK_SIZES = (1, 10, 100)
OPTIONS = ("--port-range", "41000-43999", "--log-level", "info", "--cleanup-after", "5")
FIRST_SLAVE = 50000
# probes come every 5 s
IDLE_SECONDS = 10.0
QUICK_IDLE_SECONDS = 6.0
SETTLE_SECONDS = 12.0
"""Seconds for the work after registering: the first two probes of each node, which make the kept
connection, and another reading of the master's graph.
"""
LEAST_NODES = 100
"""With fewer nodes, the noise of the process exceeds the memory of the nodes."""
PATIENCE = 120.0
PATH = "rosproxy"


def run(book: Book, rounds: int, quick: bool) -> None:
    """Add the figures of all sizes, each with a new master and a new proxy."""
    for _ in range(rounds):
        for size in QUICK_SIZES if quick else SIZES:
            with world() as machines:
                with machines.master():
                    book.add("registration, s", DIRECT, registered(machines, MASTER, size), size)
                with machines.master():
                    measure(book, machines, size, QUICK_IDLE_SECONDS if quick else IDLE_SECONDS)
    book.note(
        "Clean-up includes the 5 s for which the proxy waits for a dead node (--cleanup-after 5)"
    )


def registered(machines: World, master: str, size: int) -> float:
    """The seconds for registering ``size`` nodes, which are killed then."""
    process = crowd(machines, master, size)
    seconds = seconds_of(process)
    process.kill()
    return seconds


def measure(book: Book, machines: World, size: int, idle: float) -> None:
    """Measure a proxy's life with ``size`` nodes inside."""
    with machines.proxy("auto", *OPTIONS) as proxy:
        before = resident(proxy.pid)
        nodes = crowd(machines, proxy.master, size)
        book.add("registration, s", PATH, seconds_of(nodes), size)
        book.add("CPU when idle, ms/s", PATH, busy(proxy.pid, idle) * 1000, size)
        if size >= LEAST_NODES:
            book.add("memory per node, KiB", PATH, (resident(proxy.pid) - before) / size, size)
        proxy.process.kill()
    started = time.perf_counter()
    with machines.proxy("auto", *OPTIONS) as proxy:
        proxy.process.wait_for(f"recovered {size} nodes", timeout=PATIENCE)
        book.add("recovery, s", PATH, time.perf_counter() - started, size)
        began = time.perf_counter()
        used = cpu_seconds(proxy.pid)
        nodes.kill()
        wait_until(lambda: topics_at_master(machines) == 0, "the topics are gone")
        book.add("clean-up, s", PATH, time.perf_counter() - began, size)
        book.add("clean-up, CPU s", PATH, cpu_seconds(proxy.pid) - used, size)


def crowd(machines: World, master: str, size: int) -> Process:
    argv = [sys.executable, "-m", "tests.bench.crowd", master, INSIDE, FIRST_SLAVE, size]
    return machines.start("inside", *map(str, argv))


def seconds_of(process: Process) -> float:
    return float(process.wait_for(r"^registered (\S+)", timeout=PATIENCE)[1])


def busy(pid: int, seconds: float) -> float:
    """CPU seconds per second of a process that is left alone."""
    time.sleep(SETTLE_SECONDS)
    before = cpu_seconds(pid)
    started = time.perf_counter()
    time.sleep(seconds)
    return (cpu_seconds(pid) - before) / (time.perf_counter() - started)


def topics_at_master(machines: World) -> int:
    """The number of the nodes' topics with a publisher at the master."""
    with machines.entered("outside"), ServerProxy(MASTER) as master:
        state: Any = master.getSystemState("/bench")
    return sum(topic.startswith("/crowd/") for topic, _ in state[2][0])


def wait_until(holds: Callable[[], bool], expectation: str) -> None:
    end = time.monotonic() + PATIENCE
    while not holds():
        assert time.monotonic() < end, f"waited {PATIENCE:g} s in vain: {expectation}"
        time.sleep(0.1)
