"""XML-RPC documents of every kind, well formed or not: nothing is lost and nothing is raised."""

from contextlib import suppress
from datetime import datetime
from typing import Any
from xmlrpc.client import Binary, DateTime

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.ros1.protocol.xmlrpc import document as xmlrpc
from rosproxy.ros1.protocol.xmlrpc import multicall
from rosproxy.ros1.protocol.xmlrpc.document import Value, XmlRpcError
from rosproxy.ros1.rewriting import master_api, master_calls, slave_api
from rosproxy.shared.addresses import HostPort
from tests.unit.builders import (
    add_node,
    cpp_call,
    cpp_reply,
    make_addressing,
    make_caller,
    py_call,
    py_reply,
    python_values,
    raw_call,
    unfiltered,
)

TEXT = st.text(
    st.characters(min_codepoint=0x20, exclude_categories=["Cs"], exclude_characters="\ufffe\uffff")
    | st.sampled_from("\t\n<>&'\"")
)
SCALARS = (
    TEXT
    | st.integers(-(2**31), 2**31 - 1)
    | st.booleans()
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.binary(max_size=40).map(Binary)
    | st.datetimes(datetime(1900, 1, 1), datetime(9999, 1, 1)).map(
        lambda when: DateTime(when.replace(microsecond=0))
    )
)
VALUES = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(TEXT, inner, max_size=4),
    max_leaves=12,
)
"""Every type that XML-RPC has, nested."""

PLAIN = st.recursive(
    TEXT | st.integers(-(2**31), 2**31 - 1) | st.booleans(),
    lambda inner: st.lists(inner, max_size=4),
    max_leaves=12,
)
"""Values of ROS's own replies in XmlRpc++."""

WORLD = make_addressing()
NODE = add_node(WORLD)
CALLER = make_caller("10.0.0.5")
REACHED = HostPort("robot-host", 45000)
VIEW = slave_api.from_outside(CALLER, "http://robot:11311/", WORLD)
METHODS = ["getParam", "registerPublisher", "lookupService", "system.multicall", "x", "__proto__"]


def strings(value: Value) -> list[Value]:
    """All strings in a value, to any depth."""
    inner = [string for item in value.items for string in strings(item)]
    return [value, *inner] if value.kind == "string" else inner


def swapped(value: Any, old: str, new: str) -> Any:
    """A value with each occurrence of a string replaced, except in names of members."""
    if isinstance(value, list):
        return [swapped(item, old, new) for item in value]
    if isinstance(value, dict):
        return {name: swapped(item, old, new) for name, item in value.items()}
    return new if isinstance(value, str) and value == old else value


@given(st.lists(VALUES, max_size=4), TEXT, st.data())
def test_only_the_replaced_strings_change(values: list[Any], new: str, data: st.DataObject) -> None:
    body = py_call("m", *values)
    all_strings = [string for param in xmlrpc.parse_call(body).params for string in strings(param)]
    old = data.draw(st.sampled_from([string.text for string in all_strings])) if all_strings else ""
    edits = [string.with_text(new) for string in all_strings if string.text == old]
    before = python_values(body)
    assert python_values(xmlrpc.apply(body, edits)) == swapped(before, old, new)
    assert xmlrpc.apply(body, [string.with_text(string.text) for string in all_strings]) == body


@given(st.lists(PLAIN, max_size=4), st.sampled_from([py_call, cpp_call]))
def test_values_are_read_as_python_reads_them(values: list[Any], call: Any) -> None:
    body = call("m", *values)
    read = [xmlrpc.python_value(param) for param in xmlrpc.parse_call(body).params]
    assert read == swapped_booleans(python_values(body))


def swapped_booleans(value: Any) -> Any:
    """Booleans as text, like the result of ``python_value``."""
    if isinstance(value, list):
        return [swapped_booleans(item) for item in value]
    return str(int(value)) if isinstance(value, bool) else value


def exported(request: master_calls.Request) -> master_calls.ExportedRequest:
    """The request for the master, of a node that is not admitted."""
    return master_api.export_request(
        request, [master_calls.Passing.NO_REGISTRATION] * len(request.calls), WORLD
    )


@given(st.sampled_from(METHODS), st.lists(VALUES, max_size=4))
def test_a_call_without_addresses_comes_out_byte_for_byte(method: str, values: list[Any]) -> None:
    body = py_call(method, *values)
    request = master_calls.read_request(body, CALLER)
    assert exported(request).body == body


@given(st.sampled_from(METHODS), VALUES, st.sampled_from([1, 0, -1]))
def test_a_reply_without_addresses_comes_out_byte_for_byte(
    method: str, value: Any, status: int
) -> None:
    request = master_calls.read_request(py_call(method, "/node"), CALLER)
    for reply in (py_reply(value), py_reply([status, "said", value])):
        answer = master_calls.read_reply(exported(request), reply)
        assert master_api.import_reply(answer, WORLD, unfiltered) == reply


@given(
    st.sampled_from(["getBusInfo", "requestTopic", "publisherUpdate", "getPid", "x"]),
    st.lists(PLAIN, max_size=4),
    st.sampled_from([(py_call, py_reply), (cpp_call, cpp_reply)]),
)
def test_the_slave_side_leaves_other_values_alone(
    method: str, values: list[Any], dialect: Any
) -> None:
    call, reply = dialect
    body = call(method, *values)
    answer = reply([1, "said", values])
    parsed = xmlrpc.parse_call(body)
    named = values[2] if len(values) > 2 and isinstance(values[2], list) else []
    publishers = [item for item in named if isinstance(item, str)]
    if len(publishers) == len(set(publishers)):  # publisherUpdate drops what comes twice
        assert slave_api.rewrite_call(body, parsed, VIEW) == body
    assert slave_api.rewrite_reply(parsed, answer, REACHED, VIEW) == answer


def everything(body: bytes) -> None:
    """Do everything that the shell does with a foreign body."""
    request = master_calls.read_request(body, CALLER)
    exported(request)
    parsed = xmlrpc.parse_call(body)
    slave_api.rewrite_call(body, parsed, VIEW)
    for call in (parsed, *multicall.inner_calls(parsed)):
        if call:
            xmlrpc.parse_call(multicall.single_call(call))


def everything_in_reply(reply: bytes) -> None:
    """Do everything that the shell does with a foreign reply."""
    call = xmlrpc.parse_call(py_call("requestTopic", "/a", "/b", [["TCPROS"]]))
    slave_api.topic_port(call, reply)
    slave_api.rewrite_reply(call, reply, REACHED, VIEW)
    request = master_calls.read_request(py_call("system.multicall", []), CALLER)
    master_api.import_reply(master_calls.read_reply(exported(request), reply), WORLD, unfiltered)
    multicall.results_reply([multicall.result_value(reply)])


def survived(body: bytes) -> bool:
    """Whether a body is accepted; anything but XmlRpcError goes up."""
    accepted = 0
    for function in (everything, everything_in_reply):
        with suppress(XmlRpcError):
            function(body)
            accepted += 1
    return accepted > 0


SAMPLES = [
    py_call("registerPublisher", "/a", "/b", "t/T", "http://10.0.0.5:40001/"),
    cpp_call("registerService", "/a", "/b", "rosrpc://10.0.0.5:4", "http://10.0.0.5:40001/"),
    py_call("system.multicall", [{"methodName": "lookupNode", "params": ["/a", "/b"]}] * 2),
    cpp_call("publisherUpdate", "/master", "/b", ["http://robot-host:45000/"] * 2),
    py_reply([1, "ready on 10.0.0.5:5", ["TCPROS", "10.0.0.5", 5]]),
    cpp_reply([1, "", [[1, "http://10.0.0.5:40001/", "i", "TCPROS", "/b", True, "é & ü"]]]),
    b"<?xml version='1.0' encoding='iso-8859-1'?><methodCall><methodName>m</methodName><params>"
    b"<param><value>\xe9&amp;<![CDATA[\xe9]]></value></param></params></methodCall>",
]


@pytest.mark.parametrize("body", SAMPLES, ids=range(len(SAMPLES)))
def test_a_body_cut_anywhere_is_refused(body: bytes) -> None:
    assert survived(body)
    complete = len(body.rstrip())
    assert not any(survived(body[:end]) for end in range(complete))


@pytest.mark.parametrize("body", SAMPLES, ids=range(len(SAMPLES)))
def test_a_body_with_a_byte_missing_or_changed_anywhere_raises_nothing_else(body: bytes) -> None:
    for position in range(len(body)):
        survived(body[:position] + body[position + 1 :])
        survived(body[:position] + b"<" + body[position + 1 :])
        survived(body[:position] + b"\xff" + body[position + 1 :])


@given(st.binary(max_size=300))
def test_random_bytes_are_refused(body: bytes) -> None:
    assert not survived(body)


TAGS = ["methodCall", "methodResponse", "methodName", "params", "param", "value", "array", "data"]
TAGS += ["struct", "member", "name", "fault"]
TYPES = ["string", "int", "i4", "i8", "boolean", "double", "base64", "dateTime.iso8601", "nil"]
TYPES += ["ex:nil", "x"]
PIECES = st.sampled_from(
    [piece for tag in TAGS + TYPES for piece in (f"<{tag}>", f"</{tag}>", f"<{tag}/>")]
    + ["x", "1", " ", "\n", "&amp;", "<![CDATA[x]]>", "<!-- x -->", "<?x y?>", "http://10.0.0.5:4/"]
)


def tree(inner: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
    return st.builds(
        lambda tag, parts: f"<{tag}>{''.join(parts)}</{tag}>",
        st.sampled_from(TAGS + TYPES + ["value"] * 12 + ["member", "array"] * 3),
        st.lists(inner, max_size=4),
    )


@given(st.lists(PIECES, max_size=40))
def test_any_soup_of_tags_raises_nothing_else(pieces: list[str]) -> None:
    survived("".join(pieces).encode())


@given(st.lists(st.recursive(PIECES, tree, max_leaves=15), max_size=3), st.sampled_from(METHODS))
def test_any_tree_of_tags_raises_nothing_else(parts: list[str], method: str) -> None:
    inside = "".join(parts)
    survived(raw_call(method=method).replace(b"<params>", f"<params>{inside}".encode()))
    survived(f"<methodResponse><params>{inside}</params></methodResponse>".encode())
