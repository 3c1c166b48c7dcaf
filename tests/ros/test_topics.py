"""Messages arrive, whatever the library, the direction and the order of start."""

from __future__ import annotations

import re
from typing import Any

import pytest

from tests.ros.combinations import each_library, each_way_and_order, each_way_in_turn
from tests.ros.lab import ROSCORE, Lab

MASTER = ROSCORE
BIG = 10 * 1024 * 1024


@pytest.mark.smoke
@each_way_and_order("publisher", "subscriber")
def test_every_message_arrives_once_and_in_order(
    lab: Lab, publisher: str, subscriber: str, source: str, sink: str, starter: str
) -> None:
    topic = f"/{lab.unique('topic')}"
    # ROS drops messages from a full queue, for example if a thread of a node waits for a processor.
    queues: dict[str, Any] = {"topic": topic, "queue": 0}
    if starter == "publisher":
        lab.node(publisher, source, "pub", rate=50, **queues).wait_for(r"sent hello 2 ")
        receiver = lab.node(subscriber, sink, "sub", **queues)
    else:
        receiver = lab.node(subscriber, sink, "sub", **queues)
        receiver.wait_for("^ready")
        lab.node(publisher, source, "pub", rate=50, **queues)
    got = receiver.wait_for_count(r"^got hello (\d+) ", 20)[:20]
    numbers = [int(match[1]) for match in got]
    assert numbers == list(range(numbers[0], numbers[0] + 20))


@each_way_in_turn("publisher", "subscriber")
def test_a_latched_message_reaches_a_late_subscriber(
    lab: Lab, publisher: str, subscriber: str, source: str, sink: str
) -> None:
    topic = f"/{lab.unique('latched')}"
    sender = lab.node(publisher, source, "pub", topic=topic, latch=1, count=3)
    sent = sender.wait_for(r"sent (hello 2 size \d+ crc \w+)")[1]
    receiver = lab.node(subscriber, sink, "sub", topic=topic)
    assert receiver.wait_for(r"^got (\w+ \d+ size \d+ crc \w+)")[1] == sent


@each_way_in_turn("publisher", "subscriber")
def test_messages_of_10_mb_arrive_unharmed(
    lab: Lab, publisher: str, subscriber: str, source: str, sink: str
) -> None:
    topic = f"/{lab.unique('big')}"
    receiver = lab.node(subscriber, sink, "sub", topic=topic)
    receiver.wait_for("^ready")
    sender = lab.node(publisher, source, "pub", topic=topic, size=BIG, rate=4)
    lines = receiver.wait_for_count(rf"^got (hello \d+ size {BIG} crc \w+)", 3)
    for line in lines:
        sender.wait_for(f"^sent {re.escape(line[1])}")


@each_library
def test_one_topic_with_publishers_and_subscribers_on_both_sides(lab: Lab, library: str) -> None:
    topic = f"/{lab.unique('shared')}"
    receivers = [lab.node(library, role, "sub", topic=topic) for role in ("c1", "c2", "out")]
    for receiver in receivers:
        receiver.wait_for("^ready")
    for role in ("c1", "c2", "out"):
        lab.node(library, role, "pub", topic=topic, word=f"from-{role}")
    for receiver in receivers:
        for role in ("c1", "c2", "out"):
            receiver.wait_for_count(f"^got from-{role} ", 5)


@each_library
def test_a_publisher_that_ends_and_another_that_comes(lab: Lab, library: str) -> None:
    topic = f"/{lab.unique('relayrace')}"
    receiver = lab.node(library, "out", "sub", topic=topic)
    first = lab.node(library, "c1", "pub", topic=topic, word="first")
    receiver.wait_for_count("^got first ", 3)
    first.stop()
    lab.node(library, "c1", "pub", topic=topic, word="second")
    receiver.wait_for_count("^got second ", 3)
