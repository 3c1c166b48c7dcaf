"""Inside, the master's host name leads to the proxy, and nodes on that host give that very name.

So a container needs no other ROS_MASTER_URI than a machine outside: `http://robot:11311`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable

import pytest

from tests.ros import (
    test_recovery,
    test_rosnode,
    test_rosservice,
    test_rostopic,
    test_services,
    test_topics,
    test_udpros,
)
from tests.ros.combinations import each_library, each_pair, each_way_and_order, each_way_in_turn
from tests.ros.lab import MASTER_URI, Lab
from tests.ros.test_recovery import Measure, restart_proxy
from tests.ros.topology import ALIAS, OUT_NODE

PLAN = ALIAS
PROXY_OPTIONS = ("--master-address", OUT_NODE)

CROSSING = ("inside-to-outside", "outside-to-inside")


@each_way_and_order("publisher", "subscriber", CROSSING)
def test_messages(
    lab: Lab, publisher: str, subscriber: str, source: str, sink: str, starter: str
) -> None:
    test_topics.test_every_message_arrives_once_and_in_order(
        lab, publisher, subscriber, source, sink, starter
    )


@each_way_in_turn("publisher", "subscriber", CROSSING)
def test_latched_messages(
    lab: Lab, publisher: str, subscriber: str, source: str, sink: str
) -> None:
    test_topics.test_a_latched_message_reaches_a_late_subscriber(
        lab, publisher, subscriber, source, sink
    )


@each_way_and_order("server", "client", CROSSING)
def test_calls(lab: Lab, server: str, client: str, source: str, sink: str, starter: str) -> None:
    test_services.test_every_call_gets_its_answer(lab, server, client, source, sink, starter)


@each_way_in_turn("server", "client", CROSSING)
def test_persistent_calls(lab: Lab, server: str, client: str, source: str, sink: str) -> None:
    test_services.test_a_persistent_connection_carries_every_call(lab, server, client, source, sink)


@each_pair("server", "client")
def test_calls_of_1_mb(lab: Lab, server: str, client: str) -> None:
    test_services.test_requests_and_answers_of_1_mb_arrive_unharmed(
        lab, server, client, "out", "c1"
    )


def test_messages_by_udp(lab: Lab) -> None:
    test_udpros.test_messages_come_by_udp(lab, "subscriber", 10000, "c1", "out")


@pytest.mark.boundary
@each_way_in_turn("publisher", "subscriber", CROSSING)
def test_messages_flow_again_after_the_proxy_was_killed(
    lab: Lab, publisher: str, subscriber: str, source: str, sink: str, measure: Measure
) -> None:
    test_recovery.test_messages_flow_again_after_the_proxy_was_killed(
        lab, publisher, subscriber, source, sink, measure
    )


@pytest.mark.boundary
@each_way_in_turn("server", "client", CROSSING)
def test_calls_are_answered_again_after_the_proxy_was_killed(
    lab: Lab, server: str, client: str, source: str, sink: str, measure: Measure
) -> None:
    test_recovery.test_calls_are_answered_again_after_the_proxy_was_killed(
        lab, server, client, source, sink, measure
    )


@pytest.mark.boundary
@each_pair("publisher", "subscriber")
def test_subscribers_from_before_hear_publishers_from_after_the_proxy_was_killed(
    lab: Lab, publisher: str, subscriber: str
) -> None:
    test_recovery.test_subscribers_from_before_hear_publishers_from_after(
        lab, publisher, subscriber
    )


def stand_ins(lab: Lab) -> set[int]:
    """The ports on which the proxy stands in for nodes of the robot."""
    status = json.loads(lab.rosproxy("status", "--json").output)
    return {row["port"] for row in status["stand_ins"]}


@pytest.mark.boundary
@pytest.mark.direct
@each_library
def test_uris_are_the_same_inside_and_outside(lab: Lab, library: str) -> None:
    assert lab.environment("c1")["ROS_MASTER_URI"] == MASTER_URI
    _, name = test_rosnode.talker(lab, library, "out")
    uris = {lab.run(side, "rosnode", "list", "-a", name).output for side in ("c1", "out")}
    assert len(uris) == 1
    match = re.match(r"http://robot:(\d+)/ ", uris.pop())
    assert match
    assert int(match[1]) in stand_ins(lab)
    assert f" {match[1]}" in lab.rosproxy("status").output
    assert "Nothing wrong was found." in lab.rosproxy("doctor", name).output


INSIDE_ABOUT_ROBOT = [
    (test_rosnode.test_info_reaches_the_node, "rospy"),
    (test_rosnode.test_ping_is_answered, "roscpp"),
    (test_rosnode.test_kill_ends_the_node, "rospy"),
    (test_rosnode.test_cleanup_removes_a_killed_node, "roscpp"),
    (test_rosservice.test_info_type_args_and_uri, "rospy"),
    (test_rosservice.test_call_prints_the_answer, "roscpp"),
    (test_rostopic.test_info_names_publishers_with_their_address, "rospy"),
    (test_rostopic.test_echo_prints_messages, "roscpp"),
]


@pytest.mark.parametrize(("tool", "library"), INSIDE_ABOUT_ROBOT)
def test_tools_inside(lab: Lab, tool: Callable[..., None], library: str) -> None:
    tool(lab, library, "c1", "out")


@pytest.mark.boundary
@each_library
def test_a_killed_node_refuses_inside_as_well(lab: Lab, library: str) -> None:
    node, name = test_rosnode.talker(lab, library, "out")
    lab.run("c1", "rosnode", "ping", "-c", "1", name)
    node.kill()
    for side in ("c1", "c1", "c2"):
        said = lab.run(side, "rosnode", "ping", "-c", "1", name, check=False).output
        assert "ERROR: connection refused to [http://robot:" in said


@pytest.mark.boundary
@each_pair("server", "client")
def test_a_killed_service_is_missed_and_its_successor_found(
    lab: Lab, server: str, client: str
) -> None:
    """Calls go on with the next server, which the master has at another port."""
    service = f"/{lab.unique('successor')}"
    first = lab.node(server, "out", "serve", service=service)
    caller = lab.node(client, "c1", "call", service=service, rate=20, count=100000)
    caller.wait_for_count("^reply ", 3)
    first.kill()
    failed = lab.run("c2", "rosservice", "call", service, "x", check=False)
    assert failed.returncode != 0
    second = lab.node(server, "out", "serve", service=service)
    second.wait_for("^ready")
    caller.wait_for_count("^reply ", 3, since=caller.mark())


@pytest.mark.boundary
@pytest.mark.direct
@each_library
def test_a_publisher_that_comes_back_at_the_same_port_is_heard(lab: Lab, library: str) -> None:
    name = lab.unique("phoenix")
    ports = {"xmlrpc_port": 40001, "tcpros_port": 40002}
    topic = f"/{name}/topic"
    for text in ("first", "second"):
        node = lab.node("rospy", "out", "pub", name=name, topic=topic, word=text, **ports)
        node.wait_for("^sent ")
        receiver = lab.node(library, "c1", "sub", topic=topic)
        receiver.wait_for_count(f"^got {text} ", 3)
        assert 40001 in stand_ins(lab)
        node.kill()
        lab.run("c1", "rosnode", "ping", "-c", "1", name, check=False)
        assert 40001 not in stand_ins(lab)


@pytest.mark.boundary
@each_library
def test_tools_go_on_after_the_proxy_was_killed(lab: Lab, library: str) -> None:
    """No alias port is open after a restart until a URI is asked for again."""
    node, name = test_rosnode.talker(lab, library, "out")
    _, service = test_rosservice.server(lab, "out", library)
    restart_proxy(lab)
    assert f"Pid: {node.pid}" in lab.run("c1", "rosnode", "info", name).output
    assert "echo tool" in lab.run("c1", "rosservice", "call", service, "tool 7 x").output


@pytest.mark.boundary
@pytest.mark.direct
def test_a_port_that_the_proxy_needs_itself_is_named_with_the_fix(lab: Lab) -> None:
    assert lab.proxy is not None
    since = lab.proxy.mark()
    name = lab.unique("unlucky")
    own = lab.topology.plan.ports.last
    node = lab.node("rospy", "out", "pub", name=name, topic=f"/{name}", xmlrpc_port=own)
    node.wait_for("^sent ")
    lab.node("roscpp", "c1", "sub", topic=f"/{name}").wait_for("^ready")
    warning = lab.proxy.wait_for(rf"^.*WARNING.*http://robot:{own}/.*$", since=since)[0]
    assert f"ROS_IP={OUT_NODE}" in warning
    assert f"ROS_IP={OUT_NODE}" in lab.rosproxy("status").output
    fixed = {"name": f"{name}_fixed", "env": {"ROS_IP": OUT_NODE}, "xmlrpc_port": own - 1}
    lab.node("rospy", "out", "pub", topic=f"/{name}_fixed", **fixed).wait_for("^sent ")
    lab.node("roscpp", "c1", "sub", topic=f"/{name}_fixed").wait_for_count("^got ", 3)
