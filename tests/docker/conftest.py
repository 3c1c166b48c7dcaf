"""The engine, the images and a robot on another network, made once for all tests."""

import hashlib
import os
from collections.abc import Iterator

import pytest

from tests.docker.engine import ROOT, build, docker, run, running_engine
from tests.docker.robot import Robot, robot_outside


@pytest.fixture(scope="session", autouse=True)
def _engine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with running_engine(tmp_path_factory.mktemp("engine") / "dockerd.log"):
        yield


@pytest.fixture(scope="session")
def base_image() -> str:
    """Debian without a registry; ROSPROXY_TEST_BASE_IMAGE names another base."""
    chosen = os.environ.get("ROSPROXY_TEST_BASE_IMAGE")
    if chosen:
        return chosen
    script = ROOT / "scripts/base-image.sh"
    version = hashlib.sha256(script.read_bytes()).hexdigest()[:12]
    name = f"rosproxy-test-base:{version}"
    run(script, name, seconds=600)
    return name


@pytest.fixture(scope="session")
def proxy_image(base_image: str) -> str:
    """The image as a user builds it, on the base that is at hand."""
    arguments = ("--build-arg", f"BASE_IMAGE={base_image}", "--target", "proxy")
    return build("rosproxy:test", *arguments, ROOT)


@pytest.fixture(scope="session")
def ros_image(base_image: str) -> str:
    """A machine with ROS 1 on it."""
    here = ROOT / "tests/docker"
    dockerfile = ("--file", here / "ros.Dockerfile")
    return build(
        "rosproxy-test-ros:latest", "--build-arg", f"BASE_IMAGE={base_image}", *dockerfile, here
    )


@pytest.fixture(scope="module")
def robot(ros_image: str) -> Iterator[Robot]:
    """A machine outside with a roscore, which has a route to this host and to nothing else."""
    with robot_outside(ros_image) as robot:
        robot.start_master()
        yield robot


@pytest.fixture
def container_name() -> Iterator[str]:
    """A name for one container, which is removed afterwards."""
    name = f"rosproxy-test-{os.getpid()}"
    yield name
    docker("rm", "--force", name, check=False)
