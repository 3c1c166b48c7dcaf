"""The document at ``/status`` stays small, and nobody hides what a neighbour has."""

import json

from hypothesis import given
from hypothesis import strategies as st

from rosproxy.admin.status_bounds import (
    MOST,
    MOST_HIDDEN,
    bounded,
    bounded_names,
    fair_shares,
    first_hidden,
)
from rosproxy.admin.status_document import (
    ConnectionStatus,
    EndpointStatus,
    HiddenStatus,
    ParticipantStatus,
    ProxyStatus,
    to_json,
)

NAMES = tuple(f"/topic{number}" for number in range(20))


@given(st.lists(st.integers(0, 10**6), max_size=30), st.integers(0, 10**6))
def test_shares_are_fair(wanted: list[int], most: int) -> None:
    shares = fair_shares(wanted, most)
    assert all(0 <= share <= want for share, want in zip(shares, wanted, strict=True))
    assert sum(shares) <= most
    cut = [share for share, want in zip(shares, wanted, strict=True) if share < want]
    if cut:  # nobody has more than one that was cut, but for what does not divide
        assert max(shares) - min(cut) <= 1
        assert most - sum(shares) < len(wanted)


@given(st.lists(st.lists(st.text(max_size=300), max_size=30), max_size=6), st.integers(0, 5000))
def test_it_fits_and_counts_what_is_missing(given_names: list[list[str]], most: int) -> None:
    status = ProxyStatus(nodes=tuple(EndpointStatus(publishes=tuple(n)) for n in given_names))
    shortened = bounded(status, most)
    empty = ProxyStatus(nodes=(EndpointStatus(),) * len(given_names))
    longest = len(json.dumps(to_json(empty))) + most + 10 * len(given_names)
    assert len(json.dumps(to_json(shortened))) <= longest
    for names, node in zip(given_names, shortened.nodes, strict=True):
        assert node.left_out == len(names) - len(node.publishes)


def test_who_has_little_is_shown_in_whole() -> None:
    evil = EndpointStatus(
        nodes=("/evil",),
        subscribes=tuple("/" + "x" * 1000 + str(number) for number in range(2000)),
        connections=(ConnectionStatus(caller_id="y" * 1000),) * 2000,
    )
    good = EndpointStatus(
        nodes=("/good",), publishes=NAMES, connections=(ConnectionStatus(name="/topic1"),)
    )
    first, second, third = bounded(ProxyStatus(nodes=(evil, good, evil))).nodes
    assert second == good
    assert (first.nodes, first.connections) == (("/evil",), ())
    assert first == third
    assert first.left_out == 4000 - len(first.subscribes)
    assert len(first.subscribes) > 0.9 * MOST / 2 / 1010


def test_what_fits_is_left_as_it_is() -> None:
    status = ProxyStatus(nodes=(EndpointStatus(publishes=NAMES),))
    assert bounded(status) is status


def test_what_is_hidden_is_bounded_too() -> None:
    """A node may register any number of long names that a rule hides."""
    many = [HiddenStatus("publish", f"/{n}" + "x" * 1000, "/node", "a rule") for n in range(5000)]
    shown = first_hidden(many)
    assert 0 < sum(len(json.dumps(to_json(hidden))) for hidden in shown) < 1.1 * MOST_HIDDEN
    assert shown == many[: len(shown)]
    assert first_hidden(many[:3]) == many[:3]


@given(st.lists(st.lists(st.integers(0, 30), max_size=9), max_size=5), st.integers(0, 300))
def test_names_of_participants_fit(lengths: list[list[int]], most: int) -> None:
    """Sixty participants with the longest names had megabytes of them."""
    before = [
        ParticipantStatus(
            publishes=tuple("p" * length for length in own),
            subscribes=tuple("s" * length for length in own),
            services=tuple("v" * length for length in own),
        )
        for own in lengths
    ]
    after = bounded_names(before, most)
    shown = [(*p.publishes, *p.subscribes, *p.services) for p in after]
    assert sum(len(name) + 3 for names in shown for name in names) <= most
    for full, shortened, names in zip(before, after, shown, strict=True):
        everything = (*full.publishes, *full.subscribes, *full.services)
        assert everything[: len(names)] == names
        assert shortened.left_out == len(everything) - len(names)
