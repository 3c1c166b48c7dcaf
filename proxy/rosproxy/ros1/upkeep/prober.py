"""Probe each node, unregister dead nodes, and free unused ports.

At each ``--probe-interval`` the proxy asks a node for the pid, if no other call has reached the
node meanwhile. The proxy asks a healthy node over a kept connection
(`rosproxy.ros1.clients.kept_connections`), and all other nodes by a call. The proxy also calls at
once if a node has ended the kept connection.

After two failures in a row the port refuses connections, so that a dead node looks dead. After
``--cleanup-after`` the proxy unregisters the node at the master. When the node answers again, the
proxy serves the node again, and registers the node if necessary. A new pid means a new process: the
proxy then takes back the registrations that the former process left.

`Health.note` records the result of a probe, and `liveness` says what is due. The `Registrar` and
the modules beside this module act.
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

PROBE_CHECK_INTERVAL_S = 0.25
"""Seconds between two looks at all endpoints."""
MOST_PARALLEL_PROBES = 64
OVERDUE = "no answer in time"
SWEEP_INTERVAL_S = 5.0
"""Seconds between two searches for kept connections whose endpoint has gone."""


@dataclass(slots=True, eq=False)
class Prober:
    """Probes all endpoints, and acts on the results."""

    _context: Context
    _leases: Leases
    _registrar: Registrar
    _resubscriber: Resubscriber
    _recovery: Recovery
    kept_connections: KeptConnections[Endpoint] = field(init=False)
    _probing: set[Endpoint] = field(default_factory=set)
    _sweep_at: float = 0.0
    _limit: asyncio.Semaphore = field(
        default_factory=lambda: asyncio.Semaphore(MOST_PARALLEL_PROBES)
    )

    def __post_init__(self) -> None:
        """Create the set of kept connections."""
        self.kept_connections = KeptConnections(
            self._context.nodes, self._context.settings.probe_timeout
        )

    async def look(self) -> None:
        """Begin the probes that are due, and end unused leases."""
        context = self._context
        if context.retired:
            return
        now = context.now()
        interval = context.settings.probe_interval
        for endpoint, result in self.kept_connections.collect(now).items():
            self._note_result(endpoint, result, now)
        busy = self._probing | self._recovery.verifying
        for endpoint in liveness.endpoints_to_check(context.registry, now, interval):
            if endpoint not in busy and liveness.is_due(endpoint, now, interval):
                self._ask(endpoint, now)
            self._end_if_unused(endpoint)
        if now >= self._sweep_at:
            self._sweep_at = now + SWEEP_INTERVAL_S
            self.kept_connections.keep(set(context.registry))

    def _ask(self, endpoint: Endpoint, now: float) -> None:
        """Ask for the pid of a node over a kept connection if possible, otherwise by a call."""
        pid = endpoint.health.pid if liveness.may_use_kept_connection(endpoint) else None
        if pid is None or not self.kept_connections.ask(endpoint, endpoint.slave, pid, now):
            self._begin_probe(endpoint)

    def _note_result(self, endpoint: Endpoint, result: ProbeResult | None, now: float) -> None:
        """Record the result of a kept connection; None: the node has ended the connection."""
        if result is None:
            endpoint.health.note_hung_up()
        elif endpoint in self._probing or not liveness.may_use_kept_connection(endpoint):
            return  # meanwhile the node needs a probe by a call, or such a probe runs
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
        except (Unreachable, MasterError) as error:  # the next probe finds the same work
            log.debug("%s: the proxy could not act on the probe yet: %s", endpoint.label, error)
        finally:
            self._probing.discard(endpoint)

    async def _look_after(self, endpoint: Endpoint, answer: ProbeAnswer | None) -> None:
        """Act on the answer of a node; without ``answer``, call the node first."""
        slave = endpoint.slave
        health = endpoint.health
        answer = answer or await self._context.nodes.probe(slave)
        if endpoint.slave != slave:
            return  # the node has moved meanwhile
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
        # Last: if a call to the master has failed, the next probe finds the same work.
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
        """End the lease of an endpoint that has been unused for long enough."""
        now = self._context.now()
        if not endpoint.unused:
            endpoint.idle_since = None
            return
        lease_time = liveness.unused_lease_lifetime(endpoint, self._context.settings.linger)
        if endpoint.note_unused(now) >= lease_time:
            log.info(
                "port %d is free again: the lease of %s has ended",
                endpoint.port,
                endpoint.uri,
                extra=endpoint.log_fields,
            )
            self._leases.end(endpoint)
