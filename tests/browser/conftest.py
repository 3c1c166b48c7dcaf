"""Fixtures: machines with real nodes, a proxy between them, and a browser beside the proxy."""

from __future__ import annotations

from collections.abc import Generator, Iterator

import pytest

from tests.browser.webdriver import Browser
from tests.ros.cpp import compiled_node
from tests.ros.forks import Forks
from tests.ros.lab import Lab
from tests.ros.topology import SHARED, Place, Topology, remove_leftovers
from tests.ros2.lab import Lab as Ros2Lab
from tests.zenoh.lab import Lab as ZenohLab


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Add the output of the proxy and the nodes to the report of a failed test."""
    result = yield
    lab = getattr(item, "funcargs", {}).get("lab")
    if result.failed and isinstance(lab, Lab | Ros2Lab | ZenohLab):
        result.sections += lab.transcripts()
    return result


@pytest.fixture(scope="session")
def lab_of_all(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    """A lab with a master and a proxy for all tests."""
    remove_leftovers()
    compiled_node()
    topology = Topology(SHARED)
    forks = Forks()
    topology.build()
    lab = Lab(topology, tmp_path_factory.mktemp("lab"), forks)
    try:
        lab.ensure_running()
        yield lab
    finally:
        lab.stop()
        forks.stop()
        topology.remove()


@pytest.fixture
def lab(lab_of_all: Lab) -> Iterator[Lab]:
    """The lab without nodes of other tests."""
    lab_of_all.ensure_running()
    yield lab_of_all
    lab_of_all.stop_nodes()
    lab_of_all.check_proxy()


@pytest.fixture
def machine(lab: Lab) -> Place:
    """The machine of the browser, which is also the machine of the proxy."""
    return lab.place("px")


@pytest.fixture
def browser(machine: Place, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """A browser on a machine of the lab. At the end, the console must have no messages."""
    browser = Browser(machine, tmp_path_factory.mktemp("browser"))
    try:
        yield browser
        assert browser.console() == []
    finally:
        browser.close()
