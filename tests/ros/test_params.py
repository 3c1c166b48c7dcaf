"""Parameters keep the exact type and bytes on the way through."""

from __future__ import annotations

import json
from typing import Any
from xmlrpc.client import Binary, DateTime, dumps, loads

import pytest

from tests.ros import wire
from tests.ros.combinations import each_library, each_side
from tests.ros.lab import CALLER, Lab

OTHER = {"c1": "out", "out": "c1"}

VALUES: dict[str, Any] = {
    "int": 42,
    "negative int": -2147483648,
    "zero": 0,
    "double": 0.1,
    "whole double": 3.0,
    "tiny double": 5e-324,
    "huge double": -1.7976931348623157e308,
    "true": True,
    "false": False,
    "string": "hello",
    "empty string": "",
    "blanks": "  two  \n\t lines ",
    "markup": "a <b> & \"c\" 'd' ]]> <value><int>1</int></value>",
    "looks like a number": "007",
    "looks like a uri": "http://c1box:45000/",
    "unicode": "Grüße, 日本語 🤖",
    "list": [1, 2.0, "three", True, ""],
    "empty list": [],
    "list of lists": [[1, 2], [], [[3.5]]],
    "empty struct": {},
    "nested struct": {"a": {"b": {"c": [1, {"d": ""}]}, "e": 1.0}, "f": False},
    "base64": Binary(bytes(range(256))),
    "empty base64": Binary(b""),
    "base64 in a struct": {"image": Binary(b"\x00\xff"), "size": 2},
    "dateTime": DateTime("20260131T23:59:58"),
    "long string": "x" * 1_000_000,
}

each_value = pytest.mark.parametrize("value", VALUES.values(), ids=VALUES.keys())


def get(lab: Lab, role: str, key: str) -> bytes:
    """The whole reply to getParam, as bytes."""
    body = dumps((CALLER, key), "getParam").encode()
    return wire.post(lab.place(role), *lab.master_address(role), body)


def exactly(value: Any) -> str:
    """A text that differs for every type: 1, 1.0 and True are equal in Python."""
    if isinstance(value, Binary):
        return f"Binary({value.data!r})"
    if isinstance(value, DateTime):
        return f"DateTime({value.value!r})"
    if isinstance(value, dict):
        return str({key: exactly(item) for key, item in sorted(value.items())})
    if isinstance(value, list):
        return str([exactly(item) for item in value])
    return repr(value)


@each_side
@each_value
def test_a_value_keeps_its_type_in_both_directions(lab: Lab, side: str, value: Any) -> None:
    key = f"/{lab.unique('value')}"
    lab.ask_master("setParam", key, value, role=side)
    assert exactly(lab.ask_master("getParam", key, role=OTHER[side])) == exactly(value)
    assert get(lab, "c1", key) == get(lab, "out", key)


UNTYPED = {
    "untyped": ("<value> a &lt; b </value>", " a < b "),
    "untyped empty": ("<value></value>", ""),
    "i4": ("<value><i4>-7</i4></value>", -7),
    "double without point": ("<value><double>7</double></value>", 7.0),
    "member untyped": (
        "<value><struct><member><name>k</name><value>v</value></member></struct></value>",
        {"k": "v"},
    ),
}


@pytest.mark.parametrize(("text", "value"), UNTYPED.values(), ids=UNTYPED.keys())
def test_values_written_the_way_roscpp_does(lab: Lab, text: str, value: Any) -> None:
    key = f"/{lab.unique('untyped')}"
    parameters = f"<param><value>/x</value></param><param><value>{key}</value></param>"
    call = f"<methodName>setParam</methodName><params>{parameters}<param>{text}</param></params>"
    body = f'<?xml version="1.0"?>\r\n<methodCall>{call}</methodCall>\r\n'.encode()
    wire.post(lab.place("c1"), *lab.master_address("c1"), body)
    assert exactly(lab.ask_master("getParam", key)) == exactly(value)


@each_side
def test_roscpp_sets_every_type(lab: Lab, side: str) -> None:
    key = f"/{lab.unique('roscpp')}"
    lab.node("roscpp", side, "setparams", key=key).wait_for("^done")
    assert exactly(lab.ask_master("getParam", key, role=OTHER[side])) == exactly(
        {
            "int": -42,
            "double": 0.1,
            "whole": 2.0,
            "bool": True,
            "string": '  a <b> & "c"\n',
            "empty": "",
            "list": [1, "two", 3.5],
            "table": {"flag": True, "list": [1, "two", 3.5], "empty": ""},
            "binary": Binary(b"\x00\x01\n<\xff"),
        }
    )


JSON = {"i": 1, "d": 2.0, "b": True, "s": "", "l": [1, [2.5, "x"]], "t": {"n": {"m": -1}}}


@each_side
def test_rospy_sets_and_gets_nested_values(lab: Lab, side: str) -> None:
    key = f"/{lab.unique('rospy')}"
    lab.node("rospy", side, "setparam", key=key, json=json.dumps(JSON)).wait_for("^done")
    assert exactly(lab.ask_master("getParam", key, role=OTHER[side])) == exactly(JSON)
    reader = lab.node("rospy", OTHER[side], "getparam", key=key)
    assert exactly(json.loads(reader.wait_for("^value (.*)")[1])) == exactly(JSON)


@each_side
def test_roscpp_gets_nested_values(lab: Lab, side: str) -> None:
    key = f"/{lab.unique('read')}"
    value = {**JSON, "binary": Binary(b"\x00\xff")}
    lab.ask_master("setParam", key, value, role=OTHER[side])
    reader = lab.node("roscpp", side, "getparam", key=key)
    xml = reader.wait_for(r"^value ((?:.|\n)*</value>)\n*\Z")[1]
    document = f"<methodResponse><params><param>{xml}</param></params></methodResponse>"
    assert exactly(loads(document)[0][0]) == exactly(value)


@each_side
@pytest.mark.parametrize("setter", ["c1", "c2", "out"])
def test_a_subscribed_parameter_is_updated(lab: Lab, side: str, setter: str) -> None:
    key = f"/{lab.unique('watched')}"
    lab.ask_master("setParam", key, "before")
    watcher = lab.node("roscpp", side, "watchparam", key=key)
    watcher.wait_for("^param before$")
    for value in ("after", "later & <later>"):
        lab.ask_master("setParam", key, value, role=setter)
        watcher.wait_for(f"^param {value}$")
    assert watcher.returncode is None


@each_library
def test_private_and_relative_names_are_resolved_inside(lab: Lab, library: str) -> None:
    name = lab.unique("namespaced")
    kind, options = ("setparam", {"json": "5"}) if library == "rospy" else ("setparams", {})
    remap = [f"__ns:=/{name}"]
    lab.node(library, "c1", kind, remap=remap, key="mine", **options).wait_for("^done")
    key = f"/{name}/mine" if library == "rospy" else f"/{name}/mine/int"
    assert lab.ask_master("getParam", key) in (5, -42)


def test_search_has_list_and_delete(lab: Lab) -> None:
    key = f"/{lab.unique('tree')}"
    lab.ask_master("setParam", f"{key}/leaf", 1, role="c1")
    assert lab.ask_master("hasParam", f"{key}/leaf", role="c1") is True
    assert f"{key}/leaf" in lab.ask_master("getParamNames", role="c1")
    lab.ask_master("deleteParam", f"{key}/leaf", role="c1")
    assert lab.ask_master("hasParam", f"{key}/leaf") is False
    with pytest.raises(LookupError):
        lab.ask_master("getParam", f"{key}/leaf", role="c1")
