"""The gaps of the matrix: the same cases fail without a proxy."""

from __future__ import annotations

import pytest

from tests.clients.matrix import CALL, CALL_ON, LIMITS, PARAMETERS, SERVE, SERVE_ON
from tests.ros.lab import Lab

ROLES = {SERVE: ("serve",), CALL: ("call",), PARAMETERS: ("setparam", "getparam")}
NO_SUCH_CALL = [
    *(("foxglove", role) for lack in (SERVE, CALL) for role in ROLES[lack]),
    *(("roslibrust", role) for role in ROLES[PARAMETERS]),
]
"""The library has nothing by which a program could do this."""
ONE_CALL_FOR_EACH_CONNECTION = ["rosrust", "roslisp"]
"""Servers of these libraries ignore a request for a persistent connection."""


@pytest.mark.parametrize(("library", "role"), NO_SUCH_CALL)
def test_it_has_no_call_for_that(direct: Lab, library: str, role: str) -> None:
    options = {"service": "/x"} if role in ("serve", "call") else {"key": "/x", "json": "1"}
    node = direct.node(library, "c1", role, **options)
    assert node.wait() != 0
    node.wait_for(rf"no (role )?{role}")


def test_rosrust_does_not_call_persistently(direct: Lab) -> None:
    node = direct.node("rosrust", "c1", "call", service="/x", persistent=1)
    assert node.wait() != 0
    node.wait_for("rosrust has a connection for each call")


@pytest.mark.parametrize("library", ONE_CALL_FOR_EACH_CONNECTION)
def test_it_does_not_serve_persistently(direct: Lab, library: str) -> None:
    service = f"/{direct.unique('served')}"
    direct.node(library, "c1", "serve", service=service).wait_for("^ready")
    caller = direct.node("rospy", "out", "call", service=service, persistent=1, count=2)
    caller.wait_for("^reply ask 0 ")
    caller.wait_for("^failed 1 ")


def test_nothing_else_is_left_out() -> None:
    shown = {
        (library, lack) for library, role in NO_SUCH_CALL for lack in ROLES if role in ROLES[lack]
    }
    shown |= {(library, SERVE_ON) for library in ONE_CALL_FOR_EACH_CONNECTION}
    shown |= {("rosrust", CALL_ON), ("foxglove", SERVE_ON), ("foxglove", CALL_ON)}
    assert shown == {(library, lack) for library, lacks in LIMITS.items() for lack in lacks}
