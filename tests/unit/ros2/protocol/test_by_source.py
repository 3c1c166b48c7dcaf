"""Split a message of several participants into a message for each participant."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.ros2.protocol.addressing import destination
from rosproxy.ros2.protocol.rtps import RtpsError, by_source, samples, source_vendor
from tests.unit.ros2.protocol.messages import PREFIX, data, message, submessage

OTHER = b"\x01\x10" + bytes(range(10, 20))
FOR = bytes([9]) * 12


def info_src(prefix: bytes = OTHER) -> bytes:
    return submessage(0x0C, 0, bytes(4) + b"\x02\x05\x01\x10" + prefix)


def info_dst(prefix: bytes = FOR) -> bytes:
    return submessage(0x0E, 0, prefix)


def test_a_message_of_one_participant_stays_as_it_is() -> None:
    whole = message(info_dst(), data(b"1st!"), data(b"2nd!"))
    assert by_source(whole) == [whole]


def test_each_participant_gets_a_message_of_its_own() -> None:
    whole = message(data(b"1st!"), info_src(), data(b"2nd!"), info_src(PREFIX), data(b"last"))
    first, other, last = by_source(whole)
    assert first == message(data(b"1st!"))
    assert other == b"RTPS\x02\x05\x01\x10" + OTHER + data(b"2nd!")
    assert source_vendor(other) == b"\x01\x10"
    assert [sample.prefix for sample in samples(last)] == [PREFIX]


def test_whom_it_is_meant_for_stays_so() -> None:
    whole = message(info_dst(), data(b"1st!"), info_src(), data(b"2nd!"))
    assert [destination(datagram) for datagram in by_source(whole)] == [FOR, FOR]


def test_who_says_nothing_gets_none() -> None:
    assert by_source(message(info_src())) == []
    assert by_source(message()) == [message()]


@pytest.mark.parametrize("rest", [submessage(0x0C, 0, bytes(8)), b"\x0c\x01\xff\xff", b"\x0c"])
def test_a_length_that_leads_outside_is_refused(rest: bytes) -> None:
    with pytest.raises(RtpsError):
        by_source(message(data(b"1st!"), rest))


@given(st.lists(st.sampled_from([data(b"some"), info_src(), info_dst(), info_src(PREFIX)])))
def test_all_samples_stay_with_who_has_written_them(submessages: list[bytes]) -> None:
    whole = message(*submessages)
    before = [(sample.prefix, sample.sequence) for sample in samples(whole)]
    after = [
        (sample.prefix, sample.sequence)
        for datagram in by_source(whole)
        for sample in samples(datagram)
    ]
    assert after == before


@given(
    st.lists(
        st.sampled_from(
            [data(b"some"), info_src(), info_dst(), info_dst(FOR + bytes(5000)), info_src(PREFIX)]
        )
    )
)
def test_the_parts_are_at_most_half_as_long_again(submessages: list[bytes]) -> None:
    """Each part repeated a long INFO_DST: 195 kB became 209 MB."""
    whole = message(*submessages)
    assert sum(map(len, by_source(whole))) <= 1.5 * len(whole)
