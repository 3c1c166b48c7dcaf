"""One proxy as its operator deals with it: where it is asked, and what it has confirmed to know.

A proxy keeps nothing: one that is started again knows neither its policy nor who may use it. So
what it confirmed is remembered here, by the run of the process (`ProxySession.forget`), and the
operator of each engine decides when to tell the rest.
"""

import asyncio
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from rosproxy.access.layers import PolicyLayer
from rosproxy.admin.status_document import ProxyStatus
from rosproxy.net.addresses import HostPort
from rosproxy_operator.common.proxy_client import Json, ProxyClient
from rosproxy_operator.common.proxy_status import Leases


@dataclass(frozen=True, slots=True)
class AllowedCallers:
    """The addresses of all that may use a proxy.

    ``peers`` are those of ROS 2, None where the proxy is not for it. ``former_leases`` are the
    ports that participants had at the proxy before it.
    """

    addresses: tuple[str, ...]
    peers: tuple[str, ...] | None = None
    former_leases: Leases = field(default_factory=dict)


class ProxySession:
    """Tells one proxy what it is to know. Every call raises ProxyError."""

    def __init__(self, client: ProxyClient, admin: HostPort, token: str) -> None:
        self.admin = admin
        self.token = token
        self._client = client
        self._policy: tuple[PolicyLayer, ...] | None = None
        self._callers: AllowedCallers | None = None
        self._telling_policy = asyncio.Lock()
        self._runs = 0

    def forget(self) -> None:
        """Note that another process may answer from now on, which knows nothing."""
        self._policy = self._callers = None
        self._runs += 1

    def has_policy(self, layers: tuple[PolicyLayer, ...]) -> bool:
        """Whether it has confirmed these layers, and none since."""
        return layers == self._policy

    def has_callers(self, callers: AllowedCallers) -> bool:
        """Whether it has confirmed these callers, and none since."""
        return callers == self._callers

    async def status(self) -> ProxyStatus:
        """What its ``/status`` says."""
        return await self._client.status(self.admin)

    async def changes(self, since: str, within: float) -> tuple[str, ProxyStatus]:
        """The version of its status, and the status; see `ProxyClient.changes`."""
        return await self._client.changes(self.admin, self.token, since, within)

    async def tell_policy(self, layers: tuple[PolicyLayer, ...]) -> None:
        """Tell the layers of its policy, unless it has them. Raises PolicyRefused, too."""
        # Of two tasks that want it told the second one waits, and finds that it has been.
        async with self._telling_policy:
            if self.has_policy(layers):
                return
            run = self._runs
            await self._client.policy(self.admin, self.token, layers)
            if run == self._runs:  # else the process that confirmed it may be the former one
                self._policy = layers

    async def tell_callers(self, callers: AllowedCallers) -> None:
        """Tell who may use it, whether or not it knows."""
        run = self._runs
        peers = callers.peers
        former = callers.former_leases
        await self._client.selected(self.admin, self.token, callers.addresses, peers, former)
        if run == self._runs:
            self._callers = callers

    async def tell_containers(self, body: Mapping[str, Any]) -> Json:
        """Tell which containers are gone, have moved or arrived; how many nodes that concerned."""
        return await self._client.containers(self.admin, self.token, body)

    async def tell_master_address(self, address: str) -> None:
        """Tell where the master's host is now."""
        await self._client.master_address(self.admin, self.token, address)
