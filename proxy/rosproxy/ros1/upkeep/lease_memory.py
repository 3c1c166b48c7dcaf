"""Having the master keep what is to outlast the proxy: where the node of each lease is.

It is written before a node is registered for the first time, and before a service's registration is
answered: whatever the master knows of, the next process of the proxy can find. All who wait at once
are served by one write. Once in a while it is looked after: the master may have lost it, and what
nobody needs any more is taken back. What is kept, and how:
`rosproxy.ros1.registry.remembered_leases`.
"""

import asyncio
from collections.abc import Mapping

from rosproxy.ros1.clients.master_client import MasterError
from rosproxy.ros1.context import Context
from rosproxy.ros1.registry import remembered_leases
from rosproxy.ros1.registry.remembered_leases import RememberedLease

REFUSED = (
    "the master refuses to keep this parameter ({}). Without the parameter, nodes must be "
    "restarted after a restart of the proxy. If another proxy with a policy is in between, allow "
    "the parameter in that policy"
)


class LeaseMemory:
    """Reads and writes the parameter of this proxy."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self._lock = asyncio.Lock()
        settings = context.settings
        self.parameter = remembered_leases.parameter_of(settings.advertise_host, settings.ports)
        self._written_changes = -1
        self._stored: object = None
        """What the master has, as far as is known."""

    async def read(self) -> Mapping[int, RememberedLease]:
        """What a former process has left, by port. Raises Unreachable."""
        self._stored = await self._read()
        return remembered_leases.read_leases(self._stored, self._context.settings.ports)

    async def write(self) -> None:
        """Have the master keep what is known of all leases, unless it does. Raises Unreachable."""
        registry = self._context.registry
        while self._written_changes != registry.lease_changes:
            async with self._lock:  # whoever has waited here finds the write done, as a rule
                changes = registry.lease_changes
                if self._written_changes != changes:
                    await self._write(
                        remembered_leases.leases_text(registry, self._context.settings.ports)
                    )
                    self._written_changes = changes

    async def look(self) -> None:
        """Write it again if the master has lost it, or if somebody else has written there.

        Raises Unreachable.
        """
        async with self._lock:
            stored = await self._read()
            if stored != self._stored:
                self._stored = stored
                self._written_changes = -1
        await self.write()

    async def _read(self) -> object:
        try:
            return await self._context.upstream.call_master("getParam", self.parameter)
        except MasterError:  # it has none
            return ""

    async def _write(self, text: str) -> None:
        if text == self._stored:
            return
        upstream = self._context.upstream
        problems = self._context.problems
        try:
            if text:
                await upstream.call_master("setParam", self.parameter, text)
                problems.solved(self.parameter)
            else:
                await upstream.call_master("deleteParam", self.parameter)
        except MasterError as error:
            if text:  # nothing else depends on it; to delete what is not there is refused as well
                problems.add(self.parameter, REFUSED.format(error))
        self._stored = text  # if it was refused, `look` finds the difference and tries again
