"""Fixtures of the real-ROS layer, and the report at the end.

With ROS_TESTS_FLAT=1 the same tests run in a network without boundary and without the proxy: a
failure there is a fault of the test or of ROS. With ROS_TESTS_KERNEL=1 the kernel forwards topics
in all tests. With ROS_TESTS_ISOLATED=1 inside has no way out but a proxy with ``--direction both``,
or the direction in ROS_TESTS_DIRECTION.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Generator, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
OWN = f"{HERE.relative_to(ROOT)}/"
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))

from tests.ros import report, requirements  # noqa: E402
from tests.ros.cpp import compiled_node  # noqa: E402
from tests.ros.forks import Forks  # noqa: E402
from tests.ros.lab import Lab  # noqa: E402
from tests.ros.topology import SHARED, Plan, Topology, remove_leftovers  # noqa: E402

FLAT = os.environ.get("ROS_TESTS_FLAT") == "1"
ISOLATED = os.environ.get("ROS_TESTS_ISOLATED") == "1"
_MISSING = pytest.StashKey[str]()


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "boundary: makes sense only with a boundary and a proxy")
    config.addinivalue_line("markers", "direct: makes sense only where inside gets out by itself")
    config.stash[report.KEY] = report.Report(flat=FLAT)
    config.pluginmanager.register(Collector(config))


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    own = [item for item in items if HERE in item.path.parents]
    off = [name for name, so in (("boundary", FLAT), ("direct", ISOLATED)) if so]
    dropped = [item for item in own if any(map(item.get_closest_marker, off))]
    problem = requirements.missing(with_proxy=not FLAT)
    if problem and own:
        # A single failure with a fix is better than two hundred.
        config.stash[_MISSING] = problem
        dropped = own[1:]
    if dropped:
        config.hook.pytest_deselected(items=dropped)
        gone = set(dropped)
        items[:] = [item for item in items if item not in gone]


def pytest_runtest_setup(item: pytest.Item) -> None:
    if HERE in item.path.parents and _MISSING in item.config.stash:
        pytest.fail(item.config.stash[_MISSING], pytrace=False)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Shows with a failure what the proxy and the nodes of that test have printed."""
    result = yield
    lab = getattr(item, "funcargs", {}).get("lab")
    if result.failed and isinstance(lab, Lab):
        result.sections += lab.transcripts()
    return result


class Collector:
    """Gathers the reports of all cases, also from other processes (pytest-xdist)."""

    def __init__(self, config: pytest.Config) -> None:
        self._report = config.stash[report.KEY]

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.nodeid.startswith(OWN):
            self._report.add(report)


def pytest_terminal_summary(
    terminalreporter: pytest.TerminalReporter, config: pytest.Config
) -> None:
    summary = config.stash[report.KEY]
    if summary.run:
        terminalreporter.section("real-ROS layer")
        for line in summary.lines():
            terminalreporter.write_line(line)
        summary.write(ROOT / "build" / "ros-report.json")


@pytest.fixture(scope="session")
def topology_of() -> Iterator[Callable[[Plan], Topology]]:
    """Builds the network of a plan on first use. All networks are removed at the end."""
    remove_leftovers()
    built: dict[Plan, Topology] = {}

    def get(plan: Plan) -> Topology:
        if FLAT:
            plan = replace(plan, flat=True)
        if ISOLATED:
            plan = replace(plan, isolated=True)
        if plan not in built:
            built[plan] = Topology(plan)
            built[plan].build()
        return built[plan]

    try:
        yield get
    finally:
        for topology in built.values():
            topology.remove()


@pytest.fixture(scope="session")
def forks() -> Iterator[Forks]:
    """The command line of rospy nodes."""
    forks = Forks()
    yield forks
    forks.stop()


@pytest.fixture(scope="module")
def module_lab(
    request: pytest.FixtureRequest,
    topology_of: Callable[[Plan], Topology],
    forks: Forks,
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[Lab]:
    """A master and a proxy for a module, which may set PLAN and the other names below."""
    compiled_node()
    plan = getattr(request.module, "PLAN", SHARED)
    lab = Lab(topology_of(plan), tmp_path_factory.mktemp("lab"), forks)
    lab.proxy_options = getattr(request.module, "PROXY_OPTIONS", ())
    lab.advertise_host = getattr(request.module, "ADVERTISE_HOST", lab.advertise_host)
    lab.master_role = getattr(request.module, "MASTER_ROLE", lab.master_role)
    lab.roscore = getattr(request.module, "MASTER", lab.roscore)
    try:
        yield lab
    finally:
        lab.stop()


@pytest.fixture
def lab(module_lab: Lab) -> Iterator[Lab]:
    """The module's lab, with master and proxy running, and no node of another test."""
    module_lab.ensure_running()
    yield module_lab
    module_lab.stop_nodes()
    module_lab.check_proxy()


@pytest.fixture
def measure(request: pytest.FixtureRequest) -> Callable[[str, float], None]:
    """Notes a time in seconds for the report at the end."""
    return lambda name, seconds: report.measure(request.node, name, seconds)
