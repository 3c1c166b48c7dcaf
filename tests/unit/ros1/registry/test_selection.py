"""Sources that may use the proxy as their master."""

from ipaddress import ip_network

import pytest

from rosproxy.ros1.registry.client_kinds import ClientKind, client_kind, refusal

NETWORKS = (ip_network("10.0.0.0/24"), ip_network("fd00::/64"))
ADMITTED = ClientKind.ADMITTED
OUTSIDE = ClientKind.OUTSIDE
UNSELECTED = ClientKind.UNSELECTED


@pytest.mark.parametrize(
    ("address", "selected", "expected"),
    [
        ("10.0.0.5", None, ADMITTED),
        ("fd00::5", None, ADMITTED),
        ("10.0.1.5", None, OUTSIDE),
        ("", None, OUTSIDE),
        ("10.0.0.5", {"10.0.0.5"}, ADMITTED),
        ("10.0.0.6", {"10.0.0.5"}, UNSELECTED),
        ("10.0.0.5", set(), UNSELECTED),
        ("10.0.1.5", set(), OUTSIDE),
        ("10.0.1.5", {"10.0.1.5"}, ADMITTED),
    ],
)
def test_standing(address: str, selected: set[str] | None, expected: ClientKind) -> None:
    assert client_kind(address, NETWORKS, selected) is expected


def test_a_refusal_is_one_line_that_says_what_to_do() -> None:
    outside = refusal("10.0.1.5", OUTSIDE, NETWORKS)
    for text in ("10.0.1.5", "10.0.0.0/24, fd00::/64", "--inside-network"):
        assert text in outside
    unselected = refusal("10.0.0.5", UNSELECTED, NETWORKS)
    for text in ("10.0.0.5", "is not selected", "POST /containers"):
        assert text in unselected
    assert "\n" not in outside + unselected
