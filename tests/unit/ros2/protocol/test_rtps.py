"""RTPS messages: parsed content, refused messages, and edits that change nothing else."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.ros2.protocol.addressing import destinations
from rosproxy.ros2.protocol.rtps import (
    MOST_SUBMESSAGES,
    Fragments,
    Overwrite,
    RtpsError,
    Span,
    apply,
    samples,
    source_prefix,
)
from tests.unit.ros2.protocol.messages import (
    PREFIX,
    SPDP_WRITER,
    VALUES,
    data,
    fragment,
    message,
    parameter,
    parameter_list,
    payload,
    submessage,
)

BOTH = pytest.mark.parametrize("little", [True, False], ids=["little", "big"])
PARAMETERS = st.lists(
    st.tuples(st.integers(2, 0xFFFF), VALUES),
    max_size=8,
)


@BOTH
def test_a_sample_is_found_with_its_writer_and_its_place(little: bool) -> None:
    content = payload([(0x50, bytes(16))], little)
    whole = message(
        submessage(0x09, 0, bytes(8), little),  # INFO_TS
        data(content, sequence=2**33 + 5, little=little),
    )
    (sample,) = samples(whole)
    assert (sample.prefix, sample.writer, sample.sequence) == (PREFIX, SPDP_WRITER, 2**33 + 5)
    assert (sample.is_little_endian, sample.inline_qos, sample.is_key_only) == (little, None, False)
    assert sample.payload is not None
    assert whole[sample.payload.start : sample.payload.end] == content


@BOTH
def test_inline_qos_stands_before_the_payload(little: bool) -> None:
    qos = parameter_list([(0x71, b"\0\0\0\3")], little)
    content = payload([], little)
    whole = message(data(content, qos=qos, little=little, key=True))
    (sample,) = samples(whole)
    assert sample.is_key_only
    assert sample.inline_qos is not None
    assert sample.payload is not None
    assert whole[sample.inline_qos.start : sample.inline_qos.end] == qos
    assert whole[sample.payload.start : sample.payload.end] == content


@BOTH
def test_a_fragment_tells_which_part_it_is(little: bool) -> None:
    whole = message(fragment(b"x" * 250, 3, 100, 450, sequence=7, little=little))
    (sample,) = samples(whole)
    assert sample.fragments == Fragments(first=3, count=3, size=100, total=450)
    assert sample.sequence == 7
    assert sample.payload is not None
    assert whole[sample.payload.start : sample.payload.end] == b"x" * 250


def test_another_participants_samples_are_known_as_its_own() -> None:
    other = bytes(range(100, 112))
    source = submessage(0x0C, 0, bytes(4) + b"\x02\x03\x01\x10" + other)
    first, second = samples(message(data(b"abcd"), source, data(b"abcd")))
    assert (first.prefix, second.prefix) == (PREFIX, other)


def test_the_last_submessage_may_tell_no_length() -> None:
    body = data(b"abcd")
    (sample,) = samples(message(body[:2] + b"\0\0" + body[4:]))
    assert sample.payload is not None


@pytest.mark.parametrize("size", [5, 6, 7])
def test_the_last_submessage_may_have_any_length(size: int) -> None:
    (sample,) = samples(message(submessage(0x80, 0, b"abcd"), data(bytes(size))))
    assert sample.payload is not None


def test_a_pad_of_no_length_is_no_last_submessage() -> None:
    assert len(samples(message(submessage(0x01, 0, b""), data(b"abcd")))) == 1


@given(
    st.lists(
        st.tuples(st.integers(0x80, 0xFF), st.integers(1, 15).map(lambda words: bytes(4 * words))),
        max_size=9,
    )
)
def test_what_is_not_known_is_passed_over(unknown: list[tuple[int, bytes]]) -> None:
    unknown_submessages = [submessage(kind, 0, body) for kind, body in unknown]
    read_samples = samples(message(*unknown_submessages, data(b"abcd"), *unknown_submessages))
    assert [sample.writer for sample in read_samples] == [SPDP_WRITER]


@pytest.mark.parametrize(
    "datagram",
    [
        b"",
        b"RTPS",
        b"RTPX" + bytes(16),
        b"RTPS\x01\x01" + bytes(14),
        message(b"\x15"),
        message(b"\x15\x05\xff\xff"),
        message(submessage(0x15, 0x04, bytes(19))),
        message(submessage(0x16, 0x00, bytes(31))),
        message(submessage(0x0C, 0, bytes(8))),
        message(submessage(0x15, 0x04, struct.pack("<HH", 0, 0xFFF0) + bytes(16))),
        message(submessage(0x15, 0x04, struct.pack("<HH", 0, 4) + bytes(16))),
        message(submessage(0x15, 0x06, struct.pack("<HH", 0, 16) + bytes(20) + b"\0\0")),
        message(*[submessage(0x80, 0, b"")[:2] + b"\4\0abcd"] * (MOST_SUBMESSAGES + 1)),
        message(submessage(0x80, 0, b"abc"), data(b"abcd")),
        message(data(b"abcd", qos=b"\x71\0\3\0abc" + parameter(1, b""))),
    ],
)
def test_what_leads_outside_is_refused(datagram: bytes) -> None:
    with pytest.raises(RtpsError):
        samples(datagram)


@given(st.binary(max_size=400))
def test_any_bytes_are_read_or_refused(tail: bytes) -> None:
    for datagram in (tail, message(tail), message(data(tail)), message(b"\x15\x07", tail)):
        try:
            read_samples = samples(datagram)
        except RtpsError:
            continue
        for sample in read_samples:
            for span in (sample.inline_qos, sample.payload):
                assert span is None or 0 <= span.start <= span.end <= len(datagram)


@given(PARAMETERS, PARAMETERS, st.booleans(), st.data())
def test_a_message_cut_short_or_changed_never_leads_outside(
    qos: list[tuple[int, bytes]],
    parameters: list[tuple[int, bytes]],
    little: bool,
    more: st.DataObject,
) -> None:
    content = data(payload(parameters, little), qos=parameter_list(qos, little), little=little)
    whole = bytearray(message(content, content))
    for _ in range(more.draw(st.integers(0, 3))):
        whole[more.draw(st.integers(20, len(whole) - 1))] = more.draw(st.integers(0, 255))
    cut = bytes(whole[: more.draw(st.integers(0, len(whole)))])
    try:
        read_samples = samples(cut)
    except RtpsError:
        return
    assert all(sample.payload is None or sample.payload.end <= len(cut) for sample in read_samples)


@given(st.binary(min_size=1, max_size=200), st.data())
def test_an_edit_leaves_all_other_bytes(datagram: bytes, more: st.DataObject) -> None:
    at = more.draw(st.integers(0, len(datagram) - 1))
    after = more.draw(st.binary(max_size=len(datagram) - at))
    changed = apply(datagram, [Overwrite(at, after)])
    assert len(changed) == len(datagram)
    assert changed[at : at + len(after)] == after
    assert changed[:at] + changed[at + len(after) :] == datagram[:at] + datagram[at + len(after) :]


def test_the_inline_qos_of_a_datagram_has_a_length() -> None:
    """A datagram of 64 kB with parameters of four bytes took 20 ms."""
    qos = parameter_list([(0x1234, b"")] * 500)
    whole = message(*[data(b"some", qos=qos)] * 31)
    with pytest.raises(RtpsError, match="bytes of inline QoS"):
        samples(whole)
    assert len(samples(message(*[data(b"some", qos=qos)] * 8))) == 8


def test_an_edit_outside_is_an_error() -> None:
    for edit in (Overwrite(3, b"ab"), Overwrite(-1, b"a")):
        with pytest.raises(ValueError, match="edit of bytes"):
            apply(b"abcd", [edit])


def test_the_prefix_of_a_message() -> None:
    assert source_prefix(message()) == PREFIX
    assert samples(message()) == []
    assert Span(1, 2) != Span(1, 3)


def test_a_message_is_for_all_participants_that_it_names() -> None:
    """A message of Cyclone DDS may be for several participants at an address."""
    first = bytes([1] * 12)
    second = bytes([2] * 12)
    to_first, to_second, to_all = (submessage(0x0E, 0, p) for p in (first, second, bytes(12)))
    ack = submessage(0x06, 1, bytes(24))
    info = submessage(0x09, 1, bytes(8))
    assert destinations(message(info, to_first, ack, to_second, info, ack)) == {first, second}
    assert destinations(message(to_first, ack, to_second)) == {first}
    assert destinations(message(ack, to_first, ack)) == set()
    assert destinations(message(to_first, ack, to_all, ack)) == set()
    assert destinations(message(info)) == set()
    extension = submessage(0x00, 1, bytes(8))
    unknown = submessage(0x80, 1, bytes(56))
    assert destinations(message(extension, to_first, ack, to_all, unknown)) == {first}
