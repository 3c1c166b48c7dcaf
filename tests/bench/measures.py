"""What is measured, once each: numbers by the row of the table that they belong to."""

import os
import socket
from contextlib import ExitStack
from http.client import HTTPConnection
from pathlib import Path
from statistics import median, quantiles
from time import perf_counter
from types import SimpleNamespace
from typing import Any
from xmlrpc.client import loads

from rosproxy.demo.wire import receive
from tests.bench.node import FRAME, FRAMES
from tests.bench.parts import subscribe
from tests.integration.net import Where, xml

Numbers = dict[str, float]
WARM_UP, STREAM_SECONDS, CALL_SECONDS, STALL_SECONDS = 0.1, 1.0, 0.5, 0.5
CONNECTIONS = 200


def stream(address: Where, pid: int | None) -> Numbers:
    """An endless stream; ``pid`` is of the process that relays it."""
    with subscribe(address, "/stream") as sock:
        take(sock, WARM_UP)
        before = cpu_seconds(pid) if pid else 0
        size, took = take(sock, STREAM_SECONDS)
        used = {"relay's CPU, s/GiB": (cpu_seconds(pid) - before) / size * 2**30} if pid else {}
    return {"1 MiB writes, MB/s": size / took / 1e6, **used}


def take(sock: socket.socket, seconds: float) -> tuple[int, float]:
    """Read for a while; bytes, and the seconds that it took."""
    buffer, size, started = bytearray(2**20), 0, perf_counter()
    while (took := perf_counter() - started) < seconds:
        got = sock.recv_into(buffer)
        assert got, "the stream ended"
        size += got
    return size, took


def cpu_seconds(pid: int) -> float:
    """CPU time of a process and its children: socat has one for each connection."""
    pids = [str(pid), *Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    stats = [Path(f"/proc/{one}/stat").read_text().rpartition(")")[2].split() for one in pids]
    return sum(int(stat[11]) + int(stat[12]) for stat in stats) / os.sysconf("SC_CLK_TCK")


def ping_pong(address: Where, _: int | None) -> Numbers:
    """Time from sending a message until it is back; the first hundred don't count."""
    times, end = [], perf_counter() + CALL_SECONDS
    with subscribe(address, "/echo") as sock:
        while (started := perf_counter()) < end:
            bounce(sock)
            times.append((perf_counter() - started) * 1e6)
    percentiles = quantiles(times[100:], n=100)
    return {"1 KiB ping-pong p50, us": percentiles[49], "1 KiB ping-pong p99, us": percentiles[98]}


def bounce(sock: socket.socket) -> None:
    sock.sendall(b"x" * 1024)
    receive(sock, 1024)


def register(master: Where, source: str, caller: str, api: str) -> Numbers:
    """registerPublisher for 100 topics over and over, on one kept connection."""
    http = HTTPConnection(*master, timeout=10, source_address=(source, 0))
    http.connect()
    sock, times, end = http.sock, list[float](), perf_counter() + CALL_SECONDS
    while perf_counter() < end:
        topic = f"/bench/{len(times) % 100}"
        body = xml("registerPublisher", caller, topic, "std_msgs/String", api)
        started = perf_counter()
        http.request("POST", "/", body, {"Content-Type": "text/xml"})
        reply = http.getresponse().read()
        times.append(perf_counter() - started)
        triple: Any = loads(reply)[0][0]
        assert triple[0] == 1, triple
        assert http.sock is sock, "the connection was not kept"
    http.close()
    rate, middle = len(times) / sum(times), median(times) * 1e6
    return {"registerPublisher, 1/s": rate, "registerPublisher p50, us": middle}


def memory(proxied: SimpleNamespace) -> Numbers:
    """Of a new proxy. First the reader: later it could live on what 200 connections left."""
    idle = most = resident(proxied.pid)
    with subscribe(proxied.lease, "/offer") as sock:
        end = perf_counter() + STALL_SECONDS
        while perf_counter() < end:
            most = max(most, resident(proxied.pid))
        size = sum(iter(lambda: len(sock.recv(2**20)), 0))
    assert size == FRAMES * len(FRAME), f"{size} bytes arrived"
    before = resident(proxied.pid)
    with ExitStack() as stack:
        for _ in range(CONNECTIONS):
            bounce(stack.enter_context(subscribe(proxied.lease, "/echo")))
        added = (resident(proxied.pid) - before) / CONNECTIONS
    stalled = {"a stalled reader adds, KiB": float(most - idle)}
    return {"idle, MiB": idle / 1024, "a connection adds, KiB": added, **stalled}


def resident(pid: int) -> int:
    """KiB of memory; what the kernel holds for sockets and pipes is not in it."""
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("Rss:"))
