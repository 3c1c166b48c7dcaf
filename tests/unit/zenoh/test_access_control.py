"""Rules become the access control of a router: for names, both decide the same."""

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from rosproxy.shared.policy.layers import PolicyLayer, PolicyMode, decide
from rosproxy.shared.policy.rules import RuleKind, parse_rules
from rosproxy.shared.zenoh_rules.key_expressions import MOST_STARS, data_keys, token_key
from rosproxy.shared.zenoh_rules.name_sets import (
    MOST_MIXED_RULES,
    check_layers,
    covers,
    may_overlap,
)
from rosproxy.zenoh.access_control import access_control
from tests.unit.zenoh.key_model import includes, permits

NAMES = st.lists(st.text("ab_", min_size=1, max_size=3), min_size=1, max_size=3).map(
    lambda chunks: "".join(f"/{chunk}" for chunk in chunks)
)
GLOBS = st.text("ab/*", max_size=6).flatmap(lambda text: st.sampled_from([f"/{text}", f"*{text}"]))
RULES = st.lists(
    st.tuples(st.sampled_from(["allow", "deny"]), GLOBS | st.just("*")).map(
        lambda rule: f"{rule[0]} KIND {rule[1]}"
    ),
    max_size=4,
).map("; ".join)
SENT = {
    RuleKind.PUBLISH: ("put", "egress"),
    RuleKind.SUBSCRIBE: ("put", "ingress"),
    RuleKind.SERVE: ("query", "ingress"),
    RuleKind.CALL: ("query", "egress"),
}
REVERSE = {"egress": "ingress", "ingress": "egress"}
"""What leaves the router of a container enters the router for outside."""
TOKENS = {
    RuleKind.PUBLISH: ("MP", "MS"),
    RuleKind.SUBSCRIBE: ("MS", "MP"),
    RuleKind.SERVE: ("SS", "SC"),
    RuleKind.CALL: ("SC", "SS"),
}


def layer(rules: str, name: str = "test", mode: PolicyMode = PolicyMode.ENFORCE) -> PolicyLayer:
    return PolicyLayer(name, parse_rules(rules), mode)


def data_key(name: str) -> str:
    return f"0{name}/std_msgs::msg::dds_::String_/RIHS01_df"


def token(name: str, kind: str) -> str:
    mangled = name.replace("/", "%")
    return f"@ros2_lv/0/aa/0/1/{kind}/%/%/node/{mangled}/T_/H/::,10:,:,:,,"


@given(GLOBS, NAMES)
def test_key_expressions_match_as_the_glob(glob: str, name: str) -> None:
    """`rosproxy.shared.policy.rules.matches` is the reference; empty parts are in no name."""
    assume("//" not in glob)
    assume(not glob.endswith("/"))
    is_matched = covers(glob, name)
    keys = data_keys(glob)
    assert any(includes(key, data_key(name)) for key in keys) == is_matched
    assert includes(token_key(glob, "MP"), token(name, "MP")) == is_matched


@given(GLOBS, GLOBS, NAMES)
def test_globs_that_do_not_overlap_share_no_name(one: str, other: str, name: str) -> None:
    if covers(one, name) and covers(other, name):
        assert may_overlap(one, other)


@given(GLOBS, GLOBS, NAMES)
def test_a_covered_glob_has_no_other_name(wide: str, narrow: str, name: str) -> None:
    if covers(wide, narrow) and covers(narrow, name):
        assert covers(wide, name)


@given(st.sampled_from(RuleKind), RULES, NAMES)
def test_the_router_decides_as_the_rules(kind: RuleKind, rules: str, name: str) -> None:
    assume(kind in SENT)
    policy = [layer(rules.replace("KIND", kind.value))]
    try:
        access = access_control(policy)
    except ValueError:
        assume(False)
    allowed = decide(policy, kind, name, "", "").allowed
    if access is None:
        assert allowed
        return
    assert permits(access, *SENT[kind], data_key(name), "hub") == allowed
    inside, outside = TOKENS[kind]
    for flow, entity in (("egress", inside), ("ingress", outside)):
        assert permits(access, "liveliness_token", flow, token(name, entity), "hub") == allowed
    at_outside = access_control(policy, outside=True)
    assert at_outside is not None
    message, sent = SENT[kind]
    assert permits(at_outside, message, REVERSE[sent], data_key(name), "hub") == allowed
    for flow, entity in (("ingress", inside), ("egress", outside)):
        assert permits(at_outside, "liveliness_token", flow, token(name, entity), "hub") == allowed


@given(RULES, RULES, NAMES)
def test_layers_together_allow_no_more_than_each(first: str, second: str, name: str) -> None:
    policy = [layer(rules.replace("KIND", "publish")) for rules in (first, second)]
    try:
        access = access_control(policy)
    except ValueError:
        assume(False)
    is_sent = access is None or permits(access, "put", "egress", data_key(name), "hub")
    if is_sent:
        assert decide(policy, RuleKind.PUBLISH, name, "", "").allowed


@pytest.mark.parametrize(
    ("rules", "complaint"),
    [
        (
            "allow publish /a/b; deny publish /a/*",
            r"can't except /a/b from rule 'deny publish /a/\*'",
        ),
        ("allow serve /a*; deny serve /*b; allow serve /c*; deny serve *", "can't except"),
        ("deny publish /a?", r"rmw_zenoh has no \? in /a\?"),
        ("deny publish /a*a*a*a*a", f"at most {MOST_STARS} \\* within names"),
        (
            "; ".join(f"{a} call /{n}" for n in range(200) for a in ("allow", "deny")),
            f"at most {MOST_MIXED_RULES} rules",
        ),
    ],
)
def test_rules_that_a_router_can_not_have_are_refused(rules: str, complaint: str) -> None:
    with pytest.raises(ValueError, match=f"layer 'test': .*{complaint}"):
        check_layers([layer(rules)])
    check_layers([layer(rules, mode=PolicyMode.AUDIT)])


def test_a_double_star_counts_as_a_single_star() -> None:
    for glob in ("/*a/*b/*c/*d", "/**a/**b/**c/**d"):
        check_layers([layer(f"deny publish {glob}")])
    with pytest.raises(ValueError, match=f"at most {MOST_STARS} \\* within names"):
        check_layers([layer("deny publish /a**a**a**a**a")])
    rules = "allow publish /a/b; deny publish "
    assert access_control([layer(f"{rules}**")]) == access_control([layer(f"{rules}*")])


@pytest.mark.parametrize(
    "rules",
    [
        "",
        "deny slave *; deny get-param *; allow publish *; deny publish *",
        "deny publish /a by /driver",  # nodes of rmw_zenoh do not prove names
        "deny publish /a//b; deny publish /a#; deny publish /@*; deny publish /a%b; deny publish /",
    ],
)
def test_without_denied_names_there_is_no_access_control(rules: str) -> None:
    assert access_control([layer(rules)]) is None


def test_a_layer_in_audit_mode_denies_nothing() -> None:
    assert access_control([layer("deny publish *", mode=PolicyMode.AUDIT)]) is None


def test_nodes_of_the_container_are_free() -> None:
    access = access_control([layer("deny publish *; deny subscribe *; deny serve *; deny call *")])
    assert access is not None
    for flow in ("ingress", "egress"):
        assert permits(access, "put", flow, data_key("/a"), "nodes")
        assert permits(access, "liveliness_token", flow, token("/a", "MP"), "nodes")
        assert not permits(access, "put", flow, data_key("/a"), "hub")
        assert not permits(access, "query", flow, data_key("/a"), "hub")
        assert permits(access, "liveliness_token", flow, "@ros2_lv/0/aa/0/0/NN/%/%/node", "hub")
    assert access["default_permission"] == "deny"
    subjects = {subject["id"]: subject["link_protocols"] for subject in access["subjects"]}
    assert subjects == {"nodes": ["tcp"], "hub": ["unixsock-stream"]}


def test_a_list_lets_no_wildcard_pass() -> None:
    """A key with wildcards would reach all names, and a list of allowed names includes none."""
    access = access_control([layer("allow serve /a/b; deny serve *")])
    assert access is not None
    (rule,) = (rule for rule in access["rules"] if rule["id"] == "allow serve 0")
    assert rule["key_exprs"] == ["*/a/b/*/*"]


def test_many_denials_take_no_comparisons() -> None:
    rules = "; ".join(f"deny publish /{number}" for number in range(1000))
    access = access_control([layer(rules)])
    assert access is not None
    assert not permits(access, "put", "egress", data_key("/999"), "hub")
