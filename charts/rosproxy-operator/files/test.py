"""The outside node: sends a message to the node behind the proxy, and waits for the answer."""

import os
import re
import sys
import time
import uuid
from urllib.parse import urlsplit

NAMESPACE = os.environ["NAMESPACE"]
ROSPROXY = os.environ["ROSPROXY"]
ECHO = "/" + os.environ["NODE_NAME"]
STARTED = time.monotonic()
DEADLINE = STARTED + float(os.environ["TIMEOUT"])
# The cluster may have no DNS; the kubelet gives each pod the addresses of Services.
HOST = os.environ.get(os.environ["MASTER_HOST_VARIABLE"]) or os.environ["MASTER_NAME"]
os.environ["ROS_MASTER_URI"] = "http://%s:11311" % ("[%s]" % HOST if ":" in HOST else HOST)

import rosgraph  # noqa: E402 - these modules read ROS_MASTER_URI
import rospy  # noqa: E402
from std_msgs.msg import String  # noqa: E402


def say(text):
    print("%6.1f s  %s" % (time.monotonic() - STARTED, text), flush=True)


def wait_for(found, what, advice):
    """Return the first result that is not empty; after the deadline, fail with an advice."""
    why = ""
    while time.monotonic() < DEADLINE:
        try:
            value = found()
        except (OSError, rosgraph.MasterException) as error:
            value = None
            why = " (%s)" % error
        if value:
            return value
        time.sleep(0.5)
    say("FAILED: %s%s. %s" % (what, why, advice))
    sys.exit(1)


def proxied_address():
    """Return the address of the echo node at a proxy. Each proxy notes the ports in a parameter."""
    uri = urlsplit(master.lookupNode(ECHO))
    noted = "\n".join(map(str, master.getParam("/rosproxy").values()))
    return uri.netloc if re.search(r"^%s /" % uri.port, noted, re.MULTILINE) else None


def hear_answer():
    questions.publish(question)
    return question in answers


master = rosgraph.Master("/rosproxy_test")
wait_for(
    master.getPid,
    "the master at %s does not answer" % os.environ["ROS_MASTER_URI"],
    "Read kubectl -n %s get pods: the pods of the test must run." % NAMESPACE,
)
say("the master answers at " + os.environ["ROS_MASTER_URI"])

address = wait_for(
    proxied_address,
    "no node %s is registered through a proxy" % ECHO,
    "While the test runs, read kubectl -n %s describe rosproxy %s. Check that the operator was "
    "ready when the pod was created: otherwise the pod is not wired." % (NAMESPACE, ROSPROXY),
)
say("the node in the labelled pod is registered as " + address)

answers = set()
question = uuid.uuid4().hex
rospy.init_node("rosproxy_test", anonymous=True, disable_signals=True)
rospy.Subscriber(ECHO + "/pong", String, lambda message: answers.add(message.data))
questions = rospy.Publisher(ECHO + "/ping", String, queue_size=10)
wait_for(
    hear_answer,
    "no message comes through %s" % address,
    "Check that pods can connect to hostPorts of their nodes. A firewall or a NetworkPolicy may "
    "block the connection.",
)
say("PASSED: a message went to the pod and back, through " + address)
