"""Run the test layers one after another and say at the end which of them ran.

    python scripts/test_layers.py [unit] [integration] [ros] [docker]

A layer that this machine cannot run is named together with the reason; with CI=true
in the environment that counts as a failure, so a pipeline never turns green by
leaving a layer out.
"""

import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

ROOT = Path(__file__).resolve().parent.parent
CAP_NET_ADMIN = 1 << 12
CAP_SYS_ADMIN = 1 << 21


@dataclass(frozen=True)
class Layer:
    """A directory of tests, what it needs, and why it may not run here."""

    name: str
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
    Layer("ros", ("scripts/install-ros.sh",), debian_root_obstacle),
    Layer("docker", ("scripts/install-docker.sh",), debian_root_obstacle),
)


def run(layer: Layer) -> Outcome:
    obstacle = layer.obstacle()
    if obstacle is not None:
        return Outcome(layer, False, os.environ.get("CI") != "true", f"did not run: {obstacle}")
    print(f"\n=== {layer.name} ===", flush=True)
    for script in layer.setup:
        if subprocess.run([ROOT / script], cwd=ROOT, check=False).returncode != 0:
            return Outcome(layer, False, False, f"did not run: {script} failed")
    return run_pytest(layer)


def run_pytest(layer: Layer) -> Outcome:
    started = time.monotonic()
    with tempfile.TemporaryDirectory() as directory:
        report = Path(directory) / "report.xml"
        command = [sys.executable, "-m", "pytest", str(layer.path), f"--junitxml={report}"]
        code = subprocess.run(command, cwd=ROOT, check=False).returncode
        counts = count(report) if report.exists() else "no report"
    seconds = time.monotonic() - started
    return Outcome(layer, True, code == 0, f"{counts} in {seconds:.0f} s")


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
    outcomes = [run(layer) for layer in chosen(sys.argv[1:])]
    print(summary(outcomes))
    return 0 if all(outcome.good for outcome in outcomes) else 1


if __name__ == "__main__":
    sys.exit(main())
