"""A proxy that is killed, removed, replaced, stopped or paused in the middle of traffic."""

import re
import time
from collections.abc import Callable, Iterator
from datetime import datetime

import pytest

from tests.docker.controller import Controller, Proxy, proxies, the_proxy
from tests.docker.engine import docker, inspect, wait_until
from tests.docker.inside import Inside
from tests.docker.nodes import LIBRARIES
from tests.docker.robot import Robot
from tests.docker.traffic import Traffic, crash, traffic


@pytest.fixture(params=LIBRARIES)
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
    "docker kill …-ports": lambda proxy: docker("kill", proxy.sandbox),
    "docker rm --force …-ports": lambda proxy: docker("rm", "--force", proxy.sandbox),
    "docker rm --force both": lambda proxy: docker("rm", "--force", proxy.name, proxy.sandbox),
}


@pytest.mark.parametrize("how", LOSSES)
def test_lost_proxy_comes_back_on_its_ports(
    how: str, flow: Traffic, record_property: Callable[[str, object], None]
) -> None:
    proxy = the_proxy()
    ports, networks = proxy.ports, proxy.networks
    lost = time.time()

    LOSSES[how](proxy)

    flow.wait(since=recovered(lost), seconds=40)
    gaps = flow.gaps(lost)
    print(f"{how}: {gaps}")
    record_property(how, str(gaps))
    assert the_proxy().ports == ports
    assert the_proxy().networks == networks
    assert max(gaps.outward, gaps.inward) < 20


def recovered(lost: float) -> float:
    """A moment at which the proxy runs again."""
    wait_until(lambda: any(started(proxy) > lost for proxy in proxies()), 30, "a proxy runs")
    return time.time()


def started(proxy: Proxy) -> float:
    """When a proxy's program was started; 0 if it does not run."""
    state = inspect(proxy.name, check=False).get("State", {})
    if not state.get("Running") or not proxy.running:
        return 0.0
    text = re.sub(r"(\.\d{6})\d*Z$", r"\1+00:00", str(state["StartedAt"]))
    return datetime.fromisoformat(text).timestamp()


def test_paused_proxy_is_resumed(flow: Traffic) -> None:
    proxy = the_proxy()

    docker("pause", proxy.name)

    wait_until(lambda: proxy.running, 10, "it is resumed")
    flow.wait(since=time.time())


@pytest.fixture
def moving_image(proxy_image: str) -> Iterator[str]:
    """A tag that tests give to other images."""
    tag = "rosproxy-test-moving:latest"
    docker("tag", proxy_image, tag)
    yield tag
    docker("rmi", "--force", tag, check=False)


@pytest.mark.parametrize("library", LIBRARIES)
def test_updated_image_replaces_the_proxy(
    library: str, start_controller: Callable[..., Controller], moving_image: str, net: Inside,
    named: Robot,
) -> None:  # fmt: skip
    start_controller("--proxy-image", moving_image)
    with traffic(net, named, net.network(), library) as flow:
        before = the_proxy()
        name, number, ports, token = before.name, before.id, before.ports, secret(before)
        changed = time.time()

        update(moving_image)

        wait_until(lambda: the_proxy().id != number, 30, "another container")
        flow.wait(since=time.time())
        print(f"image updated: {flow.gaps(changed)}")
        after = the_proxy()
        assert (after.name, after.ports, secret(after)) == (name, ports, token)


def update(tag: str) -> None:
    """Give the tag to another image that does the same."""
    made = docker("create", tag)
    try:
        docker("commit", "--change", f"LABEL made={time.time()}", made, tag)
    finally:
        docker("rm", made)


def secret(proxy: Proxy) -> str:
    words = inspect(proxy.name)["Config"]["Env"]
    return next(str(word) for word in words if word.startswith("ROSPROXY_ADMIN_TOKEN="))
