"""A proxy that is killed, removed, replaced, stopped or paused in the middle of traffic."""

import re
import time
from collections.abc import Callable, Iterator
from datetime import datetime

import pytest

from tests.docker.controller import Controller, Proxy, proxies, the_proxy
from tests.docker.engine import docker, inspect, pause, wait_until
from tests.docker.inside import Inside
from tests.docker.robot import Robot
from tests.docker.traffic import Traffic, crash, traffic


@pytest.fixture
def flow(
    request: pytest.FixtureRequest, controller: Controller, net: Inside, named: Robot
) -> Iterator[Traffic]:
    with traffic(net, named, net.network(), request.param) as flow:
        yield flow


def by(*command: str) -> Callable[[Proxy], object]:
    return lambda proxy: docker(*command, proxy.name)


LOSSES: dict[str, Callable[[Proxy], object]] = {
    "docker kill": by("kill"),
    "docker rm --force": by("rm", "--force"),
    "docker stop": by("stop"),
    "crash": lambda proxy: crash(proxy.name),
    "docker rm --force both": lambda proxy: docker("rm", "--force", proxy.name, proxy.sandbox),
}


HOLDER_LOSSES: dict[str, Callable[[Proxy], object]] = {
    "docker kill …-ports": lambda proxy: docker("kill", proxy.sandbox),
    "docker rm --force …-ports": lambda proxy: docker("rm", "--force", proxy.sandbox),
}


@pytest.mark.parametrize("flow", ["roscpp"], indirect=True)
@pytest.mark.parametrize("how", HOLDER_LOSSES)
def test_lost_ports_come_back(how: str, flow: Traffic) -> None:
    """Only roscpp: rospy outside notices the loss by TCP keep-alive, after a minute."""
    proxy = the_proxy()
    ports = proxy.ports
    lost = time.time()

    HOLDER_LOSSES[how](proxy)

    flow.wait(since=recovered(lost))
    print(f"{how}: {flow.gaps(lost)}")
    assert the_proxy().ports == ports


CASES = [
    pytest.param("docker kill", "rospy", marks=pytest.mark.smoke),
    pytest.param("docker kill", "roscpp", marks=pytest.mark.smoke),
    ("docker rm --force", "rospy"),
    ("docker stop", "roscpp"),
    ("crash", "rospy"),
    ("docker rm --force both", "rospy"),
    ("docker rm --force both", "roscpp"),
]


@pytest.mark.parametrize(("how", "flow"), CASES, indirect=["flow"])
def test_lost_proxy_comes_back_on_its_ports(how: str, flow: Traffic) -> None:
    proxy = the_proxy()
    ports = proxy.ports
    networks = proxy.networks
    lost = time.time()

    LOSSES[how](proxy)

    flow.wait(since=recovered(lost))
    print(f"{how}: {flow.gaps(lost)}")
    assert the_proxy().ports == ports
    assert the_proxy().networks == networks


def recovered(lost: float) -> float:
    """A moment at which the proxy runs again."""
    wait_until(lambda: any(started(proxy) > lost for proxy in proxies()), 60, "a proxy runs")
    return time.time()


def started(proxy: Proxy) -> float:
    """The start time of a proxy's program; 0 if the program does not run."""
    state = inspect(proxy.name, check=False).get("State", {})
    if not state.get("Running") or not proxy.running:
        return 0.0
    text = re.sub(r"(\.\d{6})\d*Z$", r"\1+00:00", str(state["StartedAt"]))
    return datetime.fromisoformat(text).timestamp()


@pytest.mark.parametrize("flow", ["rospy"], indirect=True)
def test_paused_proxy_is_resumed(flow: Traffic) -> None:
    proxy = the_proxy()

    pause(proxy.name)

    wait_until(lambda: proxy.running, 60, "the proxy is resumed")
    flow.wait(since=time.time())
