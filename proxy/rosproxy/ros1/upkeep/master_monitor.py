"""Watching the real master: is it there, is it still the same, does it still know our nodes?"""

import asyncio
import logging

from rosproxy.forwarding.kernel.plane import KernelPlane
from rosproxy.net.addresses import is_inside
from rosproxy.ros1.clients.master import MasterError, Unreachable
from rosproxy.ros1.clients.master_graph import read_graph, read_registrations
from rosproxy.ros1.context import Context
from rosproxy.ros1.registry.endpoint import Endpoint, Place
from rosproxy.ros1.upkeep.prober import Prober
from rosproxy.ros1.upkeep.recovery import policy
from rosproxy.ros1.upkeep.registrar import Registrar

log = logging.getLogger(__name__)

LOOK_TIMEOUT = 5.0
"""Seconds in which a sound master answers getPid."""
LOOKS_PER_CHECK = 5
"""How many looks at the master go by between two checks of what it knows."""


class MasterMonitor:
    """Polls the master, recovers from what it holds, and restores what it has lost."""

    def __init__(
        self, context: Context, keeper: Prober, upkeep: Registrar, plane: KernelPlane
    ) -> None:
        self._context, self._keeper, self._upkeep = context, keeper, upkeep
        self._plane = plane
        self._recovering = asyncio.Lock()
        self._recovered = False
        self._failures = 0
        self._looks = 0
        self.up: bool | None = None
        self.error = ""
        self.pid: int | None = None
        self.round_trip: float | None = None
        self.since = context.now()

    async def ensure(self) -> None:
        """Wait until the registry is rebuilt from the master. Raises Unreachable."""
        if not self._recovered:
            await self._await_recovery()

    async def _await_recovery(self) -> None:
        """All who wait for the same attempt share its failure.

        A master that hangs would keep the last of them waiting for as many attempts as there are
        callers.
        """
        failures = self._failures
        async with self._recovering:
            if self._recovered:
                return
            if self._failures != failures:
                raise Unreachable("the master has not told its state")
            try:
                await self._recover()
            except (Unreachable, MasterError) as error:
                self._failures += 1
                raise Unreachable(str(error)) from None
            self._recovered = True

    async def look(self) -> None:
        """Ask the master for its pid; recover or restore where that is due."""
        started = self._context.now()
        try:
            async with asyncio.timeout(LOOK_TIMEOUT):
                pid = await self._context.upstream.ask_master("getPid")
            self.round_trip = self._context.now() - started
            await self.ensure()
            await self._check(pid)
            self._mark(True)
        except (Unreachable, MasterError) as error:
            self._mark(False, str(error))
        except TimeoutError:
            uri = self._context.settings.master_uri
            self._mark(False, f"master {uri}: no answer in {LOOK_TIMEOUT:g} s")

    async def _check(self, pid: int) -> None:
        restarted = not self.up or pid != self.pid
        self.pid = pid
        self._looks += 1
        if restarted or self._looks % LOOKS_PER_CHECK == 0:
            await self._restore_lost()

    def _mark(self, up: bool, error: str = "") -> None:
        uri = self._context.settings.master_uri
        if up != self.up:
            self.since = self._context.now()
            if up:
                log.info("master %s answers (pid %s)", uri, self.pid)
                self._context.problems.solved("master")
            else:
                log.warning("%s; waiting for it", error)
                self._context.problems.add("master", error)
        self.up, self.error = up, error

    async def _recover(self) -> None:
        self._context.refresh_networks()
        graph = await read_graph(self._context.upstream)
        claims = await self._settled(policy.claims(graph, self._context.addressing))
        endpoints = [e for claim in claims if (e := self._restore(claim)) is not None]
        self._plane.recovered(endpoints)
        if endpoints:
            log.info("recovering %d nodes from the master", len(endpoints))
            self._context.tasks.spawn(self._resume(endpoints), "recovery")

    async def _settled(self, found: list[policy.Claim]) -> list[policy.Claim]:
        """One claim per port: where several are made, the nodes themselves are asked first."""
        asked = policy.contested(found)
        answers = await asyncio.gather(*(self._keeper.topics_at(claim) for claim in asked))
        said = {found.index(c): topics for c, topics in zip(asked, answers, strict=True)}
        for claim in asked:
            log.warning("port %d is claimed by more than one URI: %s", claim.port, claim.uri)
        return policy.settle(found, said)

    def _restore(self, claim: policy.Claim) -> Endpoint | None:
        address = claim.address
        if not is_inside(address, self._context.addressing.networks):
            log.warning(
                "port %d: the master has %s for it, which is not in an inside network; refused",
                claim.port,
                address,
            )
            return None
        place = Place(address, named=claim.inside.node.host == address, confirmed=False)
        registry = self._context.registry
        endpoint = registry.restore(claim.uri, claim.inside.node, place, claim.port)
        if endpoint is None:
            log.warning("port %d of %s is not free; not recovered", claim.port, claim.uri)
            return None
        for held in claim.registrations:
            registry.register(endpoint, held)
        return endpoint

    async def _resume(self, endpoints: list[Endpoint]) -> None:
        """Serve recovered endpoints, then make up for the calls that were missed."""
        try:
            await self._keeper.resume(endpoints)
            log.info("recovered %d nodes", sum(e.trusted for e in endpoints))
        except (Unreachable, MasterError) as error:
            log.warning("recovery is incomplete: %s", error)

    async def _restore_lost(self) -> None:
        started = self._context.now()
        state = await read_registrations(self._context.upstream)
        ours = {
            held: endpoint
            for endpoint, held in self._context.registry.registrations()
            if endpoint.trusted and not endpoint.health.cleaned and not endpoint.health.down
        }
        lost = policy.lost(list(ours), state, started)
        unsettled = [e for e in self._context.registry if e.unsettled and not e.health.down]
        if unsettled:
            await self._upkeep.resettle(unsettled)
        if lost:
            log.warning("the master has lost %d registrations; making them again", len(lost))
            await self._upkeep.register([(ours[held], held) for held in lost])
