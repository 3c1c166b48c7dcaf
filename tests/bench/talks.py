"""Pings and streams between two nodes of `tests.bench.talking`, at either end of each way."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from tests.bench.book import Book, in_turn, loss, percentile
from tests.bench.ros import RosNode, wait_for_rest
from tests.bench.world import cpu_seconds

SECONDS = 2.0
QUICK_SECONDS = 1.0


class Stream(NamedTuple):
    """Messages of a size, at a rate."""

    title: str
    size: int
    rate: float


PINGS = {"100 B ping": 100, "100 kB ping": 100_000}
STREAMS = (Stream("1 KiB at 200 Hz", 1024, 200), Stream("1 MB at 20 Hz", 1_000_000, 20))


class Site(NamedTuple):
    """A way with a node at either end, and perhaps the process of a proxy."""

    name: str
    nodes: dict[str, RosNode]
    pid: int | None


def measure(book: Book, sites: Sequence[Site], rounds: int, quick: bool) -> None:
    """Measure all ways in turn."""
    seconds = QUICK_SECONDS if quick else SECONDS
    for number in range(rounds):
        for title, size in PINGS.items():
            for site in in_turn(sites, number):
                measure_ping(book, site, title, size, seconds)
        for stream in STREAMS:
            for site in in_turn(sites, number):
                measure_stream(book, site, stream, seconds)


def measure_ping(book: Book, site: Site, title: str, size: int, seconds: float) -> None:
    times = [float(delay) for delay in site.nodes["outside"].ask("ping", size, seconds)[1:]]
    enter(book, site, f"{title}, round trip", times)


def measure_stream(book: Book, site: Site, stream: Stream, seconds: float) -> None:
    before = cpu_seconds(site.pid) if site.pid else 0.0
    sent = int(site.nodes["outside"].ask("go", stream.size, stream.rate, seconds)[1])
    wait_for_rest(site.nodes["inside"], sent)
    ages = [float(age) for age in site.nodes["inside"].ask("off")[1:]]
    enter(book, site, f"{stream.title}, one way", ages)
    book.add(f"{stream.title}, one way: loss, %", site.name, 100 * loss(sent, len(ages)))
    if site.pid:
        spent = (cpu_seconds(site.pid) - before) / sent
        row = f"{stream.title}, one way: CPU of the proxy, us a message"
        book.add(row, site.name, spent * 1e6)


def enter(book: Book, site: Site, title: str, times: list[float]) -> None:
    if len(times) < 2:
        book.note(f"{site.name}, {title}: {len(times)} messages arrived")
        return
    for percent in (50, 99):
        row = f"{title}: latency p{percent}, us"
        book.add(row, site.name, percentile(times, percent))
