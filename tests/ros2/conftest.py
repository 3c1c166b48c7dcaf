"""Fixtures of the ROS 2 layer: real rclpy on Fast DDS (Jazzy, Kilted), and Cyclone DDS."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Generator, Iterable, Iterator
from pathlib import Path

import pytest

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))

from tests.ros.topology import Topology, remove_leftovers  # noqa: E402
from tests.ros2.lab import ENVIRONMENTS, PROGRAMS, Lab  # noqa: E402
from tests.ros2.machines import OTHER_PLAN, PLAN, built, join_lans  # noqa: E402

SMOKE = ("jazzy",)
"""The environments that `make test` installs, for tests marked `smoke`."""


def missing(environments: Iterable[str]) -> str | None:
    """The obstacle for this layer with the command against it, or None."""
    gone = [
        name
        for name in ("ip", "nft", "conntrack", "unshare", "sysctl")
        if shutil.which(name) is None
    ]
    gone += [name for name in environments if not (ENVIRONMENTS / name / "pins").exists()]
    if gone:
        return f"this layer needs ROS 2: run `scripts/install-ros2.sh` as root (missing: {gone})"
    if os.geteuid() != 0:
        return "this layer makes network namespaces: run it as root (`make test-all LAYERS=ros2`)"
    return None


def pytest_runtest_setup(item: pytest.Item) -> None:
    if HERE not in item.path.parents:
        return
    if problem := missing(SMOKE if item.get_closest_marker("smoke") else PROGRAMS):
        pytest.fail(problem, pytrace=False)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Shows with a failure what the proxy and the nodes of that test have printed."""
    result = yield
    labs = [value for value in getattr(item, "funcargs", {}).values() if isinstance(value, Lab)]
    if result.failed:
        for lab in labs:
            result.sections += lab.transcripts()
    return result


@pytest.fixture(scope="module")
def topology(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Topology]:
    """The machines of a module, which may have a PLAN, removed at the end."""
    remove_leftovers()
    with built(
        getattr(request.module, "PLAN", PLAN), tmp_path_factory.mktemp("machines")
    ) as topology:
        yield topology


@pytest.fixture(scope="module")
def other_topology(
    topology: Topology, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Topology]:
    """Another host with machines, on the same LAN."""
    with built(OTHER_PLAN, tmp_path_factory.mktemp("machines")) as other:
        join_lans(topology, other)
        yield other


@pytest.fixture
def lab(request: pytest.FixtureRequest, topology: Topology, tmp_path: Path) -> Iterator[Lab]:
    """A lab with a new proxy. A module may set OPTIONS, LAN_RELAY and PROXY."""
    lab = Lab(topology, tmp_path)
    lab.options = getattr(request.module, "OPTIONS", lab.options)
    with lab.used():
        if getattr(request.module, "LAN_RELAY", False):
            lab.start_lan_relay()
        if getattr(request.module, "PROXY", True):
            lab.start_proxy()
        yield lab


@pytest.fixture
def other(other_topology: Topology, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    """The lab on the other host, without a running proxy."""
    other = Lab(other_topology, tmp_path_factory.mktemp("other"))
    with other.used():
        yield other
