"""UDPROS works from an inside publisher to an outside subscriber."""

from __future__ import annotations

from typing import Any

import pytest

from tests.ros.lab import Lab


@pytest.mark.parametrize("size", [0, 10000], ids=["small", "in-several-datagrams"])
@pytest.mark.parametrize("first", ["publisher", "subscriber"], ids=lambda w: f"{w}-first")
def test_messages_come_by_udp(lab: Lab, first: str, size: int) -> None:
    topic = f"/{lab.unique('udp')}"
    receiver_options: dict[str, Any] = {"topic": topic, "udp": 1}
    if first == "subscriber":
        receiver = lab.node("roscpp", "out", "sub", **receiver_options)
        receiver.wait_for("^ready")
    sender = lab.node("roscpp", "c1", "pub", name="udp_talker", topic=topic, size=size, rate=50)
    sender.wait_for("^sent hello 2 ")
    if first == "publisher":
        receiver = lab.node("roscpp", "out", "sub", name="udp_listener", **receiver_options)
    receiver.wait_for_count(r"^got hello \d+ size", 20)
    info = lab.run("out", "rosnode", "info", "udp_talker").output
    assert "transport: UDPROS" in info
    assert f"topic: {topic}" in info
