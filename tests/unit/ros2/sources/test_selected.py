"""Inside sources that the proxy accepts, and the records of other sources."""

import pytest

from rosproxy.ros2.protocol.rtps import RtpsError, message_header
from rosproxy.ros2.sources.selected import (
    FIRST_SELECTION_TIMEOUT_S,
    LONGEST_HELD_BYTES,
    MOST_HELD_ADDRESSES,
    MOST_HELD_PER_ADDRESS,
    SelectedAddresses,
)

ADDRESS = "172.30.0.5"
OTHER_ADDRESS = "172.30.0.6"


def said(number: int, text: bytes = b"") -> bytes:
    return message_header(number.to_bytes(12, "big")) + text


def test_without_an_operator_all_are_let_in() -> None:
    assert SelectedAddresses(0.0).admits(ADDRESS, 0.0)


def test_an_operator_is_waited_for() -> None:
    selected = SelectedAddresses(FIRST_SELECTION_TIMEOUT_S)
    selected.hold(ADDRESS, said(1))
    assert not selected.admits(ADDRESS, 1.0)
    assert selected.released(1.0) == []
    assert selected.released(FIRST_SELECTION_TIMEOUT_S) == [(ADDRESS, said(1))]
    assert selected.released(FIRST_SELECTION_TIMEOUT_S) == []


def test_who_is_selected_is_let_in_and_nobody_else() -> None:
    selected = SelectedAddresses(FIRST_SELECTION_TIMEOUT_S)
    selected.hold(ADDRESS, said(1))
    selected.hold(OTHER_ADDRESS, said(2, b"at first"))
    selected.hold(OTHER_ADDRESS, said(2, b"at last"))

    selected.select([OTHER_ADDRESS])

    assert (selected.admits(ADDRESS, 99.0), selected.admits(OTHER_ADDRESS, 0.0)) == (False, True)
    assert selected.released(0.0) == [(OTHER_ADDRESS, said(2, b"at last"))]
    selected.select([ADDRESS])
    assert selected.released(0.0) == [(ADDRESS, said(1))]


def test_what_is_held_is_bounded() -> None:
    selected = SelectedAddresses(FIRST_SELECTION_TIMEOUT_S)
    selected.hold(ADDRESS, said(1, bytes(LONGEST_HELD_BYTES)))
    assert not selected.held_announcements
    for number in range(2 * MOST_HELD_PER_ADDRESS):
        selected.hold(ADDRESS, said(number))
    assert len(selected.held_announcements[ADDRESS]) == MOST_HELD_PER_ADDRESS
    for number in range(2 * MOST_HELD_ADDRESSES):
        selected.hold(f"172.31.{number // 256}.{number % 256}", said(1))
    assert len(selected.held_announcements) == MOST_HELD_ADDRESSES
    with pytest.raises(RtpsError):
        selected.hold(ADDRESS, b"nonsense")
