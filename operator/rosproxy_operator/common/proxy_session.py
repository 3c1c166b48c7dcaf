"""The operator's session with a proxy: the admin endpoint, and the facts that the proxy confirmed.

A proxy stores nothing on disk. After a restart, the proxy lacks the current policy and the selected
addresses. So the session notes the facts that the running process has confirmed, and
`ProxySession.forget` drops these notes. The operator of each engine decides when to send facts.
"""

import asyncio
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.documents.status_document import ProxyStatus
from rosproxy.shared.policy.layers import PolicyLayer
from rosproxy_operator.common.proxy_client import Json, ProxyClient
from rosproxy_operator.common.proxy_status import Leases


@dataclass(frozen=True, slots=True)
class AllowedCallers:
    """The addresses that may use a proxy, and what the operator sends in the same call.

    ``peers`` are the peers of ROS 2; None: do not send peers. ROS 1 has no peers. On Docker, an
    option of the proxy has the peers. ``former_leases`` are the ports of participants at the
    previous proxy.
    """

    addresses: tuple[str, ...]
    peers: tuple[str, ...] | None = None
    former_leases: Leases = field(default_factory=dict)


class ProxySession:
    """Sends facts to a proxy, and notes the confirmed facts. All requests raise ProxyError."""

    def __init__(self, client: ProxyClient, admin: HostPort, token: str) -> None:
        self.admin = admin
        self.token = token
        self._client = client
        self._policy: tuple[PolicyLayer, ...] | None = None
        self._callers: AllowedCallers | None = None
        self._sending_policy = asyncio.Lock()
        self._runs = 0

    def forget(self) -> None:
        """Drop all notes: a new process of the proxy may answer, which has confirmed nothing."""
        self._policy = self._callers = None
        self._runs += 1

    def has_policy(self, layers: tuple[PolicyLayer, ...]) -> bool:
        """Whether these are the last layers that the running process has confirmed."""
        return layers == self._policy

    def has_callers(self, callers: AllowedCallers) -> bool:
        """Whether these are the last callers that the running process has confirmed."""
        return callers == self._callers

    async def status(self) -> ProxyStatus:
        """Request the ``/status`` of the proxy."""
        return await self._client.status(self.admin)

    async def changes(self, since: str, within: float) -> tuple[str, ProxyStatus]:
        """Wait for another status (`ProxyClient.changes`). Return version and status."""
        return await self._client.changes(self.admin, self.token, since, within)

    async def send_policy(self, layers: tuple[PolicyLayer, ...]) -> None:
        """Send the policy's layers if they are not confirmed. Raises PolicyRefused, too."""
        # If two tasks send the same layers, the second task waits, and then sends nothing.
        async with self._sending_policy:
            if self.has_policy(layers):
                return
            run = self._runs
            await self._client.send_policy(self.admin, self.token, layers)
            if run == self._runs:  # otherwise the former process may have confirmed
                self._policy = layers

    async def send_callers(self, callers: AllowedCallers) -> None:
        """Send the callers, even if the proxy has confirmed them already."""
        run = self._runs
        peers = callers.peers
        former = callers.former_leases
        await self._client.send_selected(self.admin, self.token, callers.addresses, peers, former)
        if run == self._runs:
            self._callers = callers

    async def send_containers(self, body: Mapping[str, Any]) -> Json:
        """Send the addresses of containers that have gone, moved or arrived. Return the counts."""
        return await self._client.send_containers(self.admin, self.token, body)

    async def send_master_address(self, address: str) -> None:
        """Send the current address of the master's host."""
        await self._client.send_master_address(self.admin, self.token, address)
