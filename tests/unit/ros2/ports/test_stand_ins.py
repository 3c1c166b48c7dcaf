"""The port of a stand-in follows from the locator outside."""

from collections.abc import Callable

from hypothesis import given
from hypothesis import strategies as st

from rosproxy.ros2.ports.stand_ins import MOST_SHARING, stand_in_port
from rosproxy.shared.ports import STAND_IN_PORTS


@given(st.text(max_size=40))
def test_the_port_of_a_stand_in_follows_from_its_key(key: str) -> None:
    """Other locators do not matter, unless too many share a port."""

    def chosen(users: Callable[[int], int]) -> int | None:
        return stand_in_port(key, users, lambda _: False)

    port = chosen(lambda _: 0)
    assert port is not None
    assert port in STAND_IN_PORTS
    assert chosen(lambda _: MOST_SHARING - 1) == port
    assert chosen(lambda candidate: MOST_SHARING if candidate == port else 0) not in (None, port)
    assert chosen(lambda _: MOST_SHARING) is None


@given(st.text(max_size=40), st.integers(0, 2000))
def test_a_stand_in_is_found_behind_a_long_range_that_is_held(key: str, length: int) -> None:
    """The proxy's range may overlap the ports of stand-ins, and be longer than the number
    of tries.
    """
    wanted = stand_in_port(key, lambda _: 0, lambda _: False)
    assert wanted is not None
    port = stand_in_port(key, lambda _: 0, lambda candidate: wanted <= candidate < wanted + length)
    assert port is not None
    assert not wanted <= port < wanted + length
