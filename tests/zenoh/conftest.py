"""Fixtures of the zenoh layer: sessions of three versions of zenoh with rmw_zenoh's defaults."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Generator, Iterator
from pathlib import Path

import pytest

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))

from tests.ros.topology import Topology, remove_leftovers  # noqa: E402
from tests.zenoh.lab import ENVIRONMENTS, PLAN, SDK, VERSIONS, Lab  # noqa: E402


def missing() -> str | None:
    """The obstacle for this layer with the command against it, or None."""
    gone = [name for name in ("ip", "nft", "unshare", "sysctl") if shutil.which(name) is None]
    gone += [name for name in (*VERSIONS, SDK) if not (ENVIRONMENTS / name / "pins").exists()]
    if gone:
        return f"this layer needs zenoh: run `scripts/install-zenoh.sh` as root (missing: {gone})"
    if os.geteuid() != 0:
        return "this layer makes network namespaces: run it as root (`make test-all LAYERS=zenoh`)"
    return None


def pytest_runtest_setup(item: pytest.Item) -> None:
    if HERE in item.path.parents and (problem := missing()):
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
def topology() -> Iterator[Topology]:
    """The machines of a module, removed at the end."""
    remove_leftovers()
    topology = Topology(PLAN)
    try:
        topology.build()
        yield topology
    finally:
        topology.remove()


@pytest.fixture
def lab(topology: Topology, tmp_path: Path) -> Iterator[Lab]:
    """The machines, on which nothing runs yet."""
    lab = Lab(topology, tmp_path)
    with lab.used():
        yield lab
