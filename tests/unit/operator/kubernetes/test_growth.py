"""The work of a look, in calls of functions, grows in proportion to the nodes.

The count has no loops without calls, such as a search for an attribute in a tuple.
"""

import sys
from collections.abc import Iterator
from types import FrameType
from typing import Any

import pytest
from msgspec.structs import replace

from rosproxy_operator.kubernetes.planner.actions import Emit
from rosproxy_operator.kubernetes.planner.plan import ClusterPlan
from rosproxy_operator.kubernetes.resources import names
from tests.unit.operator.kubernetes.simulation import (
    SETTINGS,
    Cluster,
    Controller,
    Object,
    component_of,
)

NODES = 8
SPECS: dict[str, Object] = {
    "ROS 1": {"ports": 5, "master": {"uri": "http://robot:11311"}},
    "DDS": {"ports": 5, "ros": 2, "peers": ["robot"]},
    "LAN relays": {"ports": 5, "ros": 2, "multicast": True},
    "rmw_zenoh": {"ros": "zenoh"},
}


class CountingController(Controller):
    """A controller that counts the calls of the operator's functions in its last look."""

    calls = 0

    def look(self) -> ClusterPlan:
        self.calls = 0
        sys.setprofile(self._count)
        try:
            return super().look()
        finally:
            sys.setprofile(None)

    def _count(self, frame: FrameType, event: str, _function: object) -> None:
        module = frame.f_globals.get("__name__", "")
        self.calls += event == "call" and module.startswith("rosproxy")

    def act(self) -> int:
        """Look and act. Return the calls of the look."""
        self.carry_out(self.look())
        return self.calls

    def come_to_rest(self) -> None:
        """Look and act until nothing is left to do."""
        actions: list[Any] = [None]
        while actions:
            planned = self.look()
            actions = [action for action in planned.actions if not isinstance(action, Emit)]
            self.carry_out(planned)
            self.cluster.step()
            self.now += 10.0


def calls_of_looks(spec: Object, nodes: int) -> Iterator[tuple[str, int]]:
    """Yield changes of a cluster with this many nodes, and the calls of a look after each."""
    cluster = Cluster(f"ros-{nodes}")  # with names of its own, which are in no cache
    controller = CountingController(cluster, SETTINGS)
    cluster.add_rosproxy("robot", {**spec, "maxUnavailable": "100%"})
    for number in range(10, 10 + nodes):
        cluster.add_node(f"node-{number}", f"192.0.2.{number}")
        cluster.add_pod(f"pod-{number}", f"node-{number}", {names.INJECT: "robot"})
    yield "all is new", controller.act()
    controller.come_to_rest()
    yield "nothing", controller.act()
    controller.lose_memory()
    yield "the operator starts", controller.act()
    controller.come_to_rest()
    for pod in cluster.state.pods.values():
        if component_of(pod) == names.PROXY:
            pod["status"]["conditions"] = [{"type": "Ready", "status": "False"}]
    yield "no proxy is ready", controller.act()
    cluster.step()
    controller.settings = replace(SETTINGS, image="rosproxy:2")
    yield "another image", controller.act()
    yield "all nodes check the image", controller.act()
    controller.come_to_rest()
    cluster.state.pods = {n: p for n, p in cluster.state.pods.items() if component_of(p)}
    yield "no pod needs a proxy", controller.act()
    cluster.state.nodes.clear()
    yield "no node exists", controller.act()


@pytest.mark.parametrize("version", SPECS)
def test_a_look_takes_the_same_work_for_each_further_node(version: str) -> None:
    few, more, most = (dict(calls_of_looks(SPECS[version], n * NODES)) for n in (1, 2, 3))

    for change in few:
        # A call for each pair of nodes would make a difference of NODES**2.
        assert most[change] - more[change] - (more[change] - few[change]) < NODES**2 / 2, change
