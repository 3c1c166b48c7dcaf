"""One rule of a policy: ``ACTION KIND GLOB [by GLOB]``, such as ``deny publish /camera/*``.

The first glob matches the name of a topic, service, parameter or method, the second the name of a
node (`RuleKind` says which node). In a glob ``*`` stands for any characters, ``/`` included, and
``?`` for a single character. All other characters stand for themselves, and case counts. Of several
rules the first that matches decides. If none matches, everything is allowed
(`rosproxy.shared.policy.layers`).

Nodes choose names, so the time of a match is bounded. For a glob without ``?``, the match searches
for the texts between the ``*``, in a time linear in the length of the name. Other globs become a
regular expression with atomic groups, which never goes back behind a ``*``. The time then grows
with the length of the glob times the length of the name at most.
"""

import re
from collections.abc import Sequence
from enum import Enum
from functools import lru_cache

import msgspec

LONGEST_GLOB = 256
"""Characters of a glob at most. Names in large systems have a hundred."""
MOST_RULES = 1000
"""Rules of all layers together, at most."""
_LONGEST_SHOWN = 80
"""Characters of a bad rule that a message repeats."""
_EXAMPLE = "such as: deny publish /camera/* by /driver"


class RuleAction(Enum):
    """What a rule does with the names that match."""

    ALLOW = "allow"
    DENY = "deny"


class RuleKind(Enum):
    """What a rule is about, as seen from the nodes inside.

    ``by`` matches the name of the node inside. For SLAVE, ``by`` matches the name that the caller
    outside states, which proves nothing.
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
    """A method of a node inside that a caller outside calls."""


_ACTIONS = {action.value: action for action in RuleAction}
_KINDS = {kind.value: kind for kind in RuleKind}


class Rule(msgspec.Struct, frozen=True):
    """A rule; ``str`` returns the text that `parse_rule` reads."""

    action: RuleAction
    kind: RuleKind
    glob: str
    by: str = "*"

    def __str__(self) -> str:
        """The rule as text."""
        by = "" if self.by == "*" else f" by {self.by}"
        return f"{self.action.value} {self.kind.value} {self.glob}{by}"

    def is_about(self, kind: RuleKind, caller: str) -> bool:
        """Whether the rule is for this kind and this caller, whatever the name."""
        return self.kind is kind and matches(self.by, caller)

    def matches(self, kind: RuleKind, name: str, caller: str) -> bool:
        """Whether the rule is for this kind, this name and this caller."""
        return self.is_about(kind, caller) and matches(self.glob, name)

    def covers_below(self, prefix: str) -> bool:
        """Whether the glob matches all names that begin with ``prefix``.

        False is no proof: the method returns True only if the glob ends with ``*`` and matches
        ``prefix``.
        """
        return self.glob.endswith("*") and matches(self.glob, prefix)

    def may_match_below(self, prefix: str) -> bool:
        """Whether the glob may match a name that begins with ``prefix``.

        True is no proof: the method compares only the text before the first ``*`` or ``?``.
        """
        literal = re.split(r"[*?]", self.glob, maxsplit=1)[0]
        return literal.startswith(prefix) or (literal != self.glob and prefix.startswith(literal))


def parse_rules(text: str) -> tuple[Rule, ...]:
    """The rules of a text, separated by ``;`` or line ends.

    Lines that begin with ``#`` are comments. Raises ValueError, which names the rule.
    """
    lines = (line for line in text.splitlines() if not line.lstrip().startswith("#"))
    rule_texts = (rule_text.strip() for line in lines for rule_text in line.split(";"))
    return tuple(parse_rule(rule_text) for rule_text in rule_texts if rule_text)


def parse_rule(text: str) -> Rule:
    """Parse a single rule. Raises ValueError, which names the rule."""
    shown = text if len(text) <= _LONGEST_SHOWN else f"{text[:_LONGEST_SHOWN]}…"
    try:
        return _parse(text.split())
    except ValueError as error:
        raise ValueError(f"rule {shown!r}: {error}, {_EXAMPLE}") from None


def format_rules(rules: tuple[Rule, ...]) -> str:
    """Rules as a line that `parse_rules` reads."""
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
        if glob[0] not in "/*?":  # names at the master begin with /: no other glob would match
            raise ValueError(f"{glob[:40]!r} must begin with /, * or ?, as ROS names do")
    return Rule(action, kind, tokens[2], by)


def _has_texts(name: str, first: str, rest: Sequence[str]) -> bool:
    """Whether a name begins with ``first``, ends with the last of ``rest``, and has all in order.

    Each text in the middle takes its first place in the name, which leaves most room for the rest.
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
    """The regular expression of a glob; each ``*`` matches as few characters as possible.

    The last ``*`` is the exception: the segment behind it has to be at the end of the name.
    """
    first, *rest = (_fixed(segment) for segment in re.sub(r"\*+", "*", glob).split("*"))
    if not rest:
        return re.compile(first, re.DOTALL)
    *middle, last = rest
    atoms = "".join(f"(?>.*?{segment})" for segment in middle)
    return re.compile(f"{first}{atoms}.*{last}", re.DOTALL)


def _fixed(segment: str) -> str:
    """The regular expression of a segment between two ``*`` of a glob."""
    return ".".join(map(re.escape, segment.split("?")))
