"""The fast parser gives the same results as expat, and accepts only the plain form."""

from typing import Any
from xmlrpc.client import dumps

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from rosproxy.ros1.protocol.xmlrpc import document as xmlrpc
from rosproxy.ros1.protocol.xmlrpc import fast
from rosproxy.ros1.protocol.xmlrpc.document import Call, Value, XmlRpcError
from rosproxy.ros1.protocol.xmlrpc.limits import OWN_REPLY, Limits
from rosproxy.ros1.protocol.xmlrpc.passing import MulticallWatch
from tests.unit.builders import cpp_call, cpp_reply, py_call, py_reply

TEXT = st.text(st.characters(min_codepoint=0x20, max_codepoint=0x7E, exclude_characters="&<>"))
VALUES = st.recursive(
    TEXT | st.integers(-(2**31), 2**31 - 1) | st.booleans() | st.floats(allow_nan=False),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(TEXT, inner, max_size=4),
    max_leaves=12,
)
VALUE_TAGS = ["value", "string", "int", "i4", "boolean", "double", "base64", "nil"]
HOLDER_TAGS = ["array", "data", "struct", "member", "name", "param", "params", "fault"]
PIECES = [*VALUE_TAGS, *HOLDER_TAGS, "methodName", "methodCall", "methodResponse"]
SOUP = st.lists(
    st.sampled_from([f"<{name}>" for name in PIECES] + [f"</{name}>" for name in PIECES])
    | st.sampled_from(
        ["x", " ", "\r\n", "]]>", "&amp;", "<!---->", "<value/>", "<value >", "\0", "é"]
    ),
    max_size=12,
).map("".join)


def by_expat(body: bytes, limits: Limits = OWN_REPLY) -> tuple[str, Any]:
    """The result of expat for a document, or the error."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fast, "call", lambda *_: None)
        patch.setattr(fast, "response", lambda *_: None)
        return read(body, limits)


def read(body: bytes, limits: Limits = OWN_REPLY) -> tuple[str, Any]:
    try:
        if b"methodCall" in body:
            return "call", xmlrpc.parse_call(body, limits)
        return "reply", xmlrpc.parse_response(body, limits)
    except XmlRpcError as error:
        return "refused", error.code


def assert_scalars_as_by_expat(body: bytes) -> None:
    """What passes unread is a call that expat accepts, with the same method."""
    method = fast.method_of_scalars(body)
    if method is not None:
        verdict, call = by_expat(body)
        assert (verdict, call.method) == ("call", method)
        assert not {value.kind for value in call.params} & {"array", "struct"}


def plainly(body: bytes) -> Call | Value | None:
    call = fast.call(body)
    return Call(*call) if call else fast.response(body)


@given(st.lists(VALUES, max_size=4))
def test_python_s_calls_are_plain_and_read_with_every_offset_as_by_expat(values: list[Any]) -> None:
    body = py_call("registerPublisher", *values)
    assert plainly(body) is not None
    assert read(body) == by_expat(body)


@given(VALUES)
def test_python_s_replies_are_plain_and_read_with_every_offset_as_by_expat(value: Any) -> None:
    body = py_reply(value)
    assert plainly(body) is not None
    assert read(body) == by_expat(body)


@pytest.mark.parametrize("written", [py_call, cpp_call])
def test_calls_for_single_parameters_are_told_by_their_method(written: Any) -> None:
    for value in ("text", "", 5, True, 1.5):
        assert fast.method_of_scalars(written("setParam", "/n", "/a", value)) == "setParam"
    for other in (["a"], {"a": 1}, "<&>"):
        assert fast.method_of_scalars(written("setParam", "/n", "/a", other)) is None


def multicall(*calls: tuple[str, list[Any]]) -> bytes:
    return py_call("system.multicall", [{"methodName": m, "params": params} for m, params in calls])


def watched_methods(body: bytes) -> set[str] | None:
    """The methods in a multicall that expat takes apart; None if it must not pass."""
    methods = set[str]()

    def passes(method: str) -> bool:
        methods.add(method)
        return True

    watch = MulticallWatch(passes)
    try:
        watch.see(body)
        watch.end()
    except XmlRpcError:
        return None
    return methods


def test_the_methods_of_a_multicall_are_told() -> None:
    calls = ("setParam", ["/n", "/a", [1, "b", 2.5]]), ("getParam", ["/n", "/a"])
    assert fast.methods_of_multicall(multicall(*calls)) == {"setParam", "getParam"}
    assert fast.methods_of_multicall(multicall()) == set()
    assert fast.methods_of_multicall(multicall(("setParam", ["/n", "/a", {"b": 1}]))) is None
    assert fast.methods_of_multicall(py_call("setParam", "/n", "/a", 1)) is None


@given(st.lists(VALUES, max_size=2), st.data())
def test_a_multicall_whose_methods_are_told_is_one_to_expat(
    values: list[Any], data: st.DataObject
) -> None:
    body = bytearray(multicall(("setParam", values), ("x.y", [[1], "a"])))
    for _ in range(data.draw(st.integers(0, 2))):
        place = data.draw(st.integers(0, len(body) - 1))
        body[place : place + data.draw(st.integers(0, 3))] = data.draw(st.binary(max_size=3))
    methods = fast.methods_of_multicall(bytes(body))
    assert methods is None or methods == watched_methods(bytes(body))


def test_a_method_that_a_parser_would_read_otherwise_is_not_told() -> None:
    body = py_call("registerPublisher").replace(b"Pub", b"&#80;ub")
    assert fast.method_of_scalars(body) is None


def test_xmlrpcpp_s_documents_are_plain() -> None:
    for body in (cpp_call("getPid", "/n", 1, ["a", True]), cpp_reply([1, "ok", ["http://h:1/"]])):
        assert plainly(body) is not None
        assert read(body) == by_expat(body)


@given(st.lists(VALUES, max_size=2), st.data())
def test_a_changed_document_is_read_as_by_expat_or_refused_as_by_it(
    values: list[Any], data: st.DataObject
) -> None:
    body = bytearray(py_call("x", *values))
    for _ in range(data.draw(st.integers(1, 3))):
        place = data.draw(st.integers(0, len(body) - 1))
        body[place : place + data.draw(st.integers(0, 3))] = data.draw(st.binary(max_size=3))
    assert read(bytes(body)) == by_expat(bytes(body))
    assert_scalars_as_by_expat(bytes(body))


@given(SOUP, st.sampled_from(["methodCall", "methodResponse"]))
def test_soup_between_sound_tags_is_read_as_by_expat(soup: str, root: str) -> None:
    name = "<methodName>x</methodName>" if root == "methodCall" else ""
    for text in (
        f"<{root}>{name}<params><param><value>{soup}</value></param></params></{root}>",
        f"<{root}>{name}<params><param>{soup}</param></params></{root}>",
        f"<{root}>{name}{soup}</{root}>",
        f"{soup}<{root}>{name}<params></params></{root}>{soup}",
    ):
        assert read(text.encode()) == by_expat(text.encode())
        assert_scalars_as_by_expat(text.encode())


@pytest.mark.parametrize("depth", range(1, 16))
def test_depth_is_bounded_as_by_expat(depth: int) -> None:
    body = py_call("x", [["deep"]])
    limits = Limits(1000, 100, depth)
    assert read(body, limits) == by_expat(body, limits)
    assert (read(body, limits)[0] == "refused") is (depth < 11)


def test_elements_are_bounded() -> None:
    body = py_call("x", ["y"] * 100)
    count = body.count(b"</")
    assert fast.call(body, Limits(len(body), count)) is not None
    for limits in (Limits(len(body), count - 1), Limits(len(body) - 1, count)):
        assert fast.call(body, limits) is None
        with pytest.raises(XmlRpcError, match="than"):
            xmlrpc.parse_call(body, limits)


@pytest.mark.parametrize("text", ["&lt;", "é", "\x00"])
def test_what_needs_an_xml_parser_is_left_to_expat(text: str) -> None:
    body = f"<methodCall><methodName>x</methodName><params><param><value>{text}</value></param>"
    body += "</params></methodCall>"
    assert fast.call(body.encode()) is None


def test_spaces_cost_no_more_than_their_number() -> None:
    """Each token may begin with spaces. The regular expression must not backtrack over spaces."""
    spaces = b" " * 2_000_000
    body = dumps(("a",), "x").encode().replace(b"<param>", spaces + b"<param>" + spaces)
    assert fast.call(body) is not None
    assert fast.method_of_scalars(body) == "x"
    assert fast.method_of_scalars(body.replace(b"</param>", b"</parm>")) is None
    assert fast.call(body.replace(b"</param>", b"</parm>")) is None


LETTERS = st.characters(exclude_categories=["Cs", "Cc"], exclude_characters="\ufffe\uffff")
NAMES = st.recursive(
    st.text(LETTERS | st.sampled_from("&<>\"'\t\n\x7f")) | st.integers(-(2**31), 2**31 - 1),
    st.lists,
)


@given(st.lists(NAMES))
def test_lists_of_names_and_numbers_are_read_as_they_are(value: list[Any]) -> None:
    body = py_reply(value)
    assert fast.lists(body) == value
    assert xmlrpc.python_value(xmlrpc.parse_response(body)[0]) == value


@given(SOUP)
@example("<value><string>\r&lt;\r\né&amp;lt;&quot;&apos;</string></value>")
@example("<value><string>&#65;</string></value>")
@example("<value><string>&nosuch;</string></value>")
@example("<value><string>\ufffe</string></value>")
@example("<value><string>]]></string></value>")
def test_what_is_taken_for_lists_is_what_expat_reads(soup: str) -> None:
    for inner in (soup, f"<value><array><data>{soup}</data></array></value>"):
        body = f"<methodResponse><params><param>{inner}</param></params></methodResponse>".encode()
        read_lists = fast.lists(body)
        if read_lists is not None:
            _, (value, _) = by_expat(body)
            assert xmlrpc.python_value(value) == read_lists


def test_a_text_that_is_not_utf8_is_left_to_expat() -> None:
    body = py_reply(["x"]).replace(b"x</", b"\xff</")
    assert fast.lists(body) is None
    assert by_expat(body) == ("refused", xmlrpc.PARSE_ERROR)


@pytest.mark.parametrize("name", ["/a&b", "/a<b", "/é", "/a\x7f"])
def test_a_name_of_any_letters_makes_the_reading_of_all_others_no_slower(name: str) -> None:
    state = [[[topic, ["/n"]] for topic in ("/t", name)], [], []]
    assert fast.lists(py_reply([1, "", state])) == [1, "", state]


@given(VALUES, st.integers(0, 40))
def test_a_reply_that_is_too_deep_is_no_lists_either(value: Any, depth: int) -> None:
    body = py_reply([value])
    limits = Limits(10_000, 1000, depth)
    if fast.lists(body, limits) is not None:
        assert by_expat(body, limits)[0] == "reply"
