"""The cluster, the chart and the robot, made once for all tests."""

import fcntl
import subprocess
import sys
from collections.abc import Generator, Iterator
from pathlib import Path

import pytest
from urllib3.exceptions import HTTPError

from tests.docker.engine import ROOT, running_engine
from tests.kubernetes import api, release
from tests.kubernetes.cluster.control_plane import kubectl
from tests.kubernetes.cluster.layout import KUBECONFIG
from tests.kubernetes.cluster.robot import start_robot, stop_robot
from tests.kubernetes.measured import NUMBERS
from tests.kubernetes.pods import Namespace, namespace
from tests.kubernetes.robot import Robot, robot_with_master

_LOCK = Path("/run/lock/rosproxy-cluster")
LAST = ("test_chart", "test_operator_killed", "test_leader", "test_monitoring", "test_api_server",
        "test_node_lost", "test_administrators", "test_upgrade", "test_uninstall")  # fmt: skip
"""The modules whose tests disturb the whole cluster, in order."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    def place(item: pytest.Item) -> int:
        module = item.path.stem
        return LAST.index(module) if module in LAST else -1

    items.sort(key=place)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Show with a failure what operator and proxies have logged, and what the cluster has."""
    report = yield
    if report.failed and report.when in ("setup", "call") and KUBECONFIG.exists():
        try:
            report.sections += _sections()
        except (AssertionError, OSError, HTTPError) as error:
            report.sections.append(("the cluster", f"can't be asked: {error}"))
    return report


def _sections() -> Iterator[tuple[str, str]]:
    own = (api.objects("pods", "", label) for label in (release.OPERATORS, release.PROXIES))
    for told in (body["metadata"] for bodies in own for body in bodies):
        yield told["name"], api.logs(told["namespace"], told["name"])[-4000:]
    yield "the cluster", kubectl("get", "rosproxies,pods", "-A", "-o", "wide", check=False)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    if NUMBERS:
        terminalreporter.section("measured")
        for line in NUMBERS:
            terminalreporter.write_line(line)


@pytest.fixture(scope="session")
def _cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Use the running cluster. Otherwise bring a cluster up, and down afterwards."""
    log = tmp_path_factory.mktemp("engine") / "dockerd.log"
    with _LOCK.open("w") as lock, running_engine(log):
        fcntl.flock(lock, fcntl.LOCK_EX)  # a single session of tests at a time
        was_up = KUBECONFIG.exists()
        cluster("up")
        stop_robot()
        start_robot()
        try:
            yield
        finally:
            if not was_up:
                cluster("down")


def cluster(*command: str) -> None:
    """Run the cluster's tool in a separate process, so that its programs are not children of a
    test.
    """
    words = [sys.executable, "-m", "tests.kubernetes.cluster", *command]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=900, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.fixture(scope="session", autouse=True)
def _release(_cluster: None) -> Iterator[None]:
    """The chart, installed."""
    release.remove()
    others = api.objects("pods", "", release.OPERATORS)
    assert not others, f"another operator is at work in this cluster: {others[0]['metadata']}"
    release.install()
    release.wait_operator()
    yield
    release.remove()


@pytest.fixture(scope="module")
def robot(_cluster: None) -> Iterator[Robot]:
    """The robot with a master for the tests of a module."""
    with robot_with_master() as started_robot:
        yield started_robot


@pytest.fixture
def net(_release: None) -> Iterator[Namespace]:
    """A namespace for a test."""
    with namespace() as made:
        yield made
