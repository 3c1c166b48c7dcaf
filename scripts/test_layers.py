"""Run the test layers and say at the end which of them ran.

    python scripts/test_layers.py [unit] [integration] [ros] [docker] [chart] [kubernetes]

First what they need is installed. Then the layers of a lane run one after another, and lanes
side by side: real nodes and containers mostly wait for something. With several lanes each layer's
output is shown when it ends.

A layer that this machine cannot run is named together with the reason; with CI=true in the
environment that counts as a failure, so a pipeline never turns green by leaving a layer out.

Layers with real nodes, engines and clusters depend on the time that these take. Up to three tests
that fail there are tried once more when the layer has ended, and are named in the summary even if
they pass then: each of those is a bug to be found, in a test or in what it tests.
"""

import os
import platform
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import IO
from xml.etree import ElementTree

ROOT = Path(__file__).resolve().parent.parent
CAP_NET_ADMIN = 1 << 12
CAP_SYS_ADMIN = 1 << 21
SOME_FAILED = 1
"""pytest's exit code when it has run them all; any other failure is one of the whole layer."""
SECOND_CHANCES = 3
"""Most tests of a layer that are tried again."""


@dataclass(frozen=True)
class Layer:
    """A directory of tests, the lane it runs in, what it needs, and why it may not run here.

    Lane 0 runs before all others; its layers have nothing real in them that would be slow at times.
    """

    name: str
    lane: int = 0
    setup: tuple[str, ...] = ()
    obstacle: Callable[[], str | None] = lambda: None

    @property
    def path(self) -> Path:
        return ROOT / "tests" / self.name


@dataclass(frozen=True)
class Outcome:
    layer: Layer
    ran: bool
    good: bool
    text: str


def debian_root_obstacle() -> str | None:
    """Say what keeps this machine from making namespaces and installing packages."""
    if platform.system() != "Linux" or not is_debian():
        return "it needs Debian or Ubuntu"
    if os.geteuid() != 0:
        return "it needs root"
    wanted = CAP_NET_ADMIN | CAP_SYS_ADMIN
    if effective_capabilities() & wanted != wanted:
        return "root lacks CAP_NET_ADMIN or CAP_SYS_ADMIN here (a container?)"
    return None


def is_debian() -> bool:
    try:
        release = platform.freedesktop_os_release()
    except OSError:
        return False
    family = {release.get("ID", ""), *release.get("ID_LIKE", "").split()}
    return bool(family & {"debian", "ubuntu"})


def effective_capabilities() -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("CapEff:"):
            return int(line.split()[1], 16)
    return 0


LAYERS = (
    Layer("unit"),
    Layer("integration"),
    Layer("ros", 1, ("scripts/install-ros.sh",), debian_root_obstacle),
    Layer("docker", 2, ("scripts/install-docker.sh",), debian_root_obstacle),
    Layer("chart", 1, ("scripts/install-kubernetes.sh",), debian_root_obstacle),
    Layer(
        "kubernetes",
        2,
        ("scripts/install-ros.sh", "scripts/install-docker.sh", "scripts/install-kubernetes.sh"),
        debian_root_obstacle,
    ),
)


def run_all(layers: list[Layer]) -> list[Outcome]:
    """Run lane 0 first, which minds a busy machine, and then the others side by side."""
    failed = install(layers)
    outcomes = [run(layer, failed, None) for layer in layers if layer.lane == 0]
    numbers = sorted({layer.lane for layer in layers if layer.lane})
    lanes = [[layer for layer in layers if layer.lane == number] for number in numbers]
    quiet = threading.Lock() if len(lanes) > 1 else None
    with ThreadPoolExecutor() as pool:
        for ran in pool.map(lambda lane: [run(layer, failed, quiet) for layer in lane], lanes):
            outcomes += ran
    return outcomes


def install(layers: list[Layer]) -> set[str]:
    """Run the scripts that the layers need, each once; those that failed."""
    needed = [layer for layer in layers if layer.obstacle() is None]
    scripts = dict.fromkeys(script for layer in needed for script in layer.setup)
    return {s for s in scripts if subprocess.run([ROOT / s], cwd=ROOT, check=False).returncode}


def run(layer: Layer, failed: set[str], quiet: "threading.Lock | None") -> Outcome:
    obstacle = layer.obstacle()
    if obstacle is not None:
        return Outcome(layer, False, os.environ.get("CI") != "true", f"did not run: {obstacle}")
    missing = [script for script in layer.setup if script in failed]
    if missing:
        return Outcome(layer, False, False, f"did not run: {missing[0]} failed")
    return run_pytest(layer, quiet)


def run_pytest(layer: Layer, quiet: "threading.Lock | None") -> Outcome:
    """Run a layer; with ``quiet`` its output is kept until it has ended, and is shown whole."""
    started = time.monotonic()
    print(f"\n=== {layer.name} ===", flush=True)
    with tempfile.TemporaryDirectory() as name, (Path(name) / "output").open("w+") as output:
        here, shown = Path(name), output if quiet else None
        code, text = attempt(layer, here / "first.xml", shown)
        failed = failures(here / "first.xml")
        if code == SOME_FAILED and layer.lane and 0 < len(failed) <= SECOND_CHANCES:
            code, said = attempt(layer, here / "second.xml", shown, "--lf", "--lfnf=none")
            text += f"; at the second attempt {said}: {', '.join(failed)}"
        if quiet:
            output.seek(0)
            with quiet:
                print(f"\n=== {layer.name} ended ===\n{output.read()}", flush=True)
    seconds = time.monotonic() - started
    return Outcome(layer, True, code == 0, f"{text} in {seconds:.0f} s")


def attempt(layer: Layer, report: Path, output: IO[str] | None, *more: str) -> tuple[int, str]:
    """Run pytest; its exit code, and the numbers as one line of text."""
    command = [sys.executable, "-m", "pytest", str(layer.path), f"--junitxml={report}"]
    command += ["-o", f"cache_dir={report.parent / 'cache'}", *more]
    code = subprocess.run(command, cwd=ROOT, check=False, stdout=output).returncode
    return code, count(report) if report.exists() else "no report"


def failures(report: Path) -> list[str]:
    """The names of the tests of a JUnit report that have failed."""
    if not report.exists():
        return []
    cases = ElementTree.parse(report).getroot().iter("testcase")
    bad = [one for one in cases if {"failure", "error"} & {part.tag for part in one}]
    return [f"{one.get('classname', '').rpartition('.')[2]}::{one.get('name')}" for one in bad]


def count(report: Path) -> str:
    """Count the tests of a JUnit report as one line of text."""
    suites = list(ElementTree.parse(report).getroot().iter("testsuite"))

    def total(name: str) -> int:
        return sum(int(suite.get(name, 0)) for suite in suites)

    failed, skipped = total("failures") + total("errors"), total("skipped")
    passed = total("tests") - failed - skipped
    parts = [f"{passed} passed", f"{failed} failed", f"{skipped} skipped"]
    return ", ".join(parts[: 1 if not failed + skipped else 3])


def summary(outcomes: list[Outcome]) -> str:
    lines = ["", "Test layers:"]
    for outcome in outcomes:
        mark = "ok" if outcome.good and outcome.ran else "--" if outcome.good else "FAILED"
        lines.append(f"  {outcome.layer.name:<12} {mark:<7} {outcome.text}")
    return "\n".join(lines)


def chosen(names: list[str]) -> list[Layer]:
    unknown = set(names) - {layer.name for layer in LAYERS}
    if unknown:
        sys.exit(f"no such test layer: {', '.join(sorted(unknown))}")
    return [layer for layer in LAYERS if not names or layer.name in names]


def main() -> int:
    # In the background a shell has it ignored, and programs under test inherit that.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    outcomes = run_all(chosen(sys.argv[1:]))
    print(summary(outcomes))
    return 0 if all(outcome.good for outcome in outcomes) else 1


if __name__ == "__main__":
    sys.exit(main())
