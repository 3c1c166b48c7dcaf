"""The policy at each port for a container: the access control, and reports of denied names.

The access control of zenoh reports nothing. So the proxy compares the names in the tokens of nodes
inside with the rules, and reports each denial once.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from msgspec.structs import replace

from rosproxy.access.access_policy import AccessPolicy
from rosproxy.admin.common_status import MOST_HIDDEN
from rosproxy.shared.documents.status_bounds import fair_choice
from rosproxy.shared.documents.status_document import HiddenStatus
from rosproxy.shared.policy.layers import PolicyLayer, Verdict, decide
from rosproxy.shared.policy.rules import RuleKind
from rosproxy.shared.ports import PortRange
from rosproxy.shared.zenoh_rules.name_sets import layers_at
from rosproxy.zenoh.access_control import access_control

MOST_JUDGED_NAMES = 200
"""Names that the proxy compares with the rules at a time. With 1,000 rules, a name takes 0.7 ms."""


class InsideName(NamedTuple):
    """A topic or service of a node inside, and the port and address of this node."""

    port: int
    address: str
    node: str
    kind: RuleKind
    name: str


class RouterPolicy:
    """The layers of the policy by port, and the verdicts about the names of nodes inside.

    ``ports`` are for containers, ``listen`` is the port for outside; None: there is no such port.
    """

    def __init__(self, policy: AccessPolicy, ports: PortRange, listen: int | None = None) -> None:
        self._policy = policy
        self._ports = ports
        self._listen = listen
        self._addresses: dict[int, frozenset[str]] = {}
        self._layers: dict[int, tuple[PolicyLayer, ...]] = {}
        self._access: dict[int, object] = {}
        self._access_inputs: object = None
        self._verdicts: dict[InsideName, Verdict] = {}

    def note(self, sessions: Iterable[tuple[int, str]]) -> None:
        """Note the ports and addresses of sessions, for the addresses that a layer names.

        A port keeps the layers of an address that once had a session there. Otherwise the layers
        would end with the session, and the next session would begin without layers.
        """
        named = frozenset[str]().union(*(layer.addresses or () for layer in self._policy.layers))
        seen = dict(self._addresses)
        for port, address in sessions:
            if address in named:
                seen[port] = seen.get(port, frozenset()) | {address}
        self._addresses = {port: kept for port, found in seen.items() if (kept := found & named)}

    def access(self) -> dict[int, object]:
        """The access control by port, for the ports that have any.

        If nothing has changed since the last call, the result is the same object.

        Raises ValueError as `check_layers` does.
        """
        inputs = self._policy.version, self._addresses
        if inputs == self._access_inputs:
            return self._access
        access: dict[int, object] = {}
        made: dict[tuple[PolicyLayer, ...], object] = {}
        for port in self._ports.ports():
            layers = layers_at(self._policy.layers, port, self._addresses.get(port, ()))
            if layers not in made:
                made[layers] = access_control(layers)
            if made[layers]:
                access[port] = made[layers]
            self._note_layers(port, layers)
        if self._listen is not None:
            for_all = layers_at(self._policy.layers, self._listen, ())
            if control := access_control(for_all, outside=True):
                access[self._listen] = control
        self._access = access
        self._access_inputs = inputs
        return access

    def _note_layers(self, port: int, layers: Sequence[PolicyLayer]) -> None:
        # `layers_at` has decided for which nodes the layers hold. So a verdict needs no address.
        at_port = tuple(replace(layer, addresses=None) for layer in layers)
        if at_port != self._layers.get(port):
            self._layers[port] = at_port
            self._verdicts = {n: v for n, v in self._verdicts.items() if n.port != port}

    def look(self, names: Iterable[InsideName]) -> None:
        """Judge names that are new, up to a bound, and report denials. Forget names that ended."""
        current = dict.fromkeys(names)
        self._verdicts = {name: v for name, v in self._verdicts.items() if name in current}
        new = [name for name in current if name not in self._verdicts]
        for name in fair_choice(new, lambda name: name.address, MOST_JUDGED_NAMES):
            verdict = decide(self._layers.get(name.port, ()), name.kind, name.name, "", "")
            subject = f"{name.name} of {name.node}"
            self._verdicts[name] = self._policy.report(verdict, name.kind, subject, name.address)

    def not_judged(self, names: Iterable[InsideName]) -> set[tuple[int, str, str]]:
        """Port, address and name of the nodes with names that `look` has still to judge.

        Without rules at the port, no rule can deny a name.
        """
        return {
            (name.port, name.address, name.node)
            for name in names
            if self._layers.get(name.port) and name not in self._verdicts
        }

    def hidden(self) -> tuple[list[HiddenStatus], int]:
        """The names that the policy hides from outside, and how many are left out."""
        denied = [pair for pair in self._verdicts.items() if not pair[1].allowed]
        rows = [
            HiddenStatus(name.kind.value, name.name, name.node, verdict.reason, name.address)
            for name, verdict in fair_choice(denied, lambda pair: pair[0].address, MOST_HIDDEN)
        ]
        return rows, len(denied) - len(rows)
