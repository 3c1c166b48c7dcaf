"""XML-RPC documents: parsed values, and bytes that a rewrite leaves unchanged."""

import pytest

from rosproxy.ros1.protocol.xmlrpc import document as xmlrpc
from rosproxy.ros1.protocol.xmlrpc.document import XmlRpcError
from rosproxy.ros1.protocol.xmlrpc.limits import Limits
from rosproxy.ros1.protocol.xmlrpc.values import Edit
from tests.unit.builders import DIALECTS, cpp_call, py_call, py_reply, python_values, raw_call

URI = "http://10.0.0.5:40001/"

VALUES = {
    # what is sent: kind, text
    "<value>x</value>": ("string", "x"),
    "<value><string>x</string></value>": ("string", "x"),
    "<value> <string>x</string>\n</value>": ("string", "x"),
    "<value> x </value>": ("string", " x "),
    "<value><string> x\t</string></value>": ("string", " x\t"),
    "<value></value>": ("string", ""),
    "<value/>": ("string", ""),
    "<value />\n": ("string", ""),
    "<value><string></string></value>": ("string", ""),
    "<value><string/></value>": ("string", ""),
    "<value>\n<string />\n</value>": ("string", ""),
    "<value>a&amp;b &lt;c&gt; &#65;&#x42; &apos;&quot;</value>": ("string", "a&b <c> AB '\""),
    "<value><![CDATA[<a>&amp;]]></value>": ("string", "<a>&amp;"),
    "<value>a<![CDATA[b]]>c</value>": ("string", "abc"),
    "<value>a<!-- <value>no</value> -->b</value>": ("string", "ab"),
    "<value><string>a<!-- </string> -->b</string></value>": ("string", "ab"),
    "<value>a<?pi x?>b</value>": ("string", "ab"),
    "<value>one\r\ntwo\rthree\n</value>": ("string", "one\ntwo\nthree\n"),
    "<value>größe → 速度</value>": ("string", "größe → 速度"),
    "<value a='>' b=\"/\">x</value>": ("string", "x"),
    "<value><int>7</int></value>": ("int", "7"),
    "<value><i4>-7</i4></value>": ("int", "-7"),
    "<value><i8>7</i8></value>": ("int", "7"),
    "<value><double>1.5</double></value>": ("other", "1.5"),
    "<value><boolean>1</boolean></value>": ("other", "1"),
    "<value><base64>eHg=</base64></value>": ("other", "eHg="),
    "<value><dateTime.iso8601>20240101T00:00:00</dateTime.iso8601></value>": (
        "other",
        "20240101T00:00:00",
    ),
    "<value><nil/></value>": ("other", ""),
    "<value><ex:nil/></value>": ("other", ""),
    "<value><float>1.5</float></value>": ("other", "1.5"),
    "<value><array><data></data></array></value>": ("array", ""),
    "<value><array><data/></array></value>": ("array", ""),
    "<value><array/></value>": ("array", ""),
    "<value><struct></struct></value>": ("struct", ""),
    "<value><struct/></value>": ("struct", ""),
}


@pytest.mark.parametrize(("sent", "expected"), VALUES.items())
def test_a_value_is_found_with_its_kind_text_and_place(
    sent: str, expected: tuple[str, str]
) -> None:
    for body in (raw_call("<value>0</value>", sent, "<value>9</value>"), raw_call(sent)):
        params = xmlrpc.parse_call(body).params
        value = params[len(params) // 2]
        assert (value.kind, value.text) == expected
        assert value.raw.decode() == sent.strip()


@pytest.mark.parametrize("sent", [sent for sent, (kind, _) in VALUES.items() if kind == "string"])
def test_a_string_is_replaced_however_it_is_written(sent: str) -> None:
    body = raw_call("<value>before</value>", sent, "<value><int>3</int></value>")
    value = xmlrpc.parse_call(body).params[1]
    rewritten = xmlrpc.apply(body, [value.with_text("a<b>&'é")])
    assert python_values(rewritten) == ["before", "a<b>&'é", 3]
    head, tail = body.split(sent.strip().encode())
    assert rewritten.startswith(head)
    assert rewritten.endswith(tail)


@pytest.mark.parametrize("sent", VALUES)
def test_a_scalar_replaced_by_its_own_text_stays_byte_for_byte(sent: str) -> None:
    body = raw_call(sent)
    value = xmlrpc.parse_call(body).params[0]
    assert xmlrpc.apply(body, [value.with_text(value.text)]) == body


@pytest.mark.parametrize(
    ("sent", "becomes"),
    [
        ("<value>x</value>", f"<value>{URI}</value>"),
        ("<value><string>x</string></value>", f"<value><string>{URI}</string></value>"),
        ("<value> <string>x</string> </value>", f"<value> <string>{URI}</string> </value>"),
        ("<value><string/></value>", f"<value>{URI}</value>"),
        ("<value/>", f"<value>{URI}</value>"),
        ("<value></value>", f"<value>{URI}</value>"),
        ("<value><![CDATA[x]]></value>", f"<value>{URI}</value>"),
    ],
)
def test_a_replaced_string_keeps_its_type_tag(sent: str, becomes: str) -> None:
    body = raw_call(sent)
    edit = xmlrpc.parse_call(body).params[0].with_text(URI)
    assert xmlrpc.apply(body, [edit]) == raw_call(becomes)


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_replaced_number_keeps_its_type_tag(dialect: str) -> None:
    call, _ = DIALECTS[dialect]
    body = call("m", 40001)
    edit = xmlrpc.parse_call(body).params[0].with_text("45003")
    assert xmlrpc.apply(body, [edit]) == call("m", 45003)


@pytest.mark.parametrize(
    ("encoding", "text", "written"),
    [
        ("utf-8", "é→", "é→".encode()),
        ("UTF-8", "é→", "é→".encode()),
        ("iso-8859-1", "é→", b"\xe9&#8594;"),
        ("ISO-8859-1", "é→", b"\xe9&#8594;"),
        ("us-ascii", "é→", b"&#233;&#8594;"),
    ],
)
def test_text_is_written_in_the_encoding_that_the_document_declares(
    encoding: str, text: str, written: bytes
) -> None:
    body = raw_call("<value>x</value>", encoding=encoding)
    rewritten = xmlrpc.apply(body, [xmlrpc.parse_call(body).params[0].with_text(text)])
    assert written in rewritten
    assert python_values(rewritten) == [text]


@pytest.mark.parametrize("sent", ["é", "é&amp;", "<![CDATA[é]]>"])
def test_latin1_strings_are_read_as_such(sent: str) -> None:
    """Text with an entity or CDATA ended in an ExpatError, other text was read as UTF-8."""
    body = raw_call(f"<value>{sent}</value>", encoding="iso-8859-1")
    assert xmlrpc.parse_call(body).params[0].text == python_values(body)[0]


def test_a_byte_order_mark_moves_no_offset() -> None:
    body = b"\xef\xbb\xbf" + py_call("m", "before", "x")
    edit = xmlrpc.parse_call(body).params[1].with_text(URI)
    assert xmlrpc.apply(body, [edit]) == b"\xef\xbb\xbf" + py_call("m", "before", URI)


def test_a_self_closing_value_ends_where_its_tag_ends() -> None:
    """Not with the next tag, and white space may follow."""
    body = raw_call("<value><array><data><value/>\n<value>x</value><value/></data></array></value>")
    array = xmlrpc.parse_call(body).params[0]
    assert [item.raw for item in array.items] == [b"<value/>", b"<value>x</value>", b"<value/>"]
    removed = xmlrpc.apply(body, [array.items[0].removed(), array.items[2].removed()])
    assert python_values(removed) == [["x"]]


REFUSED = {
    "nothing": (b"", xmlrpc.PARSE_ERROR),
    "no XML": (b"hello", xmlrpc.PARSE_ERROR),
    "an open tag": (b"<methodCall>", xmlrpc.PARSE_ERROR),
    "two roots": (py_call("m") + b"<a/>", xmlrpc.PARSE_ERROR),
    "another root": (b"<a><methodName>m</methodName></a>", xmlrpc.INVALID_REQUEST),
    "a reply": (py_reply(1), xmlrpc.INVALID_REQUEST),
    "no method": (b"<methodCall><params/></methodCall>", xmlrpc.INVALID_REQUEST),
    "an empty method": (
        b"<methodCall><methodName> </methodName></methodCall>",
        xmlrpc.INVALID_REQUEST,
    ),
    "a DTD": (b"<!DOCTYPE m><methodCall/>", xmlrpc.PARSE_ERROR),
    "a DTD from elsewhere": (
        b'<!DOCTYPE m SYSTEM "http://10.0.0.1/evil.dtd">' + py_call("m")[22:],
        xmlrpc.PARSE_ERROR,
    ),
    "an entity": (
        b'<!DOCTYPE m [<!ENTITY a "b">]><methodCall><methodName>&a;</methodName></methodCall>',
        xmlrpc.PARSE_ERROR,
    ),
    "an unknown entity": (raw_call("<value>&a;</value>"), xmlrpc.PARSE_ERROR),
    "UTF-16": (py_call("m").decode().encode("utf-16"), xmlrpc.PARSE_ERROR),
    "UTF-16 little-endian": (b"<methodCall/>".decode().encode("utf-16-le"), xmlrpc.PARSE_ERROR),
    "UTF-16 big-endian": (b"<methodCall/>".decode().encode("utf-16-be"), xmlrpc.PARSE_ERROR),
    "UTF-7": (raw_call(encoding="utf-7"), xmlrpc.PARSE_ERROR),
    "UTF-16 declared": (
        raw_call().replace(b"encoding='utf-8'", b"encoding='utf-16'"),
        xmlrpc.PARSE_ERROR,
    ),
    "EBCDIC declared": (
        raw_call().replace(b"encoding='utf-8'", b"encoding='cp037'"),
        xmlrpc.PARSE_ERROR,
    ),
    "no UTF-8": (raw_call("<value>x</value>").replace(b"x", b"\xe9"), xmlrpc.PARSE_ERROR),
    "a control character": (raw_call("<value>\x01</value>"), xmlrpc.PARSE_ERROR),
    "a type without a value": (raw_call("<int>1</int>"), xmlrpc.INVALID_REQUEST),
    "an array without a value": (raw_call("<array><data/></array>"), xmlrpc.INVALID_REQUEST),
    "a type in a type": (
        raw_call("<value><string><int>1</int></string></value>"),
        xmlrpc.INVALID_REQUEST,
    ),
    "a member without a name": (
        raw_call("<value><struct><member><value>1</value></member></struct></value>"),
        xmlrpc.INVALID_REQUEST,
    ),
    "a member without a value": (
        raw_call("<value><struct><member><name>a</name></member></struct></value>"),
        xmlrpc.INVALID_REQUEST,
    ),
    "a name in a name": (
        raw_call("<value><struct><member><name>a<name>b</name></name></member></struct></value>"),
        xmlrpc.PARSE_ERROR,
    ),
    "a method in a method": (raw_call(method="m<methodName/>m"), xmlrpc.INVALID_REQUEST),
    "two methods": (
        b"<methodCall><methodName>shutdown</methodName><methodName>getPid</methodName>"
        b"</methodCall>",
        xmlrpc.INVALID_REQUEST,
    ),
    "a method that only XmlRpc++ sees": (
        b"<methodCall><!-- <methodName>shutdown</methodName> --><methodName>getPid</methodName>"
        b"</methodCall>",
        xmlrpc.INVALID_REQUEST,
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_call_is_refused_with_a_fault_code(name: str) -> None:
    body, code = REFUSED[name]
    with pytest.raises(XmlRpcError) as caught:
        xmlrpc.parse_call(body)
    assert caught.value.code == code
    assert str(caught.value)


@pytest.mark.parametrize("body", [py_call("m", "x"), b"", b"<methodResponse/>", b"<a/>"])
def test_what_is_no_response_is_refused(body: bytes) -> None:
    with pytest.raises(XmlRpcError):
        xmlrpc.parse_reply(body)


def test_a_billion_laughs_are_refused_before_they_are_told() -> None:
    entities = "".join(f'<!ENTITY a{i} "{f"&a{i - 1};" * 10}">' for i in range(1, 30))
    body = f'<!DOCTYPE m [<!ENTITY a0 "ha">{entities}]>'.encode() + raw_call("<value>&a29;</value>")
    with pytest.raises(XmlRpcError, match="document type"):
        xmlrpc.parse_call(body.replace(b"<?xml version='1.0' encoding='utf-8'?>", b""))


def test_depth_is_bounded() -> None:
    def nested(depth: int) -> bytes:
        opened = "<value><array><data>" * depth
        return raw_call(f"{opened}{'</data></array></value>' * depth}")

    assert xmlrpc.parse_call(nested(20)).params
    with pytest.raises(XmlRpcError, match="deeper than 64"):
        xmlrpc.parse_call(nested(21))
    with pytest.raises(XmlRpcError, match="deeper than 64"):
        xmlrpc.parse_call(nested(100_000))


def test_only_the_name_in_a_member_is_a_member_s() -> None:
    member = "<member><name>a</name><value>1</value></member>"
    body = raw_call(f"<value><struct><name>b</name>{member}<name>c</name></struct></value>")
    assert xmlrpc.parse_call(body).params[0].members == ["a"]


@pytest.mark.parametrize("odd", ["", "<!-- -->"])
def test_the_number_of_elements_is_bounded(odd: str) -> None:
    body = raw_call(f"<value>{odd}x</value>", "<value/>")  # two of param and value, and three
    assert xmlrpc.parse_call(body, Limits(1000, 7)).params
    with pytest.raises(XmlRpcError, match="more than 6 elements"):
        xmlrpc.parse_call(body, Limits(1000, 6))


ATTRIBUTES = "".join(f" a{number}=''" for number in range(100))


@pytest.mark.parametrize("content", [" " * xmlrpc.LONGEST_TAG, ATTRIBUTES * 10, " a='>'" * 1000])
@pytest.mark.parametrize("name", ["value", "größe"])
def test_the_length_of_a_tag_is_bounded(name: str, content: str) -> None:
    """A tag of 4 MiB took 460 MB: 100 bytes for each byte, and 200 for each attribute."""
    with pytest.raises(XmlRpcError, match=f"a tag of more than {xmlrpc.LONGEST_TAG} bytes"):
        xmlrpc.parse_call(raw_call(f"<{name}{content}>x</{name}>"))


def test_long_texts_and_comments_are_no_tags() -> None:
    text = "it's " * xmlrpc.LONGEST_TAG
    body = raw_call(f"<value a='{'x' * 1000}>'>{text}<!-- {text}--><?pi {text}?>\"</value>")
    assert xmlrpc.parse_call(body).params[0].text == f'{text}"'


def test_attributes_count_as_elements() -> None:
    body = raw_call(f"<value{ATTRIBUTES}>x</value>", "<value/>")
    assert xmlrpc.parse_call(body, Limits(10_000, 107)).params
    with pytest.raises(XmlRpcError, match="more than 106 elements and attributes"):
        xmlrpc.parse_call(body, Limits(10_000, 106))


@pytest.mark.parametrize("odd", ["", "<!-- -->"])
def test_the_size_is_bounded(odd: str) -> None:
    body = raw_call(f"<value>{odd}x</value>")
    assert xmlrpc.parse_call(body, Limits(len(body), 10)).params
    with pytest.raises(XmlRpcError, match=f"longer than {len(body) - 1} bytes"):
        xmlrpc.parse_call(body, Limits(len(body) - 1, 10))


@pytest.mark.parametrize("name", ["methodName", "value", "string", "array", "struct", "name"])
def test_what_python_would_read_in_spite_of_a_prefix_is_refused(name: str) -> None:
    body = raw_call(f"<value>a</value><x:{name}>b</x:{name}>")
    with pytest.raises(XmlRpcError, match="must not have a namespace prefix"):
        xmlrpc.parse_call(body)


def test_extension_types_have_a_prefix() -> None:
    assert xmlrpc.parse_call(raw_call("<value><ex:i8>5</ex:i8></value>")).params[0].kind == "other"


@pytest.mark.parametrize(
    "name", ["constructor", "__proto__", "__class__", "toString", "", "a.b", "<", "é", "%s", "{}"]
)
def test_names_have_no_meaning(name: str) -> None:
    body = py_call("m", {name: "x", "other": 1}, [name])
    struct = xmlrpc.parse_call(body).params[0]
    member = struct.member(name)
    assert member
    assert member.text == "x"
    assert struct.member(name + "?") is None
    assert xmlrpc.python_value(struct) == {name: "x", "other": 1}


@pytest.mark.parametrize("method", ["constructor", "__proto__", "__init__", "m", "größe", "a b"])
def test_any_method_name_is_read(method: str) -> None:
    for call in (py_call, cpp_call):
        assert xmlrpc.parse_call(call(method)).method == method


@pytest.mark.parametrize("text", ["", "x", "1.5", "0x10", "--1", "9" * 5000])
def test_an_int_that_is_none_has_no_number(text: str) -> None:
    value = xmlrpc.parse_call(raw_call(f"<value><int>{text}</int></value>")).params[0]
    assert value.integer() is None
    assert value.string() is None


def test_parameters_that_are_missing_or_of_another_type_are_no_strings() -> None:
    call = xmlrpc.parse_call(py_call("m", "x", 1, ["y"], {"z": "z"}))
    assert [call.string(index) for index in range(6)] == ["x", None, None, None, None, None]


def test_python_values_of_a_status_triple() -> None:
    for _, reply in DIALECTS.values():
        value = xmlrpc.parse_reply(reply([1, "", [["/a", ["/b"]], {"c": [2]}, "d"]]))
        assert value
        assert xmlrpc.python_value(value) == [1, "", [["/a", ["/b"]], {"c": [2]}, "d"]]


def test_a_fault_is_no_value() -> None:
    assert xmlrpc.parse_reply(xmlrpc.dump_fault(4, "too much")) is None


def test_edits_are_done_in_document_order_whatever_order_they_come_in() -> None:
    edits = [Edit(4, 5, b"E"), Edit(0, 1, b""), Edit(2, 2, b"x"), Edit(2, 2, b"y"), Edit(2, 3, b"")]
    assert xmlrpc.apply(b"abcdef", edits) == b"bxydEf"
