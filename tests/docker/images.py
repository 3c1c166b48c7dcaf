"""The images that tests use, built on this machine without a registry.

    python -m tests.docker.images

builds the images of nearly all tests in advance. Tests build again, from Docker's cache if nothing
has changed.
"""

import hashlib
import os
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path

from tests.docker.engine import ROOT, build, docker, run, running_engine

PROXY = "rosproxy:test"
OPERATOR = "rosproxy-operator:test"
ROS = "rosproxy-test-ros:latest"
ROS2 = "rosproxy-test-ros2:latest"
ZENOH = "rosproxy-test-zenoh:latest"
HAPROXY = "rosproxy-test-haproxy:latest"
_HERE = ROOT / "tests/docker"


@cache
def base_image() -> str:
    """Debian without a registry; ROSPROXY_TEST_BASE_IMAGE names another base."""
    chosen = os.environ.get("ROSPROXY_TEST_BASE_IMAGE")
    if chosen:
        return chosen
    script = ROOT / "scripts/base-image.sh"
    name = f"rosproxy-test-base:{hashlib.sha256(script.read_bytes()).hexdigest()[:12]}"
    run(script, name, seconds=600)
    return name


def build_image(name: str) -> str:
    """Build an image by name. Return the name."""
    recipes: dict[str, tuple[str | Path, ...]] = {
        # Like a user's build, on the base of this machine.
        PROXY: ("--target", "proxy", ROOT),
        OPERATOR: ("--target", "operator", ROOT),
        # A machine with ROS 1.
        ROS: ("--file", _HERE / "ros.Dockerfile", ROOT / "tests/ros/nodes"),
        # A machine with two distributions of ROS 2 and Cyclone DDS.
        ROS2: ("--file", _HERE / "ros2.Dockerfile", ROOT / "tests/ros2"),
        # One with sessions of zenoh, as rmw_zenoh has them.
        ZENOH: ("--file", _HERE / "zenoh.Dockerfile", ROOT / "tests/zenoh"),
        HAPROXY: ("--file", _HERE / "haproxy.Dockerfile", _HERE),
    }
    return build(name, "--build-arg", f"BASE_IMAGE={base_image()}", *recipes[name])


def update(tag: str) -> None:
    """Give the tag to another image that does the same."""
    made = docker("create", tag)
    try:
        docker("commit", "--change", f"LABEL made={time.time()}", made, tag)
    finally:
        docker("rm", made)


def main() -> None:
    """Build the images of proxy, operator and robots."""
    log = Path(tempfile.mkdtemp()) / "dockerd.log"
    with running_engine(log), ThreadPoolExecutor() as pool:
        base_image()
        robots = [pool.submit(build_image, name) for name in (ROS, ROS2)]
        for name in (PROXY, OPERATOR):  # these share the first steps
            build_image(name)
        for robot in robots:
            robot.result()


if __name__ == "__main__":
    main()
