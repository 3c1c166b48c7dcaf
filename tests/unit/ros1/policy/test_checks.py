"""The policy's checks of what nodes inside ask of outside: their cost has a bound."""

from collections.abc import Callable
from typing import Any

import pytest

from rosproxy.access import rule_index
from rosproxy.access.access_policy import AccessPolicy
from rosproxy.access.rule_index import MOST_CALLER_COMPARISONS
from rosproxy.ros1.policy.checks import Ros1Policy
from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.shared.output.problems import Problems
from rosproxy.shared.policy import rules
from rosproxy.shared.policy.layers import PolicyLayer
from rosproxy.shared.policy.rules import parse_rules
from rosproxy.telemetry.metrics import Metrics
from rosproxy.telemetry.refusals import Refusals
from tests.unit.builders import add_node, add_registration, make_addressing

ADDRESS = "10.0.0.5"
RULES = 100
NODES = 600
NAMES_PER_NODE = 10


@pytest.fixture
def comparisons(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The globs that are compared with a name."""
    made: list[str] = []

    def noting(real: Callable[[str, str], bool]) -> Callable[[str, str], bool]:
        def matches(glob: str, name: str) -> bool:
            made.append(glob)
            return real(glob, name)

        return matches

    for module in (rules, rule_index):
        monkeypatch.setattr(module, "matches", noting(module.matches))
    return made


def policy_of(text: str) -> Ros1Policy:
    """A policy at an address with many nodes of many names."""
    metrics = Metrics()
    refusals = Refusals(metrics, Problems(), lambda: 0.0)
    policy = AccessPolicy([PolicyLayer("web", parse_rules(text))], [], metrics, refusals)
    addressing = make_addressing(listen=(45000, 45000 + NODES))
    for number in range(NODES):
        endpoint = add_node(addressing, f"http://{ADDRESS}:{40000 + number}/")
        for name in range(NAMES_PER_NODE):
            add_registration(addressing, endpoint, Kind.SUBSCRIBER, "/t", f"/n{number}_{name}")
    unused: Any = None
    return Ros1Policy(policy, addressing.registry, addressing, unused, unused)


def test_a_node_that_the_proxy_knows_is_judged_by_its_own_name(comparisons: list[str]) -> None:
    policy = policy_of(";".join(f"deny subscribe /t by /x{n}" for n in range(RULES)))
    assert policy.check_inside("topic", "/t", ADDRESS, "/n7_7") is None
    assert len(comparisons) <= 3 * RULES


def test_an_unknown_name_is_judged_with_all_names_at_the_address(comparisons: list[str]) -> None:
    policy = policy_of("deny subscribe /t by /n7_7; deny subscribe /u by /other")
    assert policy.check_inside("topic", "/t", ADDRESS, "/unknown") is not None
    assert policy.check_inside("topic", "/u", ADDRESS, "/unknown") is None
    assert policy.check_inside("topic", "/t", "10.0.0.99", "/unknown") is None
    assert len(comparisons) <= 2 * (MOST_CALLER_COMPARISONS + RULES)


def test_too_many_names_for_a_rule_count_as_concerned(comparisons: list[str]) -> None:
    policy = policy_of(";".join(f"deny subscribe /t by /x{n}" for n in range(RULES)))
    assert policy.check_inside("topic", "/t", ADDRESS, "/unknown") is not None
    assert policy.check_inside("topic", "/other", ADDRESS, "/unknown") is None
    assert len(comparisons) <= RULES
