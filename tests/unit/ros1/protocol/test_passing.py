"""Long calls that pass unread: the head, and content that must not pass unread."""

import xmlrpc.client
from collections.abc import Iterable
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from rosproxy.ros1.protocol.xmlrpc import passing
from rosproxy.ros1.protocol.xmlrpc.document import XmlRpcError
from rosproxy.ros1.protocol.xmlrpc.multicall import MULTICALL
from rosproxy.ros1.protocol.xmlrpc.passing import CallWatch, MulticallWatch, method_of
from tests.unit.builders import cpp_call, cpp_reply, py_call, py_reply

PLAIN = {"setParam", "getParam"}


def pieces(body: bytes, size: int) -> Iterable[bytes]:
    """The parts of a body. The first part has the whole head, as in the server."""
    first = max(size, min(len(body), 200))
    yield body[:first]
    for start in range(first, len(body), size):
        yield body[start : start + size]


def see(watch: CallWatch, body: bytes, size: int = 1000) -> None:
    for piece in pieces(body, size):
        watch.see(piece)
    watch.end()


def multicall(calls: list[Any]) -> bytes:
    return py_call(MULTICALL, calls)


def element(method: str, *params: Any) -> dict[str, Any]:
    return {"methodName": method, "params": list(params)}


@pytest.mark.parametrize("dialect", [py_call, cpp_call])
def test_the_method_is_told_by_the_head(dialect: Any) -> None:
    assert (
        method_of(dialect("setParam", "/n", "/key", "x" * 100_000)[: passing.HEAD_BYTES])
        == "setParam"
    )


@pytest.mark.parametrize(
    "head",
    [
        "<?xml version='1.0' encoding='UTF-8'?>",
        '<?xml version="1.0" encoding="iso-8859-1" ?>\r\n\r\n',
        "",
        "\n ",
    ],
)
def test_heads_that_are_known(head: str) -> None:
    text = f"{head}<methodCall>\n<methodName>getParam</methodName><params>"
    assert method_of(text.encode()) == "getParam"


@pytest.mark.parametrize(
    "head",
    [
        "<?xml version='1.0' encoding='utf-16'?><methodCall><methodName>getParam</methodName>",
        "<?xml version='1.0' encoding='cp037'?><methodCall><methodName>getParam</methodName>",
        "<!DOCTYPE a><methodCall><methodName>getParam</methodName>",
        "<!-- a --><methodCall><methodName>getParam</methodName>",
        "<methodCall><!-- a --><methodName>getParam</methodName>",
        "<methodCall><methodName>get<!-- -->Param</methodName>",
        "<methodCall><methodName>get&#80;aram</methodName>",
        "<methodCall><methodName a='b'>getParam</methodName>",
        "<methodCall><params/><methodName>getParam</methodName>",
        "<methodCall><x:methodName>getParam</x:methodName>",
        "<methodCall>" + " " * passing.HEAD_BYTES + "<methodName>getParam</methodName>",
        "<methodCall><methodName>getParam",
        "",
    ],
)
def test_a_call_with_another_head_is_read_whole(head: str) -> None:
    assert method_of(head.encode()) is None


SECOND = [
    b"<methodName>shutdown</methodName>",
    b"<methodName\n>shutdown</methodName>",
    b"<methodName/>",
    b"<x:methodName>shutdown</x:methodName>",
    b"<a:b:methodName >shutdown</a:b:methodName>",
    b"<!-- <methodName>shutdown</methodName> -->",
    b"<![CDATA[<methodName>shutdown</methodName>]]>",
    b"<!DOCTYPE a>",
    b"<!ENTITY a 'b'>",
    b"\0",
]


@pytest.mark.parametrize("hidden", SECOND)
@pytest.mark.parametrize("size", [1, 7, 64, 5000])
def test_what_could_be_another_method_is_refused_however_it_is_cut(
    hidden: bytes, size: int
) -> None:
    body = py_call("setParam", "/n", "/key", "x" * 500)
    for place in (body.index(b"<params>"), body.index(b"xxx") + 250, body.index(b"</methodCall>")):
        with pytest.raises(XmlRpcError):
            see(CallWatch(), body[:place] + hidden + body[place:], size)


@given(st.text(max_size=300), st.integers(1, 100))
def test_parameters_pass_whatever_they_say(text: str, size: int) -> None:
    value = [text, {text: text}, ["methodName", "registerPublisher", "&lt;methodName>"]]
    body = py_call("setParam", "/n", "/key", value).replace(b"\0", b"")
    see(CallWatch(), body, size)


@pytest.mark.parametrize("size", [1, 5, 9, 1000])
def test_nesting_is_bounded(size: int) -> None:
    def nested(depth: int, times: int = 1) -> bytes:
        value = b"<value><array><data>" * depth + b"</data></array></value>" * depth
        return py_call("setParam", "/n", "/key", "x").replace(b"<string>x</string>", value * times)

    see(CallWatch(), nested(passing.MOST_NESTED, times=3), size)
    with pytest.raises(XmlRpcError, match="nested deeper than 20 levels"):
        see(CallWatch(), nested(passing.MOST_NESTED + 1), size)


@pytest.mark.parametrize("size", [1, 13, 1000])
def test_a_multicall_passes_if_all_of_its_calls_do(size: int) -> None:
    values = [1, 2.5, True, "text", [], {"methodName": "registerPublisher", "a": [{}]}]
    body = multicall([element("setParam", "/n", "/key", value) for value in values])
    see(MulticallWatch(PLAIN.__contains__), body, size)
    untyped = body.replace(b"<string>", b"").replace(b"</string>", b"")
    see(MulticallWatch(PLAIN.__contains__), untyped, size)


ODD = {
    "another method": "<value><string>registerPublisher</string></value>",
    "no string": "<value><int>5</int></value>",
    "in pieces": "<value><string>register<!-- -->Publisher</string></value>",
    "as references": "<value><string>&#114;egisterPublisher</string></value>",
    "as CDATA": "<value><string><![CDATA[registerPublisher]]></string></value>",
    "two strings": "<value><string>setParam</string><string>registerPublisher</string></value>",
    "two values": "<value>setParam</value><value>registerPublisher</value>",
    "with a prefix": "<x:value><x:string>registerPublisher</x:string></x:value>",
    "text around": "<value>setParam<string>registerPublisher</string></value>",
    "a multicall": f"<value>{MULTICALL}</value>",
    "nothing": "",
}


@pytest.mark.parametrize("odd", ODD.values(), ids=ODD)
def test_a_multicall_with_an_odd_method_is_refused(odd: str) -> None:
    body = multicall([element("setParam", "/n", "/key", 1)])
    good = b"<value><string>setParam</string></value>"
    assert good in body
    with pytest.raises(XmlRpcError):
        see(MulticallWatch(PLAIN.__contains__), body.replace(good, odd.encode()))


def test_members_that_python_would_take_in_place_of_others_are_refused() -> None:
    body = multicall([element("setParam", "/n", "/key", 1)])
    member = "<member><name>methodName</name><value>registerPublisher</value></member>"
    stray = "<name>methodName</name><string>registerPublisher</string>"
    for place, text in (
        ("</struct></value></data></array>", member),
        ("</value></member></struct>", stray),
        ("</member></struct>", stray),
        ("</struct></value></data>", stray),
        ("</data></array></value></param>", f"<value><struct>{member}</struct></value>"),
    ):
        broken = body.replace(b"\n", b"").replace(place.encode(), (text + place).encode(), 1)
        assert broken.count(b"registerPublisher") == 1, place
        with pytest.raises(XmlRpcError):
            see(MulticallWatch(PLAIN.__contains__), broken)


@pytest.mark.parametrize(
    "markup",
    ["<!--{}-->", "<?pi {}?>", "<value{}></value>", "<value a='{}'></value>"],
)
def test_a_multicall_with_markup_that_does_not_end_is_refused(markup: str) -> None:
    """A comment of 60 MB took as much memory, and a tag with attributes twenty times as much."""
    body = multicall([element("setParam", "/n", "/key", [])])
    before, after = body.split(b"<data>\n</data>")

    def padded(size: int) -> bytes:
        return before + b"<data>" + markup.format(" " * size).encode() + b"</data>" + after

    see(MulticallWatch(PLAIN.__contains__), padded(1000))
    with pytest.raises(XmlRpcError, match=f"more than {passing.LONGEST_MARKUP} bytes"):
        see(MulticallWatch(PLAIN.__contains__), padded(200_000), 10_000)


@pytest.mark.parametrize("tag", ["<n{}/>", "<n a{}=''/>"])
def test_a_multicall_with_many_names_of_elements_is_refused(tag: str) -> None:
    """The parser keeps each name until the end: a million took 200 MB."""
    body = multicall([element("setParam", "/n", "/key", [])])
    odd = "".join(tag.format(number) for number in range(2000)).encode()
    assert body.count(b"<data>\n</data>") == 1
    with pytest.raises(XmlRpcError, match="names of elements and attributes"):
        see(
            MulticallWatch(PLAIN.__contains__),
            body.replace(b"<data>\n</data>", b"<data>" + odd + b"</data>"),
        )


@pytest.mark.parametrize("cut", [50, 200, -5])
def test_a_multicall_that_is_cut_is_refused(cut: int) -> None:
    body = multicall([element("setParam", "/n", "/key", 1)] * 3)
    with pytest.raises(XmlRpcError):
        see(MulticallWatch(PLAIN.__contains__), body[:cut])


SOUP = st.lists(
    st.sampled_from(
        [
            *(f"<{name}>" for name in ("value", "struct", "member", "name", "array", "data")),
            *(f"</{name}>" for name in ("value", "struct", "member", "name", "array", "data")),
            "<string>",
            "</string>",
            "methodName",
            "params",
            "setParam",
            "registerPublisher",
            "<x:value>",
            "</x:value>",
            "<value/>",
            " ",
        ]
    ),
    max_size=14,
).map("".join)


@pytest.mark.parametrize("text", ["", "text"])
def test_a_value_that_is_no_call_is_refused(text: str) -> None:
    body = multicall([element("setParam", "/n", "/key", 1)])
    odd = body.replace(b"</struct></value>", f"</struct></value><value>{text}</value>".encode())
    assert odd != body
    with pytest.raises(XmlRpcError, match="is not a struct"):
        see(MulticallWatch(PLAIN.__contains__), odd)


@example("</value><value>", "</struct>")
@given(SOUP, st.sampled_from(["</value>", "</member>", "</struct>", "</data>", "<struct>"]))
def test_what_passes_python_reads_as_it_was_judged(soup: str, place: str) -> None:
    body = multicall([element("setParam", "/n", "/key", 1)]).replace(b"\n", b"").decode()
    for odd in (body.replace(place, soup + place, 1), body.replace(place, place + soup, 1)):
        try:
            see(MulticallWatch(PLAIN.__contains__), odd.encode())
        except XmlRpcError:
            continue
        read: Any = xmlrpc.client.loads(odd)
        (calls,), method = read
        assert method == MULTICALL
        assert {call["methodName"] for call in calls} <= PLAIN


@pytest.mark.parametrize("dialect", [py_reply, cpp_reply])
@pytest.mark.parametrize("status", [1, 0, -1])
def test_the_status_of_a_reply_is_told_by_its_head(dialect: Any, status: int) -> None:
    body = dialect([status, "text", "x" * 100_000])
    assert passing.status_of(body[: passing.HEAD_BYTES]) == status


@pytest.mark.parametrize(
    "body",
    [
        py_reply("1"),
        py_reply(["1", "", 0]),
        py_reply([[1, "", 0]]),
        py_reply({"faultCode": 1, "faultString": ""}),
        b"<methodResponse><fault><value><int>1</int></value></fault></methodResponse>",
        b"",
    ],
)
def test_what_has_no_status_is_read(body: bytes) -> None:
    assert passing.status_of(body) is None
