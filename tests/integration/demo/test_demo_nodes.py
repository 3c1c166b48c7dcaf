"""The demo's nodes speak real TCPROS with each other, and keep to the boundary."""

import errno
import json
import os
import socket
import subprocess
import sys
import time
from contextlib import ExitStack, closing

import pytest

from rosproxy.demo import cast, layout, service, wire
from rosproxy.demo.boundary import Boundary, within
from rosproxy.demo.master import Master
from rosproxy.demo.node import Node
from rosproxy.demo.publisher import Publisher
from rosproxy.demo.rpc import RosError, ask, call, split_address
from rosproxy.demo.subscriber import Subscription

FREE = Boundary()
HERE = "127.0.0.1"
separated = pytest.mark.skipif(
    bool(layout.detect().note) and os.environ.get("CI") != "true",
    reason="this system has no loopback addresses but 127.0.0.1",
)


def eventually(condition, seconds=5.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it didn't happen in time"
        time.sleep(0.01)


@pytest.fixture
def master():
    with closing(Master(HERE, FREE)) as running:
        yield running


@pytest.fixture
def make_node(master):
    """Make nodes that are closed after the test, which has to start each of them."""
    with ExitStack() as stack:
        yield lambda name: stack.enter_context(closing(Node(name, master.uri, HERE, HERE, FREE)))


@pytest.fixture
def talking(make_node):
    """A publisher and a subscription that are connected."""
    talker, listener = make_node("/talker"), make_node("/listener")
    publisher, subscription = talker.advertise("/t"), listener.subscribe("/t")
    listener.start()
    talker.start()
    eventually(publisher.peers)
    return publisher, subscription, talker


def publish(publisher, count):
    for _ in range(count):
        publisher.publish()


def tcpros_address(node, topic):
    _, host, port = ask(FREE, node.uri, "requestTopic", "/x", topic, [["TCPROS"]])
    return host, port


def test_messages_arrive_in_order_and_are_counted_alike(talking):
    publisher, subscription, _ = talking
    publish(publisher, 200)
    eventually(lambda: subscription.to_json()["count"] == 200)
    assert subscription.to_json()["runs"] == [[1, 200]]
    session = publisher.to_json()["sessions"][0]
    assert (session["peer"], session["first"], session["last"]) == ("/listener", 1, 200)


def test_messages_without_a_subscriber_are_unheard():
    publisher = Publisher("/alone", "/t", wire.STRING)
    publish(publisher, 3)
    counts = publisher.to_json()
    assert (counts["published"], counts["unheard"], counts["sessions"]) == (3, 3, [])


def test_a_subscriber_retries_by_itself_when_its_connection_breaks(talking):
    publisher, subscription, _ = talking
    publish(publisher, 1)
    eventually(lambda: subscription.to_json()["count"] == 1)
    for connection in list(publisher._open):
        connection.shutdown(socket.SHUT_RDWR)
    eventually(lambda: not publisher.peers())
    publish(publisher, 1)
    eventually(publisher.peers)
    publish(publisher, 1)
    eventually(lambda: subscription.to_json()["count"] == 2)
    assert subscription.to_json()["runs"] == [[1, 1], [3, 3]]
    links = subscription.to_json()["links"]
    assert [link["closed"] is None for link in links] == [False, True]


def test_a_subscriber_follows_a_publisher_that_restarts(make_node, master):
    listener = make_node("/listener")
    subscription = listener.subscribe("/t")
    listener.start()
    for _ in range(2):
        talker = Node("/talker", master.uri, HERE, HERE, FREE)
        with closing(talker):
            publisher = talker.advertise("/t")
            talker.start()
            eventually(publisher.peers)
            publish(publisher, 2)
            eventually(lambda: subscription.to_json()["runs"][-1:] == [[1, 2]])
        eventually(lambda: not subscription.connected_to())
    assert subscription.to_json()["count"] == 4


def test_a_publisher_out_of_reach_is_named_as_the_problem():
    with closing(Subscription("/listener", "/t", FREE)) as subscription:
        subscription.update(["http://127.0.0.1:1/"])
        eventually(lambda: "refused" in subscription.to_json()["problem"])


def test_an_update_that_overtakes_the_registration_s_reply_counts(make_node):
    talker = make_node("/talker")
    publisher = talker.advertise("/t")
    talker.start()
    with closing(Subscription("/listener", "/t", FREE)) as subscription:
        subscription.update([talker.uri])
        subscription.begin([])
        eventually(publisher.peers)
        publish(publisher, 1)
        eventually(lambda: subscription.to_json()["count"] == 1)


def test_services_are_called_across_the_master(make_node, master):
    server = make_node("/server")
    adder = server.serve("/add")
    with pytest.raises(RosError, match="no provider"):
        service.add(FREE, master.uri, "/client", "/add", 1, 2)
    server.start()
    assert server.registered.wait(5)
    assert service.add(FREE, master.uri, "/client", "/add", 1, 2) == 3
    assert service.add(FREE, master.uri, "/client", "/add", -(2**62), 1) == 1 - 2**62
    assert adder.answered == 2


def test_a_persistent_client_calls_many_times_over_one_connection(make_node):
    server = make_node("/server")
    server.serve("/add")
    server.start()
    header = {"service": "/add", "md5sum": "*", "callerid": "/c", "persistent": "1"}
    with socket.create_connection(tcpros_address(server, "/rosout"), 5) as connection:
        wire.send_header(connection, header)
        assert wire.receive_header(connection)["type"] == "rospy_tutorials/AddTwoInts"
        for number in range(3):
            connection.sendall(wire.pack_operands(number, 1))
            assert wire.receive(connection, 1) == b"\x01"
            assert wire.unpack_sum(wire.receive_block(connection)) == number + 1


@pytest.mark.parametrize(
    ("fields", "problem"),
    [
        ({"topic": "/t", "md5sum": "0" * 32}, "types do not match"),
        ({"topic": "/other", "md5sum": "*"}, "no such topic"),
        ({"service": "/none", "md5sum": "*"}, "no such topic or service"),
        ({"callerid": "/x"}, "no such topic or service"),
    ],
)
def test_refused_connections_are_told_why(make_node, fields, problem):
    node = make_node("/node")
    node.advertise("/t")
    node.start()
    with socket.create_connection(tcpros_address(node, "/t"), 5) as connection:
        wire.send_header(connection, fields)
        with pytest.raises(wire.ProtocolError, match=problem):
            wire.receive_header(connection)


def test_garbage_does_not_hurt_a_node(talking):
    publisher, subscription, talker = talking
    for garbage in (b"", b"\x01", b"\xff\xff\xff\xff", b"\x05\0\0\0\xff\0\0\0x", b"GET / HTTP/1.1"):
        with socket.create_connection(tcpros_address(talker, "/t"), 5) as connection:
            connection.sendall(garbage)
    publish(publisher, 1)
    eventually(lambda: subscription.to_json()["count"] == 1)


def test_the_slave_api_answers(talking, master):
    _, _, talker = talking
    assert call(FREE, talker.uri, "getMasterUri", "/x")[2] == master.uri
    assert ["/t", "std_msgs/String"] in ask(FREE, talker.uri, "getPublications", "/x")
    assert ask(FREE, talker.uri, "getBusInfo", "/x") == [
        [0, "/listener", "o", "TCPROS", "/t", True]
    ]
    assert call(FREE, talker.uri, "requestTopic", "/x", "/no", [["TCPROS"]])[0] == -1
    assert call(FREE, talker.uri, "requestTopic", "/x", "/t", [["UDPROS"]])[0] == 0
    assert call(FREE, talker.uri, "getPid")[0] == -1


def test_a_node_told_to_shut_down_stops(talking):
    _, _, talker = talking
    ask(FREE, talker.uri, "shutdown", "/master", "because")
    assert talker.stopping.is_set()


def test_a_node_takes_back_all_that_it_registered(make_node, master):
    node = make_node("/node")
    node.advertise("/t")
    node.subscribe("/u")
    node.serve("/s")
    node.start()
    assert node.registered.wait(5)
    assert all(ask(FREE, master.uri, "getSystemState", "/x"))
    node._unregister()
    assert ask(FREE, master.uri, "getSystemState", "/x") == [[], [], []]


def test_a_name_is_in_no_network():
    assert within("127.0.1.7", ("10.0.0.0/8", "127.0.1.0/24"))
    assert not within("127.0.2.7", ("127.0.1.0/24",))
    assert not within("talker.inside", ("0.0.0.0/0",))


PROBE = """
import json, socket, sys
from rosproxy.demo.boundary import Boundary
boundary = Boundary.from_json(json.loads(sys.argv[1]))
boundary.raise_wall()
try:
    boundary.connect(sys.argv[2], int(sys.argv[3]), 2.0).close()
except OSError as problem:
    print(problem.errno)
else:
    print(0)
"""


def connect_behind_the_wall(host, port):
    """The errno with which a process behind outside's wall fails to connect, or 0."""
    boundary = cast.node_config(cast.OUTSIDE_TALKER, layout.separate(), "")["boundary"]
    command = [sys.executable, "-c", PROBE, json.dumps(boundary), host, str(port)]
    run = subprocess.run(command, capture_output=True, text=True, timeout=20, check=True)
    return int(run.stdout)


@separated
def test_outside_reaches_outside_and_nothing_else():
    with (
        socket.create_server((layout.ROBOT, 0)) as near,
        socket.create_server((layout.INSIDE["talker"], 0)) as far,
    ):
        assert connect_behind_the_wall(layout.ROBOT, near.getsockname()[1]) == 0
        far_port = far.getsockname()[1]
        assert connect_behind_the_wall(layout.INSIDE["talker"], far_port) == errno.EHOSTUNREACH
        assert connect_behind_the_wall("localhost", far_port) == socket.EAI_NONAME
        assert connect_behind_the_wall("talker.inside", far_port) == socket.EAI_NONAME


@separated
def test_inside_turns_outside_away_and_takes_the_rest(master):
    place = layout.separate().inside["talker"]
    free_to_leave = Boundary(accept_from=place.boundary.accept_from)
    answers = {}
    with closing(Node("/t", master.uri, place.address, place.host, free_to_leave)) as node:
        node.start()
        peer = (place.address, split_address(node.uri)[1])
        for source in (layout.ROBOT, layout.HOST, layout.INSIDE["listener"], HERE):
            with socket.create_connection(peer, 5, (source, 0)) as connection:
                answers[source] = _answers(connection)
    assert answers == {
        layout.ROBOT: False,
        layout.HOST: False,
        layout.INSIDE["listener"]: True,
        HERE: True,
    }


def _answers(connection):
    try:
        connection.sendall(b"GET / HTTP/1.0\r\n\r\n")
        return bool(connection.recv(1))
    except ConnectionError:
        return False
