"""The Docker operator on a host with a growing number of labelled containers.

Engine, proxies and masters are real. The labelled containers do nothing, so only the operator and
the engine cost time. Ten containers share a network and a master, and so a proxy.
The second half of the containers starts at once, as with ``docker compose up``.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path
from statistics import median
from typing import NamedTuple

from tests.bench.book import Book
from tests.bench.world import cpu_seconds, resident
from tests.docker.controller import Process, proxies, remove_proxies
from tests.docker.engine import docker, running_engine, wait_until
from tests.docker.images import PROXY, ROS, build_image

PATH = "rosproxy-operator"
SIZES = (20, 100, 200)
QUICK_SIZES = (20,)
SHARE = 10
"""Containers that share a master and a network."""
PORTS = 12
SECONDS = 120.0
QUICK_SECONDS = 5.0
"""Seconds of measuring without events. A look follows at least every `RESYNC` seconds."""
RESYNC = "30"
"""The operator's default, which tests shorten."""
AT_ONCE = 8
FIRST_MASTER = 21400
PATIENCE = 600.0
LOOK_LINE = re.compile(r"look ended in ([\d.]+) s: (\d+) actions")
"""A line of the operator's log: the duration of a look, and the number of actions."""


class Look(NamedTuple):
    seconds: float
    actions: int


def run(book: Book, rounds: int, quick: bool) -> None:
    folder = Path(tempfile.mkdtemp(prefix="rosproxy-bench-docker-"))
    with running_engine(folder / "dockerd.log"):
        build_image(PROXY)
        build_image(ROS)
        for number in range(rounds):
            for size in QUICK_SIZES if quick else SIZES:
                place = folder / f"{number}-{size}"
                place.mkdir()
                _measure_size(book, size, QUICK_SECONDS if quick else SECONDS, place)
    shutil.rmtree(folder)
    book.note(f"{SHARE} containers share a network, a master and a proxy with {PORTS} ports")


def _measure_size(book: Book, size: int, seconds: float, folder: Path) -> None:
    def add(row: str, value: float) -> None:
        book.add(row, PATH, value, size)

    with ExitStack() as stack:
        stack.callback(remove_proxies)
        stack.enter_context(_masters(size // SHARE))
        names = stack.enter_context(_containers(size))
        early = names[::2]
        late = names[1::2]
        _docker_all("start", early)
        options = ("--proxy-image", PROXY, "--ports", str(PORTS), "--resync", RESYNC,
                   "--log-level", "debug")  # fmt: skip
        operator = Process(folder, *options)
        stack.callback(operator.stop)
        started = time.monotonic()
        operator.start()
        assert operator.process is not None
        pid = operator.process.pid
        wait_until(lambda: _serving() == size // SHARE, PATIENCE, lambda: operator.logs()[-3000:])
        add("all proxies run, s", time.monotonic() - started)
        _rest(operator)
        add("CPU of the operator until then, s", cpu_seconds(pid))

        seen = len(_looks(operator))
        cpu = cpu_seconds(pid)
        since = time.monotonic()
        _docker_all("start", late)
        add("half of the containers started, s", time.monotonic() - since)
        _rest(operator)
        looks = [look.seconds for look in _looks(operator)[seen:]]
        add("half start: CPU of the operator, s", cpu_seconds(pid) - cpu)
        add("half start: looks", len(looks))
        add("half start: one look, median, s", median(looks))
        add("half start: one look, longest, s", max(looks))
        _measure_rest(add, operator, pid, seconds)


def _measure_rest(
    add: Callable[[str, float], None], operator: Process, pid: int, seconds: float
) -> None:
    """Measure the operator while nothing happens. There may be no look in this time."""
    seen = len(_looks(operator))
    cpu = cpu_seconds(pid)
    since = time.monotonic()
    time.sleep(seconds)
    looks = [look.seconds for look in _looks(operator)[seen:]]
    took = time.monotonic() - since
    add("nothing happens: operator, % of a core", (cpu_seconds(pid) - cpu) / took * 100)
    add("nothing happens: operator, MiB", resident(pid) / 1024)
    add("nothing happens: looks", len(looks))
    add("nothing happens: one look, longest, s", max(looks, default=0.0))


def _serving() -> int:
    return sum(proxy.running for proxy in proxies())


def _looks(operator: Process) -> list[Look]:
    return [Look(float(match[1]), int(match[2])) for match in LOOK_LINE.finditer(operator.logs())]


def _rest(operator: Process, quiet: float = 6.0) -> None:
    """Wait until the operator has had nothing to do for a while."""

    def done() -> int:
        return sum(look.actions > 0 for look in _looks(operator))

    end = time.monotonic() + PATIENCE
    before = -1
    while (now := done()) != before:
        assert time.monotonic() < end, f"the operator never rests: {operator.logs()[-3000:]}"
        before = now
        time.sleep(quiet)


@contextmanager
def _masters(count: int) -> Iterator[None]:
    """Run masters on this host, a master for each network."""
    masters = []
    try:
        for number in range(count):
            port = str(FIRST_MASTER + number)
            argv = ("/usr/bin/python3", "/usr/bin/rosmaster", "--core", "-p", port)
            masters.append(
                subprocess.Popen(
                    argv,
                    env={"PATH": "/usr/bin:/bin"},
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                )
            )
        yield
    finally:
        for master in masters:
            master.kill()
            master.wait()


@contextmanager
def _containers(count: int) -> Iterator[list[str]]:
    """Labelled containers that are not started yet, spread over networks."""
    names = [f"rosproxy-bench-{number}" for number in range(count)]
    networks = [f"rosproxy-bench-net-{number}" for number in range(count // SHARE)]
    host = docker("network", "inspect", "bridge", "--format", "{{(index .IPAM.Config 0).Gateway}}")

    def create(number: int) -> None:
        network = number // SHARE
        uri = f"http://{host}:{FIRST_MASTER + network}"
        docker("create", "--init", "--name", names[number], "--network", networks[network],
               "--label", "rosproxy.enable=true", "--label", f"rosproxy.master-uri={uri}",
               ROS, "sleep", "infinity")  # fmt: skip

    try:
        for network in networks:
            docker("network", "create", network)
        with ThreadPoolExecutor(AT_ONCE) as pool:
            list(pool.map(create, range(count)))
        yield names
    finally:
        docker("rm", "--force", *names, check=False, seconds=PATIENCE)
        remove_proxies()
        docker("network", "rm", *networks, check=False)


def _docker_all(verb: str, names: list[str]) -> None:
    with ThreadPoolExecutor(AT_ONCE) as pool:
        list(pool.map(lambda name: docker(verb, name, seconds=PATIENCE), names))
