"""Slots: a limited number, and never all for a single source."""

from contextlib import ExitStack

import pytest

from rosproxy.net.fair_slots import FairSlots, NoSlot

NEAR = "192.0.2.1"
FAR = "192.0.2.2"


def test_a_source_has_its_share_and_leaves_the_rest_to_others() -> None:
    slots = FairSlots("replies are under way", 3, 2, "read one")
    with slots.slot(NEAR), slots.slot(NEAR):
        with pytest.raises(NoSlot, match=r"192\.0\.2\.1: 2 replies are under way already; read"):
            slots.slot(NEAR).__enter__()
        with slots.slot(FAR):
            assert slots.taken == 3
            with pytest.raises(NoSlot, match=r"^3 replies are under way already; read one$"):
                slots.slot("192.0.2.3").__enter__()


def test_what_has_ended_makes_room() -> None:
    slots = FairSlots("replies are under way", 1, 1)
    for _ in range(3):
        with pytest.raises(ValueError, match="a mistake"), slots.slot(NEAR):
            raise ValueError("a mistake")
    assert slots.taken == 0
    assert not slots._by_source


def test_the_addresses_of_an_ipv6_network_share() -> None:
    slots = FairSlots("replies are under way", 8, 4)
    with ExitStack() as stack:
        for number in (1, 1, 1, 1, 2, 2):
            stack.enter_context(slots.slot(f"2001:db8::{number}"))
        for full in ("2001:db8::1", "2001:db8::2", "2001:db8::3"):
            with pytest.raises(NoSlot):
                stack.enter_context(slots.slot(full))
        stack.enter_context(slots.slot("2001:db8:0:1::1"))
