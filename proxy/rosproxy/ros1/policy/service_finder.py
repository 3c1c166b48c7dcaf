"""Finds hidden services after a restart of the proxy, by questions to nodes inside.

The slave API reports the topics of a node, but not the services, and the master never knew the
hidden services. When a node inside looks up an unknown service that the policy would hide, the
proxy asks the nodes that the last recovery found again. The question is the header of a service
client that only probes (http://wiki.ros.org/ROS/Connection%20Header).
"""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field

from rosproxy.access.access_policy import AccessPolicy
from rosproxy.ros1.clients.node_client import NodeClient
from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.registry.endpoint import Endpoint, Registration
from rosproxy.ros1.registry.registry import Registry
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.policy.rules import RuleKind
from rosproxy.shared.uris import service_uri

ASK_AGAIN_S = 5.0
"""Seconds between two questions for the same service. roscpp looks up an awaited service fifty
times a second."""
MOST_REMEMBERED_SERVICES = 1000
"""The highest number of services for which the proxy remembers the time of the last question."""


@dataclass(slots=True, eq=False)
class ServiceFinder:
    """Finds hidden services that a former process of the proxy knew."""

    _rules: AccessPolicy
    _registry: Registry
    _nodes: NodeClient
    _now: Callable[[], float]
    _asked_at: dict[str, float] = field(default_factory=dict)

    async def find(self, name: str) -> None:
        """Register an unknown service as hidden if a node inside has the service."""
        now = self._now()
        if name in self._registry.services:
            return
        endpoints = [e for e in self._registry if self._may_have(e, name)]
        if not endpoints or now - self._asked_at.get(name, -ASK_AGAIN_S) < ASK_AGAIN_S:
            return
        self._asked_at.pop(name, None)
        if len(self._asked_at) >= MOST_REMEMBERED_SERVICES:
            del self._asked_at[next(iter(self._asked_at))]
        self._asked_at[name] = now
        await asyncio.gather(*(self._ask(endpoint, name) for endpoint in endpoints))

    def _may_have(self, endpoint: Endpoint, name: str) -> bool:
        """Whether a node may have registered a hidden service before the restart."""
        if not (endpoint.restored and endpoint.answers and endpoint.node_ports):
            return False
        verdict = self._rules.judge(RuleKind.SERVE, name, endpoint.caller_ids, endpoint.address)
        return not verdict.allowed

    async def _ask(self, endpoint: Endpoint, name: str) -> None:
        for port in endpoint.node_ports:
            caller_id = await self._nodes.provider(HostPort(endpoint.address, port), name)
            if caller_id is not None and caller_id in endpoint.callers:
                api = service_uri(HostPort(endpoint.node.host, port))
                registration = Registration(
                    Kind.SERVICE, name, caller_id, "*", api, self._now(), hidden=True
                )
                self._registry.register(endpoint, registration)
                return
