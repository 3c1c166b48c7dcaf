"""A RosProxy's policy: what outside is not to see."""

from tests.docker.engine import wait_until
from tests.kubernetes.pods import Namespace, unique
from tests.kubernetes.robot import Robot
from tests.kubernetes.rosproxies import rosproxy
from tests.kubernetes.traffic import START, wait_for_service


def test_a_policy_hides_a_topic_and_changes_without_a_new_pod(net: Namespace, robot: Robot) -> None:
    mark = unique("hidden").replace("-", "_")
    topic = f"/{mark}/out"
    rules = [{"action": "Deny", "kind": "Publish", "names": [f"/{mark}/*"]}]
    made = rosproxy(net.name, master={"uri": robot.master_uri}, ports=8, policy={"rules": rules})
    wait_for_service(net)
    talker = net.node("rospy", "pub", "--topic", topic, "--word", "inside", on="node1")
    listener = net.node("roscpp", "sub", "--topic", topic, on="node1")
    listener.log.wait_for("inside", seconds=START)
    wait_until(lambda: robot.knows_proxied(talker.node), 20, made.tell)
    assert robot.publishers(topic) == set()
    proxy = made.the_proxy()

    made.change(policy={"rules": []})
    robot.node("listener_hidden", "roscpp", "sub", "--topic", topic).wait_for("inside")
    assert robot.publishers(topic) == {f"/{talker.node}"}

    made.change(policy={"rules": rules})
    wait_until(lambda: not robot.publishers(topic), 20, made.tell)
    robot.end("listener_hidden")
    again = made.the_proxy()
    assert (again.uid, again.restarts) == (proxy.uid, 0)
