"""A policy that has changed: registrations are hidden and shown, connections are cut.

What is denied now is taken back at the master and hidden; the nodes inside that use it stay
connected. What is allowed again is registered. Connections from outside to what outside may not
have are cut, and a node of which anything may be denied loses its fast port, as do all stand-ins
for nodes outside where a rule is about those: what the kernel forwards is not checked. Nothing
else is touched, so that it may be done at any time, and is done again until it has worked.
"""

import asyncio
import logging
from dataclasses import dataclass, field

from rosproxy.admin.requests import EnforcementCounts
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

log = logging.getLogger(__name__)

ENFORCE_TICK = 0.5
"""Seconds between looks whether the policy has changed."""


@dataclass(slots=True, eq=False)
class PolicyEnforcer:
    """Makes registrations and connections fit the policy."""

    _context: Context
    _leases: Leases
    _registrar: Registrar
    _recovery: Recovery
    _tcpros: TcprosServer
    _plane: KernelPlane
    _stand_ins: StandInPorts
    _enforced_version: int = -1
    _lock: asyncio.Lock = field(default_factory=asyncio.Lock)

    async def look(self) -> None:
        """Enforce the policy if that has not been done since it changed."""
        policy = self._context.policy
        if policy.must_enforce or self._enforced_version != policy.rules.version:
            try:
                await self.enforce()
            except (Unreachable, MasterError) as error:
                log.debug("the proxy could not enforce the policy yet: %s", error)

    async def enforce(self) -> EnforcementCounts:
        """Make everything fit the policy. Raises Unreachable, MasterError; what is cut is cut."""
        async with self._lock:
            # Before anything is awaited: what changes meanwhile is left for the next look.
            policy = self._context.policy
            version = policy.rules.version
            policy.must_enforce = False
            cut = self._cut_relays() + self._stand_ins.udpros.cut_denied() + self._take_fast_ports()
            try:
                await self._recovery.ensure()
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

    def _cut_relays(self) -> int:
        """End the connections that outside, or a node inside, may not have; how many.

        The name of what is not registered is not known: a connection to it may be denied as well.
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

    def _take_fast_ports(self) -> int:
        """Take fast ports from nodes of which something may be denied; how many connections."""
        policy = self._context.policy
        count = 0 if policy.inside_may_bypass() else self._stand_ins.close_fast_ports()
        # These are connections of nodes inside, who may have to be told of their publishers again.
        if count:
            self._leases.watch(self._context.registry)
        for endpoint in self._context.registry:
            if endpoint.fast_port is not None and not policy.may_bypass(endpoint):
                count += endpoint.fast_connections
                self._plane.cut(endpoint)
                self._leases.withdraw_fast_port(endpoint)
        return count
