"""The demonstration's ROS 2 nodes among themselves: discovery, and no lost messages."""

import socket
from contextlib import AsyncExitStack
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from examples.demo import ros2_acts
from examples.demo.fake_participant import WRITER
from examples.demo.proxy_process import DemoError
from examples.demo.reliable_topics import ReliableReader, ReliableWriter
from examples.demo.ros2_acts import Ros2Listener, Ros2Talker, reserve_domain
from examples.demo.rtps_messages import (
    MOST_ASKED,
    acknack,
    heartbeat,
    message,
    pack_string,
    told,
    unpack_string,
)
from rosproxy.ros2.protocol.rtps import SubmessageId
from tests.integration.net import until

A = b"A" * 12
B = b"B" * 12
LISTENER = A + bytes([0, 0, 1, 4])


@pytest.fixture
async def met():
    """Starts nodes that announce themselves to the first node."""
    async with AsyncExitStack() as ending:
        first = []

        async def start(*nodes):
            for node in nodes:
                first.append(node)
                ending.push_async_callback(node.stop)
                await node.start()
                node.announce_to([peer.locators[0] for peer in first[:1] if peer is not node])
            return nodes

        yield start


def publish(talker, count):
    for _ in range(count):
        talker.number += 1
        talker.publish(pack_string(str(talker.number)))


def heard(listener):
    return [number for number, _ in listener.received]


async def test_messages_arrive_once_and_in_order_though_datagrams_are_lost(met):
    talker, listener = await met(
        Ros2Talker("/t", "127.0.0.1", "/x"), Ros2Listener("/l", "127.0.0.1", "/x")
    )
    dice = Random(7)
    for node in (talker, listener):
        node.admits = lambda _: dice.random() < 0.7
    await until(lambda: talker.connected and listener.connected, "both are connected")
    publish(talker, 100)
    await until(lambda: len(listener.received) == 100, "all messages arrive")
    await until(lambda: not talker.writers[WRITER].samples, "the writer keeps no samples")
    assert heard(listener) == list(range(1, 101))
    assert talker.turned_away > 0 < listener.turned_away


async def test_a_late_listener_gets_only_later_messages(met):
    (talker,) = await met(Ros2Talker("/t", "127.0.0.1", "/x"))
    publish(talker, 3)
    (listener,) = await met(Ros2Listener("/l", "127.0.0.1", "/x"))
    await until(lambda: talker.connected, "both are connected")
    publish(talker, 2)
    await until(lambda: len(listener.received) == 2, "both messages arrive")
    assert heard(listener) == [4, 5]


async def test_nodes_of_other_topics_do_not_connect(met):
    talker, other, listener = await met(
        Ros2Talker("/t", "127.0.0.1", "/x"),
        Ros2Listener("/o", "127.0.0.1", "/y"),
        Ros2Listener("/l", "127.0.0.1", "/x"),
    )
    await until(lambda: listener.connected and talker.connected, "both are connected")
    await until(lambda: len(talker.peers) == 2, "the talker knows both")
    assert not other.connected


@pytest.mark.parametrize("noise", [b"", b"RTPS", b"RTPS\2\3\1\1" + A + b"\x06\1\4\0" + bytes(4)])
async def test_what_is_no_message_is_ignored(met, noise):
    talker, listener = await met(
        Ros2Talker("/t", "127.0.0.1", "/x"), Ros2Listener("/l", "127.0.0.1", "/x")
    )
    listener.datagram_received(noise, ("127.0.0.1", 1))
    await until(lambda: talker.connected and listener.connected, "both are connected")
    publish(talker, 1)
    await until(lambda: listener.received, "a message")


def test_a_reader_asks_for_what_it_lacks_and_does_not_wait_for_what_is_gone():
    reader = ReliableReader(4)
    reader.match(B + bytes(4))
    writer = B + bytes(4)
    assert not reader.take(writer, 3)
    reader.skip(writer, 1, 2)
    (answer,) = told(message(A, B, reader.answer(writer, 5)))
    assert (answer.first, answer.missing) == (3, (3, 4, 5))
    assert reader.take(writer, 3)
    assert not reader.take(writer, 3)
    reader.skip(writer, 7, 9)  # there is something before
    assert reader.expected[writer] == 4


def test_a_writer_keeps_what_one_of_its_readers_lacks():
    writer = ReliableWriter(3, durable=False)
    other = B + LISTENER[12:]
    writer.write(b"nobody's")
    for reader in (LISTENER, other):
        writer.match(reader)
    for payload in (b"one.", b"two."):
        writer.write(payload)
    (answer,) = told(message(A, B, acknack(0x104, 3, 4, range(0), 1)))
    assert writer.heed(LISTENER, answer) == []
    assert [*writer.samples] == [2, 3]
    (question,) = told(message(A, B, acknack(0x104, 3, 3, range(3, 4), 1)))
    (again,) = writer.heed(other, question)
    assert again.endswith(b"two.")
    assert [*writer.samples] == [3]
    assert writer.heed(B + bytes(4), question) == []


@given(st.integers(1, 2**40), st.integers(0, 100), st.integers(0, 2**31 - 1))
def test_what_is_asked_for_can_be_read(base, count, number):
    (submessage,) = told(
        message(A, B, acknack(0x104, 0x103, base, range(base, base + count), number))
    )
    assert (submessage.kind, submessage.reader, submessage.writer) == (
        SubmessageId.ACKNACK,
        0x104,
        0x103,
    )
    assert (submessage.first, submessage.missing) == (
        base,
        tuple(range(base, base + min(count, MOST_ASKED))),
    )


@given(st.integers(1, 2**40), st.integers(0, 2**40), st.integers(0, 2**31 - 1))
def test_a_heartbeat_can_be_read(first, last, number):
    (submessage,) = told(message(A, B, heartbeat(0x104, 0x103, first, last, number)))
    assert (submessage.kind, submessage.reader, submessage.writer) == (
        SubmessageId.HEARTBEAT,
        0x104,
        0x103,
    )
    assert (submessage.first, submessage.last, submessage.asks) == (first, last, True)


@given(st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"])))
def test_a_string_can_be_read(text):
    assert unpack_string(pack_string(text)) == text


def test_a_domain_that_somebody_has_is_not_chosen(monkeypatch):
    domain, reservation = reserve_domain()
    monkeypatch.setattr(ros2_acts, "DOMAINS", range(domain, domain + 1))
    with reservation, pytest.raises(DemoError, match="every domain"):
        reserve_domain()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as participant:
        participant.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        participant.bind(("", 7400 + 250 * domain))
        with pytest.raises(DemoError, match="every domain"):
            reserve_domain()
