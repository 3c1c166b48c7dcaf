"""The policies that operators give to proxies: the administrator's layer, bounds, and the variable.

A proxy gets its policy in two ways:

- In a variable at its creation, so that the proxy never serves without a policy.
- By ``POST /policy`` after each change of the policy and each start of the proxy. So a new policy
  does not recreate the proxy.

A restarted proxy first waits up to `AWAITED` seconds for ``POST /policy``, and registers nothing
meanwhile. If the operator is away, the proxy then uses the policy of its creation. Layers that are
too long for the variable become a layer that denies more (`as_variable`).
"""

import json
from collections.abc import Iterable, Sequence

from rosproxy.access.layers import PolicyLayer, PolicyMode, layers_as_json
from rosproxy.access.rules import MOST_RULES, Rule, RuleAction, RuleKind
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
_TOO_LONG = "the operator, which has not sent its long policy yet"
"""Name of the layer that stands for layers that are too long for the variable."""


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
    size = len(_as_json(layers))
    return f"{size} bytes, at most {LONGEST_POLICY} are accepted" if size > LONGEST_POLICY else ""


def as_variable(layers: Sequence[PolicyLayer]) -> str:
    """Return the layers as JSON for the variable of a new proxy; empty without layers.

    If all layers are too long for a variable, a layer that denies at least as much stands for the
    layers of single nodes. If the text is still too long, such a layer stands for all layers. So no
    denied name becomes visible before the operator sends the policy.
    """
    if not layers:
        return ""
    common = [layer for layer in layers if layer.addresses is None]
    others = [layer for layer in layers if layer.addresses is not None]
    addresses = frozenset(address for layer in others for address in layer.addresses or ())
    shorter = [*common, *_stricter(others, addresses)]
    texts = (_as_json(subset) for subset in (layers, shorter))
    fitting = (text for text in texts if len(text) <= LONGEST_VARIABLE)
    return next(fitting, None) or _as_json(_stricter(layers, None))


def _stricter(
    layers: Iterable[PolicyLayer], addresses: frozenset[str] | None
) -> tuple[PolicyLayer, ...]:
    """Return a layer that denies each kind of which one of the layers denies a name.

    The layer is for the nodes at ``addresses``. Empty if the layers deny nothing.
    """
    kinds = {
        rule.kind
        for layer in layers
        if layer.mode is PolicyMode.ENFORCE
        for rule in layer.rules
        if rule.action is RuleAction.DENY
    }
    rules = tuple(Rule(RuleAction.DENY, kind, "*") for kind in RuleKind if kind in kinds)
    return (PolicyLayer(_TOO_LONG, rules, addresses=addresses),) if rules else ()


def _as_json(layers: Iterable[PolicyLayer]) -> str:
    """Return layers as JSON in ASCII, so each character is a byte."""
    return json.dumps(layers_as_json(layers))
