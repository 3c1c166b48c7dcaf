"""Layers of rules: a layer has an author, a mode, and the nodes for which the rules hold.

In each layer the first rule that matches decides. The policy allows what all enforced layers allow,
so a further layer can only deny more. A layer in audit mode denies nothing: the proxy reports what
the layer would deny.
"""

from collections.abc import Collection, Iterable, Sequence
from enum import Enum
from typing import Annotated, Any

import msgspec

from rosproxy.shared.addresses import parse_address
from rosproxy.shared.policy.rules import MOST_RULES, Rule, RuleAction, RuleKind, parse_rules

MOST_LAYERS = 1024
"""Layers of a proxy: one for each container with rules, and a few for options and operator."""
LONGEST_LAYER_NAME = 200
"""Characters of a layer's name."""


_Port = Annotated[int, msgspec.Meta(ge=1, le=65535)]


class PolicyMode(Enum):
    """Whether the proxy enforces the rules of a layer, or only reports what they would deny."""

    ENFORCE = "enforce"
    AUDIT = "audit"


class PolicyLayer(msgspec.Struct, frozen=True):
    """Rules of one author, for the nodes inside at ``addresses``; None: for all nodes inside.

    On rmw_zenoh, a layer with addresses holds only at ``ports``: the ports of the proxy to which
    the nodes of the layer connect. None stands for all ports.
    """

    name: str
    rules: tuple[Rule, ...]
    mode: PolicyMode = PolicyMode.ENFORCE
    addresses: frozenset[str] | None = None
    ports: frozenset[int] | None = None

    def is_for(self, address: str) -> bool:
        """Whether the rules hold for the node inside at an address."""
        return self.addresses is None or address in self.addresses


class WrittenLayer(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A layer as decoded from JSON; `read_layer` checks the rules and addresses."""

    name: str
    rules: tuple[str, ...]
    mode: PolicyMode = PolicyMode.ENFORCE
    addresses: tuple[str, ...] | None = None
    ports: tuple[_Port, ...] | None = None


class Verdict(msgspec.Struct, frozen=True):
    """Whether the policy allows something, and the ``rule`` of ``layer`` that denies it.

    ``allowed`` with a ``rule``: the layer is in audit mode, and the rule would deny.
    """

    allowed: bool = True
    rule: Rule | None = None
    layer: str = ""

    @property
    def mode(self) -> PolicyMode:
        """The mode of the layer with the rule; meaningless without a rule."""
        return PolicyMode.AUDIT if self.allowed else PolicyMode.ENFORCE

    @property
    def reason(self) -> str:
        """The layer and the rule, for messages; empty without a rule."""
        return f"policy of {self.layer}: {self.rule}" if self.rule else ""


ALLOWED = Verdict()


def decide(
    layers: Iterable[PolicyLayer], kind: RuleKind, name: str, caller: str, address: str
) -> Verdict:
    """The verdict on a name for ``caller``, by the layers for the node inside at ``address``."""
    return _verdict(
        (layer, next((rule for rule in layer.rules if rule.matches(kind, name, caller)), None))
        for layer in layers
        if layer.is_for(address)
    )


def decide_below(
    layers: Iterable[PolicyLayer], kind: RuleKind, prefix: str, caller: str, address: str
) -> Verdict:
    """The verdict on all names that begin with ``prefix``: a denial if a rule may deny one."""
    return _verdict(
        (layer, _first_below(layer, kind, prefix, caller))
        for layer in layers
        if layer.is_for(address)
    )


def of_kind(layers: Iterable[PolicyLayer], kind: RuleKind) -> tuple[PolicyLayer, ...]:
    """The layers that have rules of one kind, with these rules alone: equivalent for that kind."""
    pairs = [(layer, tuple(rule for rule in layer.rules if rule.kind is kind)) for layer in layers]
    return tuple(msgspec.structs.replace(layer, rules=kept) for layer, kept in pairs if kept)


def strictest(verdicts: Iterable[Verdict]) -> Verdict:
    """The strictest verdict: a denial, else a denial in audit mode. Needs at least one verdict."""
    return min(verdicts, key=lambda verdict: (verdict.allowed, verdict.rule is None))


def may_deny(
    layers: Iterable[PolicyLayer],
    kinds: Collection[RuleKind],
    callers: Collection[str],
    address: str | None,
) -> bool:
    """Whether an enforced rule of these kinds may deny something to one of these callers.

    Without callers: to any caller. ``address`` is the address of the node inside; None: any.
    """
    return any(
        rule.action is RuleAction.DENY
        and (not callers or any(rule.is_about(rule.kind, name) for name in callers))
        for layer in layers
        if layer.mode is PolicyMode.ENFORCE and (address is None or layer.is_for(address))
        for rule in layer.rules
        if rule.kind in kinds
    )


def read_layer(written: WrittenLayer) -> PolicyLayer:
    """The layer that JSON describes. Raises ValueError, which names the layer and the fault."""
    shown = written.name[:40]
    if not written.name.strip() or len(written.name) > LONGEST_LAYER_NAME:
        text = f"the name of a layer must have 1 to {LONGEST_LAYER_NAME} characters"
        raise ValueError(f"layer {shown!r}: {text}")
    try:
        rules = tuple(rule for text in written.rules for rule in parse_rules(text))
        addresses = _addresses(written.addresses)
    except ValueError as error:
        raise ValueError(f"layer {shown!r}: {error}") from None
    ports = None if written.ports is None else frozenset(written.ports)
    return PolicyLayer(written.name, rules, written.mode, addresses, ports)


def read_layers(value: object) -> tuple[PolicyLayer, ...]:
    """The layers in ``value``, a list of decoded JSON. Raises ValueError, which names the fault."""
    try:
        written = msgspec.convert(value, tuple[WrittenLayer, ...])
    except msgspec.ValidationError as error:
        raise ValueError(str(error)) from None
    return check_bounds([read_layer(layer) for layer in written])


def layers_as_json(layers: Iterable[PolicyLayer]) -> list[dict[str, Any]]:
    """Layers as JSON that `read_layers` takes."""
    return [
        {
            "name": layer.name,
            "mode": layer.mode.value,
            "rules": [str(rule) for rule in layer.rules],
            "addresses": None if layer.addresses is None else sorted(layer.addresses),
            **({} if layer.ports is None else {"ports": sorted(layer.ports)}),
        }
        for layer in layers
    ]


def check_bounds(layers: Sequence[PolicyLayer]) -> tuple[PolicyLayer, ...]:
    """Return the layers. Raises ValueError for more than MOST_LAYERS or MOST_RULES."""
    if len(layers) > MOST_LAYERS:
        raise ValueError(f"the policy has {len(layers)} layers, at most {MOST_LAYERS} are accepted")
    count = sum(len(layer.rules) for layer in layers)
    if count > MOST_RULES:
        raise ValueError(f"the policy has {count} rules, at most {MOST_RULES} are accepted")
    return tuple(layers)


def _verdict(deciding_rules: Iterable[tuple[PolicyLayer, Rule | None]]) -> Verdict:
    """The verdict of all layers, given the deciding rule of each: the first enforced denial.

    Without an enforced denial, the verdict has the first denial in audit mode.
    """
    verdict = ALLOWED
    for layer, rule in deciding_rules:
        if rule is None or rule.action is RuleAction.ALLOW:
            continue
        if layer.mode is PolicyMode.ENFORCE:
            return Verdict(False, rule, layer.name)
        if verdict.rule is None:
            verdict = Verdict(True, rule, layer.name)
    return verdict


def _first_below(layer: PolicyLayer, kind: RuleKind, prefix: str, caller: str) -> Rule | None:
    """The first rule that allows all names below a prefix, or may deny a name there."""
    for rule in layer.rules:
        if not rule.is_about(kind, caller):
            continue
        if rule.action is RuleAction.DENY and rule.may_match_below(prefix):
            return rule
        if rule.action is RuleAction.ALLOW and rule.covers_below(prefix):
            return rule
    return None


def _addresses(written: Sequence[str] | None) -> frozenset[str] | None:
    if written is None:
        return None
    address_by_text = {text: parse_address(text) for text in written}
    for text, address in address_by_text.items():
        if address is None:
            raise ValueError(f"addresses: must be IP addresses, not {text[:40]!r}")
    return frozenset(address for address in address_by_text.values() if address)
