"""Which messages have samples."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.ros2.protocol.addressing import (
    LONGEST_WITHOUT_SAMPLES_BYTES,
    carries_samples,
    may_be_discovery,
    only_acknowledges,
)
from rosproxy.ros2.protocol.rtps import SubmessageId
from tests.unit.ros2.protocol.messages import data, fragment, message, submessage
from tests.unit.ros2.recorded import VENDORS, recorded

ACKNACK = submessage(SubmessageId.ACKNACK, 0, bytes(24))
HEARTBEAT = submessage(SubmessageId.HEARTBEAT, 0, bytes(28))
INVALIDATED_TIME = submessage(SubmessageId.INFO_TS, 0x02, b"")
EMPTY_PAD = submessage(SubmessageId.PAD, 0, b"")
SOURCE = submessage(SubmessageId.INFO_SRC, 0, bytes(20))
ENCRYPTED = submessage(0x33, 0, bytes(24))
SAMPLE = data(b"12345678", writer=0x00001203)


@pytest.mark.parametrize(
    ("datagram", "has_samples"),
    [
        (message(ACKNACK), False),
        (message(submessage(SubmessageId.INFO_DST, 0, bytes(12)), HEARTBEAT, ACKNACK), False),
        (message(ACKNACK, data(b"12345678", writer=0x1203)), True),
        (message(fragment(b"12345678", 1, 8, 8, writer=0x1203)), True),
        (message(ENCRYPTED), True),
        (message(*[ACKNACK] * (LONGEST_WITHOUT_SAMPLES_BYTES // 28)), True),
        (message(ACKNACK)[:-1], True),
        (message(INVALIDATED_TIME, SAMPLE), True),
        (message(INVALIDATED_TIME, ACKNACK), False),
        (message(EMPTY_PAD, SAMPLE), True),
        (message(submessage(SubmessageId.ACKNACK, 0, b""), SAMPLE), False),
        (b"", True),
    ],
)
def test_a_message_has_samples_unless_it_shows_that_it_has_none(
    datagram: bytes, has_samples: bool
) -> None:
    assert carries_samples(datagram) is has_samples


@given(st.binary(max_size=2 * LONGEST_WITHOUT_SAMPLES_BYTES))
def test_any_message_has_samples_or_not(rest: bytes) -> None:
    carries_samples(message() + rest)
    carries_samples(rest)


@given(st.lists(st.sampled_from([ACKNACK, HEARTBEAT, ENCRYPTED, SAMPLE]), min_size=1, max_size=5))
def test_a_message_without_samples_has_no_submessage_with_one(parts: list[bytes]) -> None:
    assert carries_samples(message(*parts)) is bool({ENCRYPTED, SAMPLE} & {*parts})


@given(st.lists(st.sampled_from([ACKNACK, HEARTBEAT, SOURCE, ENCRYPTED, SAMPLE]), max_size=50))
def test_a_message_of_several_participants_may_be_without_samples(parts: list[bytes]) -> None:
    assert only_acknowledges(message(*parts)) is not bool({ENCRYPTED, SAMPLE} & {*parts})


def test_a_malformed_message_does_not_count_as_one_without_samples() -> None:
    assert not only_acknowledges(message(ACKNACK)[:-1])


@pytest.mark.parametrize("vendor", VENDORS)
def test_recorded_user_data_has_messages_of_both_kinds(vendor: str) -> None:
    users = [d.content for d in recorded(vendor) if not may_be_discovery(d.content)]
    assert all(carries_samples(datagram) for datagram in users if b"hello" in datagram)
    assert {carries_samples(datagram) for datagram in users} == {True, False}
