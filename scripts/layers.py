"""The layers of tests: what each layer needs, and how each layer runs.

A layer is a directory under tests/, or some tests of a directory with another environment.
`test_layers` runs the layers.
"""

import os
import platform
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
LOGS = ROOT / "build/test-logs"
CAP_NET_ADMIN = 1 << 12
CAP_SYS_ADMIN = 1 << 21
ALL = "all"
MARKED = "marked"
NONE = "none"

ROS = "install-ros"
CLIENTS = "install-clients"
CHROMIUM = "install-browser"
JAZZY = "install-jazzy"
ROS2 = "install-ros2"
ZENOH = "install-zenoh"
NODES = "compile-nodes"
ENGINE = "install-docker"
COMPOSE = "install-compose"
PROMETHEUS = "install-prometheus"
KUBERNETES = "install-kubernetes"
REGISTRY = "install-registry"
IMAGES = "build-images"
PREPARATIONS = (
    ROS,
    CLIENTS,
    CHROMIUM,
    JAZZY,
    ROS2,
    ZENOH,
    NODES,
    ENGINE,
    COMPOSE,
    PROMETHEUS,
    KUBERNETES,
    REGISTRY,
    IMAGES,
)
ABUSE_TOOLS = "install-abuse"
COMMANDS = {name: [f"scripts/{name}.sh"] for name in (*PREPARATIONS, ABUSE_TOOLS)} | {
    JAZZY: ["scripts/install-ros2.sh", "jazzy"],
    NODES: [sys.executable, "-m", "tests.ros.cpp"],
    IMAGES: [sys.executable, "-m", "tests.docker.images"],
}


@dataclass(frozen=True)
class Layer:
    """A directory of tests, or some ``tests`` of another directory.

    ``setup``: steps that prepare this machine. ``smoke_setup``: the steps that smoke tests need.
    ``smoke``: the tests that run with --smoke, as ALL, MARKED or NONE. ``workers``: the number of
    pytest processes that share the files. ``environment``: variables for the tests. ``obstacle``:
    the reason why the layer cannot run here, or None. ``second_look``: whether failed tests run
    once more.
    """

    name: str
    smoke: str = NONE
    setup: tuple[str, ...] = ()
    smoke_setup: tuple[str, ...] = ()
    workers: int = 0
    obstacle: Callable[[], str | None] = lambda: None
    tests: tuple[str, ...] = ()
    environment: tuple[str, ...] = ()
    second_look: bool = True

    @property
    def cache(self) -> Path:
        """The folder in which pytest notes failed tests."""
        return LOGS / f"{self.name}-cache"

    def report(self, again: bool = False) -> Path:
        """The JUnit report of the first run; with ``again`` of the second run."""
        return LOGS / f"{self.name}{'-again' * again}.xml"

    def command(self, smoke: bool, again: bool = False) -> list[str]:
        """The command for the tests; with ``again`` only failed tests, one after the other."""
        words = ["env", *self.environment, sys.executable, "-m", "pytest"]
        words += [*(self.tests or (f"tests/{self.name}",)), f"--junitxml={self.report(again)}"]
        words += ["--tb=short", "--durations=15", "-o", f"cache_dir={self.cache}"]
        if again:
            words += ["--last-failed", "--last-failed-no-failures=none"]
        elif self.workers:
            words += ["-n", str(self.workers), "--dist=loadfile"]
        return words + (["-m", "smoke"] if smoke and self.smoke == MARKED else [])


def debian_root_obstacle() -> str | None:
    """Return why this machine can't make namespaces and install packages, or None."""
    if platform.system() != "Linux" or not is_debian():
        return "it needs Debian or Ubuntu"
    if os.geteuid() != 0:
        return "it needs root"
    needed = CAP_NET_ADMIN | CAP_SYS_ADMIN
    if effective_capabilities() & needed != needed:
        return "root lacks CAP_NET_ADMIN or CAP_SYS_ADMIN here (a container?)"
    return None


def abuse_obstacle() -> str | None:
    """Return why this machine can't bound a process's memory and make namespaces, or None."""
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


UNIT = Layer("unit", smoke=ALL, workers=2, second_look=False)
INTEGRATION = Layer("integration", smoke=ALL, workers=2)
ABUSE = Layer("abuse", setup=(ABUSE_TOOLS,), obstacle=abuse_obstacle)
CHART = Layer(
    "chart", setup=(PROMETHEUS, KUBERNETES), obstacle=debian_root_obstacle, second_look=False
)
IMAGE = Layer("image", setup=(ENGINE, COMPOSE, IMAGES), obstacle=debian_root_obstacle)
ROS_NODES = Layer("ros", MARKED, (ROS, NODES), (ROS, NODES), 2, debian_root_obstacle)
INSIDE_ONLY_CASES = (
    *("inside-to-inside", "inside-to-outside"),
    *("inside-about-inside", "inside-about-itself", "outside-about-inside"),
)
"""Names of cases in `ros` where inside needs nothing from outside."""
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
        *("-k", " and ".join(f"not {name}" for name in INSIDE_ONLY_CASES)),
    ),
    environment=("ROS_TESTS_ISOLATED=1",),
)
"""Tests where inside has no way out but the proxy: traffic inwards, calls from inside, recovery.

All of tests/ros can run so, which takes as long again. The omitted tests are the same in `ros`, or
depend on paths that these tests cover.
"""
ROS1_CLIENTS = Layer(
    "clients", setup=(ROS, NODES, CLIENTS), workers=2, obstacle=debian_root_obstacle
)
ROS2_NODES = Layer("ros2", MARKED, (ROS2,), (JAZZY,), 2, debian_root_obstacle)
ZENOH_NODES = Layer("zenoh", setup=(ZENOH,), workers=2, obstacle=debian_root_obstacle)
BROWSER = Layer("browser", setup=(ROS, NODES, ROS2, ZENOH, CHROMIUM), obstacle=debian_root_obstacle)
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
    setup=(ENGINE, KUBERNETES, REGISTRY, PROMETHEUS, IMAGES),
    obstacle=debian_root_obstacle,
    tests=("tests/kubernetes", f"--ignore={_ROS2_PODS}"),
)
ROS2_CLUSTER = Layer(
    "kubernetes-ros2",
    setup=(ENGINE, KUBERNETES, IMAGES),
    obstacle=debian_root_obstacle,
    tests=(_ROS2_PODS,),
)
LAYERS = (
    *(UNIT, INTEGRATION, ABUSE, CHART, IMAGE),
    *(ROS_NODES, ISOLATED, ROS1_CLIENTS, ROS2_NODES, ZENOH_NODES, BROWSER),
    *(DOCKER_ENGINE, CLUSTER, ROS2_CLUSTER),
)

BESIDE_PREPARATION = (UNIT,)
ALONE_FIRST = (INTEGRATION,)
ON_THE_ENGINE = (DOCKER_ENGINE, IMAGE, CLUSTER)
SIDE_BY_SIDE = (ROS_NODES, ROS2_NODES, ISOLATED, ROS1_CLIENTS, ZENOH_NODES, BROWSER, CHART)
ALONE_LAST = (ABUSE, ROS2_CLUSTER)
"""The order of the layers. ON_THE_ENGINE and SIDE_BY_SIDE begin together.

Layers on the Docker engine take turns: an operator with `--expose-by-default` takes over all
containers of the engine.
"""
