"""Topics, services and the graph: between two containers, and between a container and the robot."""

from __future__ import annotations

import pytest

from tests.zenoh.lab import PORTS, VERSIONS, Lab

PAIRS = [("c1", "c2"), ("c1", "out"), ("out", "c1"), ("c1", "c1")]
WAYS = ("redirect", "client")
"""The ways of nodes in containers to the proxy."""


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize(("source", "target"), PAIRS)
def test_everything_passes(lab: Lab, version: str, way: str, source: str, target: str) -> None:
    lab.start_router(version)
    for role in PORTS if way == "redirect" else ():
        lab.redirect(role)
    lab.start_proxy()
    lab.wait_for_link()
    graph = lab.node(version, source, "graph")
    subscriber = lab.node(version, target, "sub")
    server = lab.node(version, target, "serve", "add")
    publisher = lab.node(version, source, "pub")
    client = lab.node(version, source, "call", "add")
    subscriber.wait_for_count("^got hello ", 5, timeout=30)
    client.wait_for(f"^answer of {server.title}$", timeout=30)
    for node in (subscriber, server, publisher, client):
        graph.wait_for(f"^seen {node.title}$", timeout=30)
    server.kill()
    graph.wait_for(f"^gone {server.title}$", timeout=30)


@pytest.mark.parametrize("version", VERSIONS)
def test_containers_with_a_port_each_meet(lab: Lab, version: str) -> None:
    """Nodes stay peers, and the variable names the port."""
    lab.start_proxy(with_robot=False)
    proxy = lab.topology.places["px"].address
    override = {role: f'connect/endpoints=["tcp/{proxy}:{port}"]' for role, port in PORTS.items()}
    subscriber = lab.node(version, "c1", "sub", ZENOH_CONFIG_OVERRIDE=override["c1"])
    lab.node(version, "c2", "pub", ZENOH_CONFIG_OVERRIDE=override["c2"])
    subscriber.wait_for_count("^got hello ", 5, timeout=30)
