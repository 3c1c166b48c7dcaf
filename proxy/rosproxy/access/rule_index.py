"""Rules of one kind, prepared to judge many names.

A datagram of ROS 2 may bring hundreds of names, a policy may have a thousand rules, and an address
may have thousands of node names. So look-ups find the rules for a name or a namespace. For all
other rules, a search for a part of the glob leaves out most. The number of comparisons with node
names has a bound.
"""

import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from functools import lru_cache
from itertools import compress, groupby

from rosproxy.shared.policy.layers import ALLOWED, PolicyLayer, PolicyMode, Verdict
from rosproxy.shared.policy.rules import MOST_RULES, Rule, RuleAction, RuleKind, matches

MOST_CALLER_COMPARISONS = 20_000
"""Comparisons of node names with rules for a verdict, about 10 ms. Beyond the bound, each rule
counts as a rule for one of the nodes."""


class RuleIndex:
    """Rules of one kind, each with its layer, in the order in which the policy applies them."""

    def __init__(self, rules: Sequence[tuple[PolicyLayer, Rule]]) -> None:
        self._rules = rules
        self._by_name: defaultdict[str, list[int]] = defaultdict(list)
        """The indices of the rules for a single name."""
        self._by_prefix: defaultdict[int, defaultdict[str, list[int]]]
        self._by_prefix = defaultdict(lambda: defaultdict(list))
        """The indices of the rules for all names with a prefix, by the length of the prefix."""
        self._others = list[int]()
        """The indices of all other rules."""
        for index, (_, rule) in enumerate(rules):
            texts = _fixed_texts(rule.glob)
            if len(texts) == 1:
                self._by_name[rule.glob].append(index)
            elif len(texts) == 2 and rule.glob.endswith("*"):
                self._by_prefix[len(texts[0])][texts[0]].append(index)
            else:
                self._others.append(index)
        globs = [_fixed_texts(rules[index][1].glob) for index in self._others]
        globs_with = Counter(text for texts in globs for text in texts)
        self._texts = [
            min(texts, key=lambda text: (globs_with[text], -len(text))) for texts in globs
        ]
        """A text of the glob of each of the others, which the other globs rarely have."""

    @classmethod
    def of_kind(cls, layers: Iterable[PolicyLayer], kind: RuleKind, address: str) -> "RuleIndex":
        """The rules of a kind that hold for the nodes inside at an address."""
        at_address = (layer for layer in layers if layer.is_for(address))
        return cls([(layer, r) for layer in at_address for r in layer.rules if r.kind is kind])

    def judge(self, name: str, callers: Sequence[str]) -> Verdict:
        """The verdict on a name for all of ``callers``: a denial for one is a denial for all.

        The verdict has the first enforced denial, or else the first denial in audit mode.
        """
        likely = (self._rules[index] for index in self._likely(name))
        about = [(layer, rule) for layer, rule in likely if matches(rule.glob, name)]
        compared = callers if len(about) * len(callers) <= MOST_CALLER_COMPARISONS else None
        verdict = ALLOWED
        for _, group in groupby(about, lambda entry: id(entry[0])):
            of_layer = list(group)
            layer = of_layer[0][0]
            denial = _denial([rule for _, rule in of_layer], compared)
            if denial is not None and layer.mode is PolicyMode.ENFORCE:
                return Verdict(False, denial, layer.name)
            if denial is not None and verdict.rule is None:
                verdict = Verdict(True, denial, layer.name)
        return verdict

    def _likely(self, name: str) -> list[int]:
        """The indices of the rules whose globs may match a name, in order."""
        likely = [*self._by_name.get(name, ())]
        for length, rules in self._by_prefix.items():
            likely += rules.get(name[:length], ())
        likely += compress(self._others, map(name.__contains__, self._texts))
        return sorted(likely)


def _denial(about: Sequence[Rule], callers: Sequence[str] | None) -> Rule | None:
    """The first of a layer's rules about a name that denies the name to one of ``callers``.

    ``callers`` None: too many to compare. Then each rule that denies counts as a rule for one of
    the callers, unless an earlier rule for all callers allows the name.
    """
    for rule in about:
        is_denial = rule.action is RuleAction.DENY
        if rule.by == "*":
            return rule if is_denial else None
        if callers is None:
            concerns = is_denial
        else:
            others = [caller for caller in callers if not matches(rule.by, caller)]
            concerns = len(others) < len(callers)
            callers = others
        if concerns and is_denial:
            return rule
    return None


@lru_cache(2 * MOST_RULES)
def _fixed_texts(glob: str) -> list[str]:
    """The texts of a glob between ``*`` and ``?``: each name that matches has all of them."""
    return re.split(r"[*?]", glob)
