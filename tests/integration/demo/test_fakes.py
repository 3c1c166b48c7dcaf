"""The fake master and nodes do what the tests of the proxy rely on, as ROS's own do."""

import asyncio
import random
from operator import itemgetter

import pytest

from examples.demo.fake_http import BLOCK, MOST_BLOCKS, PORTS, PortDraws
from examples.demo.players import Listener, Refused, Talker
from tests.integration.net import NODE, OTHER_NODE, OUTSIDE, rpc, until

TYPE = "std_msgs/String"
A = "http://127.0.0.1:1/"
B = "http://127.0.0.1:2/"
NEW_NODE = "[/twin] Reason: new node registered with same name"


def test_two_programs_draw_no_port_of_each_other(monkeypatch):
    monkeypatch.setattr(random, "choice", itemgetter(0))
    rows = [PortDraws(PORTS.ports).draw(8) for _ in range(2)]
    assert len({row // BLOCK for row in rows}) == len(rows)


def test_a_program_leaves_ports_to_others():
    draws = PortDraws(PORTS.ports)
    drawn = {draws.draw(8) // BLOCK for _ in range(3 * MOST_BLOCKS * BLOCK // 8)}
    assert len(drawn) <= MOST_BLOCKS


async def state(master):
    return (await rpc(master.uri, "getSystemState", "/x"))[2]


async def test_a_second_node_of_the_same_name_shuts_the_first_one_down(master, node):
    await rpc(master.uri, "registerPublisher", "/twin", "/t", TYPE, node.uri)
    await rpc(master.uri, "registerService", "/twin", "/s", "rosrpc://old:1", node.uri)
    await rpc(master.uri, "registerSubscriber", "/twin", "/u", TYPE, B)
    await until(lambda: node.calls, "the node gets the calls")
    assert node.calls == [("shutdown", ("/master", NEW_NODE))]
    assert await state(master) == [[], [["/u", ["/twin"]]], []]
    assert (await rpc(master.uri, "lookupNode", "/x", "/twin"))[2] == B


async def test_subscribers_hear_of_every_change_of_publishers_in_order(master, node):
    await rpc(master.uri, "registerSubscriber", "/gone", "/t", "*", A)
    await rpc(master.uri, "registerSubscriber", "/sub", "/t", "*", node.uri)
    for name, uri in (("/a", A), ("/b", B)):
        await rpc(master.uri, "registerPublisher", name, "/t", TYPE, uri)
    await rpc(master.uri, "unregisterPublisher", "/a", "/t", A)
    await until(lambda: len(node.calls) == 3, "the node gets the calls")
    assert node.updates("/t") == [[A], [A, B], [B]]


async def test_only_the_very_string_is_unregistered(master):
    await rpc(master.uri, "registerPublisher", "/pub", "/t", TYPE, A)
    for wrong in (B, A.rstrip("/")):
        assert (await rpc(master.uri, "unregisterPublisher", "/pub", "/t", wrong))[2] == 0
    assert (await rpc(master.uri, "unregisterPublisher", "/pub", "/t", A))[2] == 1
    assert (await rpc(master.uri, "lookupNode", "/x", "/pub"))[0] == -1
    answer = await rpc(master.uri, "unregisterPublisher", "/pub", "/t", A)
    assert answer[1:] == ["[/pub] is not a registered node", 0]


async def test_the_last_provider_of_a_service_wins(master):
    await rpc(master.uri, "registerService", "/a", "/s", "rosrpc://a:9", A)
    await rpc(master.uri, "registerService", "/b", "/s", "rosrpc://b:9", B)
    assert (await rpc(master.uri, "lookupService", "/x", "/s"))[2] == "rosrpc://b:9"
    assert (await rpc(master.uri, "unregisterService", "/a", "/s", "rosrpc://a:9"))[2] == 0
    assert (await rpc(master.uri, "unregisterService", "/b", "/s", "rosrpc://b:9"))[2] == 1


async def test_a_publisher_decides_on_a_topics_type(master):
    topic_types = []
    for method, type_ in (
        ("registerSubscriber", "*"),
        ("registerSubscriber", "a/A"),
        ("registerPublisher", "b/B"),
        ("registerPublisher", "*"),
    ):
        await rpc(master.uri, method, "/n", "/t", type_, A)
        topic_types.append((await rpc(master.uri, "getTopicTypes", "/x"))[2])
    assert topic_types == [[], [["/t", "a/A"]], [["/t", "b/B"]], [["/t", "b/B"]]]


async def test_subscribers_of_a_parameter_hear_of_it_unless_they_set_it(master, node):
    assert (await rpc(master.uri, "subscribeParam", "/sub", node.uri, "/p"))[2] == {}
    await rpc(master.uri, "setParam", "/sub", "/p", 1)
    await rpc(master.uri, "setParam", "/other", "/p", 2)
    await rpc(master.uri, "deleteParam", "/other", "/p")
    await until(lambda: len(node.calls) == 2, "the node gets the calls")
    assert [params[2] for _, params in node.calls] == [2, {}]


@pytest.fixture
async def pair(master):
    """A talker that talks and a listener, without a proxy."""
    talker = Talker("/t", OUTSIDE, topic="/t")
    listener = Listener("/l", OTHER_NODE, topic="/t")
    for node in (listener, talker):
        await node.start()
        await node.register(master.uri)
    talking = asyncio.create_task(talker.talk())
    yield talker, listener
    talking.cancel()
    await asyncio.gather(listener.stop(), talker.stop())


async def test_a_listener_comes_back_when_its_connection_breaks(pair):
    talker, listener = pair
    await until(lambda: listener.received, "it hears")
    for writer in talker.subscribers:
        writer.transport.abort()
    await until(lambda: not listener.connected, "the listener loses the connection")
    heard = len(listener.received)
    await until(lambda: len(listener.received) > heard, "messages arrive again")


async def test_a_listener_follows_the_masters_list(master, pair):
    talker, listener = pair
    await until(lambda: listener.received, "it hears")
    await talker.call(master.uri, "unregisterPublisher", "/t", talker.uri)
    await until(lambda: not talker.subscribers, "it leaves")
    assert not listener.connected


async def test_a_node_turns_away_whom_it_does_not_admit(make_node):
    node = await make_node("/n", NODE)
    node.slave.admits = lambda peer: peer != OUTSIDE
    assert (await rpc(node.uri, "getPid", "/x", source=OTHER_NODE))[0] == 1
    with pytest.raises((OSError, EOFError)):
        await rpc(node.uri, "getPid", "/x", source=OUTSIDE)


async def test_who_asks_for_nothing_there_is_told(master, pair):
    talker, listener = pair
    with pytest.raises(Refused, match="no provider"):
        await listener.add(master.uri, "/none", 1, 2)
    with pytest.raises(Refused, match="Not a publisher"):
        await listener.ask(talker.uri, "requestTopic", "/none", [["TCPROS"]])
