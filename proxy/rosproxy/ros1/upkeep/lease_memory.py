"""A parameter at the master that outlasts the proxy: where the node of each lease is.

The proxy writes the parameter before a node is registered for the first time, and before the answer
to the registration of a service. So the next process of the proxy can find every node that the
master knows. A single write serves all callers that wait at the same time. From time to time the
proxy compares the parameter with the leases: the master may have lost the parameter, and ended
leases have to go. Contents and format: `rosproxy.ros1.registry.remembered_leases`.
"""

import asyncio
from collections.abc import Mapping

from rosproxy.ros1.clients.master_client import MasterError, Unreachable
from rosproxy.ros1.context import Context
from rosproxy.ros1.protocol.xmlrpc.limits import LEASES
from rosproxy.ros1.registry import remembered_leases
from rosproxy.ros1.registry.node_health import ProbeResult
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
        """The value of the parameter at the master, as far as the proxy knows."""

    async def read(self) -> Mapping[int, RememberedLease]:
        """What a former process of the proxy has stored, by port. Raises Unreachable."""
        self._stored = await self._read()
        return remembered_leases.read_leases(self._stored, self._context.settings.ports)

    async def write(self) -> None:
        """Store the leases at the master if they have changed. Raises Unreachable.

        If the master refuses the parameter, the proxy reports a problem.
        """
        registry = self._context.registry
        while self._written_changes != registry.lease_changes:
            async with self._lock:  # a caller that has waited here usually finds the write done
                changes = registry.lease_changes
                if self._written_changes != changes:
                    await self._write(
                        remembered_leases.leases_text(registry, self._context.settings.ports)
                    )
                    self._written_changes = changes

    async def look(self) -> None:
        """Write the parameter again if the master has lost it, or another program has changed it.

        Raises Unreachable.
        """
        async with self._lock:
            stored = await self._read()
            if stored != self._stored:
                self._stored = stored
                self._written_changes = -1
        await self.write()

    async def _read(self) -> object:
        """The value of the parameter; "" if not set, None if too long for leases."""
        upstream = self._context.upstream
        try:
            return await upstream.call_master("getParam", self.parameter, limits=LEASES)
        except MasterError:
            return ""
        except Unreachable as error:
            if error.probe is not ProbeResult.ANSWERED:
                raise
            return None

    async def _write(self, text: str) -> None:
        upstream = self._context.upstream
        problems = self._context.problems
        if not text:  # there is nothing that the master could refuse to keep
            problems.solved(self.parameter)
        if text == self._stored:
            return
        try:
            if text:
                await upstream.call_master("setParam", self.parameter, text)
                problems.solved(self.parameter)
            else:
                await upstream.call_master("deleteParam", self.parameter)
        except MasterError as error:
            if text:  # the master also refuses to delete a missing parameter, which is no problem
                problems.add(self.parameter, REFUSED.format(error))
        self._stored = text  # if the master refused, `look` finds the difference and tries again
