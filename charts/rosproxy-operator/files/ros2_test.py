"""The test in a labelled pod: sends a message to a node in another pod, and waits for the answer."""

import os
import sys
import time
import uuid

import rclpy
from std_msgs.msg import String

NAMESPACE = os.environ["NAMESPACE"]
ROSPROXY = os.environ["ROSPROXY"]
ON = os.environ["ON_NODE"]
ECHO = "/" + os.environ["NODE_NAME"]
STARTED = time.monotonic()
DEADLINE = STARTED + float(os.environ["TIMEOUT"])


def say(text):
    print("%6.1f s  %s" % (time.monotonic() - STARTED, text), flush=True)


def fail(what, advice):
    say("FAILED: %s. %s" % (what, advice))
    sys.exit(1)


def wait_for_answer():
    """Return the cluster's node from which the answer comes; None if no answer comes in time."""
    question = uuid.uuid4().hex
    found = []
    questions = node.create_publisher(String, ECHO + "/ping", 10)

    def hear(answer):
        said, _, on = answer.data.partition(" ")
        found.extend([on] if said == question else [])

    node.create_subscription(String, ECHO + "/pong", hear, 10)
    node.create_timer(0.5, lambda: questions.publish(String(data=question)))
    while not found and time.monotonic() < DEADLINE:
        rclpy.spin_once(node, timeout_sec=0.5)
    return found[0] if found else None


if not os.environ.get("ROS_STATIC_PEERS"):
    fail("this pod was not wired at admission", "Check that the operator's webhook answers.")
say("on node %s, the proxy is %s" % (ON, os.environ["ROS_STATIC_PEERS"]))
rclpy.init()
node = rclpy.create_node("rosproxy_test")
there = wait_for_answer()
if there is None:
    fail(
        "no message comes to the node %s and back" % ECHO,
        "While the test runs, read kubectl -n %s describe rosproxy %s. Check that the nodes reach "
        "each other's hostPorts by UDP: a firewall or a NetworkPolicy may block the datagrams."
        % (NAMESPACE, ROSPROXY),
    )
if there == ON:
    say("both pods are on node %s, so no port of a host was used" % ON)
say("PASSED: a message went to the pod on node %s and back" % there)
