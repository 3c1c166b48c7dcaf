"""Fixtures: machines with nodes of many client libraries, a master and a proxy between them."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator

import pytest

from tests.clients.programs import missing, programs
from tests.ros.forks import Forks
from tests.ros.lab import Lab
from tests.ros.topology import Plan, PortMap, Topology, remove_leftovers

NETWORKS = (("c1",),)
PORTS = PortMap(45000, 45099, 45000)
PLANS = {
    "out": Plan("out", NETWORKS, PORTS),
    "both": Plan("both", NETWORKS, PORTS, isolated=True),
}
"""By the proxy's direction. With ``both``, inside has no way out but the proxy."""
DIRECT = Plan("direct", NETWORKS, PORTS, flat=True)
"""No boundary and no proxy."""

MakeLab = Callable[[Plan], Lab]


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Shows with a failure what the proxy and the nodes of that test have printed."""
    report = yield
    for lab in getattr(item, "funcargs", {}).values():
        if report.failed and isinstance(lab, Lab):
            report.sections += lab.transcripts()
    return report


@pytest.fixture(scope="session")
def make_lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[MakeLab]:
    """Builds the network of a plan with a master and a proxy; for the direct plan without a
    proxy.
    """
    problem = missing()
    if problem:
        pytest.fail(problem, pytrace=False)
    remove_leftovers()
    forks = Forks()
    labs = dict[str, Lab]()

    def make(plan: Plan) -> Lab:
        if plan.name not in labs:
            topology = Topology(plan)
            topology.build()
            lab = labs[plan.name] = Lab(topology, tmp_path_factory.mktemp(plan.name), forks)
            lab.programs |= programs()
            # The kernel's connections would outlive a proxy that is killed.
            lab.proxy_options = ("--data-plane", "splice", "--cleanup-after", "3")
        labs[plan.name].ensure_running()
        return labs[plan.name]

    try:
        yield make
    finally:
        for lab in labs.values():
            lab.stop()
            lab.topology.remove()
        forks.stop()


@pytest.fixture(params=PLANS)
def lab(request: pytest.FixtureRequest, make_lab: MakeLab) -> Iterator[Lab]:
    """Each plan, with no node of another test."""
    lab = make_lab(PLANS[request.param])
    yield lab
    lab.stop_nodes()
    lab.check_proxy()


@pytest.fixture
def direct(make_lab: MakeLab) -> Iterator[Lab]:
    """The same nodes without a proxy."""
    lab = make_lab(DIRECT)
    yield lab
    lab.stop_nodes()
