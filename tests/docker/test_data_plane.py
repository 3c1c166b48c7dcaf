"""Topics on the kernel plane: capabilities of the containers, and flowing messages."""

import json
import time
from collections.abc import Callable
from typing import Any

import pytest

from tests.docker.controller import Controller, Proxy, the_proxy
from tests.docker.engine import docker, inspect, wait_until
from tests.docker.inside import ENABLE, Inside
from tests.docker.nodes import LIBRARIES
from tests.docker.robot import Robot
from tests.docker.test_proxy_lost import recovered
from tests.docker.traffic import Traffic, crash, traffic

KERNEL = (ENABLE, "rosproxy.data-plane=kernel", "rosproxy.ports=40")
"""Nodes of former tests hold ports for a while, and each node needs two."""
OPTIONS = ("--allow-data-plane", "kernel")


def status(proxy: Proxy) -> dict[str, Any]:
    document: dict[str, Any] = json.loads(
        docker("exec", proxy.name, "rosproxy", "status", "--json", check=False)
    )
    return document


def plane_of(node: str) -> dict[str, Any]:
    """The data plane of an inside node's topics."""
    nodes = status(the_proxy())["nodes"]
    mine = [row["data_plane"] for row in nodes if f"/{node}" in row["nodes"]]
    assert len(mine) == 1, nodes
    plane: dict[str, Any] = mine[0]
    return plane


def wait_forwarded(flow: Traffic) -> dict[str, Any]:
    """Wait until the kernel forwards the talker's topic. Return the topic's status."""
    talker = flow.talker.node
    wait_until(
        lambda: plane_of(talker)["plane"] == "kernel" and plane_of(talker)["connections"] > 0,
        20, lambda: str(status(the_proxy())),
    )  # fmt: skip
    before = plane_of(talker)
    assert before["port"] in the_proxy().ports
    wait_until(lambda: plane_of(talker)["sent"] > before["sent"], 60, "bytes are counted")
    return before


@pytest.mark.parametrize("library", LIBRARIES)
def test_kernel_forwards_what_the_label_asks_for(
    library: str, controller: Controller, net: Inside, named: Robot
) -> None:
    with traffic(net, named, net.network(), library, labels=KERNEL) as flow:
        wait_forwarded(flow)

        plane = status(the_proxy())["data_plane"]
        assert (plane["mode"], plane["plane"]) == ("kernel", "kernel")
        assert controller.status()["proxies"][0]["data_plane"] == "kernel"
        has_one_capability(the_proxy())


def has_one_capability(proxy: Proxy) -> None:
    """Check that the proxy's user has no capabilities, except through two programs."""
    host = inspect(proxy.name)["HostConfig"]
    assert (host["CapDrop"], host["CapAdd"]) == (["ALL"], ["NET_ADMIN"])
    assert host["ReadonlyRootfs"]
    assert not host["Privileged"]
    lines = docker("exec", proxy.name, "cat", "/proc/1/status").splitlines()
    rights = dict(line.split(":\t", 1) for line in lines if ":\t" in line)
    assert rights["Uid"].split() == ["10001"] * 4
    assert int(rights["CapEff"], 16) == int(rights["CapPrm"], 16) == 0
    assert not inspect(proxy.sandbox)["HostConfig"]["CapAdd"]


LOSSES: dict[str, Callable[[Proxy], object]] = {
    "crash": lambda proxy: crash(proxy.name),
    "docker kill": lambda proxy: docker("kill", proxy.name),
    "docker rm --force": lambda proxy: docker("rm", "--force", proxy.name),
    "docker stop": lambda proxy: docker("stop", proxy.name),
}


@pytest.mark.parametrize(
    ("how", "library"),
    [("crash", "rospy"), ("docker kill", "roscpp"), ("docker rm --force", "rospy"),
     ("docker rm --force", "roscpp"), ("docker stop", "rospy")],
)  # fmt: skip
def test_kernel_forwards_again_after_the_proxy_was_lost(
    how: str, library: str, controller: Controller, net: Inside, named: Robot
) -> None:
    with traffic(net, named, net.network(), library, labels=KERNEL) as flow:
        before = wait_forwarded(flow)
        proxy = the_proxy()
        lost = time.time()

        LOSSES[how](proxy)

        flow.wait(since=recovered(lost), seconds=40)
        print(f"{how}, {library}: {flow.gaps(lost)}")
        after = wait_forwarded(flow)
        assert after["port"] == before["port"]


def test_nobody_asks_and_the_proxy_says_why_the_kernel_does_not_forward(
    controller: Controller, net: Inside, named: Robot
) -> None:
    with traffic(net, named, net.network(), "roscpp") as flow:
        plane = plane_of(flow.talker.node)
        assert plane["plane"] == "splice"
        whole = status(the_proxy())["data_plane"]
        assert (whole["mode"], whole["plane"]) == ("auto", "splice")
        assert "NET_ADMIN" in whole["reason"]
