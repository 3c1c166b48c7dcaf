"""Routers, sessions and nodes in the proxy's status, and laptops that reach the proxy."""

from __future__ import annotations

from tests.ros.processes import wait_until
from tests.zenoh.lab import PORTS, ROUTER_PORT, Lab

VERSION = "1.6.2"


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
