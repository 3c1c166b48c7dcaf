"""``make bench``: the proxy next to a direct connection and socat.

They take turns in every round, so that a machine that is busy for a while is so for all.
"""

import json
import os
import platform
import shutil
import signal
import sys
from collections import defaultdict
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path
from statistics import median
from subprocess import getoutput
from typing import Any

from tests.bench import measures, parts
from tests.bench.node import NAME
from tests.integration.net import NODE, OUTSIDE, Where, where

ROUNDS = 5
REPORT = Path("build/bench.json")
RESULTS: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
"""The numbers of all rounds, by row and path."""


def main() -> None:
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    machine = describe()
    print(*(f"{name + ':':<10}{text}" for name, text in machine.items()), sep="\n", flush=True)
    with parts.master() as uri:
        compare(uri)
        for _ in range(ROUNDS):
            with parts.proxied(uri) as proxied:
                add("rosproxy", measures.memory(proxied))
    rows = [row(name, path) for name, paths in RESULTS.items() for path in paths]
    show(rows)
    REPORT.parent.mkdir(exist_ok=True)
    REPORT.write_text(json.dumps({"machine": machine, "rounds": ROUNDS, "rows": rows}, indent=1))


def compare(uri: str) -> None:
    with ExitStack() as stack:
        proxied = stack.enter_context(parts.proxied(uri))
        paths: dict[str, tuple[Where, int | None]] = {"direct": (proxied.direct, None)}
        if shutil.which("socat"):
            paths["socat"] = stack.enter_context(parts.socat(proxied.direct))
        paths["rosproxy"] = proxied.lease, proxied.pid
        for _ in range(ROUNDS):
            for measure in (measures.stream, measures.ping_pong):
                for path, way in paths.items():
                    add(path, measure(*way))
            outside = OUTSIDE, "/bench_outside", f"http://{OUTSIDE}:9/"
            add("direct", measures.register(where(uri), *outside))
            add("rosproxy", measures.register(proxied.master, NODE, NAME, proxied.node_uri))


def add(path: str, numbers: measures.Numbers) -> None:
    for name, number in numbers.items():
        RESULTS[name][path].append(number)


def row(name: str, path: str) -> dict[str, Any]:
    """A row of the report; its ratio is the median of the rounds' own ratios."""
    values, direct = RESULTS[name][path], RESULTS[name].get("direct", [])
    ratios = [a / b for a, b in zip(values, direct, strict=False)]
    numbers = {"median": median(values), "lowest": min(values), "highest": max(values)}
    ratio = median(ratios) if ratios else None
    return {"row": name, "path": path, **numbers, "to_direct": ratio, "values": values}


def show(rows: list[dict[str, Any]]) -> None:
    print(f"\n{ROUNDS} rounds:{'median':>38}{'lowest .. highest':>21}{'to direct':>12}")
    for held in rows:
        low, middle, high = (f"{held[key]:.4g}" for key in ("lowest", "median", "highest"))
        ratio = f"{held['to_direct']:8.2f} x" if held["to_direct"] else ""
        print(f"{held['row']:<28}{held['path']:<9}{middle:>10}{low:>9} .. {high:<9}{ratio}")


def describe() -> dict[str, str]:
    """The machine before it is put to work, and what runs on it."""
    loop = "uvloop" if find_spec("uvloop") else "asyncio"
    dpkg = "dpkg-query -W python3-rosmaster 2>/dev/null || echo rosmaster"
    return {
        "rosproxy": getoutput("git describe --always --dirty 2>/dev/null || echo unknown"),
        "machine": f"{os.cpu_count()} cores, {getoutput('grep -m1 name /proc/cpuinfo')}",
        "kernel": platform.platform(),
        "load": f"{os.getloadavg()[0]:.2f} before",
        "python": f"{platform.python_version()}, event loop {loop}",
        "master": getoutput(dpkg) if os.path.exists(parts.ROSMASTER) else "embedded, no rosmaster",
        "socat": getoutput("socat -V | grep version") if shutil.which("socat") else "not installed",
    }


if __name__ == "__main__":
    main()
