"""The boundary is real: nothing passes without the proxy, and everything passes with the proxy.

So passing traffic in other tests proves that the proxy works. A listener on the near side proves
that there is traffic.
"""

from __future__ import annotations

import pytest

from tests.ros2.lab import Lab

PROXY = False
LAN_RELAY = True
OPTIONS = ("--ros2-lan-relay", "172.30.1.1:47090")
OFFERS = {"rclpy": "pub,serve,act,hold", "cyclone": "pub"}
USES = {"rclpy": "sub,call,pursue,tune,names", "cyclone": "sub"}
GOT = {
    "rclpy": [
        "^got hello ",
        "^reply .* hello",
        "^result 0 1 1 ",
        "^parameter 7$",
        "^nodes far near source end$",
    ],
    "cyclone": ["^got hello "],
}
PROGRAM = {"jazzy": "rclpy", "kilted": "rclpy", "cyclone": "cyclone"}


OUTWARD = ("c1", "c2", "out")
INWARD = ("out", "out", "c1")


@pytest.mark.parametrize(
    ("vendor", "origin", "near", "far"),
    [
        pytest.param("jazzy", *OUTWARD, marks=pytest.mark.smoke),
        ("jazzy", *INWARD),
        ("kilted", *OUTWARD),
        ("kilted", *INWARD),
        ("cyclone", *OUTWARD),
        ("cyclone", *INWARD),
    ],
    ids=lambda value: value,
)
def test_nothing_passes_without_the_proxy(
    lab: Lab, vendor: str, origin: str, near: str, far: str
) -> None:
    program = PROGRAM[vendor]
    options = {"topic": "/all", "of": "source"} if program == "rclpy" else {"topic": "/all"}
    far_node = lab.node(vendor, far, USES[program], name="far", **options)
    far_node.wait_for("^ready")
    source = lab.node(vendor, origin, OFFERS[program], name="source", topic="/all")
    listener = lab.node(vendor, near, USES[program], name="near", **options)
    for pattern in GOT[program][:4]:
        listener.wait_for(pattern)
    listener.wait_for_count("^got hello ", 15)
    assert source.returncode is None
    heard = {line.split()[0] for line in far_node.output().splitlines()}
    assert heard <= {"ready", "nodes"}, far_node.output()
    assert "source" not in far_node.output()

    lab.start_proxy()

    for pattern in GOT[program]:
        far_node.wait_for(pattern)
