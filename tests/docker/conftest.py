"""The engine, the images and machines outside, made once for all tests."""

import os
from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack

import pytest

from tests.docker import images
from tests.docker.controller import Controller, proxies, remove_proxies, running_controller
from tests.docker.engine import docker, logs, running_engine
from tests.docker.inside import Inside, inside, remove_leftovers
from tests.docker.machines import Machine
from tests.docker.robot import Robot, laptop, named_robot, robot_outside
from tests.docker.ros2 import Inside2, Outside, machine_on_lan


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Add the logs and the status of all proxies to a failure."""
    report = yield
    if report.failed and report.when == "call":
        for proxy in proxies(check=False):
            report.sections.append((proxy.name, logs(proxy.name)))
            status = docker("exec", proxy.name, "rosproxy", "status", check=False)
            report.sections.append((proxy.name, status))
    return report


@pytest.fixture(scope="session", autouse=True)
def _engine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with running_engine(tmp_path_factory.mktemp("engine") / "dockerd.log"):
        remove_leftovers()
        yield


@pytest.fixture(scope="session")
def base_image(_engine: None) -> str:
    return images.base_image()


@pytest.fixture(scope="session")
def proxy_image(_engine: None) -> str:
    return images.build_image(images.PROXY)


@pytest.fixture
def moving_image(proxy_image: str) -> Iterator[str]:
    """A tag that tests give to other images."""
    tag = "rosproxy-test-moving:latest"
    docker("tag", proxy_image, tag)
    yield tag
    docker("rmi", "--force", tag, check=False)


@pytest.fixture(scope="session")
def controller_image(_engine: None) -> str:
    return images.build_image(images.OPERATOR)


@pytest.fixture(scope="session")
def ros_image(_engine: None) -> str:
    return images.build_image(images.ROS)


@pytest.fixture(scope="session")
def ros2_image(_engine: None) -> str:
    return images.build_image(images.ROS2)


@pytest.fixture(scope="session")
def zenoh_image(_engine: None) -> str:
    return images.build_image(images.ZENOH)


@pytest.fixture(scope="session")
def haproxy_image(_engine: None) -> str:
    return images.build_image(images.HAPROXY)


@pytest.fixture(scope="module")
def robot(ros_image: str) -> Iterator[Robot]:
    """A machine outside with a roscore, which has a route to this host and to nothing else."""
    with robot_outside(ros_image) as robot:
        robot.start_master()
        yield robot


@pytest.fixture(scope="session")
def named(ros_image: str) -> Iterator[Robot]:
    """A robot with the host name ``robot``, which inside cannot resolve without the proxy."""
    with named_robot(ros_image) as robot:
        robot.start_master()
        yield robot


@pytest.fixture(scope="session")
def other_machine(ros_image: str, named: Robot) -> Iterator[Machine]:
    with laptop(ros_image, named) as machine:
        yield machine


@pytest.fixture(scope="module")
def lan(ros2_image: str) -> Iterator[Outside]:
    """A machine outside with ROS 2, which hears this host's multicast."""
    with machine_on_lan(ros2_image) as outside:
        yield outside


@pytest.fixture
def inside2(ros2_image: str) -> Iterator[Inside2]:
    """Networks and containers for ROS 2 nodes inside, removed after the test."""
    with inside(ros2_image, "") as made:
        yield Inside2(made)


@pytest.fixture(scope="session")
def _no_other_controller(_engine: None) -> None:
    """If all proxies have the tests' image, remove these remainders of a killed run."""
    if {proxy.image for proxy in proxies()} == {images.PROXY}:
        remove_proxies()
    proxy_names = [proxy.name for proxy in proxies()]
    assert not proxy_names, (
        f"a controller is at work on this engine, or has left its proxies: {proxy_names}"
    )


@pytest.fixture
def start_controller(
    controller_image: str, proxy_image: str, named: Robot, _no_other_controller: None
) -> Iterator[Callable[..., Controller]]:
    """Starts a controller with its own options. Controller and proxies are removed afterwards."""
    with ExitStack() as stack:
        stack.callback(remove_proxies)
        names = {named.name: named.address}

        def start(*options: str, **more: dict[str, str]) -> Controller:
            every = {**names, **more.get("names", {})}
            return stack.enter_context(
                running_controller(
                    controller_image, "--proxy-image", proxy_image, *options, names=every
                )
            )

        yield start


@pytest.fixture(scope="module")
def controller(
    controller_image: str, proxy_image: str, named: Robot, _no_other_controller: None,
    request: pytest.FixtureRequest,
) -> Iterator[Controller]:  # fmt: skip
    """A controller for all tests of a module, with the usual options and the module's `OPTIONS`."""
    names = {named.name: named.address}
    options = getattr(request.module, "OPTIONS", ())
    try:
        with running_controller(
            controller_image, "--proxy-image", proxy_image, *options, names=names
        ) as started_controller:
            yield started_controller
    finally:
        remove_proxies()


@pytest.fixture
def net(ros_image: str, named: Robot) -> Iterator[Inside]:
    """Networks and containers for nodes inside, removed after the test."""
    with inside(ros_image, named.master_uri) as made:
        yield made


@pytest.fixture
def near(ros_image: str, robot: Robot) -> Iterator[Inside]:
    """Networks and containers for nodes with the robot's address in ROS_MASTER_URI."""
    with inside(ros_image, robot.master_uri) as made:
        yield made


@pytest.fixture
def container_name() -> Iterator[str]:
    """A name for a container, which is removed afterwards."""
    name = f"rosproxy-test-{os.getpid()}"
    yield name
    docker("rm", "--force", name, check=False)
