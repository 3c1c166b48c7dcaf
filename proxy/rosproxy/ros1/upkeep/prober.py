"""Housekeeping: probes, clean-up of dead nodes, and the end of leases that nobody uses."""

import asyncio
import logging
from collections.abc import Iterable
from dataclasses import replace

from rosproxy.leases.leases import Leases
from rosproxy.net.addresses import HostPort, is_inside
from rosproxy.net.resolver import resolve
from rosproxy.ros1.clients.master import MasterError, Unreachable
from rosproxy.ros1.clients.node import NodeClient
from rosproxy.ros1.context import Context
from rosproxy.ros1.registry.endpoint import Endpoint
from rosproxy.ros1.registry.health import Change, ProbeResult
from rosproxy.ros1.upkeep.recovery.policy import Claim, confirmed_by
from rosproxy.ros1.upkeep.registrar import Registrar

log = logging.getLogger(__name__)

TICK = 0.25
"""Seconds between looks at all endpoints."""
FORGET_AFTER = 3600.0
"""Seconds after which a node that was cleaned up while it was silent is forgotten."""
PARALLEL_PROBES = 64
DIRECT_INTERVAL = 2.0
"""Seconds between probes, at most, of a node that registered around the proxy."""
AT_ONCE = 0.001


class Prober:
    """Looks after all endpoints."""

    def __init__(
        self, context: Context, leases: Leases[Endpoint], nodes: NodeClient, upkeep: Registrar
    ) -> None:
        self._context, self._leases, self._nodes, self._upkeep = context, leases, nodes, upkeep
        self._probing: set[Endpoint] = set()
        self._limit = asyncio.Semaphore(PARALLEL_PROBES)
        self._unannounced: list[Endpoint] = []
        self._announcing = asyncio.Lock()

    async def look(self) -> None:
        """Look after all endpoints once."""
        if self._context.retired:
            return
        for endpoint in self._context.registry:
            self._probe_if_due(endpoint)
            self._maybe_end(endpoint)

    async def topics_at(self, claim: Claim) -> frozenset[str] | None:
        """The topics that the node at a claimed address names; None if there is no answer."""
        if not is_inside(claim.address, self._context.addressing.networks):
            return None
        said = await self._nodes.describe(HostPort(*claim.key))
        return frozenset(said.topics) if said else None

    async def resume(self, endpoints: Iterable[Endpoint]) -> None:
        """Verify and announce recovered endpoints. Raises Unreachable, MasterError.

        None waits for another that does not answer, and none is probed meanwhile.
        """
        limit, resumed = asyncio.Semaphore(PARALLEL_PROBES), set(endpoints)

        async def resume(endpoint: Endpoint) -> None:
            try:
                async with limit:
                    await self.verify(endpoint)
            finally:
                self._probing.discard(endpoint)
            if self._leases.is_open(endpoint):
                await self._announce(endpoint)

        self._probing |= resumed
        await asyncio.gather(*map(resume, resumed))

    async def verify(self, endpoint: Endpoint) -> None:
        """Serve a recovered endpoint if its node bears out what the master says of it."""
        said = await self._nodes.describe(endpoint.slave)
        if said is None or endpoint.trusted:
            return
        if not confirmed_by(endpoint, said.topics):
            log.warning("%s: the node there has none of its topics; not served", endpoint.label)
            await self._upkeep.clean_up(endpoint)
            self._leases.end(endpoint)
            return
        endpoint.tcpros_port, endpoint.trusted = said.tcpros_port, True
        self._leases.open(endpoint)
        await self._name(endpoint)
        await self._upkeep.adopt(endpoint, said)

    async def probe(self, endpoint: Endpoint) -> None:
        """Probe an endpoint and act on the result."""
        where = endpoint.slave
        answer = await self._nodes.probe(where)
        if endpoint.slave != where:
            return  # it has moved meanwhile
        failing = endpoint.health.failures > 0
        change = endpoint.health.note(answer.probe, self._context.now())
        if answer.probe is ProbeResult.ANSWERED:
            await self._answered(endpoint, answer.pid)
            if failing:
                self._context.problems.solved_at(endpoint.port)
        elif change is Change.DOWN:
            self._report_down(endpoint, answer.reason)
            self._leases.close(endpoint)
        if endpoint.health.clean_up(self._context.now(), self._patience(endpoint)):
            await self._upkeep.clean_up(endpoint)

    def _probe_if_due(self, endpoint: Endpoint) -> None:
        interval = self._context.settings.probe_interval
        if endpoint.direct:
            interval = min(interval, DIRECT_INTERVAL)
        due = endpoint.health.due(self._context.now(), interval)
        if due and endpoint not in self._probing:
            self._probing.add(endpoint)
            self._context.tasks.spawn(self._probe(endpoint), f"probe of {endpoint.uri}")

    def _patience(self, endpoint: Endpoint) -> float:
        """Seconds for which a node that is down keeps its registrations; 0: for ever.

        One that registered around the proxy has unregistered there as well, to no effect; so it
        keeps nothing once it has ended.
        """
        after = self._context.settings.cleanup_after
        return min(after, AT_ONCE) if endpoint.direct and endpoint.health.refused else after

    async def _probe(self, endpoint: Endpoint) -> None:
        try:
            async with self._limit:
                await self.probe(endpoint)
        except (Unreachable, MasterError) as error:
            log.debug("upkeep of %s has to wait: %s", endpoint.label, error)
        finally:
            self._probing.discard(endpoint)

    async def _answered(self, endpoint: Endpoint, pid: int | None) -> None:
        if not endpoint.trusted:
            await self.verify(endpoint)
            if endpoint.health.pid is None:
                endpoint.health.pid = pid
            if self._leases.is_open(endpoint):
                await self._announce(endpoint)
            return
        if endpoint.health.cleaned:
            await self._upkeep.come_back(endpoint, pid)
        elif endpoint.health.pid not in (None, pid):
            await self._upkeep.audit(endpoint)
        elif endpoint.direct:
            await self._upkeep.reconcile(endpoint)
        endpoint.health.pid = pid
        if not self._leases.is_open(endpoint):
            log.info("%s answers again", endpoint.label)
            self._leases.open(endpoint)
            await self._upkeep.remind(endpoint)

    async def _announce(self, endpoint: Endpoint) -> None:
        """Announce an endpoint, together with those that came up during the one before.

        Each time the whole graph is read: one by one, that would grow with the square of nodes.
        """
        self._unannounced.append(endpoint)
        async with self._announcing:
            found, self._unannounced = self._unannounced, []
            if found:
                await self._upkeep.announce(found)

    def _report_down(self, endpoint: Endpoint, reason: str) -> None:
        if endpoint.registrations:
            log.warning("%s does not answer: %s", endpoint.label, reason)
            self._context.problems.add(endpoint.label, f"does not answer: {reason}", endpoint.port)

    async def _name(self, endpoint: Endpoint) -> None:
        """Find out whether neighbours can use a recovered node's host name."""
        address = endpoint.place.address
        addresses = await resolve(self._context.upstream.reach(endpoint.node).host)
        if endpoint.place.address == address:
            endpoint.place = replace(endpoint.place, named=address in addresses)

    def _maybe_end(self, endpoint: Endpoint) -> None:
        now, health = self._context.now(), endpoint.health
        if endpoint.connected or endpoint.pending or not (endpoint.idle or health.cleaned):
            endpoint.idle_since = None
            return
        if endpoint.idle_since is None:
            endpoint.idle_since = now
        linger = self._context.settings.linger
        if health.cleaned and not (health.refused or health.over):
            linger = FORGET_AFTER
        if now - endpoint.idle_since >= linger:
            log.info("port %d is free again: %s", endpoint.port, endpoint.uri)
            self._leases.end(endpoint)
