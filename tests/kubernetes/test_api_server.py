"""The API server is killed and started again."""

import time

from tests.docker.engine import wait_until
from tests.kubernetes import release
from tests.kubernetes.conftest import cluster
from tests.kubernetes.measured import note
from tests.kubernetes.pods import Namespace
from tests.kubernetes.robot import Robot
from tests.kubernetes.rosproxies import rosproxy
from tests.kubernetes.traffic import flow


def test_traffic_goes_on_and_the_operator_finds_back(net: Namespace, robot: Robot) -> None:
    made = rosproxy(net.name, master={"uri": robot.master_uri}, ports=8)
    with flow(net, robot, "roscpp") as traffic:
        before = made.the_proxy()
        restarts = _restarts()
        killed = time.time()
        cluster("restart-apiserver")
        up = time.time()
        traffic.wait(since=up)
        gaps = traffic.gaps(killed)
        assert gaps.unnoticed, gaps
        assert made.the_proxy().uid_then == before.uid_then

        net.idle(on="node2")
        took = wait_until(lambda: made.proxy_on("node2") is not None, 60, made.tell)
        note(f"API server killed: up again after {up - killed:.1f} s; {gaps}; "
             f"a pod's proxy was made {took:.1f} s after it")  # fmt: skip
        made.the_proxy("node2")
        assert _restarts() == restarts, "the operator needed a restart"


def _restarts() -> int:
    bodies = [pod.body for pod in release.operators()]
    return sum(int(body["status"]["containerStatuses"][0]["restartCount"]) for body in bodies)
