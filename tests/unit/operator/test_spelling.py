"""The known name that a misspelt name probably means."""

import difflib

from hypothesis import given
from hypothesis import strategies as st

from rosproxy_operator.common.spelling import nearest

KNOWN = ("advertise-host", "inject")


def test_a_name_of_more_than_twice_the_length_may_be_near() -> None:
    assert nearest("advertise-host-of-the-robot-arm", KNOWN, 0.6) == "advertise-host"


@given(
    st.text("advertis-honjc", max_size=40),
    st.sampled_from([0.6, 0.75, 0.9]),
    st.sampled_from(["", *KNOWN]),
)
def test_no_name_is_too_long_to_be_near(end: str, cutoff: float, start: str) -> None:
    name = start + end
    expected = difflib.get_close_matches(name, KNOWN, n=1, cutoff=cutoff)
    assert nearest(name, KNOWN, cutoff) == "".join(expected)
