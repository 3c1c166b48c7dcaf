"""After a start: finding at the master which nodes are behind this proxy, and on which ports.

The proxy keeps nothing on disk; the master is the database. `Recovery.ensure` reads the master's
graph once, and what the proxy has it remember (`LeaseMemory`), finds the URIs that this proxy
advertised (`recovery_claims.find_claims`), and rebuilds the endpoints on the ports that they had.
Calls that register wait for it: a node that registered before would get another port, and the
master would shut it down for having moved. Before that an operator's policy is waited for
(``--await-policy``), or what it denies would be registered for a moment.

What the master says is only a claim, since anybody can write to it. Until the node itself has
borne it out (`Verifier`), the endpoint's port is held but refuses. Then subscribers are made to
connect again (`Resubscriber.announce`). A node that does not answer yet is verified when a probe
finds it (`Prober`).

A claim keeps no port from a node that lives: where the range is used up, one that registers waits a
moment for claims that are being verified, and gets the port of one whose node is dead
(`wait_for_dead_claim`). What the master has for nodes that got no port again, although it carries
this proxy's own address, is nobody's: a former proxy left it behind, and it is taken back
(`_sweep`).

If ports are others after a start, look here: the log names each claim that was refused, and why.
"""

import asyncio
import contextlib
import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace

from rosproxy.forwarding.kernel.plane import KernelPlane
from rosproxy.net.addresses import is_inside
from rosproxy.net.resolver import resolve
from rosproxy.ros1.clients.master_client import MasterError, Unreachable
from rosproxy.ros1.context import Context
from rosproxy.ros1.leases import Leases
from rosproxy.ros1.registry.client_kinds import ClientKind
from rosproxy.ros1.registry.endpoint import Endpoint, NodeLocation, Registration
from rosproxy.ros1.registry.node_health import ProbeResult
from rosproxy.ros1.upkeep.decisions import recovery_claims
from rosproxy.ros1.upkeep.decisions.recovery_claims import Claim
from rosproxy.ros1.upkeep.lease_memory import LeaseMemory
from rosproxy.ros1.upkeep.registrar import Registrar
from rosproxy.ros1.upkeep.resubscriber import Resubscriber
from rosproxy.ros1.upkeep.verifier import Verifier

log = logging.getLogger(__name__)

PARALLEL_INSPECTIONS = 64
CLAIM_GRACE = 1.0
"""Seconds that a claim gets to be borne out once a living node waits for its port."""
DOUBT = (
    "answers, but the proxy can't tell whether this is the node that the master has at this port: "
    "the client library lacks getPublications or getSubscriptions, and the node has no topic or "
    "service to ask for. The port stays closed until the node registers again. Restart the node"
)


class Recovery:
    """Rebuilds the registry from what the master holds.

    ``verifying`` are the endpoints that wait to be verified, and need not be probed meanwhile.
    """

    def __init__(
        self,
        context: Context,
        leases: Leases,
        registrar: Registrar,
        resubscriber: Resubscriber,
        plane: KernelPlane,
        memory: LeaseMemory,
    ) -> None:
        self._context = context
        self._leases = leases
        self._plane = plane
        self._verifier = Verifier(context.nodes)
        self._memory = memory
        self._registrar = registrar
        self._resubscriber = resubscriber
        self.verifying: set[Endpoint] = set()
        self._inspecting: set[Endpoint] = set()
        self._limit = asyncio.Semaphore(PARALLEL_INSPECTIONS)
        self._recovered = asyncio.Event()
        self._lock = asyncio.Lock()
        self._failures = 0
        self._unannounced: list[Endpoint] = []
        self._announcing = asyncio.Lock()

    async def ensure(self) -> None:
        """Have the registry rebuilt from the master, once. Raises Unreachable.

        All who wait for the same attempt share its failure: a master that hangs would keep the
        last of them waiting for as many attempts as there are callers.
        """
        if self._recovered.is_set():
            return
        failures_before = self._failures
        async with self._lock:
            if self._recovered.is_set():
                return
            if self._failures != failures_before:
                raise Unreachable("the proxy could not read the master's state")
            try:
                await self._context.policy.rules.wait_for_operator(
                    self._context.settings.await_policy
                )
                await self._recover()
            except (Unreachable, MasterError) as error:
                self._failures += 1
                raise Unreachable(str(error)) from None
            self._recovered.set()

    async def serve(self, endpoint: Endpoint) -> None:
        """Serve a recovered endpoint if its node bears it out, and have subscribers connect again.

        Raises Unreachable, MasterError.
        """
        try:
            async with self._limit:
                await self._verify(endpoint)
        finally:
            self.verifying.discard(endpoint)
        if not self._leases.is_open(endpoint):
            return
        # Each announcement reads the whole graph: one per node would cost the square of the nodes.
        # So nodes that came up during the announcement before are announced together.
        self._unannounced.append(endpoint)
        async with self._announcing:
            endpoints = self._unannounced
            self._unannounced = []
            if endpoints:
                await self._resubscriber.announce(endpoints)

    async def wait_for_dead_claim(self) -> None:
        """Wait a moment for a node that is being verified to turn out dead.

        Those that were inspected all that time and are silent count as failing from then on.
        """
        end = self._context.now() + CLAIM_GRACE
        awaited = set(self.verifying)
        inspected = set(self._inspecting)
        while awaited & self.verifying and self._context.now() < end:
            if (
                self._context.registry.pool.free
                or self._context.registry.dead_endpoint() is not None
            ):
                return
            await asyncio.sleep(0.01)
        for endpoint in inspected & self._inspecting:
            endpoint.health.note(ProbeResult.SILENT, self._context.now())

    async def _recover(self) -> None:
        self._context.refresh_networks()
        memory = await self._memory.read()
        graph = await self._context.upstream.read_graph()
        claims, forgotten = recovery_claims.find_claims(graph, self._context.addressing, memory)
        restored = [(claim, self._restore(claim)) for claim in await self._settle(claims)]
        endpoints = [endpoint for _, endpoint in restored if endpoint is not None]
        served_ids = {id(claim) for claim, endpoint in restored if endpoint is not None}
        unserved = [claim for claim in claims if id(claim) not in served_ids]
        # Before calls that register go on: their nodes could get these fast ports as leases.
        self._plane.recovered([e for e in endpoints if self._context.policy.may_bypass(e)])
        if (unserved or forgotten) and self._context.settings.cleanup_after:
            sweep = self._sweep(unserved, forgotten)
            self._context.tasks.spawn(sweep, "taking back registrations of former proxies")
        self.verifying |= set(endpoints)
        if endpoints:
            log.info("recovering %d nodes from the master", len(endpoints))
            self._context.tasks.spawn(self._resume(endpoints), "recovery")

    async def _settle(self, claims: Sequence[Claim]) -> list[Claim]:
        """One claim per port: where several are made, the nodes themselves are asked first."""

        async def ask(claim: Claim) -> None:
            log.warning(
                "port %d of %s: another URI at the master claims the same port or the same node",
                claim.port,
                claim.uri,
            )
            # Anybody can write to the master: nobody outside is called on its word.
            if is_inside(claim.slave.host, self._context.addressing.networks):
                claim.node_info = await self._context.nodes.inspect(claim.slave)

        await asyncio.gather(*map(ask, recovery_claims.contested_claims(claims)))
        return recovery_claims.choose_claims(claims)

    def _restore(self, claim: Claim) -> Endpoint | None:
        """The endpoint of a claim, not trusted yet; None if it is outside, or its port is taken."""
        address = claim.slave.host
        if self._context.client_kind(address) is ClientKind.OUTSIDE:
            text = "port %d: not recovered: the node's address %s is not in an inside network"
            log.warning(text, claim.port, address)
            return None
        location = NodeLocation(address, named=claim.node.host == address, confirmed=False)
        registry = self._context.registry
        endpoint = registry.restore(claim.uri, claim.node, location, claim.port)
        if endpoint is None:
            text = "port %d: not recovered: the port is taken, or %s has another port"
            log.warning(text, claim.port, claim.uri)
            return None
        for registration in claim.registrations:
            registry.register(endpoint, registration)
        for port in claim.service_ports:
            endpoint.note_service_port(port)
        if claim.advertised != self._context.addressing.advertised_uri(endpoint):
            endpoint.former_uris.add(claim.advertised)  # the URI of a former version
        return endpoint

    async def _resume(self, endpoints: Sequence[Endpoint]) -> None:
        """Serve recovered endpoints; none waits for another that does not answer."""
        try:
            await asyncio.gather(*map(self.serve, endpoints))
            log.info("recovered %d nodes", sum(e.trusted for e in endpoints))
        except (Unreachable, MasterError) as error:
            log.warning("recovery is incomplete: %s", error)

    async def _sweep(
        self, unserved: Sequence[Claim], forgotten: Mapping[str, Sequence[Registration]]
    ) -> None:
        """Take back at the master what no endpoint stands for, after ``--cleanup-after``.

        Not of a node that bears out what the master has of it: it gets its port, if that is free
        by now and the node is inside, as an operator may have said meanwhile. One that does not
        tell who it is is left alone.
        """
        await asyncio.sleep(self._context.settings.cleanup_after)
        self._context.refresh_networks()
        for uri, registrations in forgotten.items():
            with contextlib.suppress(Unreachable):  # the next start finds it again
                await self._registrar.take_back(uri, registrations)
        for claim in unserved:
            try:
                borne_out = await self._is_borne_out(claim)
                if borne_out is False:
                    await self._registrar.take_back(claim.advertised, claim.registrations)
                elif borne_out and (endpoint := self._restore(claim)):
                    await self.serve(endpoint)
                    await self._registrar.apply_policy()
            except (Unreachable, MasterError) as error:
                log.warning("%s stays registered at the master: %s", claim.advertised, error)

    async def _is_borne_out(self, claim: Claim) -> bool | None:
        """Whether the node of a claim is inside and is the one that the master has.

        None if it lives and does not tell.
        """
        if self._context.client_kind(claim.slave.host) is ClientKind.OUTSIDE:
            return False
        registrations = claim.registrations
        ports = claim.service_ports
        info, borne_out = await self._verifier.ask(claim.slave, registrations, ports)
        return False if info is None else borne_out

    async def _verify(self, endpoint: Endpoint) -> None:
        self._inspecting.add(endpoint)
        registrations = list(endpoint.registrations.values())
        try:
            ports = list(endpoint.service_ports)
            info, borne_out = await self._verifier.ask(endpoint.slave, registrations, ports)
        finally:
            self._inspecting.discard(endpoint)
        if endpoint.trusted or self._context.registry.by_port.get(endpoint.port) is not endpoint:
            return  # it has registered meanwhile, or was given up for a node that lives
        if info is None:
            if endpoint.health.answered_at is None:
                endpoint.health.note(ProbeResult.SILENT, self._context.now())
            return
        if borne_out is None:
            self._note_doubt(endpoint)
            return
        if not borne_out:
            text = "%s: not recovered: the node at this address has none of the registered topics"
            log.warning(text, endpoint.label)
            await self._registrar.clean_up(endpoint)
            self._leases.end(endpoint)
            return
        self._context.problems.solved_at(endpoint.port)
        endpoint.note_verified(info.pid, info.topic_ports)
        endpoint.health.note(ProbeResult.ANSWERED, self._context.now())
        self._leases.open(endpoint)
        address = endpoint.location.address
        host = self._context.upstream.reach(endpoint.node).host
        addresses = await resolve(host, address)
        # Neighbours can use the host's name if it leads here.
        if endpoint.location.address == address:
            endpoint.location = replace(endpoint.location, named=address in addresses)
        refuted = await self._verifier.refuted(endpoint.slave, registrations, info, ports)
        await self._registrar.disown(endpoint, refuted)
        # The master has it by a former version's URI: it is registered by that of this one.
        if len(self._context.addressing.uris_at_master(endpoint)) > 1:
            current = list(endpoint.registrations.values())
            await self._registrar.register([(endpoint, r) for r in current])
            endpoint.former_uris.clear()
        await self._registrar.register_missing(endpoint, info)

    def _note_doubt(self, endpoint: Endpoint) -> None:
        """Note that the node that answers does not tell who it is: it stays registered."""
        endpoint.health.note(ProbeResult.ANSWERED, self._context.now())
        self._context.problems.add(endpoint.label, DOUBT, endpoint.port)
