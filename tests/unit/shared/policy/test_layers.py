"""Layers: a policy allows only what all layers allow."""

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.shared.policy import layers
from rosproxy.shared.policy.layers import PolicyLayer, PolicyMode, decide, decide_below, may_deny
from rosproxy.shared.policy.rules import RuleKind, parse_rules
from tests.unit.shared.policy.test_rules import RULES

LAYERS = st.builds(
    PolicyLayer,
    st.sampled_from(["administrator", "label of container talker"]),
    st.lists(RULES, max_size=4).map(tuple),
    st.sampled_from(PolicyMode),
    st.none() | st.frozensets(st.sampled_from(["10.0.0.1", "10.0.0.2"])),
)
NAMES = st.text("/ab", max_size=6).map(lambda text: f"/{text}")
PUBLISH = RuleKind.PUBLISH


def layer(rules: str, name: str = "administrator", mode: str = "enforce") -> PolicyLayer:
    return PolicyLayer(name, parse_rules(rules), PolicyMode(mode))


def test_the_first_rule_that_matches_decides() -> None:
    policy = [layer("allow publish /camera/front; deny publish /camera/*")]
    assert decide(policy, PUBLISH, "/camera/front", "/driver", "").allowed
    verdict = decide(policy, PUBLISH, "/camera/rear", "/driver", "")
    assert not verdict.allowed
    assert verdict.reason == "policy of administrator: deny publish /camera/*"
    assert decide(policy, PUBLISH, "/odom", "/driver", "").allowed
    assert decide(policy, RuleKind.SUBSCRIBE, "/camera/rear", "/driver", "").allowed


def test_a_rule_may_be_for_one_node() -> None:
    policy = [layer("deny publish * by /driver")]
    assert decide(policy, PUBLISH, "/a", "/other", "").allowed
    assert not decide(policy, PUBLISH, "/a", "/driver", "").allowed


def test_a_layer_may_be_for_some_addresses() -> None:
    policy = [
        PolicyLayer("label", parse_rules("deny publish *"), addresses=frozenset(["10.0.0.1"]))
    ]
    assert decide(policy, PUBLISH, "/a", "/n", "10.0.0.2").allowed
    assert not decide(policy, PUBLISH, "/a", "/n", "10.0.0.1").allowed


def test_audit_tells_and_enforcement_goes_first() -> None:
    audit = layer("deny publish /a", "trial", "audit")
    enforce = layer("deny publish /a")
    told = decide([audit], PUBLISH, "/a", "/n", "")
    assert told.allowed
    assert (told.layer, told.mode) == ("trial", PolicyMode.AUDIT)
    verdict = decide([audit, enforce], PUBLISH, "/a", "/n", "")
    assert (verdict.allowed, verdict.layer) == (False, "administrator")


@given(st.lists(LAYERS, max_size=3), LAYERS, st.sampled_from(RuleKind), NAMES)
def test_one_more_layer_only_narrows(
    policy: list[PolicyLayer], more: PolicyLayer, kind: RuleKind, name: str
) -> None:
    if not decide(policy, kind, name, "/a", "10.0.0.1").allowed:
        assert not decide([*policy, more], kind, name, "/a", "10.0.0.1").allowed


@given(st.lists(LAYERS, max_size=3), st.sampled_from(RuleKind), NAMES, NAMES)
def test_nothing_below_an_allowed_prefix_is_denied(
    policy: list[PolicyLayer], kind: RuleKind, prefix: str, rest: str
) -> None:
    if decide_below(policy, kind, prefix, "/a", "10.0.0.1").allowed:
        assert decide(policy, kind, prefix + rest, "/a", "10.0.0.1").allowed


@given(st.lists(LAYERS, max_size=3), st.sampled_from(RuleKind), NAMES)
def test_what_is_denied_may_be(policy: list[PolicyLayer], kind: RuleKind, name: str) -> None:
    if not decide(policy, kind, name, "/a", "10.0.0.1").allowed:
        assert may_deny(policy, [kind], ["/b", "/a"], "10.0.0.1")


@given(st.lists(LAYERS, max_size=3), st.sampled_from(RuleKind), NAMES)
def test_rules_of_other_kinds_decide_nothing(
    policy: list[PolicyLayer], kind: RuleKind, name: str
) -> None:
    mine = layers.of_kind(policy, kind)
    assert decide(mine, kind, name, "/a", "10.0.0.1") == decide(
        policy, kind, name, "/a", "10.0.0.1"
    )


def test_an_allow_list_lets_its_namespaces_be_read() -> None:
    policy = [layer("allow get-param /arm/*; allow get-param /arm; deny get-param *")]
    kind = RuleKind.GET_PARAM
    assert decide_below(policy, kind, "/arm/", "/n", "").allowed
    assert decide_below(policy, kind, "/arm/joints/", "/n", "").allowed
    assert not decide_below(policy, kind, "/", "/n", "").allowed


@given(st.lists(LAYERS, max_size=3))
def test_layers_are_read_as_they_are_written(policy: list[PolicyLayer]) -> None:
    as_json = msgspec.json.decode(msgspec.json.encode(layers.layers_as_json(policy)))
    assert layers.read_layers(as_json) == tuple(policy)


@pytest.mark.parametrize(
    ("value", "says"),
    [
        ({}, "Expected `array`"),
        ([{"name": "a"}], "rules"),
        ([{"name": "a", "rules": ["deny publish a"]}], "layer 'a': rule 'deny publish a'"),
        ([{"name": " ", "rules": []}], "must have 1 to 200"),
        ([{"name": "a", "rules": [], "addresses": ["talker"]}], "layer 'a': addresses"),
        ([{"name": "a", "rules": [], "mode": "off"}], "mode"),
        ([{"name": "a", "rules": [], "more": 1}], "more"),
        ([{"name": "a", "rules": ["deny publish *"] * 1001}], "1001 rules"),
        ([{"name": "a", "rules": []}] * 1025, "1025 layers"),
    ],
)
def test_bad_layers_say_what_is_wrong(value: object, says: str) -> None:
    with pytest.raises(ValueError, match=r".") as caught:
        layers.read_layers(value)
    assert says in str(caught.value)
