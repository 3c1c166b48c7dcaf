"""A RosProxy with the kernel plane."""

import json
import time
from typing import Any

from tests.docker.engine import wait_until
from tests.kubernetes.pods import Namespace
from tests.kubernetes.robot import Robot
from tests.kubernetes.rosproxies import RosProxy, rosproxy
from tests.kubernetes.traffic import Flow, flow


def status(made: RosProxy) -> dict[str, Any]:
    """The status of the proxy on node1."""
    text = made.the_proxy().run("rosproxy", "status", "--json", check=False)
    document: dict[str, Any] = json.loads(text)
    return document


def plane_of(made: RosProxy, node: str) -> dict[str, Any]:
    nodes = status(made)["nodes"]
    planes = [row["data_plane"] for row in nodes if f"/{node}" in row["nodes"]]
    return dict(planes[0]) if planes else {}


def wait_forwarded(made: RosProxy, moving: Flow) -> None:
    """Wait until the kernel forwards the talker's topic and counts bytes."""
    talker = moving.talker.node

    def is_forwarded() -> bool:
        plane = plane_of(made, talker)
        return plane.get("plane") == "kernel" and plane["connections"] > 0 and plane["sent"] > 0

    wait_until(is_forwarded, 60, lambda: f"the kernel forwards: {status(made)}")
    before = plane_of(made, talker)["sent"]
    wait_until(lambda: plane_of(made, talker)["sent"] > before, 60, "bytes are counted")


def test_kernel_forwards_again_after_the_proxy_was_killed(net: Namespace, robot: Robot) -> None:
    made = rosproxy(net.name, master={"uri": robot.master_uri}, ports=16, dataPlane="Kernel")
    with flow(net, robot, "roscpp") as moving:
        wait_forwarded(made, moving)
        proxy = made.the_proxy()
        given = proxy.body["spec"]["containers"][0]["securityContext"]
        assert given["capabilities"] == {"add": ["NET_ADMIN"], "drop": ["ALL"]}
        assert "CapEff:\t0000000000000000" in proxy.run("cat", "/proc/1/status")
        restarts = proxy.restarts

        proxy.crash()

        wait_until(lambda: made.the_proxy().restarts > restarts, 60, made.tell)
        moving.wait(since=time.time())
        wait_forwarded(made, moving)


def test_another_plane_makes_the_proxy_anew(net: Namespace, robot: Robot) -> None:
    made = rosproxy(net.name, master={"uri": robot.master_uri}, ports=16, dataPlane="Splice")
    with flow(net, robot, "rospy") as moving:
        before = made.the_proxy()
        assert plane_of(made, moving.talker.node)["plane"] == "splice"

        made.change(dataPlane="Kernel")

        def anew() -> bool:
            proxy = made.proxy_on("node1")
            return proxy is not None and proxy.uid_then != before.uid_then and proxy.ready

        wait_until(anew, 40, made.tell)
        assert made.the_proxy().ports == before.ports
        moving.wait(since=time.time())
        wait_forwarded(made, moving)
