"""Hidden services after a restart of the proxy: nodes inside are asked whether they have one.

The slave API tells a node's topics, but not its services, and the master was never told of hidden
ones. So when a node inside looks a service up that is unknown and that the policy would hide, those
nodes that were found again by the last recovery are asked for it, by the header of a service client
that only probes (http://wiki.ros.org/ROS/Connection%20Header). Nobody is asked for the same name
again for a while: roscpp looks a service up fifty times a second while it waits for one.
"""

import asyncio
from dataclasses import dataclass, field

from rosproxy.access.rules import RuleKind
from rosproxy.net.addresses import HostPort
from rosproxy.ros1.context import Context
from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.protocol.uris import service_uri
from rosproxy.ros1.registry.endpoint import Endpoint, Registration
from rosproxy.ros1.rewriting.master_calls import Request, second_parameter_name

ASK_AGAIN = 5.0
"""Seconds in which nodes are not asked for the same service again."""
MOST_REMEMBERED = 1000
"""Services that are remembered for that."""


@dataclass(slots=True, eq=False)
class ServiceFinder:
    """Finds hidden services that a former process of the proxy knew."""

    _context: Context
    _asked_at: dict[str, float] = field(default_factory=dict)

    async def find_for(self, request: Request) -> None:
        """Register as hidden what nodes inside have of the services that a request looks up."""
        looked_up = {
            second_parameter_name(call)
            for call in request.calls
            if call and call.method == "lookupService"
        }
        for name in looked_up - self._context.registry.services.keys():
            await self._find(name)

    async def _find(self, name: str) -> None:
        now = self._context.now()
        endpoints = [e for e in self._context.registry if self._may_have(e, name)]
        if not endpoints or now - self._asked_at.get(name, -ASK_AGAIN) < ASK_AGAIN:
            return
        self._asked_at.pop(name, None)
        if len(self._asked_at) >= MOST_REMEMBERED:
            del self._asked_at[next(iter(self._asked_at))]
        self._asked_at[name] = now
        await asyncio.gather(*(self._ask(endpoint, name) for endpoint in endpoints))

    def _may_have(self, endpoint: Endpoint, name: str) -> bool:
        """Whether a node may have a service that is hidden and that it registered before."""
        if not (endpoint.restored and endpoint.answers and endpoint.node_ports):
            return False
        judge = self._context.policy.judge
        return not judge(RuleKind.SERVE, name, endpoint.caller_ids, endpoint.address).allowed

    async def _ask(self, endpoint: Endpoint, name: str) -> None:
        for port in endpoint.node_ports:
            service = HostPort(endpoint.address, port)
            caller_id = await self._context.nodes.provider(service, name)
            if caller_id is not None and caller_id in endpoint.caller_ids:
                api = service_uri(HostPort(endpoint.node.host, port))
                now = self._context.now()
                registration = Registration(
                    Kind.SERVICE, name, caller_id, "*", api, now, hidden=True
                )
                self._context.registry.register(endpoint, registration)
                return
