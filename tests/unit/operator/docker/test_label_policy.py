"""Labels with rules: affected nodes, duration, limits."""

from dataclasses import replace

import pytest
from msgspec import structs

from rosproxy.shared.policy.layers import PolicyLayer
from rosproxy.shared.policy.rules import MOST_RULES, Rule, parse_rules
from rosproxy_operator.common.policy import administrators_policy
from rosproxy_operator.docker.planner.actions import Create
from rosproxy_operator.docker.planner.label_policy import (
    LAYERS_KEPT_S,
    RecentLayers,
    with_bounded_rules,
)
from rosproxy_operator.docker.planner.labels.readers import MOST_LABEL_RULES
from rosproxy_operator.docker.planner.model import Attachment, Member
from rosproxy_operator.docker.planner.proxy_update import ProxyUpdate, network_facts
from rosproxy_operator.docker.planner.specs import container_config, proxy_fingerprint
from rosproxy_operator.docker.planner.state import DockerMemory
from rosproxy_operator.proxy_spec.place import Master, Place
from tests.run_options import settings_of
from tests.unit.operator.docker.builders import (
    ENABLED,
    PLACE,
    SETTINGS,
    both,
    container,
    observed,
    planned,
    read_members,
)

RULES = parse_rules("deny publish /camera/*")
COMMON = administrators_policy([parse_rules("deny slave shutdown")], "enforce")
A = "172.18.0.5"
B = "172.18.0.6"


def layer(name: str, *addresses: str, rules: tuple[Rule, ...] = RULES) -> PolicyLayer:
    return PolicyLayer(f"label of container {name}", rules, addresses=frozenset(addresses))


# the label


def read(text: str) -> tuple[tuple[Member, ...], str]:
    talker = container(labels={**ENABLED, "rosproxy.policy": text})
    members, problems = read_members(observed(talker))
    assert all(
        (problem.subject, problem.fatal) == ("container talker", True) for problem in problems
    )
    return members, "".join(problem.message for problem in problems)


@pytest.mark.parametrize(
    ("text", "rules"),
    [
        ("", 0),
        ("deny publish /camera/*", 1),
        ("allow publish /camera/info\n# not the rest\n deny publish * ; deny serve * by /a", 3),
        ("; ".join(["deny publish /a"] * MOST_LABEL_RULES), MOST_LABEL_RULES),
    ],
)
def test_the_rules_of_a_label(text: str, rules: int) -> None:
    (member,), told = read(text)
    assert (len(member.policy), told) == (rules, "")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("hide /camera", "label rosproxy.policy: rule 'hide /camera': must be ACTION KIND GLOB"),
        ("deny publish camera", "'camera' must begin with /, * or ?"),
        (
            "; ".join(["deny publish /a"] * (MOST_LABEL_RULES + 1)),
            "has 101 rules, at most 100 are accepted",
        ),
        ("#" * 20_000, "has more than 16384 characters. Join rules by globs"),
    ],
)
def test_with_rules_that_can_not_be_read_a_container_is_not_served(text: str, told: str) -> None:
    members, said = read(text)
    assert members == ()
    assert told in said


# what a proxy is told


def test_a_layer_is_for_the_addresses_of_its_container() -> None:
    talker = container("talker", networks=[Attachment("app", A)])
    guest = container("guest", networks=[], mode="container:id-talker")
    # The engine keeps the name if the container did not exist at the creation.
    friend = container("friend", networks=[], mode="container:guest")
    soon = container("soon", networks=[Attachment("app", "")], state="created")
    ended = container("ended", networks=[Attachment("app", B)], state="exited")
    own = both()
    box = own["sandboxes"][0]
    home = replace(box.container, attachments=(Attachment("app", "172.18.0.2"),))
    seen = observed(
        talker, guest, friend, soon, ended, **{**own, "sandboxes": [replace(box, container=home)]}
    )
    members = [Member(c, PLACE, policy=RULES) for c in (talker, guest, friend, soon, ended)]
    plain = Member(container("plain", networks=[Attachment("app", B)]), PLACE)
    other = Member(talker, Place(Master("http://other:11311"), "192.0.2.10"), policy=RULES)
    facts = network_facts(seen, seen.proxies[0], [*members, plain, other], COMMON)
    shared = (layer("talker", A), layer("guest", A), layer("friend", A))
    assert facts.policy == (*COMMON, *shared)


def test_a_proxy_is_made_with_the_layers_of_its_containers() -> None:
    """Nodes may register before the operator has sent the policy to the proxy."""
    labels = {**ENABLED, "rosproxy.policy": "deny publish /camera/*"}
    seen = observed(container("talker", labels, [Attachment("app", A)]))
    plan = planned(seen, replace(SETTINGS, policy=COMMON), DockerMemory(), 0.0)
    (made,) = [action for action in plan.actions if isinstance(action, Create)]
    assert made.policy == (layer("talker", A),)
    body = container_config(made, replace(SETTINGS, policy=COMMON), "t", "")
    variables = dict(variable.split("=", 1) for variable in body["Env"])
    assert settings_of(variables).policy_layers == (*COMMON, layer("talker", A))
    plain = structs.replace(made, policy=())
    assert len({proxy_fingerprint(create, SETTINGS, "", "") for create in (made, plain)}) == 1


def test_what_a_container_that_has_gone_hid_stays_hidden_until_its_nodes_are_gone() -> None:
    recent = RecentLayers()
    assert recent.record([layer("a", A)], {A}, 0.0) == (layer("a", A),)
    assert recent.record([], set(), 1.0) == (layer("a", A),)
    assert recent.record([], set(), LAYERS_KEPT_S) == ()
    recent.record([layer("a", A)], {A}, 0.0)
    assert recent.record([], {A}, 1.0) == ()  # another container has the address


def test_a_container_that_comes_back_elsewhere_has_one_layer() -> None:
    recent = RecentLayers()
    recent.record([layer("a", A)], {A}, 0.0)
    assert recent.record([layer("a", B)], {B}, 1.0) == (layer("a", A, B),)
    assert recent.record([layer("a", B)], {B}, LAYERS_KEPT_S) == (layer("a", B),)


def test_those_of_gone_containers_take_no_room_from_others() -> None:
    many = RULES * (MOST_RULES // 2 + 1)
    recent = RecentLayers()
    recent.record([layer("a", A, rules=many)], {A}, 0.0)
    new = layer("b", B, rules=many)
    assert recent.record([new], {B}, 1.0) == (new,)


def test_the_same_look_is_the_same_policy() -> None:
    layers = [layer("b", B, A), layer("a", A), layer("a", B, rules=RULES * 2)]
    first = ProxyUpdate()
    second = ProxyUpdate()
    for update, order in ((first, layers), (second, layers[::-1])):
        seen = observed(**both())
        facts = replace(network_facts(seen, seen.proxies[0], ()), policy=(*COMMON, *order))
        update.record(facts, 0.0)
    assert first.policy == second.policy
    assert first.policy[0] == COMMON[0]


# how many


def crowd(**rules: int) -> list[Member]:
    return [Member(container(name), PLACE, policy=RULES * count) for name, count in rules.items()]


def test_who_has_many_rules_takes_no_room_from_who_has_few() -> None:
    settings = replace(SETTINGS, policy=administrators_policy([RULES * 400], "enforce"))
    members = crowd(a=100, b=100, c=1, d=100, e=100, f=100, g=100, h=0)
    left, (problem,) = with_bounded_rules(members, settings)
    assert {member.container.name for member in left} == set("abcdefh")
    assert (problem.subject, problem.fatal) == ("container g", True)
    assert "have too many rules together (at most 1000 rules" in problem.message
    assert with_bounded_rules(members, SETTINGS) == (tuple(members), ())


def test_proxies_are_bounded_each_for_itself() -> None:
    other = Place(Master("http://other:11311"), "192.0.2.10")
    more = [replace(member, place=other) for member in crowd(x=100)]
    members = [*crowd(**{f"c{number}": 100 for number in range(10)}), *more]
    assert with_bounded_rules(members, SETTINGS)[1] == ()


def test_the_plan_leaves_out_whom_a_proxy_can_not_hold() -> None:
    label = {"rosproxy.policy": "; ".join(["deny publish /a"] * MOST_LABEL_RULES)}
    seen = observed(*(container(f"c{n:02}", labels={**ENABLED, **label}) for n in range(11)))
    plan = planned(seen, SETTINGS, DockerMemory(), 0.0)
    assert [member.container.name for member in plan.members] == [f"c{n:02}" for n in range(10)]
    assert [
        problem.subject for problem in plan.problems if "rosproxy.policy" in problem.message
    ] == ["container c10"]
