"""Topics and services across the boundary while something happens to the cluster."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from tests.docker.engine import wait_until
from tests.docker.nodes import Log
from tests.docker.traffic import Gaps
from tests.kubernetes import api
from tests.kubernetes.cluster.layout import NODES
from tests.kubernetes.cluster.network import inside
from tests.kubernetes.pods import Namespace, Pod, unique
from tests.kubernetes.robot import Robot
from tests.kubernetes.rosproxies import PROXY_OF

START = 180
"""Seconds that pods and the robot's nodes get to start and to find each other, all at once.

A SYN that passes while kube-proxy changes from refusing to translating is sent again for 127 s
(kubernetes/kubernetes#48719).
"""


@dataclass(frozen=True)
class Flow:
    """A publisher, a subscriber and a server in pods, each with a peer on the robot.

    ``outward`` are messages at the robot, ``inward`` messages in the cluster, ``replies`` the
    robot's replies from the service.
    """

    talker: Pod
    listener: Pod
    server: Pod
    outward: Log
    replies: Log

    @property
    def inward(self) -> Log:
        return self.listener.log

    def wait(self, since: float = 0, seconds: float = 60) -> None:
        """Wait until messages and replies flow."""
        self.outward.wait_for("inside", since=since, seconds=seconds)
        self.inward.wait_for("outside", since=since, seconds=seconds)
        self.replies.wait_for("ask", since=since, seconds=seconds, verb="reply")

    def gaps(self, since: float) -> Gaps:
        """The longest pauses since then."""
        now = time.time()
        return Gaps(
            self.outward.longest_gap("inside", since, now),
            self.inward.longest_gap("outside", since, now),
            self.replies.longest_gap("ask", since, now, verb="reply"),
            self.outward.lost("inside", since) + self.inward.lost("outside", since),
        )


@contextmanager
def flow(net: Namespace, robot: Robot, library: str, on: str = "node1") -> Iterator[Flow]:
    """Twenty messages and five calls a second, which cost a processor more."""
    wait_for_service(net)
    mark = unique("flow").replace("-", "_")
    out = f"/out_{mark}"
    back = f"/in_{mark}"
    service = f"/serve_{mark}"
    talker = net.node(library, "pub", "--topic", out, "--word", "inside", on=on)
    listener = net.node(library, "sub", "--topic", back, on=on)
    server = net.node(library, "serve", "--service", service, on=on)
    names = [f"{role}_{mark}" for role in ("listener", "talker", "caller")]
    outward = robot.node(names[0], library, "sub", "--topic", out)
    robot.node(names[1], library, "pub", "--topic", back, "--word", "outside")
    call = ("call", "--service", service, "--rate", "5", "--count", "100000",
            "--patience", str(START))  # fmt: skip
    replies = robot.node(names[2], library, *call)
    try:
        traffic = Flow(talker, listener, server, outward, replies)
        traffic.wait(seconds=START)
        yield traffic
    finally:
        for name in names:
            robot.end(name)


def wait_for_service(net: Namespace) -> None:
    """Wait until a pod that starts finds the proxy: what connects before is not answered."""
    wait_until(lambda: _is_known(net.name), 60, f"kube-proxy knows the Service in {net.name}")


def _is_known(namespace: str) -> bool:
    """Whether each node knows the Service of a RosProxy, and translates or refuses calls.

    Otherwise a pod that connects earlier would hang for two minutes. On a busy machine the webhook
    does not always wait long enough.
    """
    listed = api.objects("services", namespace, PROXY_OF)
    services = [service for service in listed if service["spec"]["clusterIP"] != "None"]
    rules = [inside(node, "iptables-save") for node in NODES]
    return bool(services) and all(
        service["spec"]["clusterIP"] in text for service in services for text in rules
    )
