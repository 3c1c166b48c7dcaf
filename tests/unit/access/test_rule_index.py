"""Rules prepared for many names give the verdicts of the rules one by one, in bounded steps."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.access import rule_index
from rosproxy.access.rule_index import MOST_CALLER_COMPARISONS, RuleIndex
from rosproxy.shared.policy.layers import PolicyLayer, PolicyMode, decide
from rosproxy.shared.policy.rules import MOST_RULES, RuleKind, matches, parse_rules
from tests.unit.shared.policy.test_layers import LAYERS, NAMES, PUBLISH

ADDRESS = "10.0.0.1"
CALLERS = st.lists(st.sampled_from(["/a", "/b", "/ab", ""]), min_size=1, max_size=3)


def index_of(rules: str, mode: PolicyMode = PolicyMode.ENFORCE) -> RuleIndex:
    return RuleIndex.of_kind([PolicyLayer("web", parse_rules(rules), mode)], PUBLISH, ADDRESS)


@pytest.fixture
def comparisons(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str]]:
    """The comparisons of a glob with a name."""
    made: list[tuple[str, str]] = []

    def noting_matches(glob: str, name: str) -> bool:
        made.append((glob, name))
        return matches(glob, name)

    monkeypatch.setattr(rule_index, "matches", noting_matches)
    return made


@given(st.lists(LAYERS, max_size=3), st.sampled_from(RuleKind), NAMES)
def test_the_verdict_for_a_node_is_that_of_the_layers(
    policy: list[PolicyLayer], kind: RuleKind, name: str
) -> None:
    index = RuleIndex.of_kind(policy, kind, ADDRESS)
    assert index.judge(name, ["/a"]) == decide(policy, kind, name, "/a", ADDRESS)


@given(st.lists(LAYERS, max_size=3), st.sampled_from(RuleKind), NAMES, CALLERS)
def test_a_denial_for_one_of_several_nodes_is_a_denial_for_all(
    policy: list[PolicyLayer], kind: RuleKind, name: str, callers: list[str]
) -> None:
    verdict = RuleIndex.of_kind(policy, kind, ADDRESS).judge(name, callers)
    single = [decide(policy, kind, name, caller, ADDRESS) for caller in callers]
    assert verdict.allowed == all(one.allowed for one in single)
    assert (verdict.rule is None) == all(one.rule is None for one in single)


@pytest.mark.parametrize(
    "glob", ["/secret{}/*", "/robot/*secret{}", "*secret{}*x", "/robot/?secret{}", "/secret{}"]
)
def test_a_name_is_compared_with_few_of_many_rules(
    comparisons: list[tuple[str, str]], glob: str
) -> None:
    index = index_of(";".join(f"deny publish {glob.format(n)}" for n in range(MOST_RULES)))
    for number in range(255):
        assert index.judge(f"/robot/camera{number}/image_raw", [""]).allowed
    assert len(comparisons) < 255


def test_many_nodes_are_compared_with_rules_up_to_a_bound(
    comparisons: list[tuple[str, str]],
) -> None:
    rules = "deny publish /a by /n7; allow publish /a by /m*; deny publish /a by /x{}"
    index = index_of(rules)
    few = [f"/m{n}" for n in range(MOST_CALLER_COMPARISONS // 3)]
    assert index.judge("/a", few).allowed
    assert len(comparisons) <= MOST_CALLER_COMPARISONS + 3
    assert not index.judge("/a", [*few, "/n7"]).allowed
    comparisons.clear()
    many = few * 2
    assert str(index.judge("/a", many).rule) == "deny publish /a by /n7"
    assert len(comparisons) == 3


def test_rules_for_all_nodes_hold_for_any_number_of_nodes() -> None:
    index = index_of("allow publish /a; deny publish /* by /n; deny publish /b")
    many = ["/m"] * (MOST_CALLER_COMPARISONS + 1)
    assert index.judge("/a", many).allowed
    assert not index.judge("/b", many).allowed
