"""Routers, sessions and nodes in the proxy's status, and laptops that reach the proxy."""

from __future__ import annotations

import os
import time

import pytest

from rosproxy.zenoh.findings import APART_GRACE_S, routers_without_node
from tests.ros.processes import wait_until
from tests.zenoh.lab import PORTS, ROUTER_PORT, VERSIONS, Lab

VERSION = "1.6.2"
LATER_VERSION = "1.10.2"


def test_a_laptop_reaches_containers_at_the_published_port(lab: Lab) -> None:
    lab.start_proxy("--zenoh-listen", str(ROUTER_PORT), with_robot=False)
    lab.redirect("c1")
    subscriber = lab.node(VERSION, "out", "sub", **lab.as_laptop())
    publisher = lab.node(VERSION, "c1", "pub")
    subscriber.wait_for_count("^got hello ", 5, timeout=30)
    wait_until("both nodes are known", lambda: len(lab.zenoh().nodes) == 2, 10)
    address = {node.name: node.address for node in lab.zenoh().nodes}
    assert address[f"/{publisher.title}"] == lab.topology.places["c1"].address
    assert address[f"/{subscriber.title}"] == lab.topology.plan.robot
    assert {session.mode: session.port for session in lab.zenoh().sessions} == {
        "client": None,
        "peer": PORTS["c1"],
    }


def test_nodes_outside_are_told_with_their_topics(lab: Lab) -> None:
    lab.start_router(VERSION)
    lab.start_proxy()
    lab.wait_for_link()
    publisher = lab.node(VERSION, "out", "pub")
    wait_until("the node is known", lambda: lab.zenoh().nodes, 30)
    wait_until("the topic is known", lambda: lab.zenoh().nodes[0].publishes, 30)
    (node,) = lab.zenoh().nodes
    assert (node.name, node.address) == (f"/{publisher.title}", "")
    assert node.publishes == ("/chatter",)
    assert [(qos.name, qos.reliability, qos.depth) for qos in node.qos] == [
        ("/chatter", "RELIABLE", 10)
    ]
    (session,) = lab.zenoh().sessions
    assert session.remote == f"{lab.topology.plan.robot}:{ROUTER_PORT}"
    assert session.local.startswith(lab.topology.places["px"].address)
    publisher.kill()
    wait_until("the node is gone", lambda: not lab.zenoh().nodes, 30)


def test_a_link_does_not_wait_for_another(lab: Lab) -> None:
    lab.start_router(VERSION)
    peers = ("--zenoh-peer", "10.77.0.99", "--zenoh-peer", "robot")
    lab.start_proxy(*peers, with_robot=False)
    wait_until(
        "one link is up", lambda: [link.up for link in lab.zenoh().links] == [False, True], 30
    )
    wait_until("the other is tried", lambda: lab.zenoh().links[0].error == "unreachable", 30)
    subscriber = lab.node(VERSION, "out", "sub")
    lab.node(VERSION, "c1", "pub")
    subscriber.wait_for_count("^got hello ", 5, timeout=30)


def test_two_containers_at_one_port_are_told(lab: Lab) -> None:
    lab.start_proxy(with_robot=False)
    proxy = lab.topology.places["px"].address
    override = f'connect/endpoints=["tcp/{proxy}:{PORTS["c1"]}"]'
    for role in PORTS:
        lab.node(VERSION, role, "pub", ZENOH_CONFIG_OVERRIDE=override)
    assert lab.proxy is not None
    told = lab.proxy.wait_for("zenoh port 7448: nodes at (.*) are peers of the same router", 30)
    assert told[1] == ", ".join(lab.topology.places[role].address for role in sorted(PORTS))


def test_a_session_without_a_node_is_told(lab: Lab) -> None:
    lab.start_proxy(with_robot=False)
    lab.redirect("c1")
    lab.node(VERSION, "c1", "mute").wait_for("ready")
    node = lab.node(VERSION, "c2", "pub")
    assert lab.proxy is not None
    address = lab.topology.places["c1"].address
    told = lab.proxy.wait_for(
        "zenoh sessions at port (.*): programs at (.*) are connected, but", 30
    )
    assert (told[1], told[2]) == (str(PORTS["c1"]), address)
    silent = {s.remote.partition(":")[0] for s in lab.zenoh().sessions if s.without_node}
    assert silent == {address}
    assert [known.name for known in lab.zenoh().nodes] == [f"/{node.title}"]


def test_a_router_that_loses_the_tokens_of_nodes_is_told(lab: Lab) -> None:
    """A router of zenoh 1.9 or later, with nodes of 1.8 or earlier that start before it."""
    router = lab.start_router(LATER_VERSION)
    lab.start_proxy()
    lab.redirect("c1")
    lab.wait_for_link()
    publisher = lab.node(VERSION, "out", "pub")
    subscriber = lab.node(VERSION, "c1", "sub")
    subscriber.wait_for_count("^got hello ", 5, timeout=30)
    wait_until("both nodes are known", lambda: len(lab.zenoh().nodes) == 2, 30)
    os.kill(router.pid, 9)
    router.wait()
    lab.start_router(LATER_VERSION)
    mark = subscriber.mark()
    subscriber.wait_for_count("^got hello ", 5, timeout=30, since=mark)
    assert f"/{publisher.title}" not in {node.name for node in lab.zenoh().nodes}
    wait_until("the link has been up for long", lambda: routers_without_node(lab.zenoh()), 60)
    assert [*routers_without_node(lab.zenoh())] == [f"zenoh peer {lab.topology.plan.robot}:7447"]


@pytest.mark.parametrize("version", VERSIONS)
def test_a_peer_of_the_router_of_the_robot_is_told(lab: Lab, version: str) -> None:
    """The usual mistake: nodes connect to the robot's router, and get no message."""
    lab.start_router(version)
    lab.start_proxy()
    lab.wait_for_link()
    publisher = lab.node(version, "out", "pub")
    robot = lab.topology.plan.robot
    endpoint = f'connect/endpoints=["tcp/{robot}:{ROUTER_PORT}"]'
    mistaken = lab.node(version, "c1", "sub", ZENOH_CONFIG_OVERRIDE=endpoint)
    right = lab.node(version, "c2", "sub", ZENOH_CONFIG_OVERRIDE=f'mode="client";{endpoint}')
    right.wait_for_count("^got hello ", 5, timeout=30)
    assert lab.proxy is not None
    told = lab.proxy.wait_for(f"zenoh peers of router {robot}:{ROUTER_PORT}: nodes at (.*)", 60)
    assert told[1].startswith(f"{lab.topology.plan.host} (/{mistaken.title}) are connected")
    assert "these nodes run on this host or in its containers" in told[1]
    assert 'Fix: set mode="client" in ZENOH_CONFIG_OVERRIDE' in told[1]
    assert publisher.title not in told[1]
    assert "got" not in mistaken.output()
    mistaken.kill()
    wait_until("the fault is over", lambda: not lab.status().problems, 30)


def test_peers_of_a_router_that_reach_each_other_are_no_fault(lab: Lab) -> None:
    """As in a configuration in which all nodes listen on the LAN."""
    lab.start_router(VERSION)
    lab.start_proxy()
    lab.wait_for_link()
    robot = lab.topology.plan.robot
    endpoint = f'connect/endpoints=["tcp/{robot}:{ROUTER_PORT}"]'
    strategy = '{"peer":{"to_router":"always","to_peer":"always"}}'
    dials = f"{endpoint};scouting/gossip/autoconnect_strategy={strategy}"
    listens = f'listen/endpoints=["tcp/{robot}:0"]'
    lab.node(VERSION, "out", "pub", ZENOH_CONFIG_OVERRIDE=listens)
    subscriber = lab.node(VERSION, "c1", "sub", ZENOH_CONFIG_OVERRIDE=dials)
    subscriber.wait_for_count("^got hello ", 5, timeout=30)
    time.sleep(APART_GRACE_S)
    assert not lab.zenoh().apart
    subscriber.wait_for_count("^got hello ", 5, timeout=30, since=subscriber.mark())
