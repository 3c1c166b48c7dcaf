"""Rules of a policy: read, written, matched."""

import contextlib
from fnmatch import fnmatchcase

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.shared.policy import rules
from rosproxy.shared.policy.rules import Rule, RuleAction, RuleKind, parse_rule, parse_rules

NAMES = st.text("/ab_.[!", max_size=12)
GLOBS = st.text("/ab_.[!*?", max_size=10)
WORDS = st.text("/ab*?[]{}-#", min_size=1, max_size=9).map(lambda text: f"/{text}")
RULES = st.builds(
    Rule, st.sampled_from(RuleAction), st.sampled_from(RuleKind), WORDS, st.just("*") | WORDS
)


@given(RULES)
def test_a_rule_is_read_as_it_is_written(rule: Rule) -> None:
    assert parse_rule(str(rule)) == rule


@given(st.lists(RULES).map(tuple))
def test_rules_are_read_as_they_are_written(original: tuple[Rule, ...]) -> None:
    assert parse_rules(rules.format_rules(original)) == original


@given(st.text())
def test_any_text_is_rules_or_an_error(text: str) -> None:
    with contextlib.suppress(ValueError):
        parsed = parse_rules(text)
        assert parse_rules(rules.format_rules(parsed)) == parsed


def test_lines_semicolons_and_comments() -> None:
    text = "# cameras; deny publish /x\nallow publish /camera/front/*; deny publish /camera/*\n\n"
    assert list(map(str, parse_rules(text))) == [
        "allow publish /camera/front/*",
        "deny publish /camera/*",
    ]


@given(GLOBS, NAMES)
def test_a_glob_matches_as_a_shell_s(glob: str, name: str) -> None:
    literal = glob.replace("[", "[[]")
    assert rules.matches(glob, name) == fnmatchcase(name, literal)


def test_a_hostile_glob_takes_no_time() -> None:
    assert not rules.matches("/" + "*a" * 127, "/" + "a" * 100 + "b" * 900)


def test_a_glob_without_a_question_mark_takes_no_more_steps_than_the_name_has_characters() -> None:
    """A regular expression tries each text at each place: 60 globs took 0.1 s for a single name."""
    rules._expression.cache_clear()
    assert not rules.matches("*" + "a" * 254 + "b", "a" * 1024)
    assert not rules.matches("*" + "a" * 253 + "b*", "a" * 1024)
    assert rules.matches("*a*" + "a" * 200 + "*", "a" * 1024)
    assert rules._expression.cache_info().misses == 0


@given(GLOBS, NAMES, NAMES)
def test_what_may_match_below_a_prefix_is_never_missed(glob: str, prefix: str, rest: str) -> None:
    rule = Rule(RuleAction.DENY, RuleKind.GET_PARAM, glob)
    matched = rules.matches(glob, prefix + rest)
    if matched:
        assert rule.may_match_below(prefix)
    if rule.covers_below(prefix):
        assert matched


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("deny publish", "must be ACTION KIND GLOB"),
        ("deny publish /a from /b", "must be ACTION KIND GLOB"),
        ("forbid publish /a", "must be allow or deny"),
        ("deny write /a", "must be one of publish, serve"),
        ("deny publish camera/*", "must begin with /, * or ?"),
        ("deny publish /a by talker", "must begin with /, * or ?"),
        (f"deny publish /{'a' * 256}", "at most 256"),
    ],
)
def test_a_bad_rule_says_what_is_wrong(text: str, says: str) -> None:
    with pytest.raises(ValueError, match="rule ") as caught:
        parse_rule(text)
    assert says in str(caught.value)
    assert "such as" in str(caught.value)


def test_slave_methods_have_no_slash() -> None:
    assert parse_rule("deny slave get* by /spy").matches(RuleKind.SLAVE, "getBusInfo", "/spy")
