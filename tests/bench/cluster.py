"""The Kubernetes operator in a growing cluster: a labelled pod on each node, and other pods.

etcd and API server are real. Nodes, kubelets and proxies are fake (`crowded_cluster`), so the costs
are only those of the operator and the API server. For each size, ``python -m tests.bench.cluster
NODES SECONDS IDLE`` measures in a separate network namespace.
"""

from __future__ import annotations

import asyncio
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

import aiohttp

from tests.bench.book import Book
from tests.bench.control_plane import ControlPlane, free_port, is_there
from tests.bench.crowded_cluster import CrowdedCluster
from tests.bench.world import cpu_seconds, resident

PATH = "rosproxy-operator"
SIZES = (10, 100, 1000)
QUICK_SIZES = (10,)
PODS_A_NODE = 30
SECONDS = 60.0
QUICK_SECONDS = 10.0
"""Seconds of measuring without events, and while other pods come and go."""
IDLE_SECONDS = 600.0
"""Seconds without events at the largest size. The operator asks all proxies anew in this time."""
CHURN = 20.0
"""Other pods that come and go in a second."""
TRIES = 5
PATIENCE = 600.0


class Operator:
    """The operator as a process, with the rights of the manifests."""

    def __init__(self, plane: ControlPlane) -> None:
        self._admin = f"127.0.0.1:{free_port()}"
        log = (plane.folder / "operator.log").open("wb")
        command = [
            str(Path(sys.executable).parent / "rosproxy-operator"), "kubernetes",
            "--admin-bind", self._admin, "--liveness-bind", f"127.0.0.1:{free_port()}",
            "--key-secret", "rosproxy-system/rosproxy-operator-key",
        ]  # fmt: skip
        environment = {**os.environ, "KUBECONFIG": str(plane.folder / "operator")}
        self._process = subprocess.Popen(command, stdout=log, stderr=log, env=environment)
        log.close()

    @property
    def pid(self) -> int:
        return self._process.pid

    def stop(self) -> None:
        self._process.terminate()
        self._process.wait()

    async def looks(self) -> tuple[float, float]:
        """The seconds of all looks, and the number of looks."""
        async with (
            aiohttp.ClientSession() as session,
            session.get(f"http://{self._admin}/metrics") as reply,
        ):
            text = await reply.text()
        samples = dict(
            re.findall(r"^rosproxy_operator_look_seconds_(sum|count) (\S+)$", text, re.M)
        )
        return float(samples["sum"]), float(samples["count"])


def run(book: Book, rounds: int, quick: bool) -> None:
    if not is_there():
        raise RuntimeError("etcd and kube-apiserver are missing: scripts/install-kubernetes.sh")
    for _ in range(rounds):
        for size in QUICK_SIZES if quick else SIZES:
            seconds = QUICK_SECONDS if quick else SECONDS
            _apart(book, size, seconds, IDLE_SECONDS if size == SIZES[-1] else seconds)
    book.note(f"{PODS_A_NODE} pods a node, one of them labelled; nodes and proxies are simulated")


def _apart(book: Book, size: int, seconds: float, idle: float) -> None:
    """Measure in a network namespace where no other program has the proxies' port."""
    words = [sys.executable, "-m", "tests.bench.cluster", str(size), str(seconds), str(idle)]
    inside = f"ip link set lo up && exec {shlex.join(words)}"
    done = subprocess.run(
        ["unshare", "--net", "sh", "-c", inside], stdout=subprocess.PIPE, text=True, check=True
    )
    measured = json.loads(done.stdout.splitlines()[-1])
    for row, value in measured["rows"]:
        book.add(row, PATH, value, size)
    for note in measured["notes"]:
        book.note(note)


async def _measure_size(book: Book, size: int, seconds: float, idle: float) -> None:
    folder = Path(tempfile.mkdtemp(prefix="rosproxy-bench-cluster-"))
    try:
        async with ControlPlane(folder) as plane, CrowdedCluster(plane) as cluster:
            await cluster.fill(size, size * PODS_A_NODE)
            started = time.monotonic()
            operator = Operator(plane)
            try:
                await _measure(book, size, seconds, idle, Bench(plane, cluster, operator, started))
            finally:
                operator.stop()
    finally:
        shutil.rmtree(folder, ignore_errors=True)


class Bench:
    """The measured programs, and the start time of the operator."""

    def __init__(
        self, plane: ControlPlane, cluster: CrowdedCluster, operator: Operator, started: float
    ) -> None:
        self.plane = plane
        self.cluster = cluster
        self.operator = operator
        self.started = started

    async def rest(self, quiet: float = 5.0) -> None:
        """Wait until the operator has made no writing requests for a while."""
        end = time.monotonic() + PATIENCE
        before = -1
        while True:
            asked = self.plane.asked()
            written = sum(
                n for request, n in asked.items() if request.split()[0] in ("create", "patch")
            )
            if written == before:
                return
            assert time.monotonic() < end, f"the operator does not come to rest: {asked}"
            before = written
            await asyncio.sleep(quiet)

    async def over(self, seconds: float) -> tuple[float, float, dict[str, int]]:
        """Shares of a core of the operator and the API server meanwhile, and the requests."""
        pids = self.operator.pid, self.plane.api_server
        before = [*map(cpu_seconds, pids)]
        asked = self.plane.asked()
        since = time.monotonic()
        await asyncio.sleep(seconds)
        took = time.monotonic() - since
        own, api = ((cpu_seconds(p) - b) / took for p, b in zip(pids, before, strict=True))
        return own, api, dict(self.plane.asked() - asked)

    async def reaction(self, node: str) -> float:
        """Seconds from the binding of a labelled pod to a new node until the proxy's pod is
        created.
        """
        await self.cluster.add_node(node)
        bound = await self.cluster.add_robot(node)
        return await self.cluster.made_on(node, 120.0) - bound


async def _measure(book: Book, size: int, seconds: float, idle: float, bench: Bench) -> None:
    """Measure for ``seconds`` while pods come and go, and for ``idle`` seconds without events."""

    def add(row: str, value: float) -> None:
        book.add(row, PATH, value, size)

    await bench.cluster.all_made(size, PATIENCE)
    add("all proxies made, s", time.monotonic() - bench.started)
    add("CPU of the operator until then, s", cpu_seconds(bench.operator.pid))
    await bench.rest()
    took, count = await bench.operator.looks()
    add("one look, s", took / count)
    own, api, asked = await bench.over(idle)
    add("nothing happens: operator, % of a core", own * 100)
    add("nothing happens: API server, % of a core", api * 100)
    add("nothing happens: operator, MiB", resident(bench.operator.pid) / 1024)
    add("nothing happens: requests a minute", sum(asked.values()) * 60 / idle)
    book.note(f"{size} nodes, requests when nothing happens: {asked}")
    tries = [await bench.reaction(f"new{number}") for number in range(TRIES)]
    add("labelled pod bound, proxy's pod made: median, s", median(tries))
    add("labelled pod bound, proxy's pod made: longest, s", max(tries))
    churning = asyncio.create_task(bench.cluster.churn(size, CHURN))
    try:
        own, _, asked = await bench.over(seconds)
        add("others' pods come and go: operator, % of a core", own * 100)
        tries = [await bench.reaction(f"newer{number}") for number in range(TRIES)]
        add("others' pods come and go: proxy's pod made: median, s", median(tries))
        add("others' pods come and go: proxy's pod made: longest, s", max(tries))
    finally:
        churning.cancel()


def main() -> None:
    """Measure a size, and print the results as JSON."""
    book = Book()
    asyncio.run(_measure_size(book, int(sys.argv[1]), *map(float, sys.argv[2:])))
    rows = [(line.row, line.middle) for line in book.lines()]
    notes = [note.partition(": ")[2] for note in book.notes]
    print(json.dumps({"rows": rows, "notes": notes}))


if __name__ == "__main__":
    main()
