"""An inside node is reached with any address or host name of its own."""

from __future__ import annotations

import re
from typing import Any

import pytest

from tests.ros.combinations import LIBRARIES, each_library, each_way_in_turn
from tests.ros.lab import Lab

INSIDE_TO = {"to-outside": "out", "to-another-inside": "c2"}

each_sink = pytest.mark.parametrize("sink", INSIDE_TO.values(), ids=INSIDE_TO.keys())

NOWHERE = {"ROS_HOSTNAME": "a-name-that-resolves-nowhere"}


def exchange_messages(lab: Lab, library: str, sink: str, **options: Any) -> None:
    """A publisher in c1, started with `options`, is heard in `sink`; and the other way."""
    forward_topic = f"/{lab.unique('there')}"
    back_topic = f"/{lab.unique('back')}"
    lab.node(library, "c1", "pub", topic=forward_topic, **options)
    receiver = lab.node(library, "c1", "sub", topic=back_topic, **options)
    lab.node("roscpp", sink, "sub", topic=forward_topic).wait_for_count("^got hello ", 3)
    lab.node("rospy", sink, "pub", topic=back_topic)
    receiver.wait_for_count("^got hello ", 3)


def call_both_ways(lab: Lab, library: str, sink: str, **options: Any) -> None:
    """A server in c1, started with `options`, is called from `sink`; and the other way."""
    forward_service = f"/{lab.unique('there')}"
    back_service = f"/{lab.unique('back')}"
    lab.node(library, "c1", "serve", service=forward_service, **options)
    lab.node("roscpp", sink, "call", service=forward_service).wait_for("^reply ask 0 ")
    lab.node("rospy", sink, "serve", service=back_service)
    lab.node(library, "c1", "call", service=back_service, **options).wait_for("^reply ask 0 ")


@pytest.mark.boundary
@each_sink
@each_library
def test_topics_with_a_host_name_that_resolves_nowhere(lab: Lab, library: str, sink: str) -> None:
    exchange_messages(lab, library, sink, env=NOWHERE)


@pytest.mark.boundary
@each_sink
@each_library
def test_services_with_a_host_name_that_resolves_nowhere(lab: Lab, library: str, sink: str) -> None:
    call_both_ways(lab, library, sink, env=NOWHERE)


@each_sink
@each_library
def test_topics_with_ros_ip_set_to_the_inside_address(lab: Lab, library: str, sink: str) -> None:
    exchange_messages(lab, library, sink, env={"ROS_IP": lab.place("c1").address})


@each_sink
@each_library
def test_services_with_ros_ip_set_to_the_inside_address(lab: Lab, library: str, sink: str) -> None:
    call_both_ways(lab, library, sink, env={"ROS_IP": lab.place("c1").address})


@pytest.mark.boundary
@each_library
def test_a_node_bound_to_loopback_is_named_in_the_log_with_the_fix(lab: Lab, library: str) -> None:
    """With ROS_IP=127.0.0.1 both libraries listen on loopback only, unreachable for other
    machines.
    """
    assert lab.proxy is not None
    since = lab.proxy.mark()
    name = lab.unique("lonely")
    topic = f"/{lab.unique('topic')}"
    lab.node(library, "c1", "pub", name=name, topic=topic, env={"ROS_IP": "127.0.0.1"})
    lab.node("rospy", "out", "sub", topic=topic)
    warning = lab.proxy.wait_for(rf"^.*WARNING.*/{name}\b.*loopback.*$", since=since)[0]
    assert f"set ROS_IP={lab.place('c1').address}" in warning


@each_way_in_turn("first", "second")
def test_nodes_in_a_namespace(lab: Lab, first: str, second: str, source: str, sink: str) -> None:
    """The same relative names, pushed into a namespace, meet each other."""
    space = [f"__ns:=/{lab.unique('robot')}/arm"]
    receiver = lab.node(second, sink, "sub", remap=space, topic="joint")
    receiver.wait_for("^ready")
    sender = lab.node(first, source, "pub", name="talker", remap=space, topic="joint")
    receiver.wait_for_count("^got hello ", 3)
    full = sender.wait_for("^node (.*)")[1]
    assert full == f"{space[0].removeprefix('__ns:=')}/talker"
    assert lab.registered(full)


@each_library
def test_two_containers_with_the_same_ports(lab: Lab, library: str) -> None:
    """Both nodes have the same port numbers on different addresses."""
    nodes = {role: lab.unique("twin") for role in ("c1", "c2")}
    fixed = (
        {"xmlrpc_port": 20001, "tcpros_port": 20002}
        if library == "rospy"
        else {"remap": ["__tcpros_server_port:=20003"]}
    )
    for role, name in nodes.items():
        lab.node(library, role, "pub", name=name, topic=f"/{name}", word=name, **fixed)
    for name in nodes.values():
        for listener in LIBRARIES:
            receiver = lab.node(listener, "out", "sub", topic=f"/{name}")
            words = {match[1] for match in receiver.wait_for_count(r"^got (\w+) ", 3)}
            assert words == {name}
    uris = {lab.node_uri(name) for name in nodes.values()}
    assert len(uris) == 2


@pytest.mark.boundary
def test_outside_sees_one_port_of_the_published_range_per_node(lab: Lab) -> None:
    name = lab.unique("seen")
    node = lab.node("roscpp", "c1", "serve", name=name, service=f"/{name}/s")
    node.wait_for("^ready")
    uri = lab.node_uri(name)
    service = lab.ask_master("lookupService", f"/{name}/s")
    assert uri is not None
    host, port = re.findall(r"^http://([^:/]+):(\d+)/", uri)[0]
    assert host == lab.place("host").address
    assert int(port) in range(45000, 45100)
    assert service == f"rosrpc://{host}:{port}"


@pytest.mark.boundary
def test_a_node_sees_its_own_uri_as_it_registered_it(lab: Lab) -> None:
    name = lab.unique("self")
    lab.node("roscpp", "c1", "serve", name=name, service=f"/{name}/s").wait_for("^ready")
    uri = lab.run("c1", "rosnode", "list", "-a").output
    assert re.search(rf"^http://c1box:\d+/\s+/{name}$", uri, re.MULTILINE), uri
