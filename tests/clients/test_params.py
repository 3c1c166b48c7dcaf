"""Parameters keep values between each library and the other side."""

from __future__ import annotations

import json

from tests.clients.matrix import PARAMETERS, each_client
from tests.ros.lab import Lab

VALUES = (-42, 0.5, True, "two words")
"""Values of types that all libraries have. goroslib does not escape special characters of XML."""


@each_client(PARAMETERS)
def test_what_a_node_sets_is_got(lab: Lab, library: str, side: str, across: str) -> None:
    for value in VALUES:
        key = f"/{lab.unique('set')}"
        lab.node(library, side, "setparam", key=key, json=json.dumps(value)).wait_for("^done")
        assert repr(lab.ask_master("getParam", key, role=across)) == repr(value)


@each_client(PARAMETERS)
def test_a_node_gets_what_is_set(lab: Lab, library: str, side: str, across: str) -> None:
    for value in VALUES:
        key = f"/{lab.unique('get')}"
        lab.ask_master("setParam", key, value, role=across)
        told = lab.node(library, side, "getparam", key=key).wait_for("^value (.*)")[1]
        assert json.loads(told) == value
