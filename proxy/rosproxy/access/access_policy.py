"""The policy in force: whoever is about to let something pass asks it, and it tells of denials.

Layers come from three sources: the options, which stay; a file, which is read again when it
changes; and an operator, whose word replaces what it said before. Whatever is denied, or would be
by a layer in audit mode, is told in the log, the metrics and the status.
"""

import asyncio
import contextlib
from collections.abc import Collection, Sequence

from rosproxy.access.layers import (
    ALLOWED,
    PolicyLayer,
    PolicyMode,
    Verdict,
    check_bounds,
    decide,
    decide_below,
    may_deny,
    of_kind,
    strictest,
)
from rosproxy.access.rules import RuleKind
from rosproxy.telemetry.metrics import Metrics
from rosproxy.telemetry.refusals import DENIED, WOULD_BE_DENIED, Refusals

OUTWARDS = frozenset({RuleKind.PUBLISH, RuleKind.SERVE})
"""What is enforced on the way of TCPROS connections from outside."""
PARAMETERS = frozenset({RuleKind.GET_PARAM, RuleKind.SET_PARAM})


class AccessPolicy:
    """The layers in force: of the options, of the policy file and of an operator.

    ``version`` is another number after each change of them, ``empty`` whether there is no rule.
    """

    def __init__(
        self,
        option_layers: Sequence[PolicyLayer],
        operator_layers: Sequence[PolicyLayer],
        metrics: Metrics,
        refusals: Refusals,
    ) -> None:
        self._metrics = metrics
        self._refusals = refusals
        self._option_layers = tuple(option_layers)
        self._operator_layers = tuple(operator_layers)
        self._file_layers = tuple[PolicyLayer, ...]()
        self._operator_told = asyncio.Event()
        self._by_kind: dict[RuleKind, tuple[PolicyLayer, ...]] = {}
        self.version = 0
        self.empty = False
        self._note_change()

    @property
    def layers(self) -> tuple[PolicyLayer, ...]:
        """All layers in force."""
        return (*self._option_layers, *self._file_layers, *self._operator_layers)

    def use_file(self, layer: PolicyLayer) -> None:
        """Take in what the file says now. Raises ValueError if that is too much."""
        check_bounds((*self._option_layers, layer, *self._operator_layers))
        self._file_layers = (layer,)
        self._note_change()

    def use_operator_layers(self, layers: Sequence[PolicyLayer]) -> None:
        """Take in what an operator says now. Raises ValueError if that is too much."""
        check_bounds((*self._option_layers, *self._file_layers, *layers))
        self._operator_layers = tuple(layers)
        self._note_change()
        self._operator_told.set()

    async def wait_for_operator(self, seconds: float) -> None:
        """Wait until an operator has told its layers, once and for so many seconds at most."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await self._operator_told.wait()
        self._operator_told.set()

    def judge(self, kind: RuleKind, name: str, callers: Sequence[str], address: str) -> Verdict:
        """Whether a thing is allowed to all of the callers at a node inside; nothing is reported.

        What only some of them may not have is denied: nobody can tell them apart at one URI.
        """
        if self.empty:
            return ALLOWED
        layers = self._layers_for(kind)
        return strictest([decide(layers, kind, name, c, address) for c in callers or ("",)])

    def ask(
        self,
        kind: RuleKind,
        name: str,
        callers: Sequence[str],
        address: str,
        source: str = "",
    ) -> Verdict:
        """The same, and a denial is reported; ``source`` is the address of who asks, if another."""
        verdict = self.judge(kind, name, callers, address)
        subject = f"{name} of {callers[0]}" if callers else name
        return self.report(verdict, kind, subject, source or address)

    def judge_below(self, kind: RuleKind, prefix: str, caller: str, address: str) -> Verdict:
        """Whether all is allowed whose name begins with a prefix; nothing is reported."""
        return decide_below(self._layers_for(kind), kind, prefix, caller, address)

    def report(self, verdict: Verdict, kind: RuleKind, subject: str, source: str) -> Verdict:
        """Report a verdict in metrics, log and status, if a rule denies or would deny."""
        if verdict.rule is not None:
            is_audit = verdict.mode is PolicyMode.AUDIT
            self._metrics.policy_denied.labels(kind.value, verdict.mode.value).inc()
            outcome = "would be denied" if is_audit else "is denied"
            reason = WOULD_BE_DENIED if is_audit else DENIED
            text = f"{kind.value} {subject} {outcome} by {verdict.reason}"
            self._refusals.note(reason, source, text)
        return verdict

    def may_deny(
        self, kinds: Collection[RuleKind], callers: Collection[str], address: str | None
    ) -> bool:
        """Whether an enforced rule may deny something of these kinds to one of these callers.

        ``address`` is that of the node inside; None: any.
        """
        if self.empty:
            return False
        return any(may_deny(self._layers_for(kind), (kind,), callers, address) for kind in kinds)

    def _note_change(self) -> None:
        self._by_kind.clear()
        self.version += 1
        self.empty = not any(layer.rules for layer in self.layers)

    def _layers_for(self, kind: RuleKind) -> tuple[PolicyLayer, ...]:
        """The layers with their rules of one kind; those without any are left out."""
        if kind not in self._by_kind:
            self._by_kind[kind] = of_kind(self.layers, kind)
        return self._by_kind[kind]
