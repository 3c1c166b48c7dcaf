"""The names that the policy allows, in the form of zenoh's access control.

In a layer of the policy, the first rule that matches decides. In zenoh's access control, the order
of rules does not count: a name passes if a rule allows the name and no rule denies the name. So the
rules of a layer become a set of names: all names that match one of ``allowed``, except the names
that match one of ``denied``. Some layers have no such set: ``allow /a/b; deny /a/*`` allows all
names except most names below ``/a``. The proxy refuses such a layer.
"""

from collections.abc import Collection, Iterable, Sequence
from typing import NamedTuple

from rosproxy.shared.policy.layers import PolicyLayer, PolicyMode
from rosproxy.shared.policy.rules import Rule, RuleAction, RuleKind, matches
from rosproxy.shared.zenoh_rules.key_expressions import (
    check_glob,
    matches_no_name,
    with_single_stars,
)

KINDS = (RuleKind.PUBLISH, RuleKind.SUBSCRIBE, RuleKind.SERVE, RuleKind.CALL)
"""The kinds of rules that hold on rmw_zenoh."""
_EVERY_NAME = ("*", "/*")
MOST_MIXED_RULES = 300
"""Most rules of a kind in a layer that both allows and denies. Comparing all pairs takes 0.1 s."""
MOST_COMPARISONS = 50_000
"""Most pairs of globs that are compared between two layers. A pair takes 1 µs. With more pairs,
only the globs that both layers have count as allowed."""


class NameSet(NamedTuple):
    """Names that match one of the globs ``allowed``, and none of the globs ``denied``.

    ``allowed`` is None if all names are allowed, apart from the denied names.
    """

    allowed: tuple[str, ...] | None = None
    denied: tuple[str, ...] = ()


ALL_NAMES = NameSet()


def allowed_names(layers: Iterable[PolicyLayer], kind: RuleKind) -> NameSet:
    """The names of a kind that all enforced layers allow. Raises ValueError as `check_layers`.

    Globs of two layers may overlap in part, such as ``/a*`` and ``/*b``. Names that only such globs
    allow are denied.
    """
    names = ALL_NAMES
    for layer in layers:
        if layer.mode is PolicyMode.ENFORCE:
            names = _intersection(names, _names_of(layer, kind))
    return names


def layers_at(
    layers: Iterable[PolicyLayer], port: int, addresses: Collection[str]
) -> tuple[PolicyLayer, ...]:
    """The layers that hold for the container at a port.

    ``addresses`` are those of nodes that have had sessions at the port. A node may use the port of
    another container, and keeps its own rules there.
    """
    return tuple(
        layer
        for layer in layers
        if layer.ports is None
        or port in layer.ports
        or any(layer.is_for(address) for address in addresses)
    )


def check_layers(layers: Iterable[PolicyLayer]) -> None:
    """Raise ValueError, with the rule, if zenoh's access control cannot enforce a rule."""
    for layer in layers:
        for kind in KINDS if layer.mode is PolicyMode.ENFORCE else ():
            _names_of(layer, kind)


def _names_of(layer: PolicyLayer, kind: RuleKind) -> NameSet:
    """The names that a layer allows. Raises ValueError, which names layer and rule."""
    rules: list[Rule] = []
    for rule in layer.rules:
        # Nodes of rmw_zenoh do not tell their names with data. So a rule with a name after `by`
        # matches nothing, as for DDS.
        if rule.kind is not kind or not matches(rule.by, "") or matches_no_name(rule.glob):
            continue
        try:
            check_glob(rule.glob)
        except ValueError as error:
            raise ValueError(f"layer {layer.name!r}: rule '{rule}': {error}") from None
        rules.append(rule)
        if _is_for_all(rule):  # later rules decide nothing
            break
    try:
        return _as_set(rules)
    except ValueError as error:
        raise ValueError(f"layer {layer.name!r}: {error}") from None


def _is_for_all(rule: Rule) -> bool:
    """Whether the glob of a rule matches every name."""
    return with_single_stars(rule.glob) in _EVERY_NAME


def _as_set(rules: Sequence[Rule]) -> NameSet:
    """The set of names that rules allow. The first rule that matches a name decides.

    Raises ValueError if there is no such set, or if the rules are too many.
    """
    denies_rest = bool(rules) and _is_for_all(rules[-1])
    denies_rest = denies_rest and rules[-1].action is RuleAction.DENY
    globs = [rule for rule in rules if not _is_for_all(rule)]
    if len(globs) > MOST_MIXED_RULES and len({rule.action for rule in globs}) > 1:
        text = f"rmw_zenoh takes at most {MOST_MIXED_RULES} rules of a kind that allow and deny"
        raise ValueError(f"{text}. Join rules by globs")
    allowed: list[str] = []
    denied: list[str] = []
    for index, rule in enumerate(globs):
        if rule.action is RuleAction.ALLOW:
            allowed.append(rule.glob)
            continue
        later = [r.glob for r in globs[index + 1 :] if r.action is RuleAction.ALLOW]
        if denies_rest and not any(may_overlap(rule.glob, glob) for glob in later):
            continue  # the last rule denies these names as well
        if any(covers(glob, rule.glob) for glob in allowed):
            continue  # an earlier rule allows these names
        if excepted := next((g for g in allowed if may_overlap(g, rule.glob)), None):
            text = f"rmw_zenoh can't except {excepted} from rule '{rule}'. Allow the other names "
            raise ValueError(f"{text}in further rules, and end with: deny {rule.kind.value} *")
        denied.append(rule.glob)
    return NameSet(tuple(allowed) if denies_rest else None, tuple(denied))


def _intersection(left: NameSet, right: NameSet) -> NameSet:
    denied = tuple(dict.fromkeys((*left.denied, *right.denied)))
    if left.allowed is None or right.allowed is None:
        return NameSet(right.allowed if left.allowed is None else left.allowed, denied)
    pairs = len(left.allowed) * len(right.allowed)
    if pairs > MOST_COMPARISONS:
        common = set(left.allowed) & set(right.allowed)
        return NameSet(tuple(sorted(common)), denied)
    narrow = [
        a if covers(b, a) else b
        for a in left.allowed
        for b in right.allowed
        if covers(b, a) or covers(a, b)
    ]
    return NameSet(tuple(dict.fromkeys(narrow)), denied)


def covers(wide: str, narrow: str) -> bool:
    """Whether a glob matches all names of another glob. Both have no ``?``."""
    # The "*" of the narrow glob stands for any text. As no text of a glob has a "*", the wide glob
    # matches this character only by a "*" of its own.
    return matches(wide, narrow)


def may_overlap(one: str, other: str) -> bool:
    """Whether two globs may match the same name: their beginnings and their ends are compatible."""
    if "*" not in one:
        return matches(other, one)
    if "*" not in other:
        return matches(one, other)
    begins = one.split("*", 1)[0], other.split("*", 1)[0]
    ends = one.rsplit("*", 1)[1], other.rsplit("*", 1)[1]
    has_begin = begins[0].startswith(begins[1]) or begins[1].startswith(begins[0])
    return has_begin and (ends[0].endswith(ends[1]) or ends[1].endswith(ends[0]))
