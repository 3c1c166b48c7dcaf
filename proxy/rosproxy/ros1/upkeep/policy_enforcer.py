"""Enforce a changed policy: hide and show registrations, and cut connections.

- The proxy takes back denied registrations at the master, and hides these registrations.
  Connections between nodes inside stay.
- The proxy registers hidden registrations at the master once the policy allows them.
- The proxy cuts connections to denied topics and services: connections from outside, and
  connections from inside through stand-ins.
- A node loses its fast port if the policy may deny one of its topics, because the proxy does not
  check what the kernel forwards. If a rule concerns nodes outside, all stand-ins lose the second
  port that the kernel forwards.

All other connections and registrations stay, so the proxy can repeat the enforcement. It does so
until all steps have worked.
"""

import asyncio
import logging
from dataclasses import dataclass, field

from rosproxy.access.access_policy import OFFER_KINDS
from rosproxy.forwarding.kernel.plane import KernelPlane
from rosproxy.forwarding.relay import Relay
from rosproxy.ros1.clients.master_client import MasterError, Unreachable
from rosproxy.ros1.context import Context
from rosproxy.ros1.leases import Leases
from rosproxy.ros1.registry.endpoint import Endpoint
from rosproxy.ros1.servers.tcpros_server import UNREGISTERED, TcprosServer
from rosproxy.ros1.stand_ins.stand_in_ports import StandInPorts
from rosproxy.ros1.upkeep.recovery import Recovery
from rosproxy.ros1.upkeep.registrar import Registrar
from rosproxy.shared.documents.requests import EnforcementCounts

log = logging.getLogger(__name__)

ENFORCE_INTERVAL_S = 0.5
"""Seconds between two checks whether the policy has changed."""


@dataclass(slots=True, eq=False)
class PolicyEnforcer:
    """Makes registrations and connections comply with the policy."""

    _context: Context
    _leases: Leases
    _registrar: Registrar
    _recovery: Recovery
    _tcpros: TcprosServer
    _plane: KernelPlane
    _stand_ins: StandInPorts
    _enforced_version: int = -1
    _lock: asyncio.Lock = field(default_factory=asyncio.Lock)

    async def enforce_if_changed(self) -> None:
        """Enforce the policy if the policy has changed since the last time."""
        policy = self._context.policy
        if policy.must_enforce or self._enforced_version != policy.rules.version:
            try:
                await self.enforce()
            except (Unreachable, MasterError) as error:
                log.debug("the proxy could not enforce the policy yet: %s", error)

    async def enforce(self) -> EnforcementCounts:
        """Hide and show registrations, and cut connections. Return the counts.

        Raises Unreachable, MasterError; cut connections stay cut.
        """
        async with self._lock:
            # Before the first await: the next check handles changes that happen meanwhile.
            policy = self._context.policy
            version = policy.rules.version
            policy.must_enforce = False
            cut = self._cut_relays() + self._stand_ins.udpros.cut_denied()
            cut += self._withdraw_fast_ports()
            try:
                await self._know_nodes()
                has_changed = version != self._enforced_version
                hidden, shown = await self._registrar.apply_policy(has_changed)
            except (Unreachable, MasterError):
                policy.must_enforce = True
                raise
            self._enforced_version = version
        enforced = EnforcementCounts(hidden, shown, cut)
        if enforced != EnforcementCounts():
            text = "policy applied: %d registrations hidden, %d shown, %d connections cut"
            log.info(text, hidden, shown, cut)
        return enforced

    async def _know_nodes(self) -> None:
        """Wait for the recovery, and cut what the kernel forwards for unknown nodes.

        Raises Unreachable.
        """
        try:
            await self._recovery.ensure()
        except Unreachable:
            self._plane.cut_former(self._may_be_denied)
            raise
        self._plane.cut_former(self._may_be_denied)

    def _cut_relays(self) -> int:
        """End the relays that the policy denies. Return their number.

        The name of an unregistered topic or service is unknown. So the proxy ends the relay of such
        a topic or service if any rule could deny it.
        """
        policy = self._context.policy
        count = 0
        for relay in self._tcpros.relays:
            endpoint = self._context.registry.by_port.get(relay.port)
            denied = endpoint is not None and self._is_denied(relay, endpoint)
            if denied or (relay.inside_asks and not policy.inside_may_keep(relay)):
                relay.end()
                count += 1
        return count

    def _is_denied(self, relay: Relay, endpoint: Endpoint) -> bool:
        if relay.name == UNREGISTERED:
            return not self._context.policy.may_bypass(endpoint)
        policy = self._context.policy
        return policy.check_outside(relay.kind, relay.name, endpoint, relay.peer) is not None

    def _withdraw_fast_ports(self) -> int:
        """Withdraw the fast ports of nodes with a topic that the policy may deny.

        If the policy may deny a topic of outside to inside, also close the fast ports of all
        stand-ins. Return the number of cut connections.
        """
        policy = self._context.policy
        count = 0 if policy.inside_may_bypass() else self._stand_ins.close_fast_ports()
        # Nodes inside have lost connections. If a node does not reconnect, the proxy sends the
        # publishers to this node again.
        if count:
            self._leases.watch(self._context.registry)
        owners = self._plane.owners
        for endpoint in self._context.registry:
            has_port = endpoint.fast_port is not None or endpoint in owners
            if has_port and not policy.may_bypass(endpoint):
                count += endpoint.fast_connections
                self._leases.withdraw_fast_port(endpoint)
                self._plane.cut(endpoint)
        return count

    def _may_be_denied(self, port: int, host: str | None) -> bool:
        """Whether the policy may deny a topic at a port that the kernel forwarded before the start.

        ``host`` is the address to which the port led; None if unknown.
        """
        policy = self._context.policy
        if port in self._context.settings.ports.listen:
            return policy.rules.may_deny(OFFER_KINDS, (), host)
        return not policy.inside_may_bypass()
