"""A range of three ports: three inside nodes, and a clear error for a fourth."""

from __future__ import annotations

import time
from dataclasses import replace

import pytest

from tests.ros.combinations import each_library
from tests.ros.lab import Lab
from tests.ros.processes import wait_until
from tests.ros.topology import SHARED, PortMap

pytestmark = pytest.mark.boundary

PLAN = replace(SHARED, name="r", ports=PortMap(45000, 45002, 45000))
LINGER = 1.0
PROXY_OPTIONS = ("--linger", str(LINGER), "--probe-interval", "0.5")


@each_library
def test_the_fourth_node_is_told_and_a_later_one_gets_a_free_port(lab: Lab, library: str) -> None:
    names = [lab.unique("crowd") for _ in range(3)]
    nodes = [
        lab.node("roscpp", "c1", "pub", name=name, topic=f"/{name}/topic", word=name)
        for name in names
    ]
    for name in names:
        lab.wait_registered(name)
    assert lab.proxy is not None
    since = lab.proxy.mark()
    lab.node(library, "c2", "pub", topic="/too_many")
    logged = lab.proxy.wait_for(r".*45000-45002.*", since=since)[0]
    assert "--port-range" in logged or "ROSPROXY_PORT_RANGE" in logged
    for name in names:
        lab.node("roscpp", "out", "sub", topic=f"/{name}/topic").wait_for(f"^got {name} ")
    nodes[0].stop()
    wait_until("the port is free", lambda: lab.node_uri(names[0]) is None)
    time.sleep(LINGER + 1)
    late = lab.unique("late")
    lab.node(library, "c2", "pub", name=late, topic=f"/{late}/topic")
    lab.wait_registered(late)
    lab.node("roscpp", "out", "sub", topic=f"/{late}/topic").wait_for("^got ")
