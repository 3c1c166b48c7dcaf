"""The policies that operators give to proxies: the administrator's layer, bounds, and encoding.

A proxy gets its policy in two ways:

- In an environment variable at its creation, so that the proxy never serves without a policy.
- By ``POST /policy`` after each change of the policy and each start of the proxy. So a new policy
  does not recreate the proxy.

A restarted proxy first waits up to `POLICY_WAIT_S` seconds for ``POST /policy``, and registers
nothing meanwhile. If the operator is away, the proxy then uses the policy of its creation. Layers
that are too long for the variable become a layer that denies more (`as_variable`).
"""

import json
from collections.abc import Iterable, Sequence

from rosproxy.shared.policy.layers import PolicyLayer, PolicyMode, layers_as_json
from rosproxy.shared.policy.rules import MOST_RULES, Rule, RuleAction, RuleKind
from rosproxy.shared.setting_kinds import SettingError

ADMINISTRATOR = "administrator"
"""Name of the layer from the operator's options. This layer is for all proxies."""
POLICY_WAIT_S = 3.0
"""Seconds that a started proxy waits for ``POST /policy``. Calls of new callers wait as long."""
MOST_RULES_OF_AUTHOR = MOST_RULES // 2
"""The most rules of an author: the rules of the administrator and another author must fit."""
LONGEST_VARIABLE_BYTES = 96 * 1024
"""The most bytes of the variable. Linux allows less than 128 KiB (execve(2), MAX_ARG_STRLEN)."""
LONGEST_POLICY_BYTES = LONGEST_VARIABLE_BYTES // 3
"""The most bytes of an author's layers as JSON. The layers of two authors fit into a variable."""
_SUBSTITUTE_LAYER = "the operator, which has not sent its long policy yet"
"""Name of the layer that replaces layers that are too long for the variable."""


def administrators_policy(rules: Iterable[tuple[Rule, ...]], mode: str) -> tuple[PolicyLayer, ...]:
    """Return the layer of the operator's options; empty without rules. Raises SettingError."""
    all_rules = tuple(rule for group in rules for rule in group)
    layers = (PolicyLayer(ADMINISTRATOR, all_rules, PolicyMode(mode)),) if all_rules else ()
    if problem := excess_reason(layers):
        raise SettingError("--policy", f"{problem}. Join rules by globs")
    return layers


def excess_reason(layers: Sequence[PolicyLayer]) -> str:
    """Return which bound the layers of an author exceed; empty if the layers are within bounds."""
    count = sum(len(layer.rules) for layer in layers)
    if count > MOST_RULES_OF_AUTHOR:
        return f"{count} rules, at most {MOST_RULES_OF_AUTHOR} are accepted"
    size = len(_as_json(layers))
    return (
        f"{size} bytes, at most {LONGEST_POLICY_BYTES} are accepted"
        if size > LONGEST_POLICY_BYTES
        else ""
    )


def as_variable(layers: Sequence[PolicyLayer]) -> str:
    """Return the layers as JSON for the variable of a new proxy; empty without layers.

    If the text is too long for a variable, one layer that denies at least as much replaces the
    layers of single nodes. If the text is still too long, such a layer replaces all layers. So no
    denied name becomes visible before the operator sends the policy.
    """
    if not layers:
        return ""
    common = [layer for layer in layers if layer.addresses is None]
    others = [layer for layer in layers if layer.addresses is not None]
    addresses = frozenset(address for layer in others for address in layer.addresses or ())
    shorter = [*common, *_stricter(others, addresses)]
    texts = (_as_json(subset) for subset in (layers, shorter))
    fitting = (text for text in texts if len(text) <= LONGEST_VARIABLE_BYTES)
    return next(fitting, None) or _as_json(_stricter(layers, None))


def _stricter(
    layers: Iterable[PolicyLayer], addresses: frozenset[str] | None
) -> tuple[PolicyLayer, ...]:
    """Return a layer that denies all names of each kind for which ``layers`` have a deny rule.

    Layers in mode audit do not count. The layer is for the nodes at ``addresses``; None: for all
    nodes. Return an empty tuple if the layers deny nothing.
    """
    kinds = {
        rule.kind
        for layer in layers
        if layer.mode is PolicyMode.ENFORCE
        for rule in layer.rules
        if rule.action is RuleAction.DENY
    }
    rules = tuple(Rule(RuleAction.DENY, kind, "*") for kind in RuleKind if kind in kinds)
    return (PolicyLayer(_SUBSTITUTE_LAYER, rules, addresses=addresses),) if rules else ()


def _as_json(layers: Iterable[PolicyLayer]) -> str:
    """Return layers as JSON in ASCII, so each character is a byte."""
    return json.dumps(layers_as_json(layers))
