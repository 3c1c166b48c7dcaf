"""Run layers of tests, side by side as far as they allow it, and say what ran and how long it took.

    python scripts/test_layers.py --smoke          what `make test` runs
    python scripts/test_layers.py                  what `make test-all` runs
    python scripts/test_layers.py unit ros         these layers only

How it works. A layer is a directory under tests/, or some tests of one in other surroundings. Two
layers run side by side; three, beside each other's nodes and engines, were at a load of 30 to 55 on
two processors, where what takes a second takes a minute:

  1. The integration tests have a processor for themselves. Beside them what other layers need is
     prepared: packages, programs and images, by scripts that do nothing where their work is done
     already. After that docker begins, and then kubernetes, which are the longest and mostly wait.
  2. After the integration tests the others, the long ones first, in the lane that is free.
  3. At the end, alone: those with bad neighbours, which hold how long an answer may take, and ROS 2
     in a cluster. There two dozen participants meet anew each time when a proxy's pod is replaced,
     for which Fast DDS takes all of two processors for seconds, and minutes beside others.

No layer with real nodes, engines or clusters starts before everything is prepared: they mind a
machine that is busy with compiling.

With --smoke, only tests marked `smoke` run of the layers that have such, and layers without are
left to `make test-all`. So all that `make test` runs is part of `make test-all`.

What a step prints goes to build/test-logs. A layer's is shown whole when it ends, a preparation's
when it fails. A layer that this machine cannot run is named together with the reason; with CI=true
in the environment that counts as a failure, so a pipeline never turns green by leaving a layer out.
No test is tried twice.
"""

import argparse
import os
import platform
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

ROOT = Path(__file__).resolve().parent.parent
LOGS = ROOT / "build/test-logs"
CAP_NET_ADMIN = 1 << 12
CAP_SYS_ADMIN = 1 << 21
ALL, MARKED, NONE = "all", "marked", "none"

ROS, CHROMIUM, JAZZY, ROS2, NODES, ENGINE, COMPOSE, PROMETHEUS, KUBERNETES, IMAGES = (
    PREPARATIONS
) = (
    "install-ros",
    "install-browser",
    "install-jazzy",
    "install-ros2",
    "compile-nodes",
    "install-docker",
    "install-compose",
    "install-prometheus",
    "install-kubernetes",
    "build-images",
)
COMMANDS = {name: [f"scripts/{name}.sh"] for name in PREPARATIONS} | {
    JAZZY: ["scripts/install-ros2.sh", "jazzy"],
    NODES: [sys.executable, "-m", "tests.ros.cpp"],
    IMAGES: [sys.executable, "-m", "tests.docker.images"],
}


@dataclass(frozen=True)
class Layer:
    """A directory of tests, or some ``tests`` of another one, and how they are run.

    ``setup``: what prepares this machine for it; ``smoke_setup``: those of them that its smoke
    needs. ``smoke``: ALL of its tests are in the smoke, those that are MARKED, or NONE.
    ``workers``: how many processes of pytest share the tests, one file each at a time.
    ``environment``: variables that they are told. ``obstacle`` says why it can't run here, if so.
    """

    name: str
    smoke: str = NONE
    setup: tuple[str, ...] = ()
    smoke_setup: tuple[str, ...] = ()
    workers: int = 0
    obstacle: Callable[[], str | None] = lambda: None
    tests: tuple[str, ...] = ()
    environment: tuple[str, ...] = ()

    def command(self, report: Path, smoke: bool) -> list[str]:
        words = ["env", *self.environment, sys.executable, "-m", "pytest"]
        words += [*(self.tests or (f"tests/{self.name}",)), f"--junitxml={report}"]
        words += ["--tb=short", "--durations=15", "-o", f"cache_dir={LOGS}/{self.name}-cache"]
        if self.workers:
            words += ["-n", str(self.workers), "--dist=loadfile"]
        return words + (["-m", "smoke"] if smoke and self.smoke == MARKED else [])


@dataclass(frozen=True)
class Outcome:
    """What became of a layer: whether it ran, whether that is good, and numbers or a reason."""

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


def abuse_obstacle() -> str | None:
    """Say what keeps this machine from bounding a process's memory, and from making namespaces."""
    if platform.system() != "Linux":
        return "it needs Linux"
    if os.geteuid() != 0:
        return "it needs root"
    if not shutil.which("ip"):
        return "it needs ip (iproute2)"
    groups = Path("/sys/fs/cgroup")
    if not any(os.access(groups / name, os.W_OK) for name in ("memory", "cgroup.subtree_control")):
        return f"{groups} can't be written here (a container?)"
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


UNIT = Layer("unit", smoke=ALL, workers=2)
INTEGRATION = Layer("integration", smoke=ALL, workers=2)
ABUSE = Layer("abuse", obstacle=abuse_obstacle)
CHART = Layer("chart", setup=(PROMETHEUS, KUBERNETES), obstacle=debian_root_obstacle)
IMAGE = Layer("image", setup=(ENGINE, COMPOSE, IMAGES), obstacle=debian_root_obstacle)
ROS_NODES = Layer("ros", MARKED, (ROS, NODES), (ROS, NODES), 2, debian_root_obstacle)
ALIKE = (
    *("inside-to-inside", "inside-to-outside"),
    *("inside-about-inside", "inside-about-itself", "outside-about-inside"),
)
"""Cases of `ros` in which nobody inside wants anything of outside, by their names."""
ISOLATED = Layer(
    "isolated",
    setup=(ROS, NODES),
    workers=2,
    obstacle=debian_root_obstacle,
    tests=(
        *(
            f"tests/ros/test_{name}.py"
            for name in (
                *("recovery", "topics", "services", "actionlib"),
                *("networks", "rosnode", "rostopic"),
            )
        ),
        *("-k", " and ".join(f"not {name}" for name in ALIKE)),
    ),
    environment=("ROS_TESTS_ISOLATED=1",),
)
"""Inside has no way out but the proxy: what goes inwards, is asked from inside, or is recovered.

All of tests/ros may run so, which takes as long again. What is left out is the same in `ros`, or
rests on what runs here.
"""
ROS2_NODES = Layer("ros2", MARKED, (ROS2,), (JAZZY,), 2, debian_root_obstacle)
BROWSER = Layer("browser", setup=(ROS, NODES, CHROMIUM), obstacle=debian_root_obstacle)
DOCKER_ENGINE = Layer(
    "docker",
    MARKED,
    (ENGINE, COMPOSE, PROMETHEUS, IMAGES),
    (ENGINE, IMAGES),
    obstacle=debian_root_obstacle,
)
_ROS2_PODS = "tests/kubernetes/test_ros2.py"
CLUSTER = Layer(
    "kubernetes",
    setup=(ENGINE, KUBERNETES, IMAGES),
    obstacle=debian_root_obstacle,
    tests=("tests/kubernetes", f"--ignore={_ROS2_PODS}"),
)
ROS2_CLUSTER = Layer(
    "kubernetes-ros2",
    setup=CLUSTER.setup,
    obstacle=debian_root_obstacle,
    tests=(_ROS2_PODS,),
)
LAYERS = (
    *(UNIT, INTEGRATION, ABUSE, CHART, IMAGE),
    *(ROS_NODES, ISOLATED, ROS2_NODES, BROWSER, DOCKER_ENGINE, CLUSTER, ROS2_CLUSTER),
)


class Run:
    """One run of some layers."""

    def __init__(self, layers: Iterable[Layer], smoke: bool) -> None:
        self.layers = list(layers)
        self.smoke = smoke
        self._started = time.monotonic()
        self._failed: set[str] = set()
        self._printing = threading.Lock()

    def all(self) -> list[Outcome]:
        """Prepare and run; the outcomes in the order of the layers."""
        LOGS.mkdir(parents=True, exist_ok=True)
        with ThreadPoolExecutor() as pool:
            integration = pool.submit(self._some, deque([INTEGRATION]))
            self._prepare()
            lanes = [integration, pool.submit(self._some, deque([DOCKER_ENGINE, CLUSTER]))]
            integration.result()
            late = deque([ROS_NODES, IMAGE, ROS2_NODES, ISOLATED, BROWSER, CHART, UNIT])
            lanes += [pool.submit(self._then, lane, late) for lane in lanes]
        outcomes = [outcome for lane in lanes for outcome in lane.result()]
        outcomes += self._some(deque([ABUSE, ROS2_CLUSTER]))
        return sorted(outcomes, key=lambda outcome: LAYERS.index(outcome.layer))

    def _prepare(self) -> None:
        able = [layer for layer in self.layers if layer.obstacle() is None]
        for step in dict.fromkeys(step for layer in able for step in self._steps(layer)):
            code, text = self._run(step, COMMANDS[step])
            if code:
                self._failed.add(step)
                self._say(f"{step} failed:\n{text}")

    def _steps(self, layer: Layer) -> tuple[str, ...]:
        return layer.smoke_setup if self.smoke else layer.setup

    def _then(self, before: Future[list[Outcome]], left: deque[Layer]) -> list[Outcome]:
        before.result()
        return self._some(left)

    def _some(self, left: deque[Layer]) -> list[Outcome]:
        """Run layers one after another, until none is left: others may take from them, too."""
        outcomes = []
        while left:
            try:
                layer = left.popleft()
            except IndexError:  # another was faster
                break
            if layer in self.layers:
                outcomes.append(self._layer(layer))
        return outcomes

    def _layer(self, layer: Layer) -> Outcome:
        obstacle = layer.obstacle()
        if obstacle is not None:
            return Outcome(layer, False, os.environ.get("CI") != "true", f"did not run: {obstacle}")
        missing = [step for step in self._steps(layer) if step in self._failed]
        if missing:
            return Outcome(layer, False, False, f"did not run: {missing[0]} failed")
        report, began = LOGS / f"{layer.name}.xml", time.monotonic()
        report.unlink(missing_ok=True)
        code, text = self._run(f"tests/{layer.name}", layer.command(report, self.smoke))
        self._say(f"=== {layer.name} ===\n{text}")
        numbers = count(report) if report.exists() else "no report"
        return Outcome(layer, True, code == 0, f"{numbers} in {time.monotonic() - began:.0f} s")

    def _run(self, title: str, command: list[str]) -> tuple[int, str]:
        """Run a step; its exit code and what it has printed."""
        log, began = LOGS / f"{title.replace('/', '-')}.log", time.monotonic()
        self._say(f"{title} …")
        with log.open("wb") as output:
            code = subprocess.run(
                command, cwd=ROOT, check=False, stdout=output, stderr=subprocess.STDOUT
            ).returncode
        self._say(f"{title}: {'failed' if code else 'ok'} after {time.monotonic() - began:.0f} s")
        return code, log.read_text(errors="replace")

    def _say(self, text: str) -> None:
        with self._printing:
            print(f"[{time.monotonic() - self._started:4.0f} s] {text}", flush=True)

    def summary(self, outcomes: list[Outcome]) -> str:
        minutes, seconds = divmod(round(time.monotonic() - self._started), 60)
        lines = ["", f"Test layers, {minutes} min {seconds} s in all:"]
        for outcome in outcomes:
            mark = "ok" if outcome.good and outcome.ran else "--" if outcome.good else "FAILED"
            only = " (smoke)" if self.smoke and outcome.layer.smoke == MARKED else ""
            lines.append(f"  {outcome.layer.name + only:<16} {mark:<7} {outcome.text}")
        if self.smoke:
            lines.append(
                "The whole of each layer, the chart and a Kubernetes cluster: make test-all"
            )
        return "\n".join(lines)


def count(report: Path) -> str:
    """Count the tests of a JUnit report as one line of text."""
    suites = list(ElementTree.parse(report).getroot().iter("testsuite"))

    def total(name: str) -> int:
        return sum(int(suite.get(name, 0)) for suite in suites)

    failed, skipped = total("failures") + total("errors"), total("skipped")
    passed = total("tests") - failed - skipped
    parts = [f"{passed} passed", f"{failed} failed", f"{skipped} skipped"]
    return ", ".join(parts[: 1 if not failed + skipped else 3])


def main() -> int:
    names = [layer.name for layer in LAYERS]
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--smoke", action="store_true", help="of real programs a small part only")
    parser.add_argument("layers", nargs="*", metavar="layer", help=", ".join(names))
    options = parser.parse_args()
    if unknown := set(options.layers) - set(names):
        parser.error(f"no such layer: {', '.join(sorted(unknown))}")
    # Hundreds of programs are started: each would compile the project anew.
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    # In the background a shell has it ignored, and programs under test inherit that.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    wanted = [layer for layer in LAYERS if not options.layers or layer.name in options.layers]
    if options.smoke:
        wanted = [layer for layer in wanted if layer.smoke != NONE]
    run = Run(wanted, options.smoke)
    outcomes = run.all()
    print(run.summary(outcomes))
    return 0 if all(outcome.good for outcome in outcomes) else 1


if __name__ == "__main__":
    sys.exit(main())
