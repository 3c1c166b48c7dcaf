"""Small rospy nodes, one for each role. The C++ program takes the same arguments.

    node.py ROLE [--option value]... [__name:=NAME]

Each node prints plain lines for the tests.
"""

from __future__ import annotations

import json
import sys
import time
import zlib
from pathlib import Path

import actionlib
import rospy
from actionlib.msg import TwoIntsAction, TwoIntsFeedback, TwoIntsGoal, TwoIntsResult
from actionlib_msgs.msg import GoalStatus
from std_msgs.msg import String
from topic_tools.srv import MuxSelect, MuxSelectResponse

ALPHABET = "abcdefghijklmnopqrstuvwxyz"


class Options:
    """The `--option value` pairs of the command line."""

    def __init__(self, argv: list[str]) -> None:
        names = [argument.removeprefix("--") for argument in argv[::2]]
        self._values = dict(zip(names, argv[1::2], strict=True))

    def text(self, name: str, default: str = "") -> str:
        return self._values.get(name, default)

    def number(self, name: str, default: float) -> float:
        return float(self._values.get(name, default))


def say(*words: object) -> None:
    # At once: otherwise callbacks of several threads would mix lines.
    sys.stdout.write(" ".join(map(str, words)) + "\n")
    sys.stdout.flush()


def spin() -> None:
    """Waits for the end, which rospy.spin notices only after half a second."""
    while not rospy.is_shutdown():
        time.sleep(0.02)


def payload(prefix: str, number: int, size: int) -> str:
    """`prefix number` filled up to `size` characters."""
    head = f"{prefix} {number} "
    if size <= len(head):
        return head
    return head + (ALPHABET * (size // len(ALPHABET) + 1))[: size - len(head)]


def describe(text: str) -> str:
    """The identity of a payload: the first two words, the size and the checksum."""
    prefix, number = text.split(" ", 2)[:2]
    data = text.encode()
    return f"{prefix} {number} size {len(data)} crc {zlib.crc32(data):08x} at {time.time():.3f}"


def publish(options: Options) -> None:
    """Publishes for ever, or `--count` messages. `--latch 1`: latched; `--queue 0`: no limit."""
    latch = options.number("latch", 0) > 0
    topic = options.text("topic")
    queue = int(options.number("queue", 10))
    publisher = rospy.Publisher(topic, String, queue_size=queue, latch=latch)
    prefix = options.text("word", "hello")
    size = int(options.number("size", 0))
    rate = rospy.Rate(options.number("rate", 20))
    count = options.number("count", 1e9)
    say("ready")
    number = 0
    while number < count and not rospy.is_shutdown():
        text = payload(prefix, number, size)
        publisher.publish(text)
        say("sent", describe(text))
        number += 1
        rate.sleep()
    spin()


def publish_more(options: Options) -> None:
    """Publishes; once the file `--when` is there, also to `--then`; `--last` ends the first."""
    publishers = [rospy.Publisher(options.text("topic"), String, queue_size=10)]
    say("ready")
    more = False
    while not rospy.is_shutdown():
        if not more and Path(options.text("when")).exists():
            more = True
            publishers.append(rospy.Publisher(options.text("then"), String, queue_size=10))
            if options.number("last", 0) > 0:
                publishers.pop(0).unregister()
            say("more")
        for publisher in publishers:
            publisher.publish(payload("more", 0, 0))
        time.sleep(0.05)


def subscribe(options: Options) -> None:
    """Prints every message."""
    rospy.Subscriber(options.text("topic"), String, lambda m: say("got", describe(m.data)))
    say("ready")
    spin()


def serve(options: Options) -> None:
    """A service that answers `echo REQUEST`."""

    def answer(request: object) -> MuxSelectResponse:
        say("request", describe(request.topic))
        return MuxSelectResponse("echo " + request.topic)

    rospy.Service(options.text("service"), MuxSelect, answer)
    say("ready")
    spin()


def call(options: Options) -> None:
    """Waits for the service, then makes `--count` calls, and prints failed calls."""
    service = options.text("service")
    persistent = options.number("persistent", 0) > 0
    say("waiting")
    rospy.wait_for_service(service, timeout=options.number("patience", 30))
    proxy = rospy.ServiceProxy(service, MuxSelect, persistent=persistent)
    rate = rospy.Rate(options.number("rate", 20))
    size = int(options.number("size", 0))
    for number in range(int(options.number("count", 1))):
        if rospy.is_shutdown():
            break
        try:
            reply = proxy(payload("ask", number, size)).prev_topic
            say("reply", describe(reply.removeprefix("echo ")))
        except (rospy.ServiceException, rospy.ROSException) as error:
            say("failed", number, error)
        rate.sleep()
    say("done")


def set_parameter(options: Options) -> None:
    rospy.set_param(options.text("key"), json.loads(options.text("json")))
    say("done")


def get_parameter(options: Options) -> None:
    say("value", json.dumps(rospy.get_param(options.text("key")), sort_keys=True))


def action_server(options: Options) -> None:
    """Adds two integers, unless preempted before `--seconds` are over."""

    def execute(goal: TwoIntsGoal) -> None:
        say("goal", goal.a, goal.b)
        end = time.monotonic() + options.number("seconds", 0.3)
        while time.monotonic() < end:
            server.publish_feedback(TwoIntsFeedback())
            if server.is_preempt_requested():
                say("preempted")
                server.set_preempted()
                return
            time.sleep(0.1)
        server.set_succeeded(TwoIntsResult(goal.a + goal.b))

    server = actionlib.SimpleActionServer(options.text("action"), TwoIntsAction, execute, False)
    server.start()
    say("ready")
    spin()


def action_client(options: Options) -> None:
    """Sends a goal; with `--cancel 1` cancels after feedback.

    Cancels only once the status has the goal. Before, an older status may arrive, and a client that
    has cancelled would take the goal for lost.
    """
    client = actionlib.SimpleActionClient(options.text("action"), TwoIntsAction)
    if not client.wait_for_server(rospy.Duration(20)):
        say("no server")
        return
    cancel = options.number("cancel", 0) > 0

    def feedback(_: object) -> None:
        say("feedback")
        if cancel and client.get_state() == GoalStatus.ACTIVE:
            client.cancel_goal()

    goal = TwoIntsGoal(int(options.number("a", 1)), int(options.number("b", 2)))
    client.send_goal(goal, feedback_cb=feedback)
    finished = client.wait_for_result(rospy.Duration(20))
    result = client.get_result()
    say("finished", int(finished), "state", client.get_state(), "sum", result.sum if result else 0)


ROLES = {
    "pub": publish,
    "more": publish_more,
    "sub": subscribe,
    "serve": serve,
    "call": call,
    "setparam": set_parameter,
    "getparam": get_parameter,
    "actionserver": action_server,
    "actionclient": action_client,
}


def main() -> None:
    role, *rest = rospy.myargv()[1:]
    options = Options(rest)
    rospy.init_node(
        "node",
        xmlrpc_port=int(options.number("xmlrpc-port", 0)),
        tcpros_port=int(options.number("tcpros-port", 0)),
    )
    say("node", rospy.get_name())
    ROLES[role](options)


if __name__ == "__main__":
    sys.exit(main())
