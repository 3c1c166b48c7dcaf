"""The client libraries, their limits without a proxy, and the cases.

The matrix leaves out LIMITS. test_limits.py shows each limit without a proxy.
"""

from __future__ import annotations

import pytest

LIBRARIES = ("goroslib", "rosrust", "roslibrust", "rosnodejs", "foxglove", "roslisp")
PEERS = ("rospy", "roscpp")
SIDES = {"inside": ("c1", "out"), "outside": ("out", "c1")}
"""The machine of the library's node, and the machine of its peers."""

SERVE = "serve"
SERVE_ON = "serve persistently"
CALL = "call"
CALL_ON = "call persistently"
PARAMETERS = "parameters"
LIMITS: dict[str, tuple[str, ...]] = {
    "rosrust": (SERVE_ON, CALL_ON),
    "roslibrust": (PARAMETERS,),
    "foxglove": (SERVE, SERVE_ON, CALL, CALL_ON),
    "roslisp": (SERVE_ON,),
}
"""Features that a library lacks."""


def able(*needs: str) -> list[str]:
    """The libraries that can do all of something."""
    return [name for name in LIBRARIES if not {*LIMITS.get(name, ())} & {*needs}]


def each_client(*needs: str) -> pytest.MarkDecorator:
    """Every library that can do what a test needs, inside and outside."""
    names = able(*needs)
    rows = {f"{name}-{side}": (name, *ways) for name in names for side, ways in SIDES.items()}
    return pytest.mark.parametrize(("library", "side", "across"), rows.values(), ids=rows.keys())
