"""The policy in force: gives a verdict on each name, and reports denials.

Layers come from three sources. The layers of the options stay. The layer of the policy file changes
with the file. New layers of an operator replace the earlier layers of the operator. The log, the
metrics and the status report each denial, and what a layer in audit mode would deny.
"""

import asyncio
import contextlib
from collections.abc import Callable, Collection, Sequence

from rosproxy.access.rule_index import RuleIndex
from rosproxy.shared.output.problems import DENIED, WOULD_BE_DENIED
from rosproxy.shared.policy.layers import (
    ALLOWED,
    PolicyLayer,
    PolicyMode,
    Verdict,
    check_bounds,
    decide_below,
    may_deny,
    of_kind,
)
from rosproxy.shared.policy.rules import RuleKind
from rosproxy.telemetry.metrics import Metrics
from rosproxy.telemetry.refusals import Refusals

OFFER_KINDS = frozenset({RuleKind.PUBLISH, RuleKind.SERVE})
"""The kinds of rules about what nodes inside offer: the proxy enforces these on TCPROS connections
from outside."""
PARAMETER_KINDS = frozenset({RuleKind.GET_PARAM, RuleKind.SET_PARAM})
"""The kinds of rules about parameters."""
MOST_INDEXES = 256
"""Addresses and kinds of rules whose rules are kept prepared."""


class AccessPolicy:
    """The layers in force: of the options, of the policy file and of an operator.

    ``version`` grows by 1 with each change of the layers. ``empty``: no layer has a rule. Before
    new layers are put in force, the policy calls each of ``checks`` with all layers. A check raises
    ValueError for a rule that the proxy cannot enforce.
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
        self._operator_wait_over = asyncio.Event()
        self.checks: list[Callable[[Sequence[PolicyLayer]], None]] = []
        self._by_kind: dict[RuleKind, tuple[PolicyLayer, ...]] = {}
        self._indexes: dict[tuple[RuleKind, str], RuleIndex] = {}
        """The rules by kind and by address of a node inside, for the latest addresses."""
        self.version = 0
        self.empty = False
        self._note_change()

    @property
    def layers(self) -> tuple[PolicyLayer, ...]:
        """All layers in force."""
        return (*self._option_layers, *self._file_layers, *self._operator_layers)

    def use_file(self, layer: PolicyLayer) -> None:
        """Put the layer of the policy file in force. Raises ValueError if a check fails."""
        self._check((*self._option_layers, layer, *self._operator_layers))
        self._file_layers = (layer,)
        self._note_change()

    def use_operator_layers(self, layers: Sequence[PolicyLayer]) -> None:
        """Put the layers of an operator in force. Raises ValueError if a check fails."""
        self._check((*self._option_layers, *self._file_layers, *layers))
        self._operator_layers = tuple(layers)
        self._note_change()
        self._operator_wait_over.set()

    async def wait_for_operator(self, seconds: float) -> None:
        """Wait until an operator has sent layers, but at most ``seconds``.

        After the end of a wait, further calls return at once.
        """
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await self._operator_wait_over.wait()
        self._operator_wait_over.set()

    def judge(self, kind: RuleKind, name: str, callers: Sequence[str], address: str) -> Verdict:
        """The verdict on a name for all of ``callers``, without a report.

        ``address`` is the address of the node inside. Callers at one URI are indistinguishable, so
        a denial for one caller is a denial for all.
        """
        if self.empty:
            return ALLOWED
        return self._index_for(kind, address).judge(name, callers or ("",))

    def ask(
        self,
        kind: RuleKind,
        name: str,
        callers: Sequence[str],
        address: str,
        source: str = "",
    ) -> Verdict:
        """Return the verdict of `judge`, and report a denial.

        ``source``: the address that the report names, if not the address of the node inside.
        """
        verdict = self.judge(kind, name, callers, address)
        subject = f"{name} of {callers[0]}" if callers else name
        return self.report(verdict, kind, subject, source or address)

    def judge_below(self, kind: RuleKind, prefix: str, caller: str, address: str) -> Verdict:
        """The verdict on all names that begin with ``prefix``, without a report.

        The policy denies these names if it may deny one of them.
        """
        return decide_below(self._layers_for(kind), kind, prefix, caller, address)

    def report(self, verdict: Verdict, kind: RuleKind, subject: str, source: str) -> Verdict:
        """Return the verdict. If a rule denies or would deny, report it in metrics, log, status."""
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
        """Whether an enforced rule of these kinds may deny something to one of these callers.

        Without callers: to any caller. ``address`` is the address of the node inside; None: any.
        """
        if self.empty:
            return False
        return any(may_deny(self._layers_for(kind), (kind,), callers, address) for kind in kinds)

    def _check(self, layers: Sequence[PolicyLayer]) -> None:
        check_bounds(layers)
        for check in self.checks:
            check(layers)

    def _note_change(self) -> None:
        self._by_kind.clear()
        self._indexes.clear()
        self.version += 1
        self.empty = not any(layer.rules for layer in self.layers)

    def _index_for(self, kind: RuleKind, address: str) -> RuleIndex:
        """The rules of one kind that hold for the nodes inside at an address."""
        index = self._indexes.get((kind, address))
        if index is None:
            if len(self._indexes) >= MOST_INDEXES:
                self._indexes.clear()
            index = RuleIndex.of_kind(self._layers_for(kind), kind, address)
            self._indexes[kind, address] = index
        return index

    def _layers_for(self, kind: RuleKind) -> tuple[PolicyLayer, ...]:
        """The layers that have rules of one kind, with these rules alone."""
        if kind not in self._by_kind:
            self._by_kind[kind] = of_kind(self.layers, kind)
        return self._by_kind[kind]
