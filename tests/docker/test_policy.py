"""A label by which a container hides a topic from outside."""

import time

from tests.docker.controller import Controller, the_proxy
from tests.docker.engine import docker, wait_until
from tests.docker.inside import ENABLE, Inside, unique
from tests.docker.robot import Robot
from tests.docker.test_proxy_lost import recovered


def test_a_label_hides_a_topic_from_outside(
    controller: Controller, net: Inside, named: Robot
) -> None:
    """Inside receives. The topic is never visible outside, not even after a loss of the proxy."""
    network = net.network()
    topic = f"/{unique('hidden').replace('-', '_')}"
    listener = net.node(network, "roscpp", "sub", "--topic", topic)
    wait_until(lambda: named.knows_proxied(listener.node), 30, listener.log.read)
    publish = (network, "rospy", "pub", "--topic", topic, "--word", "inside")
    hider = net.node(*publish, labels=(ENABLE, f"rosproxy.policy=deny publish {topic}"))

    def is_hidden() -> bool:
        assert named.publishers(topic) == set()
        told = docker("exec", the_proxy().name, "rosproxy", "status", check=False)
        return named.knows_proxied(hider.node) and f"publish {topic} of /{hider.node}" in told

    wait_until(is_hidden, 30, controller.logs)
    listener.log.wait_for("inside")

    lost = time.time()
    docker("kill", the_proxy().name)
    recovered(lost)
    wait_until(is_hidden, 30, controller.logs)

    hider.remove()
    net.node(*publish, name=hider.name)
    named.node("listener_hidden", "roscpp", "sub", "--topic", topic).wait_for("inside")
    named.end("listener_hidden")
    assert named.publishers(topic) == {f"/{hider.node}"}
