"""Calls go both ways between each library and rospy and roscpp, as without the proxy."""

from __future__ import annotations

from tests.clients.matrix import CALL, CALL_ON, PEERS, SERVE, SERVE_ON, each_client
from tests.ros.lab import Lab
from tests.ros.processes import Process

CALLS = {"count": 5, "rate": 50}
PERSISTENT = CALLS | {"persistent": 1}


def check(caller: Process, server: Process) -> None:
    """Check that each call has reached this server, and got the answer."""
    for reply in caller.wait_for_count(r"^reply (ask \d+ size \d+ crc \w+)", 5):
        server.wait_for(f"^request {reply[1]} ")


@each_client(SERVE)
def test_a_node_serves(lab: Lab, library: str, side: str, across: str) -> None:
    service = f"/{lab.unique('served')}"
    server = lab.node(library, side, "serve", service=service)
    for peer in PEERS:
        check(lab.node(peer, across, "call", service=service, **CALLS), server)


@each_client(SERVE_ON)
def test_a_node_serves_persistently(lab: Lab, library: str, side: str, across: str) -> None:
    service = f"/{lab.unique('served')}"
    server = lab.node(library, side, "serve", service=service)
    for peer in PEERS:
        check(lab.node(peer, across, "call", service=service, **PERSISTENT), server)


@each_client(CALL)
def test_a_node_calls(lab: Lab, library: str, side: str, across: str) -> None:
    for peer in PEERS:
        service = f"/{lab.unique('called')}"
        server = lab.node(peer, across, "serve", service=service)
        check(lab.node(library, side, "call", service=service, **CALLS), server)


@each_client(CALL_ON)
def test_a_node_calls_persistently(lab: Lab, library: str, side: str, across: str) -> None:
    for peer in PEERS:
        service = f"/{lab.unique('called')}"
        server = lab.node(peer, across, "serve", service=service)
        check(lab.node(library, side, "call", service=service, **PERSISTENT), server)
