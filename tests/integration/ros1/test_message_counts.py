"""Messages by topic, counted by nodes, while a client reads the metrics."""

from typing import Any

import pytest

from examples.demo.fake_http import End, value
from examples.demo.fake_node import FakeNode
from rosproxy.ros1.upkeep import message_counter
from rosproxy.ros1.upkeep.message_counter import ASK_INTERVAL_S
from tests.clock import pass_time
from tests.integration.conftest import MakeNode
from tests.integration.proxy import Proxy

PUBLISHED = {"name": "/chatter", "side": "published"}
ASK_AFTER_READ_S = 15.0
INTERVAL_AFTER_ERROR_S = 40.0
INTERVAL_AFTER_SILENCE_S = 12.0
"""Shorter than the proxy's own."""
ROUND = ASK_INTERVAL_S + 2
"""Seconds in which each of few nodes is asked once more."""


class Counts:
    """The message count of a node, which has a single topic."""

    def __init__(self, node: FakeNode) -> None:
        self.messages = 1000
        self._node = node
        node.answers["getBusStats"] = lambda *_: value(
            [1, "", [[["/chatter", 0, [[1, 10 * self.messages, self.messages, True]]]], [], []]]
        )

    def asked(self) -> int:
        """The number of getBusStats calls."""
        return times_asked(self._node)


@pytest.fixture(autouse=True)
def _shorter(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(message_counter, "ASK_AFTER_READ_S", ASK_AFTER_READ_S)
    monkeypatch.setattr(message_counter, "INTERVAL_AFTER_ERROR_S", INTERVAL_AFTER_ERROR_S)
    monkeypatch.setattr(message_counter, "INTERVAL_AFTER_SILENCE_S", INTERVAL_AFTER_SILENCE_S)


def times_asked(node: FakeNode) -> int:
    return [method for method, *_ in node.calls].count("getBusStats")


@pytest.fixture
def counts(node: FakeNode) -> Counts:
    return Counts(node)


def read(proxy: Proxy, what: str = "messages") -> float:
    return proxy.metric(f"topic_{what}_total", **PUBLISHED)


async def test_what_is_added_while_somebody_reads_is_counted(
    proxy: Proxy, node: FakeNode, counts: Counts
) -> None:
    await node.publish(proxy.master)
    assert read(proxy) == 0
    await pass_time(ROUND)
    assert counts.asked()
    assert read(proxy) == 0, "what was before is not added"
    counts.messages += 50
    await pass_time(ROUND)
    assert (read(proxy), read(proxy, "bytes")) == (50, 500)
    counts.messages = 20
    await pass_time(ROUND)
    assert read(proxy) == 70, "another process begins anew"


async def test_without_readers_no_node_is_asked(
    proxy: Proxy, node: FakeNode, counts: Counts
) -> None:
    await node.publish(proxy.master)
    await pass_time(ROUND)
    assert not counts.asked()
    read(proxy)
    await pass_time(ASK_AFTER_READ_S + ROUND)
    asked = counts.asked()
    assert asked
    counts.messages += 50
    await pass_time(2 * ASK_INTERVAL_S)
    assert counts.asked() == asked
    read(proxy)
    await pass_time(ROUND)
    assert read(proxy) == 0, "the times of earlier messages are unknown"


async def test_who_does_not_count_is_left_alone(
    proxy: Proxy, node: FakeNode, counts: Counts, make_node: MakeNode
) -> None:
    other = await make_node("/other")
    other.answers["getBusStats"] = value([0, "no such method", 0])
    await node.publish(proxy.master)
    await other.publish(proxy.master)
    for _ in range(3):
        read(proxy)
        await pass_time(ASK_INTERVAL_S)
    assert times_asked(other) == 1
    assert counts.asked() >= 2
    for _ in range(2):
        read(proxy)
        await pass_time(ASK_INTERVAL_S)
    assert times_asked(other) == 2


async def test_who_does_not_answer_once_loses_nothing(
    proxy: Proxy, node: FakeNode, counts: Counts
) -> None:
    await node.publish(proxy.master)
    read(proxy)
    await pass_time(ROUND)
    counts.messages += 50
    answer = node.answers["getBusStats"]
    node.answers["getBusStats"] = End.HANG
    asked = counts.asked()
    read(proxy)
    await pass_time(ROUND)
    assert counts.asked() > asked
    assert read(proxy) == 0
    node.answers["getBusStats"] = answer
    await pass_time(INTERVAL_AFTER_SILENCE_S + 2)
    assert read(proxy) == 50


@pytest.fixture
def odd_answers(node: FakeNode) -> list[Any]:
    answers: list[Any] = [
        [1, "", [[["/chatter", 0, [[1, 2**31 - 1, -5, True], ["x"], 7]]], "y", []]],
        [1, "", [[["/made_up", 0, [[1, 10, 10, True]]]], [["/chatter", [[1, 1, 1, 1]]]]]],
        [1, "", 3],
    ]
    queue = iter(answers)
    node.answers["getBusStats"] = lambda *_: value(next(queue, answers[-1]))
    return answers


async def test_a_node_that_answers_nonsense_makes_no_series(
    proxy: Proxy, node: FakeNode, odd_answers: list[Any]
) -> None:
    await node.publish(proxy.master)
    for _ in odd_answers:
        read(proxy)
        await pass_time(ROUND)
    metrics = proxy.ros1.context.metrics.registry.collect()
    (family,) = [metric for metric in metrics if metric.name == "rosproxy_topic_messages"]
    assert [sample.labels for sample in family.samples] == [PUBLISHED]
    assert read(proxy) == 0
