"""Nodes that offer each other two topics, a service, parameters and an action.

A topic is latched. Keys, tokens, attachments and options of queries are the same as in rmw_zenoh.
The sources are rmw_publisher_data.cpp, rmw_client_data.cpp, rmw_service_data.cpp,
liveliness_utils.cpp and attachment_helpers.cpp. Both topics and the service `add` have the payloads
and type hashes of ROS. So a node of another library can use these topics and the service
(`sdk_node.py`). All other payloads are text, and have the hash of a string.
"""

import itertools
import struct
import threading
import time
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import zenoh
from zenoh import ext

HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
"""The type hash of std_msgs/msg/String."""
ADD_HASH = "RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a"
"""The type hash of example_interfaces/srv/AddTwoInts."""
_CDR = b"\0\1\0\0"
"""The encapsulation header of CDR in little endian."""
PERIOD_S = 0.1
CALL_TIMEOUT_S = 120.0
ENOUGH_MESSAGES = 5
SHORT_GOAL_STEPS = 5
LONG_GOAL_STEPS = 10_000
"""A goal that ends only if a client cancels the goal."""


class Codec(NamedTuple):
    """How a payload stands for a text."""

    encode: Callable[[str], bytes]
    decode: Callable[[bytes], str]


def _string_to_cdr(text: str) -> bytes:
    encoded = text.encode() + b"\0"
    return _CDR + struct.pack("<I", len(encoded)) + encoded


def _string_from_cdr(payload: bytes) -> str:
    (length,) = struct.unpack_from("<I", payload, len(_CDR))
    return payload[len(_CDR) + 4 :][: length - 1].decode()


def _integers_to_cdr(text: str) -> bytes:
    integers = [int(word) for word in text.split()]
    return _CDR + struct.pack(f"<{len(integers)}q", *integers)


def _integers_from_cdr(payload: bytes) -> str:
    return " ".join(str(integer) for (integer,) in struct.iter_unpack("<q", payload[len(_CDR) :]))


TEXT = Codec(str.encode, bytes.decode)
STRING = Codec(_string_to_cdr, _string_from_cdr)
INTEGERS = Codec(_integers_to_cdr, _integers_from_cdr)
"""The request and the response of AddTwoInts: int64 with spaces between."""


class Kind(NamedTuple):
    """A topic or service below the name of a node."""

    name: str
    type: str
    latched: bool = False
    codec: Codec = TEXT
    hash: str = HASH

    @property
    def qos(self) -> str:
        """The QoS in tokens: reliable; volatile with ten messages, or transient_local with 1."""
        return ":1:,1:,:,:,," if self.latched else "::,10:,:,:,,"


CHATTER = Kind("chatter", "std_msgs::msg::dds_::String_", codec=STRING)
MAP = Kind("map", "std_msgs::msg::dds_::String_", latched=True, codec=STRING)
ADD = Kind("add", "example_interfaces::srv::dds_::AddTwoInts_", codec=INTEGERS, hash=ADD_HASH)
PARAMETERS = {
    name: Kind(name, f"rcl_interfaces::srv::dds_::{name.title().replace('_', '')}_")
    for name in (
        "describe_parameters",
        "get_parameter_types",
        "get_parameters",
        "list_parameters",
        "set_parameters",
        "set_parameters_atomically",
    )
}
_ACTION = "example_interfaces::action::dds_::Fibonacci"
SEND_GOAL = Kind("fibonacci/_action/send_goal", f"{_ACTION}_SendGoal_")
GET_RESULT = Kind("fibonacci/_action/get_result", f"{_ACTION}_GetResult_")
CANCEL_GOAL = Kind("fibonacci/_action/cancel_goal", "action_msgs::srv::dds_::CancelGoal_")
FEEDBACK = Kind("fibonacci/_action/feedback", f"{_ACTION}_FeedbackMessage_")
STATUS = Kind("fibonacci/_action/status", "action_msgs::msg::dds_::GoalStatusArray_", latched=True)


def say(*words: object) -> None:
    """Print a line, by a single write: several threads print."""
    print(" ".join(map(str, words)) + "\n", end="", flush=True)


class Node:
    """A node with entities and tokens."""

    def __init__(self, session: Any, name: str) -> None:
        self.session = session
        self.name = name
        self.gid = name.encode()[:16].ljust(16, b"\0")
        self._held: list[Any] = []
        self._entities = itertools.count(1)
        self._numbers = itertools.count(1)

    def publisher(self, kind: Kind) -> Callable[[str], None]:
        """A function that publishes a message."""
        key = self._declare("MP", kind, self.name)
        if kind.latched:
            cache = ext.CacheConfig(1)
            publisher = ext.declare_advanced_publisher(
                self.session, key, cache=cache, publisher_detection=True
            )
        else:
            publisher = self.session.declare_publisher(key)
        return lambda text: publisher.put(kind.codec.encode(text))

    def subscribe(self, kind: Kind, owner: str, take: Callable[[str], None]) -> None:
        """Call ``take`` with each message of another node."""
        key = self._declare("MS", kind, owner)

        def callback(sample: Any) -> None:
            take(kind.codec.decode(sample.payload.to_bytes()))

        if kind.latched:
            history = ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
            self._held.append(
                ext.declare_advanced_subscriber(self.session, key, callback, history=history)
            )
        else:
            self._held.append(self.session.declare_subscriber(key, callback))

    def serve(self, kind: Kind, answer: Callable[[str], str]) -> None:
        """Answer calls. Each answer has a thread, since the answer may take long."""
        key = self._declare("SS", kind, self.name)

        def reply(query: Any) -> None:
            asked = bytes(query.attachment)
            attachment = attachment_of(number_in(asked), asked[-16:])
            told = answer(kind.codec.decode(query.payload.to_bytes()))
            query.reply(key, kind.codec.encode(told), attachment=attachment)

        def callback(query: Any) -> None:
            threading.Thread(target=reply, args=(query,), daemon=True).start()

        self._held.append(self.session.declare_queryable(key, callback, complete=True))

    def client(self, kind: Kind, owner: str) -> Callable[[str], str]:
        """A function that calls a service of another node until there is an answer."""
        key = self._declare("SC", kind, owner)

        def call(payload: str) -> str:
            while True:
                for answer in self._ask(key, kind.codec.encode(payload)):
                    return kind.codec.decode(answer)
                time.sleep(PERIOD_S)

        return call

    def _ask(self, key: str, payload: bytes) -> Iterable[bytes]:
        number = next(self._numbers)
        replies = self.session.get(
            key,
            target=zenoh.QueryTarget.ALL_COMPLETE,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=CALL_TIMEOUT_S,
            payload=payload,
            attachment=attachment_of(number, self.gid),
        )
        for reply in replies:
            if reply.ok is not None:
                told = bytes(reply.ok.attachment)
                assert (number_in(told), told[-16:]) == (number, self.gid)
                yield reply.ok.payload.to_bytes()

    def _declare(self, entity: str, kind: Kind, owner: str) -> str:
        """Declare the token of an entity. Return the key of the messages or calls."""
        name = f"{owner}/{kind.name}"
        start = f"@ros2_lv/0/{self.session.info.zid()}/0/{next(self._entities)}/{entity}/%/%"
        mangled = f"/{name}".replace("/", "%")
        token = f"{start}/{self.name}/{mangled}/{kind.type}/{kind.hash}/{kind.qos}"
        self._held.append(self.session.liveliness().declare_token(token))
        return f"0/{name}/{kind.type}/{kind.hash}"


def attachment_of(number: int, gid: bytes) -> bytes:
    """Sequence number, source timestamp, and the length and bytes of the source's id."""
    return struct.pack("<qqB16s", number, time.time_ns(), len(gid), gid)


def number_in(attachment: bytes) -> int:
    """The sequence number in an attachment."""
    number, _, length, _ = struct.unpack("<qqB16s", attachment)
    assert length == 16
    return int(number)


class Goal:
    """A goal of an action with ``steps`` steps."""

    def __init__(self, steps: int) -> None:
        self.steps = steps
        self.state = "accepted"
        self.canceled = threading.Event()
        self.ended = threading.Event()


class ActionServer:
    """The three services and two topics of an action, as in rcl_action."""

    def __init__(self, node: Node) -> None:
        self._goals: dict[str, Goal] = {}
        self._lock = threading.Lock()
        self._feedback = node.publisher(FEEDBACK)
        self._status = node.publisher(STATUS)
        node.serve(SEND_GOAL, self._accept)
        node.serve(GET_RESULT, self._result)
        node.serve(CANCEL_GOAL, self._cancel)

    def _accept(self, request: str) -> str:
        name, steps = request.split()
        goal = Goal(int(steps))
        self._goals[name] = goal
        threading.Thread(target=self._execute, args=(name, goal), daemon=True).start()
        return "accepted"

    def _result(self, name: str) -> str:
        goal = self._goals[name]
        goal.ended.wait()
        return goal.state

    def _cancel(self, name: str) -> str:
        self._goals[name].canceled.set()
        return "canceling"

    def _execute(self, name: str, goal: Goal) -> None:
        self._note(goal, "executing")
        for step in range(goal.steps):
            self._feedback(f"{name} {step}")
            if goal.canceled.wait(PERIOD_S):
                break
        self._note(goal, "canceled" if goal.canceled.is_set() else "succeeded")
        goal.ended.set()

    def _note(self, goal: Goal, state: str) -> None:
        with self._lock:
            goal.state = state
            states = (f"{name}={goal.state}" for name, goal in self._goals.items())
            self._status(" ".join(states))


def offer(session: Any, name: str, _: str) -> None:
    """Offer all kinds. Print ``latched`` when the latched message is published."""
    node = Node(session, name)
    node.serve(ADD, lambda payload: str(sum(map(int, payload.split()))))
    for kind in PARAMETERS.values():
        node.serve(kind, lambda payload, kind=kind: f"{kind.name} of {payload}")
    ActionServer(node)
    publish_map = node.publisher(MAP)
    publish_map("latched")
    say("latched")
    publish_chatter = node.publisher(CHATTER)
    while True:
        publish_chatter("hello")
        time.sleep(PERIOD_S)


def use(session: Any, name: str, owners: str) -> None:
    """Use all kinds of each node in ``owners``. Print what has arrived."""
    node = Node(session, name)
    for owner in owners.split(","):
        subscribe(node, owner)
        threading.Thread(target=call, args=(node, owner), daemon=True).start()
    threading.Event().wait()


def subscribe(node: Node, owner: str) -> None:
    """Subscribe to both topics of a node."""
    numbers = itertools.count(1)

    def take(_: str) -> None:
        if next(numbers) == ENOUGH_MESSAGES:
            say("got", owner, "topic")

    node.subscribe(CHATTER, owner, take)
    node.subscribe(MAP, owner, lambda text: say("got", owner, text))


def call(node: Node, owner: str) -> None:
    """Call the services of a node, ask for parameters, and use the action."""
    say("got", owner, "sum", node.client(ADD, owner)("1 2"))
    get_parameters = node.client(PARAMETERS["get_parameters"], owner)
    say("got", owner, get_parameters("use_sim_time"))
    act(node, owner)


def act(node: Node, owner: str) -> None:
    """Send a short goal and await the end, then send a long goal and cancel the long goal."""
    goals = {f"{node.name}_short": SHORT_GOAL_STEPS, f"{node.name}_long": LONG_GOAL_STEPS}
    seen: set[str] = set()

    def note(word: str, text: str) -> None:
        """Print the feedback and the states of own goals, each once."""
        for told in text.split():
            goal = told.partition("=")[0]
            if goal in goals and f"{word} {told}" not in seen:
                seen.add(f"{word} {told}")
                say("got", owner, word, told.removeprefix(f"{node.name}_"))

    node.subscribe(FEEDBACK, owner, lambda text: note("feedback", text))
    node.subscribe(STATUS, owner, lambda text: note("status", text))
    calls = {kind: node.client(kind, owner) for kind in (SEND_GOAL, GET_RESULT, CANCEL_GOAL)}
    for goal, steps in goals.items():
        calls[SEND_GOAL](f"{goal} {steps}")
        if steps == LONG_GOAL_STEPS:
            say("got", owner, calls[CANCEL_GOAL](goal))
        say("got", owner, "result", calls[GET_RESULT](goal))
