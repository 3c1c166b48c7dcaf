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
    """Inside hears it, also after the proxy was lost; without the label outside hears it, too."""
    network, topic = net.network(), f"/{unique('hidden').replace('-', '_')}"
    publish = (network, "rospy", "pub", "--topic", topic, "--word", "inside")
    hider = net.node(*publish, labels=(ENABLE, f"rosproxy.policy=deny publish {topic}"))
    listener = net.node(network, "roscpp", "sub", "--topic", topic)
    listener.log.wait_for("inside")
    wait_until(lambda: named.knows_proxied(hider.node), 20, hider.log.read)
    assert named.publishers(topic) == set()

    lost = time.time()
    docker("kill", the_proxy().name)
    listener.log.wait_for("inside", since=recovered(lost))
    wait_until(lambda: named.knows_proxied(hider.node), 20, hider.log.read)
    wait_until(lambda: not named.publishers(topic), 20, controller.logs)

    hider.remove()
    net.node(*publish, name=hider.name)
    named.node("ear_hidden", "roscpp", "sub", "--topic", topic).wait_for("inside")
    named.end("ear_hidden")
    assert named.publishers(topic) == {f"/{hider.node}"}
