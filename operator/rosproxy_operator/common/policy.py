"""Policies, as operators hand them to proxies: whose rules they are, and how they get there.

A proxy gets its policy twice. In a variable, when it is created, so that it serves for no moment
without. And by ``POST /policy``, whenever it has changed or the proxy has been started: another
policy makes no proxy anew. So one that is started again waits some seconds for its operator's word
before it registers anything, and if that is away begins with the policy of its creation.
"""

import json
from collections.abc import Iterable, Sequence

from rosproxy.access.layers import PolicyLayer, PolicyMode, layers_as_json
from rosproxy.access.rules import MOST_RULES, Rule
from rosproxy.setting_kinds import SettingError

ADMINISTRATOR = "administrator"
"""Name of the layer that the operator's options make, which is for every proxy."""
AWAITED = 3.0
"""Seconds that a proxy waits for its operator, as for an update about a new caller."""
MOST_AUTHORS_RULES = MOST_RULES // 2
"""Rules of one author, so that those of the administrator and of another always fit together."""
LONGEST_VARIABLE = 96 * 1024
"""Bytes: Linux starts no program with a variable of 128 KiB (MAX_ARG_STRLEN)."""
LONGEST_POLICY = LONGEST_VARIABLE // 3
"""Bytes, as JSON, of one author's layer: the administrator's and another's fit into a variable."""


def administrators_policy(rules: Iterable[tuple[Rule, ...]], mode: str) -> tuple[PolicyLayer, ...]:
    """The layer of the operator's options, none if they give no rules. Raises SettingError."""
    all_rules = tuple(rule for group in rules for rule in group)
    layers = (PolicyLayer(ADMINISTRATOR, all_rules, PolicyMode(mode)),) if all_rules else ()
    if problem := too_much(layers):
        raise SettingError("--policy", f"{problem}. Join rules by globs")
    return layers


def too_much(layers: Sequence[PolicyLayer]) -> str:
    """Why these are more than a proxy can take from one author; empty if they are not."""
    count = sum(len(layer.rules) for layer in layers)
    if count > MOST_AUTHORS_RULES:
        return f"{count} rules, at most {MOST_AUTHORS_RULES} are accepted"
    size = len(as_variable(layers).encode())
    return f"{size} bytes, at most {LONGEST_POLICY} are accepted" if size > LONGEST_POLICY else ""


def as_variable(layers: Sequence[PolicyLayer]) -> str:
    """Layers as a proxy takes them at its creation; empty if there are none.

    Where all are too long for a variable, only those that are for all of its nodes.
    """
    common = [layer for layer in layers if layer.addresses is None]
    texts = (json.dumps(layers_as_json(subset)) for subset in (layers, common) if subset)
    return next((text for text in texts if len(text) <= LONGEST_VARIABLE), "")
