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
    with parts.proxied(uri) as proxied, parts.socat(proxied.direct) as through_socat:
        paths: dict[str, tuple[Where, int | None]] = {"direct": (proxied.direct, None)}
        paths |= {"socat": through_socat} if through_socat else {}
        paths |= {"rosproxy": (proxied.lease, proxied.pid)}
        outside = OUTSIDE, "/bench_outside", f"http://{OUTSIDE}:9/"
        for _ in range(ROUNDS):
            for measure in (measures.stream, measures.ping_pong):
                for path, way in paths.items():
                    add(path, measure(*way))
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
    print(f"\n{ROUNDS} rounds{'median':>39}{'lowest .. highest':>22}{'to direct':>12}")
    for held in rows:
        low, middle, high = (f"{held[key]:.4g}" for key in ("lowest", "median", "highest"))
        ratio = f"{held['to_direct']:8.2f} x" if held["to_direct"] else ""
        print(f"{held['row']:<28}{held['path']:<9}{middle:>9}{low:>11} .. {high:<9}{ratio}")


def describe() -> dict[str, str]:
    """The machine before it is put to work, and what runs on it."""
    dpkg, model = "dpkg-query -W python3-rosmaster", "sed -n '/^model name/{s/.*: //p;q}'"
    with_socat = shutil.which("socat")
    return {
        "rosproxy": getoutput("git describe --always --dirty"),
        "machine": f"{os.cpu_count()} cores, {getoutput(model + ' /proc/cpuinfo')}",
        "kernel": platform.platform(),
        "load": f"{os.getloadavg()[0]:.2f} before",
        "python": f"{sys.version.split()[0]}, {'uvloop' if find_spec('uvloop') else 'asyncio'}",
        "master": getoutput(dpkg) if os.path.exists(parts.ROSMASTER) else "the embedded one",
        "socat": getoutput("socat -V | sed -n 2p") if with_socat else "not installed: not compared",
    }


if __name__ == "__main__":
    main()
