"""A controller that is killed at any step, and restarted."""

import signal
import threading
import time
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path

import pytest

from tests.docker.controller import (
    Controller,
    Process,
    Proxy,
    managed,
    proxies,
    remove_proxies,
    the_proxy,
)  # fmt: skip
from tests.docker.engine import docker, wait_until
from tests.docker.inside import ENABLE, Inside, inside
from tests.docker.nodes import LIBRARIES
from tests.docker.robot import Robot
from tests.docker.tap import EngineTap
from tests.docker.traffic import traffic

MASTER = "http://robot:11311"
NAMES = {"robot": "198.51.100.7"}  # no master there: these tests are about the engine


@pytest.fixture
def tap(tmp_path: Path) -> Iterator[EngineTap]:
    with EngineTap(tmp_path) as tap:
        yield tap


@pytest.fixture
def idle(base_image: str) -> Iterator[Inside]:
    with inside(base_image, MASTER) as made:
        yield made


@pytest.fixture
def start_process(
    tmp_path: Path, proxy_image: str, _no_other_controller: None
) -> Iterator[Callable[..., Process]]:
    """Makes controllers that run beside the test, and that can be killed faster than containers."""
    made: list[Process] = []

    def make(*options: str, engine: str = "") -> Process:
        settings = ("--proxy-image", proxy_image, "--ports", "2", "--advertise-host", "192.0.2.1")
        environment = {"DOCKER_HOST": engine} if engine else {}
        process = Process(tmp_path, *settings, *options, names=NAMES, environment=environment)
        made.append(process)
        return process

    yield make
    for process in made:
        process.stop()
    remove_proxies()


def good(network: str) -> Proxy:
    """The only proxy, complete and without remainders."""
    (proxy,) = proxies()
    assert [managed("proxy"), managed("ports")] == [[proxy.name], [proxy.sandbox]]
    assert proxy.running
    assert proxy.networks == {network}
    assert proxy.aliases(network) >= {"robot", "rosproxy"}
    return proxy


def test_killed_before_each_step_of_a_first_proxy(
    tap: EngineTap, idle: Inside, start_process: Callable[..., Process]
) -> None:
    network = idle.network()
    idle.idle(network)
    killed = start_process(engine=tap.url)
    whole = start_process()
    for step in count(1):
        if not killed_at(step, "before", tap, killed):
            break
        whole.once("--once")
        good(network)
        remove_proxies()
    assert step > 6, tap.writes


def test_killed_during_each_step_of_a_replacement(
    tap: EngineTap, idle: Inside, start_process: Callable[..., Process]
) -> None:
    """The controller recreates both containers, because each label asks for more ports.

    The engine executes a request, or a part, and the answer is lost.
    """
    network = idle.network()
    idle.idle(network)
    killed = start_process(engine=tap.url)
    whole = start_process()
    whole.once("--once")
    first = good(network).ports[0]
    for step in count(1):
        wanted = len(good(network).ports) + 1
        idle.idle(network, labels=(ENABLE, f"rosproxy.ports={wanted}"))

        done = not killed_at(step, "during", tap, killed)
        whole.once("--once")

        assert good(network).ports == range(first, first + wanted)
        if done:
            break
    assert step > 6, tap.writes


def killed_at(step: int, when: str, tap: EngineTap, process: Process) -> bool:
    """Kill a controller at a step. Return whether the controller reached this step."""
    reached = threading.Event()

    def kill() -> None:
        process.send(signal.SIGKILL)
        reached.set()

    tap.arm(step, when, kill)
    process.once("--once", check=False)
    return reached.is_set()


@pytest.mark.parametrize("library", LIBRARIES)
def test_traffic_goes_on_without_the_controller(
    library: str, start_controller: Callable[..., Controller], net: Inside, named: Robot
) -> None:
    controller = start_controller()
    with traffic(net, named, net.network(), library) as flow:
        before = time.time()
        number = the_proxy().id

        controller.kill()
        flow.wait(since=time.time())
        controller.start()
        wait_until(lambda: "health and metrics" in controller.logs(), 60, controller.logs)
        controller.command("status", "--wait", "60")
        flow.wait(since=time.time())

        gaps = flow.gaps(before)
        print(f"controller killed: {gaps}")
        assert gaps.unnoticed, gaps
        assert the_proxy().id == number


def test_what_happened_while_the_controller_was_away(
    start_controller: Callable[..., Controller], net: Inside, named: Robot
) -> None:
    """A container is gone, and another comes on a new network."""
    controller = start_controller()
    network = net.network()
    node = net.node(network, "roscpp", "pub", "--topic", "/out")
    wait_until(lambda: named.knows_proxied(node.node), 60, node.log.read)
    controller.kill()
    docker("rm", "--force", node.name)
    other = net.node(net.network(), "rospy", "pub", "--topic", "/out")

    controller.start()

    wait_until(lambda: named.knows_proxied(other.node), 60, controller.logs)
    wait_until(lambda: not named.uri(node.node), 25, controller.logs)
    wait_until(lambda: network not in the_proxy().networks, 60, controller.logs)


def test_engine_that_is_not_there_yet_is_waited_for(
    tap: EngineTap, idle: Inside, start_process: Callable[..., Process]
) -> None:
    network = idle.network()
    idle.idle(network)
    hidden = tap.address.rename(tap.address.with_name("hidden"))
    controller = start_process(engine=tap.url)
    controller.start()
    wait_until(lambda: str(tap.address) in controller.logs(), 60, controller.logs)

    hidden.rename(tap.address)

    wait_until(lambda: bool(proxies()), 60, controller.logs)
    the_proxy()
