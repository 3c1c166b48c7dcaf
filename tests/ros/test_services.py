"""Service calls work, whatever the library, the direction and the order of start."""

from __future__ import annotations

from typing import Any

import pytest

from tests.ros.combinations import each_way_and_order, each_way_in_turn
from tests.ros.lab import Lab


@pytest.mark.smoke
@each_way_and_order("server", "client")
def test_every_call_gets_its_answer(
    lab: Lab, server: str, client: str, source: str, sink: str, starter: str
) -> None:
    service = f"/{lab.unique('service')}"
    options: dict[str, Any] = {"service": service, "count": 5, "rate": 50}
    if starter == "server":
        lab.node(server, source, "serve", service=service).wait_for("^ready")
        caller = lab.node(client, sink, "call", **options)
    else:
        caller = lab.node(client, sink, "call", **options)
        caller.wait_for("^waiting")
        lab.node(server, source, "serve", service=service)
    caller.wait_for("^done")
    answered = [match[1] for match in caller.wait_for_count(r"^reply ask (\d+) ", 5)]
    assert answered == ["0", "1", "2", "3", "4"]


@each_way_in_turn("server", "client")
def test_a_persistent_connection_carries_every_call(
    lab: Lab, server: str, client: str, source: str, sink: str
) -> None:
    service = f"/{lab.unique('persistent')}"
    lab.node(server, source, "serve", service=service).wait_for("^ready")
    options: dict[str, Any] = {
        "service": service,
        "persistent": 1,
        "count": 20,
        "rate": 100,
        "size": 5000,
    }
    caller = lab.node(client, sink, "call", **options)
    caller.wait_for("^done")
    assert len(caller.wait_for_count(r"^reply ask \d+ size 5000 crc", 20)) == 20


@each_way_in_turn("server", "client")
def test_requests_and_answers_of_1_mb_arrive_unharmed(
    lab: Lab, server: str, client: str, source: str, sink: str
) -> None:
    service = f"/{lab.unique('bigservice')}"
    size = 1024 * 1024
    serving = lab.node(server, source, "serve", service=service)
    caller = lab.node(client, sink, "call", service=service, size=size, count=2)
    replies = [match[1] for match in caller.wait_for_count(rf"^reply (.* size {size} crc \w+)", 2)]
    requests = [match[1] for match in serving.wait_for_count(r"^request (.* crc \w+)", 2)]
    assert replies == requests


@pytest.mark.parametrize("client", ["rospy", "roscpp"])
@pytest.mark.parametrize("server", ["rospy", "roscpp"])
def test_a_server_replaced_by_another_node(lab: Lab, server: str, client: str) -> None:
    service = f"/{lab.unique('replaced')}"
    first = lab.node(server, "c1", "serve", service=service)
    lab.node(client, "out", "call", service=service).wait_for("^reply ask 0 ")
    first.stop()
    second = lab.node(server, "c2", "serve", service=service)
    second.wait_for("^ready")
    lab.node(client, "out", "call", service=service).wait_for("^reply ask 0 ")
    second.wait_for("^request ask 0 ")
