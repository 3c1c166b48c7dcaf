"""One rule of a policy: ``ACTION KIND GLOB [by GLOB]``, such as ``deny publish /camera/*``.

The first glob is on the name of what is asked for, the second on the node that asks (`RuleKind`
says which node that is). In a glob ``*`` stands for any characters, ``/`` too, and ``?`` for one;
nothing else is special, and case counts. Of several rules the first that matches decides; where
none does, everything is allowed (`rosproxy.access.layers`).

A glob without ``?`` is matched by searches for its texts, which take no longer than the name. Any
other is matched by an expression that never goes back behind a ``*`` (atomic groups), so that it
takes no longer than its length times the name's.
"""

import re
from collections.abc import Sequence
from enum import Enum
from functools import lru_cache

import msgspec

LONGEST_GLOB = 256
"""Characters of a glob. Names of large systems have a hundred."""
MOST_RULES = 1000
"""Rules of all layers together."""
_LONGEST_SHOWN = 80
"""Characters of a bad rule that a message repeats."""
_EXAMPLE = "such as: deny publish /camera/* by /driver"


class RuleAction(Enum):
    """What a rule does with what it matches."""

    ALLOW = "allow"
    DENY = "deny"


class RuleKind(Enum):
    """What a rule is about, as seen from the nodes inside.

    ``by`` is on the name of the node inside; for SLAVE it is the name that a caller outside gives,
    which proves nothing.
    """

    PUBLISH = "publish"
    """A topic that a node inside publishes, outwards."""
    SERVE = "serve"
    """A service that a node inside offers, outwards."""
    SUBSCRIBE = "subscribe"
    """A topic of outside that a node inside subscribes to."""
    CALL = "call"
    """A service of outside that a node inside calls."""
    GET_PARAM = "get-param"
    """A parameter that a node inside reads."""
    SET_PARAM = "set-param"
    """A parameter that a node inside sets or deletes."""
    SLAVE = "slave"
    """A method of a node inside that somebody outside calls."""


_ACTIONS = {action.value: action for action in RuleAction}
_KINDS = {kind.value: kind for kind in RuleKind}


class Rule(msgspec.Struct, frozen=True):
    """A rule; ``str`` gives it as text, which `parse_rule` reads again."""

    action: RuleAction
    kind: RuleKind
    glob: str
    by: str = "*"

    def __str__(self) -> str:
        """The rule as text."""
        by = "" if self.by == "*" else f" by {self.by}"
        return f"{self.action.value} {self.kind.value} {self.glob}{by}"

    def is_about(self, kind: RuleKind, caller: str) -> bool:
        """Whether it is for this kind of thing and this caller."""
        return self.kind is kind and matches(self.by, caller)

    def matches(self, kind: RuleKind, name: str, caller: str) -> bool:
        """Whether it is about a thing of that name."""
        return self.is_about(kind, caller) and matches(self.glob, name)

    def covers_below(self, prefix: str) -> bool:
        """Whether it matches all names that begin with ``prefix``."""
        return self.glob.endswith("*") and matches(self.glob, prefix)

    def may_match_below(self, prefix: str) -> bool:
        """Whether it may match a name that begins with ``prefix``; at times though it can't."""
        literal = re.split(r"[*?]", self.glob, maxsplit=1)[0]
        return literal.startswith(prefix) or (literal != self.glob and prefix.startswith(literal))


def parse_rules(text: str) -> tuple[Rule, ...]:
    """The rules of a text, separated by ``;`` or line ends; lines with ``#`` first are comments.

    Raises ValueError, which names the rule.
    """
    lines = (line for line in text.splitlines() if not line.lstrip().startswith("#"))
    rule_texts = (rule_text.strip() for line in lines for rule_text in line.split(";"))
    return tuple(parse_rule(rule_text) for rule_text in rule_texts if rule_text)


def parse_rule(text: str) -> Rule:
    """A single rule. Raises ValueError, which names it."""
    shown = text if len(text) <= _LONGEST_SHOWN else f"{text[:_LONGEST_SHOWN]}…"
    try:
        return _parse(text.split())
    except ValueError as error:
        raise ValueError(f"rule {shown!r}: {error}, {_EXAMPLE}") from None


def format_rules(rules: tuple[Rule, ...]) -> str:
    """Rules as one line, which `parse_rules` reads again."""
    return "; ".join(map(str, rules))


def matches(glob: str, name: str) -> bool:
    """Whether a glob matches all of a name."""
    if glob == "*":
        return True
    if "?" in glob:
        return _expression(glob).fullmatch(name) is not None
    first, *rest = glob.split("*")
    return _has_texts(name, first, rest) if rest else name == first


def _parse(tokens: list[str]) -> Rule:
    if len(tokens) not in (3, 5) or (len(tokens) == 5 and tokens[3] != "by"):
        raise ValueError("must be ACTION KIND GLOB [by GLOB]")
    action = _ACTIONS.get(tokens[0])
    kind = _KINDS.get(tokens[1])
    if action is None:
        raise ValueError(f"the action must be {' or '.join(_ACTIONS)}, not {tokens[0][:20]!r}")
    if kind is None:
        raise ValueError(f"the kind must be one of {', '.join(_KINDS)}, not {tokens[1][:20]!r}")
    by = tokens[4] if len(tokens) == 5 else "*"
    if max(len(tokens[2]), len(by)) > LONGEST_GLOB:
        raise ValueError(f"a glob must have at most {LONGEST_GLOB} characters")
    globs = [by] if kind is RuleKind.SLAVE else [tokens[2], by]
    for glob in globs:
        if glob[0] not in "/*?":  # it would never match: names that the master knows begin so
            raise ValueError(f"{glob[:40]!r} must begin with /, * or ?, as ROS names do")
    return Rule(action, kind, tokens[2], by)


def _has_texts(name: str, first: str, rest: Sequence[str]) -> bool:
    """Whether a name begins with a text, and has the others after it, the last one at its end.

    Each is taken where it comes first: so all that follows has most room.
    """
    *middle, last = rest
    position = len(first)
    end = len(name) - len(last)
    if position > end or not name.startswith(first) or not name.endswith(last):
        return False
    for text in middle:
        found = name.find(text, position, end)
        if found < 0:
            return False
        position = found + len(text)
    return True


@lru_cache(maxsize=2 * MOST_RULES)
def _expression(glob: str) -> re.Pattern[str]:
    """The regular expression of a glob; each ``*`` takes as little as the next segment lets it.

    That is right for all segments but the last, which has to be at the name's end.
    """
    first, *rest = (_fixed(segment) for segment in re.sub(r"\*+", "*", glob).split("*"))
    if not rest:
        return re.compile(first, re.DOTALL)
    *middle, last = rest
    atoms = "".join(f"(?>.*?{segment})" for segment in middle)
    return re.compile(f"{first}{atoms}.*{last}", re.DOTALL)


def _fixed(segment: str) -> str:
    """The expression of a glob's segment, which has no ``*``."""
    return ".".join(map(re.escape, segment.split("?")))
