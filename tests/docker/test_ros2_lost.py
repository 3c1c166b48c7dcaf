"""The parts of a proxy for ROS 2, killed, removed or replaced in the midst of traffic."""

import time
from collections.abc import Callable, Iterator

import pytest

from tests.docker.controller import Controller, Proxy, the_proxy
from tests.docker.engine import docker, wait_until
from tests.docker.ros2 import OPTIONS as ROS2_OPTIONS
from tests.docker.ros2 import Flow, Inside2, Outside, all_run, domain, ports, ports_are_kept, runs
from tests.docker.traffic import crash

OPTIONS = ROS2_OPTIONS


@pytest.fixture
def flow(controller: Controller, lan: Outside, inside2: Inside2) -> Iterator[Flow]:
    try:
        yield Flow(lan, inside2)
    finally:
        lan.end()


def by(*command: str) -> Callable[[Proxy], object]:
    return lambda proxy: docker(*command, proxy.name)


LOSSES: dict[str, Callable[[Proxy], object]] = {
    "docker kill": by("kill"),
    "docker rm --force": by("rm", "--force"),
    "crash": lambda proxy: crash(proxy.name),
    "docker kill …-ports": lambda proxy: docker("kill", proxy.sandbox),
    "docker rm --force …-ports": lambda proxy: docker("rm", "--force", proxy.sandbox),
    "docker kill …-lan-relay": lambda proxy: docker("kill", proxy.lan_relay),
    "docker rm --force …-lan-relay": lambda proxy: docker("rm", "--force", proxy.lan_relay),
    "LAN relay crashes": lambda proxy: crash(proxy.lan_relay),
}


@pytest.mark.parametrize(
    "how", [pytest.param(how, marks=[pytest.mark.smoke] * (how == "docker kill")) for how in LOSSES]
)
def test_lost_parts_come_back(how: str, flow: Flow) -> None:
    """On the same ports, which participants keep for the proxy."""
    proxy = the_proxy()
    wait_until(lambda: ports_are_kept(proxy), 30, lambda: str(domain(proxy).inside))
    before = ports(proxy)
    port_range = proxy.ports
    former = runs(proxy)
    lost = time.time()

    LOSSES[how](proxy)

    took = wait_until(
        lambda: all_run(proxy) and runs(proxy) != former, 60, lambda: docker("ps", "--all")
    )
    wait_until(lambda: ports(proxy) == before, 60, lambda: f"{ports(proxy)} is not {before}")
    flow.wait(since=time.time())
    print(f"{how}: all run again after {took:.1f} s; {flow.gaps(lost)}")
    assert proxy.ports == port_range


def test_an_outside_node_that_comes_after_the_lan_relay_was_lost_is_heard(
    flow: Flow, lan: Outside
) -> None:
    proxy = the_proxy()
    docker("rm", "--force", proxy.lan_relay)
    wait_until(lambda: all_run(proxy), 60, lambda: docker("ps", "--all"))

    late = lan.node("jazzy", "sub", "/out")

    late.log.wait_for("inside")


def test_controller_killed(flow: Flow, controller: Controller) -> None:
    """Everything goes on without the controller. Parts lost meanwhile come back with the
    controller.
    """
    proxy = the_proxy()
    killed = time.time()
    controller.kill()
    try:
        flow.wait(since=time.time())
        print(f"controller killed: {flow.gaps(killed)}")
        docker("rm", "--force", proxy.name, proxy.lan_relay)
    finally:
        controller.start()
    wait_until(lambda: all_run(proxy), 60, lambda: docker("ps", "--all"))
    flow.wait(since=time.time())


def test_proxy_and_lan_relay_crash_while_no_controller_runs(
    flow: Flow, controller: Controller
) -> None:
    """The engine restarts both, which is sufficient."""
    proxy = the_proxy()
    controller.kill()
    try:
        lost = time.time()
        crash(proxy.name)
        crash(proxy.lan_relay)
        wait_until(lambda: all_run(proxy), 60, lambda: docker("ps", "--all"))
        flow.wait(since=time.time())
        print(f"proxy and LAN relay crash without a controller: {flow.gaps(lost)}")
    finally:
        controller.start()
