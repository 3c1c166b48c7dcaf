"""The TCPROS connection header, and how the proxy distinguishes TCPROS from HTTP."""

import struct
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.ros1.protocol.tcpros import (
    MAX_FIELDS,
    MAX_HEADER,
    HeaderError,
    decode_header,
    encode_header,
    header_length,
    speaks_http,
)

SUBSCRIBER = (
    b"\xb0\x00\x00\x00"
    b"\x20\x00\x00\x00message_definition=string data\n\n"
    b"\x25\x00\x00\x00callerid=/rostopic_4767_1316912741557"
    b"\x0a\x00\x00\x00latching=1"
    b"\x27\x00\x00\x00md5sum=992ce8a1687cec8c8bd883ec73ca41d1"
    b"\x0e\x00\x00\x00topic=/chatter"
    b"\x14\x00\x00\x00type=std_msgs/String"
)
"""The example of http://wiki.ros.org/ROS/Connection%20Header."""


def field(raw: bytes) -> bytes:
    return struct.pack("<I", len(raw)) + raw


def test_the_example_of_the_specification() -> None:
    assert header_length(SUBSCRIBER[:4]) == len(SUBSCRIBER) - 4
    assert decode_header(SUBSCRIBER[4:]) == {
        "message_definition": "string data\n\n",
        "callerid": "/rostopic_4767_1316912741557",
        "latching": "1",
        "md5sum": "992ce8a1687cec8c8bd883ec73ca41d1",
        "topic": "/chatter",
        "type": "std_msgs/String",
    }
    assert encode_header(decode_header(SUBSCRIBER[4:])) == SUBSCRIBER


CHARACTERS = st.characters(exclude_categories=["Cs"], exclude_characters="=")
NAMES = st.text(CHARACTERS, max_size=20).map(str.strip)
FIELDS = st.dictionaries(NAMES, st.text(st.characters(exclude_categories=["Cs"])), max_size=6)


@given(FIELDS)
def test_round_trip(fields: dict[str, str]) -> None:
    header = encode_header(fields)
    assert header_length(header[:4]) == len(header) - 4
    assert decode_header(header[4:]) == fields


def test_a_header_cut_inside_a_field_is_refused_at_every_byte() -> None:
    body = SUBSCRIBER[4:]
    complete = {0}
    position = 0
    while position < len(body):
        position += 4 + struct.unpack_from("<I", body, position)[0]
        complete.add(position)
    for end in range(len(body)):
        if end in complete:
            assert decode_header(body[:end]).items() <= decode_header(body).items()
        else:
            with pytest.raises(HeaderError):
                decode_header(body[:end])


@pytest.mark.parametrize(
    ("body", "complaint"),
    [
        (b"\x00", "length of a field"),
        (b"\x00\x00\x00", "length of a field"),
        (field(b"a=b") + b"\x01", "length of a field"),
        (b"\x04\x00\x00\x00a=b", "inside a field"),
        (b"\xff\xff\xff\xffa=b", "inside a field"),
        (b"\x00\x00\x00\x80a=b", "inside a field"),
        (field(b"a=b") + b"\x05\x00\x00\x00c=d", "inside a field"),
        (field(b"no equals sign"), "without '='"),
        (field(b""), "without '='"),
        (field(b"a=b") + field(b"c"), "without '='"),
        (field(b"a=1") + field(b"a=2"), "the same field twice"),
        (field(b"a=1") + field(b"a =2"), "the same field twice"),
    ],
)
def test_lengths_that_lead_outside_and_fields_without_equals_are_refused(
    body: bytes, complaint: str
) -> None:
    with pytest.raises(HeaderError, match=complaint):
        decode_header(body)


@pytest.mark.parametrize(
    ("raw", "fields"),
    [
        (b"", {}),
        (field(b"a="), {"a": ""}),
        (field(b"=b"), {"": "b"}),
        (field(b"a=b=c"), {"a": "b=c"}),
        (field(b" a=1"), {"a": "1"}),
        (field(b"a=\xff\xfe"), {"a": "\ufffd\ufffd"}),
    ],
)
def test_odd_fields_that_are_read(raw: bytes, fields: dict[str, str]) -> None:
    assert decode_header(raw) == fields


@given(st.binary(max_size=60))
def test_random_bytes_raise_nothing_but_header_errors(body: bytes) -> None:
    with suppress(HeaderError):
        fields = decode_header(body)
        assert sum(len(name) + len(value) for name, value in fields.items()) <= len(body)


@pytest.mark.parametrize(
    ("first", "http"),
    [
        (b"POST", True),
        (b"GET ", True),
        (b"HEAD", True),
        (b"PUT ", True),
        (b"OPTI", True),
        (b"PRI ", True),
        (b"post", True),
        (b"A B ", True),
        (SUBSCRIBER[:4], False),
        (b"\x00\x00\x00\x00", False),
        (b"\x40\x42\x0f\x00", False),  # 1,000,000
        (b"\xff\xff\xff\xff", False),
        (b"\x16\x03\x01\x02", False),  # TLS
        (b"POS\x00", False),
        (b"P\xd6ST", False),
        (b"12 4", False),
        (b"", False),
        (b"GET", False),
    ],
)
def test_the_first_four_bytes_tell_http_from_tcpros(first: bytes, http: bool) -> None:
    assert speaks_http(first) is http


@given(st.integers(0, MAX_HEADER))
def test_no_header_that_is_read_looks_like_http(length: int) -> None:
    first = struct.pack("<I", length)
    assert not speaks_http(first)
    assert header_length(first) == length


@given(st.binary(min_size=4, max_size=4))
def test_what_looks_like_http_is_no_header_that_is_read(first: bytes) -> None:
    if speaks_http(first):
        with pytest.raises(HeaderError, match="at most 1000000"):
            header_length(first)


def test_a_longer_header_is_refused() -> None:
    with pytest.raises(HeaderError, match="1000001"):
        header_length(struct.pack("<I", MAX_HEADER + 1))


def test_a_header_of_more_fields_than_anybody_sends_is_refused() -> None:
    fields = {f"f{n}": "" for n in range(MAX_FIELDS)}
    assert decode_header(encode_header(fields)[4:]) == fields
    with pytest.raises(HeaderError, match="more than"):
        decode_header(encode_header({**fields, "one": "more"})[4:])
