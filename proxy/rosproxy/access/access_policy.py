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
    bounded,
    decide,
    decide_below,
    may_deny,
    of_kind,
    strictest,
)
from rosproxy.access.rules import RuleKind
from rosproxy.telemetry.metrics import Metrics
from rosproxy.telemetry.refusals import Refusals

OUTWARDS = frozenset({RuleKind.PUBLISH, RuleKind.SERVE})
"""What is enforced on the way of TCPROS connections from outside."""
PARAMETERS = frozenset({RuleKind.GET_PARAM, RuleKind.SET_PARAM})


class AccessPolicy:
    """The layers in force: ``own`` are those of the options, ``told`` those of an operator.

    ``version`` is another number after each change of them, ``empty`` whether there is no rule.
    """

    def __init__(
        self,
        own: Sequence[PolicyLayer],
        told: Sequence[PolicyLayer],
        metrics: Metrics,
        refusals: Refusals,
    ) -> None:
        self._metrics, self._refusals = metrics, refusals
        self._own, self._told = tuple(own), tuple(told)
        self._file = tuple[PolicyLayer, ...]()
        self._heard = asyncio.Event()
        self._by_kind: dict[RuleKind, tuple[PolicyLayer, ...]] = {}
        self.version, self.empty = 0, False
        self._note_change()

    @property
    def layers(self) -> tuple[PolicyLayer, ...]:
        """All layers in force."""
        return (*self._own, *self._file, *self._told)

    def use_file(self, layer: PolicyLayer) -> None:
        """Take in what the file says now. Raises ValueError if that is too much."""
        bounded((*self._own, layer, *self._told))
        self._file = (layer,)
        self._note_change()

    def use_told(self, layers: Sequence[PolicyLayer]) -> None:
        """Take in what an operator says now. Raises ValueError if that is too much."""
        bounded((*self._own, *self._file, *layers))
        self._told = tuple(layers)
        self._note_change()
        self._heard.set()

    async def wait_for_operator(self, seconds: float) -> None:
        """Wait until an operator has told its layers, once and for so many seconds at most."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await self._heard.wait()
        self._heard.set()

    def judge(self, kind: RuleKind, name: str, callers: Sequence[str], address: str) -> Verdict:
        """Whether a thing is allowed to all of the callers at a node inside; nobody is told.

        What only some of them may not have is denied: nobody can tell them apart at one URI.
        """
        if self.empty:
            return ALLOWED
        layers = self._about(kind)
        return strictest([decide(layers, kind, name, one, address) for one in callers or ("",)])

    def ask(
        self,
        kind: RuleKind,
        name: str,
        callers: Sequence[str],
        address: str,
        source: str = "",
    ) -> Verdict:
        """The same, and a denial is told; ``source`` is the address of who asks, if another."""
        verdict = self.judge(kind, name, callers, address)
        what = f"{name} of {callers[0]}" if callers else name
        return self.tell(verdict, kind, what, source or address)

    def judge_below(self, kind: RuleKind, prefix: str, caller: str, address: str) -> Verdict:
        """Whether all is allowed whose name begins with a prefix; nobody is told."""
        return decide_below(self._about(kind), kind, prefix, caller, address)

    def tell(self, verdict: Verdict, kind: RuleKind, what: str, source: str) -> Verdict:
        """Tell of a verdict, if a rule denies or would deny."""
        if verdict.rule is not None:
            audit = verdict.mode is PolicyMode.AUDIT
            self._metrics.policy_denied.labels(kind.value, verdict.mode.value).inc()
            done = "would be denied" if audit else "denied"
            reason = "policy_audit" if audit else "policy"
            text = f"{kind.value} {what} {done} by {verdict.reason}"
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
        return any(may_deny(self._about(kind), (kind,), callers, address) for kind in kinds)

    def _note_change(self) -> None:
        self._by_kind.clear()
        self.version += 1
        self.empty = not any(layer.rules for layer in self.layers)

    def _about(self, kind: RuleKind) -> tuple[PolicyLayer, ...]:
        """The layers with their rules of one kind; those without any are left out."""
        if kind not in self._by_kind:
            self._by_kind[kind] = of_kind(self.layers, kind)
        return self._by_kind[kind]
