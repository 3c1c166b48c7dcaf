"""Watch the real master: does it answer, is it the same process, does it know the nodes inside?

At each ``--master-interval`` the proxy asks the master for the pid. After the first answer the
proxy rebuilds the registry from the master (`recovery`). The proxy makes lost registrations again
after an outage, after a change of the pid, and after every `PID_CALLS_PER_CHECK` answers. Nodes of
ROS 1 do not notice that the master has lost their registrations.
"""

import asyncio
import logging
from urllib.parse import urlsplit

from rosproxy.ros1.clients.master_client import MasterError, Unreachable
from rosproxy.ros1.context import Context
from rosproxy.ros1.registry.node_health import ProbeResult
from rosproxy.ros1.upkeep.lease_memory import LeaseMemory
from rosproxy.ros1.upkeep.recovery import Recovery
from rosproxy.ros1.upkeep.registrar import Registrar
from rosproxy.shared.fixes import how_to_in_a_sentence

log = logging.getLogger(__name__)

PID_TIMEOUT_S = 5.0
"""Seconds within which a healthy master answers getPid."""
PID_CALLS_PER_CHECK = 5
"""Answers of the master from one check of the registrations to the next."""


MASTER_PATHS = ("", "/", "/RPC2")
"""Paths at which rosmaster answers. Python's xmlrpc.server refuses other paths (rpc_paths)."""


class MasterMonitor:
    """Polls the master, and starts the repair of lost registrations.

    ``up`` is None before the first look. ``since`` is the time of the last change of ``up``.
    ``round_trip`` is the duration of the last answered getPid in seconds. ``answered`` is set
    after the first look without an error.
    """

    def __init__(
        self, context: Context, recovery: Recovery, registrar: Registrar, memory: LeaseMemory
    ) -> None:
        self._context = context
        self._recovery = recovery
        self._registrar = registrar
        self._memory = memory
        self._looks = 0
        self.up: bool | None = None
        self.answered = asyncio.Event()
        self.error = ""
        self.pid: int | None = None
        self.round_trip: float | None = None
        self.since = context.now()

    async def look(self) -> None:
        """Ask the master for its pid; recover the registry or restore registrations if due."""
        started = self._context.now()
        try:
            async with asyncio.timeout(PID_TIMEOUT_S):
                pid = await self._context.upstream.call_master("getPid")
            self.round_trip = self._context.now() - started
            await self._recovery.ensure()
            restarted = not self.up or pid != self.pid
            self.pid = pid
            self._looks += 1
            await self._memory.write()
            if restarted or self._looks % PID_CALLS_PER_CHECK == 0:
                await self._memory.look()  # first: `register_lost` needs the parameter
                await self._registrar.register_lost()
            self._mark(True)
        except (Unreachable, MasterError) as error:
            self._mark(False, f"{error}{self._path_hint(error)}{_port_hint(error)}")
        except TimeoutError:
            uri = self._context.settings.master_uri
            self._mark(False, f"master {uri}: no answer in {PID_TIMEOUT_S:g} s")

    def _path_hint(self, error: Exception) -> str:
        """What to do if a program answers, but not at the path of the master URI; else empty."""
        uri = urlsplit(self._context.settings.master_uri)
        if uri.path in MASTER_PATHS or "HTTP status 404" not in str(error):
            return ""
        return ". A ROS master answers only at the paths / and /RPC2. " + how_to_in_a_sentence(
            "master", uri=f"http://{uri.netloc}"
        )

    def _mark(self, up: bool, error: str = "") -> None:
        if up != self.up:
            self.since = self._context.now()
            if up:
                if self.answered.is_set():  # after an outage, hosts may have moved
                    self._context.outside_changed.set()
                self.answered.set()
                log.info("master %s answers (pid %s)", self._context.settings.master_uri, self.pid)
                self._context.problems.solved("master")
            else:
                log.warning("%s. The proxy waits for the master", error)
                self._context.problems.add("master", error)
        self.up = up
        self.error = error


def _port_hint(error: Exception) -> str:
    """What to do if no program listens at the port; empty for other errors."""
    if isinstance(error, Unreachable) and error.probe is ProbeResult.REFUSED:
        return ". No roscore listens there. Check the port; roscore listens on 11311 by default"
    return ""
