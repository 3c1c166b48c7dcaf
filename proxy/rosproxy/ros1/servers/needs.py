"""What the servers need of the rooms above them (upkeep and alias), which know the servers.

The rooms above are given to the servers when the proxy is put together (`rosproxy.app`).
"""

from collections.abc import Iterable
from typing import Protocol

from rosproxy.ros1.protocol.xmlrpc.document import Call
from rosproxy.ros1.registry.endpoint import Endpoint


class AliasPorts(Protocol):
    """The ports that stand in for nodes on the master's host; see `rosproxy.ros1.alias`."""

    async def listen_for(self, uris: Iterable[str], /) -> None:
        """Have the ports listen that these URIs lead to, before an inside node is given them."""

    def import_call(self, body: bytes, call: Call, /) -> bytes:
        """A call from outside, parsed as ``call``, in a form that an inside node can use."""


class Recovering(Protocol):
    """Rebuilds the registry after a start; see `rosproxy.ros1.upkeep.recovery`."""

    async def ensure(self) -> None:
        """Wait until the registry is rebuilt from the master. Raises Unreachable."""


class TakingOver(Protocol):
    """Deals with nodes that registered around the proxy; see `rosproxy.ros1.upkeep.adoption`."""

    async def take_over(self, endpoint: Endpoint, caller_id: str, /) -> None:
        """Before a name registers: take back what the same node registered around the proxy.

        Raises Unreachable.
        """

    async def absorb_shutdown(self, endpoint: Endpoint, caller_id: str, reason: str, /) -> bool:
        """Whether a ``shutdown`` is only due to what the endpoint's own node has registered."""
