"""Who inside is let in, and what is held of those who are not."""

import pytest

from rosproxy.ros2.protocol.rtps import RtpsError, message_header
from rosproxy.ros2.registry.selected import (
    LONGEST_HELD,
    MOST_HELD,
    MOST_HELD_EACH,
    NEWS_TIMEOUT,
    SelectedAddresses,
)

HERE, THERE = "172.30.0.5", "172.30.0.6"


def said(number: int, text: bytes = b"") -> bytes:
    return message_header(number.to_bytes(12, "big")) + text


def test_without_an_operator_all_are_let_in() -> None:
    assert SelectedAddresses(0.0).admits(HERE, 0.0)


def test_an_operator_is_waited_for() -> None:
    one = SelectedAddresses(NEWS_TIMEOUT)
    one.hold(HERE, said(1))
    assert not one.admits(HERE, 1.0)
    assert one.released(1.0) == []
    assert one.released(NEWS_TIMEOUT) == [(HERE, said(1))]
    assert one.released(NEWS_TIMEOUT) == []


def test_who_is_selected_is_let_in_and_nobody_else() -> None:
    one = SelectedAddresses(NEWS_TIMEOUT)
    one.hold(HERE, said(1))
    one.hold(THERE, said(2, b"at first"))
    one.hold(THERE, said(2, b"at last"))

    one.select([THERE])

    assert (one.admits(HERE, 99.0), one.admits(THERE, 0.0)) == (False, True)
    assert one.released(0.0) == [(THERE, said(2, b"at last"))]
    one.select([HERE])
    assert one.released(0.0) == [(HERE, said(1))]


def test_what_is_held_is_bounded() -> None:
    one = SelectedAddresses(NEWS_TIMEOUT)
    one.hold(HERE, said(1, bytes(LONGEST_HELD)))
    assert not one.held_announcements
    for number in range(2 * MOST_HELD_EACH):
        one.hold(HERE, said(number))
    assert len(one.held_announcements[HERE]) == MOST_HELD_EACH
    for number in range(2 * MOST_HELD):
        one.hold(f"172.31.{number // 256}.{number % 256}", said(1))
    assert len(one.held_announcements) == MOST_HELD
    with pytest.raises(RtpsError):
        one.hold(HERE, b"nonsense")
