"""The live page of 10 to 1,000 nodes with links that change every second, in Chromium.

The nodes are fake (`tests.browser.many`). The proxy's own code serves the page.
"""

from __future__ import annotations

import http.client
import json
import sys
import time
from statistics import median

from tests.bench.book import Book, percentile
from tests.bench.world import World, cpu_seconds, world
from tests.browser.webdriver import Browser
from tests.ros.processes import wait_until

SIZES = (10, 100, 1000)
QUICK_SIZES = (10, 100)
PORT = 11312
WATCHED = 10.0
QUICK_WATCHED = 3.0
"""Seconds for which frames are counted."""
PATIENCE = 60
FIRST_ROWS = "return document.querySelector('#rows tr') ? performance.now() : null"
COUNT_FRAMES = """
window.gaps = [];
let before = performance.now();
const count = (now) => { gaps.push(now - before); before = now; requestAnimationFrame(count); };
requestAnimationFrame(count);
"""
PATH = "page"


def run(book: Book, rounds: int, quick: bool) -> None:
    """Add the figures of all sizes, each with a new browser."""
    for _ in range(rounds):
        for size in QUICK_SIZES if quick else SIZES:
            with world() as machines:
                measure(book, machines, size, QUICK_WATCHED if quick else WATCHED)
    book.note("The proxy makes a document each second. Frames are painted without a graphics card")


def measure(book: Book, machines: World, size: int, seconds: float) -> None:
    """Measure a page for a while, and the events to the page."""

    def add(row: str, value: float) -> None:
        book.add(row, PATH, value, size)

    argv = (sys.executable, "-m", "tests.browser.many", str(PORT), str(size))
    with machines.running("host", *argv) as server:
        server.wait_for("^serving", timeout=PATIENCE)
        browser = Browser(machines.places["host"], machines.folder)
        try:
            browser.open(f"http://127.0.0.1:{PORT}/")
            add("first rows, s", first_rows(browser))
            time.sleep(1)  # what is shown first is laid out
            browser.run(COUNT_FRAMES)
            began = time.perf_counter()
            used = cpu_seconds(server.pid)
            time.sleep(seconds)
            gaps = browser.run("return gaps")
            took = time.perf_counter() - began
            add("server's CPU, ms/s", (cpu_seconds(server.pid) - used) / took * 1000)
            add("frames, 95th percentile, ms", percentile(gaps, 95))
            add("longest frame, ms", max(gaps))
        finally:
            browser.close()
        with machines.entered("host"):
            first, changes = events(3)
            add("whole document, kB", first / 1000)
            add("changes of a second, kB", median(changes) / 1000)
            add("making a document, ms", median(costs()) * 1000)


def first_rows(browser: Browser) -> float:
    """The seconds from opening the page until the table has rows."""
    seen: list[float] = []

    def are_there() -> bool:
        milliseconds = browser.run(FIRST_ROWS)
        seen.extend([] if milliseconds is None else [milliseconds / 1000])
        return bool(seen)

    wait_until("there are rows", are_there, PATIENCE)
    return seen[0]


def events(count: int) -> tuple[int, list[int]]:
    """The bytes of the first event, and of ``count`` later events."""
    connection = http.client.HTTPConnection("127.0.0.1", PORT, timeout=PATIENCE)
    connection.request("GET", "/events")
    reply = connection.getresponse()
    sizes = list[int]()
    while len(sizes) <= count:
        line = reply.readline()
        assert line, "the stream has ended"
        if line.startswith(b"data: {"):
            sizes.append(len(line))
    connection.close()
    return sizes[0], sizes[1:]


def costs() -> list[float]:
    """The seconds of each document."""
    connection = http.client.HTTPConnection("127.0.0.1", PORT, timeout=PATIENCE)
    connection.request("GET", "/cost")
    took: list[float] = json.loads(connection.getresponse().read())
    connection.close()
    return took
