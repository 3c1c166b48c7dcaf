"""Answers of ``/status`` for the tests of the status table and of the doctor."""

from typing import Any

HOST = "robot-host"


def make_status(*nodes: dict[str, Any], **parts: Any) -> dict[str, Any]:
    """A status. ``master``, ``ports`` and ``settings`` update the defaults."""
    status: dict[str, Any] = {
        "version": "0.1.0",
        "pid": 42,
        "instance": "abc",
        "uptime": 75.0,
        "settings": {
            "master_port": 11311,
            "publish_master": None,
            "advertise_host": HOST,
            "bind": "0.0.0.0",
            "inside_networks": ["10.0.0.0/24"],
            "cleanup_after": 30.0,
            "linger": 30.0,
        },
        "master": {
            "uri": "http://robot:11311",
            "up": True,
            "error": "",
            "pid": 7,
            "since": 60.0,
            "round_trip": 0.0012,
        },
        "ports": {
            "listen": "45000-45099",
            "advertise": "45000-45099",
            "used": len(nodes),
            "free": 100 - len(nodes),
            "blocked": 0,
        },
        "nodes": list(nodes),
        "problems": parts.pop("problems", []),
    }
    for name, changes in parts.items():
        status[name] |= changes
    return status


def make_node(name: str = "/talker", port: int = 45000, **changes: Any) -> dict[str, Any]:
    """A node of a status."""
    address = changes.pop("address", "10.0.0.5:40001")
    return {
        "nodes": [name],
        "uri": f"http://{address}/",
        "address": address,
        "advertised_uri": f"http://{HOST}:{port}/",
        "port": port,
        "state": "ok",
        "publishes": ["/chatter"],
        "subscribes": [],
        "services": [],
        "parameters": [],
        "connections": [],
        "problems": [],
        **changes,
    }


def make_connection(**changes: Any) -> dict[str, Any]:
    """A connection of a node."""
    return {
        "kind": "topic",
        "name": "/chatter",
        "caller_id": "/listener",
        "peer": "192.168.0.9",
        "sent": 3_400_000,
        "received": 120,
        "sent_rate": 1200.0,
        "received_rate": 0.0,
        **changes,
    }
