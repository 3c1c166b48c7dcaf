"""Limits on resources in use: in all, and of a single source."""

import contextlib

import pytest

from rosproxy.shared.connections.budget import Budget, Charge, OverBudget


def test_a_source_has_a_share_and_leaves_the_rest_to_others() -> None:
    budget = Budget(100, 50, "bytes")
    budget.take("a", 50)
    with pytest.raises(OverBudget, match="at most 50 bytes are accepted at once from a"):
        budget.take("a", 1)
    budget.take("b", 50)
    with pytest.raises(OverBudget, match="at most 100 bytes are accepted at once; try again"):
        budget.take("c", 1)
    budget.give("a", 1)
    budget.take("c", 1)
    assert budget.used == 100


def test_a_charge_is_given_back_whatever_happens() -> None:
    budget = Budget(100, 50, "bytes")
    with Charge(budget, "a") as charge:
        charge.add(20)
        charge.add(30)
        assert budget.used == charge.taken == 50
        with pytest.raises(OverBudget):
            charge.add(1)
        assert budget.used == 50
    assert budget.used == 0
    with contextlib.suppress(LookupError), Charge(budget, "a") as charge:
        charge.add(50)
        raise LookupError
    assert budget.used == 0


def test_nothing_is_kept_of_a_source_that_holds_nothing() -> None:
    budget = Budget(100, 50, "bytes")
    for number in range(1000):
        with Charge(budget, f"source {number}") as charge:
            charge.add(1)
    assert not budget._used_by_source


def test_the_addresses_of_an_ipv6_network_share() -> None:
    budget = Budget(100, 50, "bytes")
    budget.take("2001:db8::1", 50)
    budget.take("2001:db8::2", 25)
    for address in ("2001:db8::2", "2001:db8::3"):
        with pytest.raises(OverBudget):
            budget.take(address, 1)
    budget.take("2001:db8:0:1::1", 25)
