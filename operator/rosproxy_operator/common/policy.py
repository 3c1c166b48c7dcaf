"""The policies that operators give to proxies: the administrator's layer, bounds, and the variable.

A proxy gets its policy in two ways:

- In a variable at its creation, so that the proxy never serves without a policy.
- By ``POST /policy`` after each change of the policy and each start of the proxy. So a new policy
  does not recreate the proxy.

A restarted proxy first waits up to `AWAITED` seconds for ``POST /policy``, and registers nothing
meanwhile. If the operator is away, the proxy then uses the policy of its creation.
"""

import json
from collections.abc import Iterable, Sequence

from rosproxy.access.layers import PolicyLayer, PolicyMode, layers_as_json
from rosproxy.access.rules import MOST_RULES, Rule
from rosproxy.setting_kinds import SettingError

ADMINISTRATOR = "administrator"
"""Name of the layer from the operator's options. This layer is for all proxies."""
AWAITED = 3.0
"""Seconds that a started proxy waits for ``POST /policy``. Calls of new callers wait as long."""
MOST_AUTHORS_RULES = MOST_RULES // 2
"""Rules of an author at most, so that the rules of the administrator and another author fit."""
LONGEST_VARIABLE = 96 * 1024
"""Bytes of the variable at most: Linux allows less than 128 KiB (execve(2), MAX_ARG_STRLEN)."""
LONGEST_POLICY = LONGEST_VARIABLE // 3
"""Bytes of an author's layer as JSON at most. Two such layers fit into a variable."""


def administrators_policy(rules: Iterable[tuple[Rule, ...]], mode: str) -> tuple[PolicyLayer, ...]:
    """Return the layer of the operator's options; empty without rules. Raises SettingError."""
    all_rules = tuple(rule for group in rules for rule in group)
    layers = (PolicyLayer(ADMINISTRATOR, all_rules, PolicyMode(mode)),) if all_rules else ()
    if problem := too_much(layers):
        raise SettingError("--policy", f"{problem}. Join rules by globs")
    return layers


def too_much(layers: Sequence[PolicyLayer]) -> str:
    """Return why the layers are too much for a proxy from an author; empty if they are not."""
    count = sum(len(layer.rules) for layer in layers)
    if count > MOST_AUTHORS_RULES:
        return f"{count} rules, at most {MOST_AUTHORS_RULES} are accepted"
    size = len(as_variable(layers).encode())
    return f"{size} bytes, at most {LONGEST_POLICY} are accepted" if size > LONGEST_POLICY else ""


def as_variable(layers: Sequence[PolicyLayer]) -> str:
    """Return the layers as JSON for the variable of a new proxy; empty without layers.

    If all layers are too long for a variable, the JSON has only the layers for all nodes. If these
    are too long as well, the text is empty.
    """
    common = [layer for layer in layers if layer.addresses is None]
    texts = (json.dumps(layers_as_json(subset)) for subset in (layers, common) if subset)
    return next((text for text in texts if len(text) <= LONGEST_VARIABLE), "")
