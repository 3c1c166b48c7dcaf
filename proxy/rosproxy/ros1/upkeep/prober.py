"""Looking after each node by its pulse: probe, unregister the dead, free the ports of the unused.

Every few seconds a node that nobody called is asked for its pid: one that is well over a connection
that is kept (`rosproxy.ros1.clients.kept_connections`), any other by a call; so is, at once, one
that has ended that connection. Two failures in a row make its port refuse, so that a dead node
looks dead; after the time of ``--cleanup-after`` it is unregistered at the master. A node that
answers again is served again, and registered again if need be. Another pid than before means
another process: what the former one left is taken back.

What follows from a probe: `Health.note` says how the node is, `liveness` what is due, and the
`Registrar` and the modules beside this one do it.
"""

import asyncio
import logging
from dataclasses import dataclass, field

from rosproxy.ros1.clients.kept_connections import KeptConnections
from rosproxy.ros1.clients.master_client import MasterError, Unreachable
from rosproxy.ros1.clients.node_client import ProbeAnswer
from rosproxy.ros1.context import Context
from rosproxy.ros1.leases import Leases
from rosproxy.ros1.registry.endpoint import Endpoint
from rosproxy.ros1.registry.node_health import ProbeResult
from rosproxy.ros1.upkeep.decisions import liveness
from rosproxy.ros1.upkeep.decisions.liveness import AfterAnswer
from rosproxy.ros1.upkeep.recovery import Recovery
from rosproxy.ros1.upkeep.registrar import Registrar
from rosproxy.ros1.upkeep.resubscriber import Resubscriber

log = logging.getLogger(__name__)

PROBE_TICK = 0.25
"""Seconds between looks at all endpoints."""
PARALLEL_PROBES = 64
OVERDUE = "no answer in time"
SWEEP_INTERVAL = 5.0
"""Seconds between looks for kept connections whose endpoint has gone."""


@dataclass(slots=True, eq=False)
class Prober:
    """Looks after all endpoints."""

    _context: Context
    _leases: Leases
    _registrar: Registrar
    _resubscriber: Resubscriber
    _recovery: Recovery
    kept_connections: KeptConnections[Endpoint] = field(init=False)
    _probing: set[Endpoint] = field(default_factory=set)
    _sweep_at: float = 0.0
    _limit: asyncio.Semaphore = field(default_factory=lambda: asyncio.Semaphore(PARALLEL_PROBES))

    def __post_init__(self) -> None:
        """Begin with no connection."""
        self.kept_connections = KeptConnections(
            self._context.nodes, self._context.settings.probe_timeout
        )

    async def look(self) -> None:
        """Look after all endpoints once."""
        context = self._context
        if context.retired:
            return
        now = context.now()
        interval = context.settings.probe_interval
        for endpoint, result in self.kept_connections.collect(now).items():
            self._note_result(endpoint, result, now)
        busy = self._probing | self._recovery.verifying
        for endpoint in liveness.to_look_at(context.registry, now, interval):
            if endpoint not in busy and liveness.is_due(endpoint, now, interval):
                self._ask(endpoint, now)
            self._end_if_unused(endpoint)
        if now >= self._sweep_at:
            self._sweep_at = now + SWEEP_INTERVAL
            self.kept_connections.keep(set(context.registry))

    def _ask(self, endpoint: Endpoint, now: float) -> None:
        """Find out how a node is, in the cheapest way that there is."""
        pid = endpoint.health.pid if liveness.may_be_kept(endpoint) else None
        if pid is None or not self.kept_connections.ask(endpoint, endpoint.slave, pid, now):
            self._begin_probe(endpoint)

    def _note_result(self, endpoint: Endpoint, result: ProbeResult | None, now: float) -> None:
        """Note what a kept connection has shown; None: the node has ended it."""
        if result is None:
            endpoint.health.note_hung_up()
        elif endpoint in self._probing or not liveness.may_be_kept(endpoint):
            return  # it is suspected meanwhile: it is asked by a call
        elif result is ProbeResult.ANSWERED:
            endpoint.health.note(result, now)
        else:
            self._begin_probe(endpoint, ProbeAnswer(result, reason=f"{endpoint.slave}: {OVERDUE}"))

    def _begin_probe(self, endpoint: Endpoint, answer: ProbeAnswer | None = None) -> None:
        self._probing.add(endpoint)
        self._context.tasks.spawn(self._probe(endpoint, answer), f"probe of {endpoint.uri}")

    async def _probe(self, endpoint: Endpoint, answer: ProbeAnswer | None) -> None:
        try:
            async with self._limit:
                await self._look_after(endpoint, answer)
        except (Unreachable, MasterError) as error:  # the same is due at the next probe
            log.debug("%s: the proxy could not act on the probe yet: %s", endpoint.label, error)
        finally:
            self._probing.discard(endpoint)

    async def _look_after(self, endpoint: Endpoint, answer: ProbeAnswer | None) -> None:
        """Act on how a node has answered, or answers when it is called."""
        slave = endpoint.slave
        health = endpoint.health
        answer = answer or await self._context.nodes.probe(slave)
        if endpoint.slave != slave:
            return  # it has moved meanwhile
        was_failing = health.failures > 0
        went_down = health.note(answer.probe, self._context.now())
        if answer.probe is ProbeResult.ANSWERED:
            await self._note_answer(endpoint, answer.pid)
            if was_failing:
                self._context.problems.solved_at(endpoint.port)
        elif went_down:
            self._report_down(endpoint, answer.reason)
            self._leases.close(endpoint)
        after = self._context.settings.cleanup_after
        if liveness.is_to_be_unregistered(endpoint, self._context.now(), after):
            await self._registrar.clean_up(endpoint)

    async def _note_answer(self, endpoint: Endpoint, pid: int | None) -> None:
        due = liveness.after_answer(endpoint, pid)
        if due is AfterAnswer.VERIFY:
            await self._recovery.serve(endpoint)
            return
        if due is AfterAnswer.COME_BACK:
            await self._registrar.come_back(endpoint, pid)
        elif due is AfterAnswer.UNREGISTER_LEFT_OVER:
            await self._registrar.unregister_left_over(endpoint)
        elif due is AfterAnswer.RECONCILE:
            await self._registrar.reconcile(endpoint)
        # Only now: had a call to the master failed, the next probe would find the same due.
        endpoint.health.pid = pid
        if not self._leases.is_open(endpoint):
            log.info("%s answers again", endpoint.label, extra=endpoint.log_fields)
            self._leases.open(endpoint)
            await self._resubscriber.remind(endpoint)

    def _report_down(self, endpoint: Endpoint, reason: str) -> None:
        if endpoint.registrations:
            log.warning("%s does not answer: %s", endpoint.label, reason, extra=endpoint.log_fields)
            self._context.problems.add(endpoint.label, f"does not answer: {reason}", endpoint.port)

    def _end_if_unused(self, endpoint: Endpoint) -> None:
        """End the lease of an endpoint that nobody has needed for long enough."""
        now = self._context.now()
        if not endpoint.unused:
            endpoint.idle_since = None
            return
        lease_time = liveness.lease_lasts(endpoint, self._context.settings.linger)
        if endpoint.note_unused(now) >= lease_time:
            log.info(
                "port %d is free again: the lease of %s has ended",
                endpoint.port,
                endpoint.uri,
                extra=endpoint.log_fields,
            )
            self._leases.end(endpoint)
