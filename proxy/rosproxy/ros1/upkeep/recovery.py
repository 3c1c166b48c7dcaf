"""After a start: find the nodes behind this proxy, and their ports, at the master.

The proxy keeps nothing on disk; the master is the database. `Recovery.ensure` reads the graph of
the master once, and the parameter of the proxy (`LeaseMemory`). `recovery_claims.find_claims` finds
the URIs that this proxy advertised. `Recovery` rebuilds the endpoints on their former ports. Calls
that register wait for the recovery. Otherwise a node would get another port, and the master would
shut the node down because of the changed URI. First the recovery waits for the policy of an
operator (``--await-policy``). Without the policy, the proxy would register denied names for a
moment.

Any program can write to the master, so its data are only claims. Until the node has confirmed the
claim (`Verifier`), the proxy holds the port, and the port refuses connections. Afterwards
subscribers connect again (`Resubscriber.announce`). If a node does not answer yet, the proxy
verifies the node when a probe gets an answer (`Prober`).

A claim never keeps a port from a live node. If the range is used up, a new node waits a moment for
pending verifications, and gets the port of a claim whose node is dead (`wait_for_dead_claim`).

A registration at the master may have the address of this proxy, although no node got its port
again. A former proxy left this registration, and the proxy takes it back (`_sweep`).

If nodes have other ports after a start, the log names each refused claim and the reason.
"""

import asyncio
import contextlib
import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace

from rosproxy.forwarding.kernel.plane import KernelPlane
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
from rosproxy.shared.addresses import is_inside
from rosproxy.shared.machine.resolver import resolve

log = logging.getLogger(__name__)

MOST_PARALLEL_INSPECTIONS = 64
CLAIM_GRACE_S = 1.0
"""Seconds that a node has to confirm its claim once a live node waits for the port."""
UNCONFIRMED_CLAIM = (
    "answers, but the proxy can't tell whether this is the node that the master has at this port: "
    "the client library lacks getPublications or getSubscriptions, and the node has no topic or "
    "service to ask for. The port stays closed until the node registers again. Restart the node"
)


class Recovery:
    """Rebuilds the registry from the data at the master.

    ``verifying`` has the endpoints that wait for verification; the prober leaves them out.
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
        self._limit = asyncio.Semaphore(MOST_PARALLEL_INSPECTIONS)
        self._recovered = asyncio.Event()
        self._lock = asyncio.Lock()
        self._failures = 0
        self._unannounced: list[Endpoint] = []
        self._announcing = asyncio.Lock()

    async def ensure(self) -> None:
        """Rebuild the registry from the master, once. Raises Unreachable.

        All callers that wait for the same attempt share its failure. Otherwise, with a master that
        hangs, the last caller would wait for as many attempts as there are callers.
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
        """Serve a recovered endpoint if its node confirms the claim, and reconnect subscribers.

        Raises Unreachable, MasterError.
        """
        try:
            async with self._limit:
                await self._verify(endpoint)
        finally:
            self.verifying.discard(endpoint)
        if not self._leases.is_open(endpoint):
            return
        # Each announcement reads the whole graph, so an announcement for each node would cost the
        # square of the number of nodes. Nodes that came up during an announcement share the next.
        self._unannounced.append(endpoint)
        async with self._announcing:
            endpoints = self._unannounced
            self._unannounced = []
            if endpoints:
                await self._resubscriber.announce(endpoints)

    async def wait_for_dead_claim(self) -> None:
        """Wait up to `CLAIM_GRACE_S` for a free port or a dead node.

        The wait also ends with the last pending verification. Nodes that were silent during the
        whole wait count as failing afterwards.
        """
        end = self._context.now() + CLAIM_GRACE_S
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
        # Before calls that register go on: other nodes could get these fast ports as leases.
        self._plane.recovered([e for e in endpoints if self._context.policy.may_bypass(e)])
        if (unserved or forgotten) and self._context.settings.cleanup_after:
            sweep = self._sweep(unserved, forgotten)
            self._context.tasks.spawn(sweep, "taking back registrations of former proxies")
        self.verifying |= set(endpoints)
        if endpoints:
            log.info("recovering %d nodes from the master", len(endpoints))
            self._context.tasks.spawn(self._resume(endpoints), "recovery")

    async def _settle(self, claims: Sequence[Claim]) -> list[Claim]:
        """Choose one claim for each port. First ask the nodes inside with contested claims."""

        async def ask(claim: Claim) -> None:
            log.warning(
                "port %d of %s: another URI at the master claims the same port or the same node",
                claim.port,
                claim.uri,
            )
            # Any program can write to the master, so the proxy calls no address outside for a
            # claim.
            if is_inside(claim.slave.host, self._context.addressing.networks):
                claim.node_info = await self._context.nodes.inspect(claim.slave)

        await asyncio.gather(*map(ask, recovery_claims.contested_claims(claims)))
        return recovery_claims.choose_claims(claims)

    def _restore(self, claim: Claim) -> Endpoint | None:
        """The untrusted endpoint of a claim.

        None if the node is outside, or if the port or the address is taken.
        """
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
            endpoint.former_uris.add(claim.advertised)  # a former version advertised this URI
        return endpoint

    async def _resume(self, endpoints: Sequence[Endpoint]) -> None:
        """Serve recovered endpoints, all at the same time: a silent node delays no other node."""
        try:
            await asyncio.gather(*map(self.serve, endpoints))
            log.info("recovered %d nodes", sum(e.trusted for e in endpoints))
        except (Unreachable, MasterError) as error:
            log.warning("recovery is incomplete: %s", error)

    async def _sweep(
        self, unserved: Sequence[Claim], forgotten: Mapping[str, Sequence[Registration]]
    ) -> None:
        """After ``--cleanup-after``, take back registrations at the master that have no endpoint.

        If the node of a claim is inside by now, and confirms its registrations, the node gets the
        port if the port is free. The proxy leaves the registrations if the node answers, but
        neither confirms nor refutes the claim.
        """
        await asyncio.sleep(self._context.settings.cleanup_after)
        self._context.refresh_networks()
        for uri, registrations in forgotten.items():
            with contextlib.suppress(Unreachable):  # the next start of the proxy finds them again
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
        """Whether the node of a claim is inside and confirms its registrations.

        False if the node does not answer. None if the node answers, but neither confirms nor
        refutes the claim.
        """
        if self._context.client_kind(claim.slave.host) is ClientKind.OUTSIDE:
            return False
        registrations = claim.registrations
        ports = claim.service_ports
        info, borne_out = await self._verifier.ask(claim.slave, registrations, ports)
        return False if info is None else borne_out

    async def _verify(self, endpoint: Endpoint) -> None:
        """Open the port if the node confirms the claim; end the lease if the node refutes it."""
        self._inspecting.add(endpoint)
        registrations = list(endpoint.registrations.values())
        try:
            ports = list(endpoint.service_ports)
            info, borne_out = await self._verifier.ask(endpoint.slave, registrations, ports)
        finally:
            self._inspecting.discard(endpoint)
        if endpoint.trusted or self._context.registry.by_port.get(endpoint.port) is not endpoint:
            return  # the node has registered meanwhile, or lost the port to a live node
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
        # Neighbours can use the host name if the name resolves to this address.
        if endpoint.location.address == address:
            endpoint.location = replace(endpoint.location, named=address in addresses)
        refuted = await self._verifier.refuted(endpoint.slave, registrations, info, ports)
        await self._registrar.disown(endpoint, refuted)
        # The master has the URI of a former version of the proxy: register the present URI.
        if len(self._context.addressing.uris_at_master(endpoint)) > 1:
            current = list(endpoint.registrations.values())
            await self._registrar.register([(endpoint, r) for r in current])
            endpoint.former_uris.clear()
        await self._registrar.register_missing(endpoint, info)

    def _note_doubt(self, endpoint: Endpoint) -> None:
        """Record that the node answers, but neither confirms nor refutes its claim."""
        endpoint.health.note(ProbeResult.ANSWERED, self._context.now())
        self._context.problems.add(endpoint.label, UNCONFIRMED_CLAIM, endpoint.port)
