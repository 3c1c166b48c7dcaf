"""A ROS 2 node for tests, under the Python of a ROS 2 distribution.

The node has a kind, or several at once (``pub,serve``). With ``--contexts`` the process has several
such nodes, each with a separate participant. Prints a line for each event, and ends by SIGINT.
"""

import argparse
import sys
import threading
import time
from collections.abc import Callable
from functools import partial

import rclpy
from rclpy.action import ActionClient, ActionServer
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import (
    DurabilityPolicy,
    LivelinessPolicy,
    QoSProfile,
    ReliabilityPolicy,
    qos_policy_name_from_kind,
)
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from std_msgs.msg import String
from std_srvs.srv import Trigger
from test_msgs.action import Fibonacci

# An action of a millisecond ends before the feedback's publisher and the client's subscription have
# discovered each other. Volatile feedback is then lost, also without a proxy.
FEEDBACK_PAUSE = 0.2
# A server drops a response if the server has not discovered the client's reader after a tenth of a
# second (rmw_fastrtps, `check_for_subscription`). The client may already know the server. So on a
# busy machine the first reply and the result of the first goal may be lost, also without a proxy.
# Clients ask again.
ORDER = 8
"""Order of the goals. The sequence has ORDER + 1 numbers, the first feedback has three."""
GOAL_PATIENCE = 15.0
CALL_PATIENCE = 5.0


def say(*words: object) -> None:
    print(*words, flush=True)


def profile(options: argparse.Namespace) -> QoSProfile:
    qos = QoSProfile(depth=options.depth)
    if options.best_effort:
        qos.reliability = ReliabilityPolicy.BEST_EFFORT
    if options.latched:
        qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
    if options.deadline:
        qos.deadline = Duration(seconds=options.deadline)
    if options.liveliness:
        qos.liveliness = LivelinessPolicy[options.liveliness]
        qos.liveliness_lease_duration = Duration(seconds=options.lease)
    return qos


def incompatible(event: object) -> None:
    say("incompatible", qos_policy_name_from_kind(event.last_policy_kind).lower())


def publish(node: Node, options: argparse.Namespace) -> None:
    events = PublisherEventCallbacks(
        deadline=lambda event: say("offered deadline missed", event.total_count),
        liveliness=lambda event: say("liveliness lost", event.total_count),
        incompatible_qos=incompatible,
    )
    publisher = node.create_publisher(
        String, options.topic, profile(options), event_callbacks=events
    )
    number = 0

    def send() -> None:
        nonlocal number
        if options.matched and not publisher.get_subscription_count():
            return
        text = f"{options.word} {number}".ljust(options.size, ".")
        publisher.publish(String(data=text))
        say("sent", number)
        number += 1
        if number == options.count:
            timer.cancel()

    timer = node.create_timer(options.period, send)


def subscribe(node: Node, options: argparse.Namespace) -> None:
    def take(message: String) -> None:
        text = message.data.rstrip(".")
        say("got", text, "size", len(message.data), "at", f"{time.time():.3f}")

    events = SubscriptionEventCallbacks(
        deadline=lambda event: say("deadline missed", event.total_count),
        liveliness=lambda event: say("alive", event.alive_count, "not", event.not_alive_count),
        incompatible_qos=incompatible,
    )
    node.create_subscription(String, options.topic, take, profile(options), event_callbacks=events)
    say("ready")


def serve(node: Node, options: argparse.Namespace) -> None:
    def answer(_: Trigger.Request, reply: Trigger.Response) -> Trigger.Response:
        reply.success = True
        reply.message = options.word
        return reply

    node.create_service(Trigger, options.topic, answer)
    say("ready")


def call(node: Node, options: argparse.Namespace) -> None:
    """Call a service again and again. In turn, the first call is repeated until a reply arrives."""
    client = node.create_client(Trigger, options.topic)
    number = 0
    answered = set[int]()
    first_asked = -CALL_PATIENCE

    def ask() -> None:
        nonlocal number, first_asked
        now = time.monotonic()
        is_lost = not answered and now - first_asked >= CALL_PATIENCE
        waits = options.in_turn and len(answered) < number and not is_lost
        if waits or not client.service_is_ready():
            return
        if options.in_turn and not answered:
            number = 0
            first_asked = now
        client.call_async(Trigger.Request()).add_done_callback(partial(done, number, now))
        number += 1
        if number == options.count:
            timer.cancel()

    def done(asked: int, started: float, future: object) -> None:
        if asked in answered:
            return
        answered.add(asked)
        took = time.monotonic() - started
        say("reply", asked, future.result().message, f"{took * 1000:.1f}", "ms")

    timer = node.create_timer(options.period, ask)


def act(node: Node, options: argparse.Namespace) -> None:
    def execute(goal: object) -> Fibonacci.Result:
        sequence = [0, 1]
        for _ in range(goal.request.order - 1):
            sequence.append(sequence[-1] + sequence[-2])
            goal.publish_feedback(Fibonacci.Feedback(sequence=sequence))
            time.sleep(FEEDBACK_PAUSE)
        goal.succeed()
        return Fibonacci.Result(sequence=sequence)

    node.kept = ActionServer(node, Fibonacci, options.topic, execute)
    say("ready")


def pursue(node: Node, options: argparse.Namespace) -> None:
    """Send goals until a goal has all feedback.

    The server may discover the client's reader of feedback after the first goal (rcl_action,
    rcl_action_server_is_available).
    """
    client = node.kept = ActionClient(node, Fibonacci, options.topic)
    asked = -GOAL_PATIENCE
    lengths = set[int]()

    def feedback(message: object) -> None:
        lengths.add(len(message.feedback.sequence))
        say("feedback", len(message.feedback.sequence))

    def accepted(future: object) -> None:
        future.result().get_result_async().add_done_callback(done)

    def done(future: object) -> None:
        nonlocal asked
        asked = -GOAL_PATIENCE
        if lengths.issuperset(range(3, ORDER + 2)):
            timer.cancel()
        say("result", *future.result().result.sequence)

    def ask() -> None:
        nonlocal asked
        now = time.monotonic()
        if client.server_is_ready() and now - asked >= GOAL_PATIENCE:
            asked = now
            lengths.clear()
            goal = Fibonacci.Goal(order=ORDER)
            client.send_goal_async(goal, feedback_callback=feedback).add_done_callback(accepted)

    timer = node.create_timer(options.period, ask)


def hold(node: Node, options: argparse.Namespace) -> None:
    node.declare_parameter("speed", 1)
    node.add_post_set_parameters_callback(
        lambda changed: say(
            "changed", *(f"{parameter.name}={parameter.value}" for parameter in changed)
        )
    )
    say("ready")


def until_answered(
    node: Node,
    period: float,
    is_ready: Callable[[], bool],
    send: Callable[[], Future],
    answered: Callable[[object], None],
) -> None:
    """Send a request again and again until a reply arrives."""
    sent_at = -CALL_PATIENCE

    def ask() -> None:
        nonlocal sent_at
        now = time.monotonic()
        if is_ready() and now - sent_at >= CALL_PATIENCE:
            sent_at = now
            send().add_done_callback(done)

    def done(future: Future) -> None:
        if not timer.is_canceled():
            timer.cancel()
            answered(future.result())

    timer = node.create_timer(period, ask)


def tune(node: Node, options: argparse.Namespace) -> None:
    client = node.kept = AsyncParameterClient(node, options.of)
    speed = [Parameter("speed", Parameter.Type.INTEGER, 7)]

    ask = partial(until_answered, node, options.period, client.services_are_ready)

    def listed(reply: object) -> None:
        say("listed", *sorted(reply.result.names))
        ask(partial(client.set_parameters, speed), was_set)

    def was_set(reply: object) -> None:
        say("set", *(result.successful for result in reply.results))
        ask(partial(client.get_parameters, ["speed"]), got)

    def got(reply: object) -> None:
        say("parameter", *(value.integer_value for value in reply.values))

    ask(client.list_parameters, listed)


def list_names(node: Node, options: argparse.Namespace) -> None:
    node.create_timer(
        options.period, lambda: say("nodes", *sorted(n for n in node.get_node_names()), "end")
    )


KINDS = {
    "pub": publish,
    "sub": subscribe,
    "serve": serve,
    "call": call,
    "act": act,
    "pursue": pursue,
    "hold": hold,
    "tune": tune,
    "names": list_names,
}


def read_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    parser.add_argument("kinds", type=lambda text: [KINDS[kind] for kind in text.split(",")])
    parser.add_argument("--name", required=True)
    parser.add_argument("--topic", default="/topic")
    parser.add_argument("--word", default="hello")
    parser.add_argument("--size", type=int, default=0)
    parser.add_argument("--count", type=int, default=0)
    parser.add_argument("--depth", type=int, default=10)
    parser.add_argument("--period", type=float, default=0.1)
    parser.add_argument("--matched", action="store_true", help="publish only with a subscriber")
    parser.add_argument("--best-effort", action="store_true")
    parser.add_argument("--latched", action="store_true")
    parser.add_argument("--deadline", type=float, default=0, help="seconds")
    parser.add_argument("--liveliness", choices=LivelinessPolicy.__members__)
    parser.add_argument("--lease", type=float, default=0, help="of liveliness, in seconds")
    parser.add_argument("--in-turn", action="store_true", help="call after the last reply")
    parser.add_argument("--of", default="", help="the node to ask for parameters")
    parser.add_argument("--contexts", type=int, default=1)
    parser.add_argument("--without-services", action="store_true", help="of the node itself")
    return parser.parse_args(sys.argv[1:])


def run(name: str, options: argparse.Namespace) -> None:
    context = Context()
    rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.ALL)
    described = Parameter("start_type_description_service", value=not options.without_services)
    node = Node(
        name,
        context=context,
        start_parameter_services=not options.without_services,
        parameter_overrides=[described],
    )
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    try:
        for begin in options.kinds:
            begin(node, options)
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass


def main() -> None:
    options = read_options()
    for number in range(1, options.contexts):
        arguments = f"{options.name}_{number}", options
        threading.Thread(target=run, args=arguments, daemon=True).start()
    run(options.name, options)


if __name__ == "__main__":
    main()
