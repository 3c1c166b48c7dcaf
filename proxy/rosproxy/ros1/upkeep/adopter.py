"""Adopt nodes that registered at the real master directly, not through the proxy.

There are three occasions:

- A container has arrived whose nodes may have registered directly (`adopt`).
- A node that registered directly now registers through the proxy (`take_over`).
- The master calls ``shutdown`` for a node of the proxy that has registered again, this time
  directly (`absorb_shutdown`).

In all cases `Registrar.reclaim` unregisters what is registered with the node's own URI, and
registers the same through the proxy.
"""

import asyncio
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from rosproxy.ros1.clients.master_client import MasterError, Unreachable
from rosproxy.ros1.context import Context
from rosproxy.ros1.leases import Leases
from rosproxy.ros1.registry.endpoint import Endpoint, NodeLocation
from rosproxy.ros1.registry.graph import NodeInfo
from rosproxy.ros1.rewriting.addressing import Caller
from rosproxy.ros1.servers.admission import NodeAdmission
from rosproxy.ros1.upkeep.decisions import adoption as decisions
from rosproxy.ros1.upkeep.decisions.adoption import Container, DirectNode
from rosproxy.ros1.upkeep.decisions.registration import is_known_as
from rosproxy.ros1.upkeep.registrar import Registrar
from rosproxy.ros1.upkeep.verifier import Verifier
from rosproxy.shared.addresses import HostPort, is_inside
from rosproxy.shared.fixes import how_to_in_a_sentence
from rosproxy.shared.machine.resolver import resolve
from rosproxy.shared.uris import parse_slave_uri

log = logging.getLogger(__name__)

SHUTDOWN_LOOKUP_TIMEOUT_S = 2.0
"""Seconds within which the master must tell the URI of a node for a ``shutdown``."""
NO_PORT_TEXT = (
    "registered directly at the master, and can't be adopted: no port of the range is left"
)


@dataclass(slots=True, eq=False)
class Adopter:
    """Adopts nodes that registered at the real master directly."""

    _context: Context
    _leases: Leases
    _admission: NodeAdmission
    _registrar: Registrar
    _lock: asyncio.Lock = field(default_factory=asyncio.Lock)
    _to_reclaim: dict[Endpoint, dict[str, tuple[Endpoint, str]]] = field(default_factory=dict)
    """What `_reclaim` takes next, by endpoint: the former URIs by node name."""

    async def adopt(self, arrived: Sequence[Container]) -> int:
        """Adopt the nodes of containers that have arrived; return the number of names.

        The proxy adopts a node if a node answers at the address of the container and the port of
        the URI, and confirms the registrations. All other nodes stay as they are. Raises
        Unreachable, MasterError.
        """
        context = self._context
        inside: list[Container] = []
        for address, names in arrived:  # published ports must lead to addresses inside only
            if is_inside(address, context.addressing.networks):
                inside.append((address, names))
            else:
                problem = "is not in an inside network: the proxy does not adopt the nodes there"
                context.problems.add(address, problem)
        if not inside:
            return 0
        async with self._lock:
            graph = await context.upstream.read_graph()
            nodes = decisions.find_direct(graph, inside, context.addressing)
            infos = await self._inspect({slave for node in nodes for slave in node.slaves})
            verified = await self._verify(nodes, infos)
            located, doubts = decisions.locate(nodes, infos, verified)
            for name, reason in doubts.items():
                self._report(name, reason)
            return await self._take_in(located, infos)

    async def take_over(self, endpoint: Endpoint, caller_id: str) -> None:
        """Take back direct registrations of a name before the node registers through the proxy.

        Otherwise the master would call shutdown at the node's own URI. Raises Unreachable.
        """
        # The name is known and has never bypassed the proxy, so the master is not asked each time.
        if caller_id in endpoint.callers and not endpoint.has_registered_directly:
            return
        uri = await self._look_up(caller_id)
        advertised = self._context.addressing.advertised_uri(endpoint)
        if uri and uri != advertised and is_known_as(endpoint, uri):
            text = "%s was registered directly at the master as %s; the proxy takes the node over"
            log.info(text, caller_id, uri)
            try:
                async with self._lock:
                    await self._registrar.reclaim({caller_id: (endpoint, uri)})
            except MasterError as error:  # the caller gets the same answer as without a master
                raise Unreachable(str(error)) from error

    async def absorb_shutdown(self, endpoint: Endpoint, caller_id: str, reason: str) -> bool:
        """Return whether a ``shutdown`` is needless: the caller does not pass it on to the node.

        If the node has registered directly, the proxy then makes the same registrations with the
        advertised URI. A ``shutdown`` for a name that the node never had is needless, too: another
        node had this port before.
        """
        name = decisions.name_registered_again(caller_id, reason)
        if name is None:
            return False
        if name not in endpoint.callers:
            return name not in endpoint.former_callers
        try:
            async with asyncio.timeout(SHUTDOWN_LOOKUP_TIMEOUT_S):
                uri = await self._look_up(name)
        except (TimeoutError, Unreachable):
            return False  # the call may be justified, so it is passed on
        advertised = self._context.addressing.advertised_uri(endpoint)
        if not decisions.has_name_still(endpoint, uri, advertised):
            return False
        text = "%s registered directly at the master; the proxy does not pass on the shutdown"
        log.info(text, name)
        # The node may have registered through the proxy again since: then the master has the
        # advertised URI, and there is nothing to reclaim. If the master has no URI, the proxy is
        # already registering the node anew, so reclaim what the node's own URI still has.
        former = {} if uri == advertised else {name: (endpoint, uri or endpoint.uri)}
        # Any client outside may make such calls, so the calls for an endpoint share a task.
        if endpoint not in self._to_reclaim:
            self._to_reclaim[endpoint] = {}
            self._context.tasks.spawn(self._reclaim(endpoint), f"taking over {endpoint.uri}")
        self._to_reclaim[endpoint] |= former
        return True

    async def _reclaim(self, endpoint: Endpoint) -> None:
        """Reclaim names of an endpoint, and repair the effects of direct calls. Log failures."""
        try:
            async with self._lock:
                former = self._to_reclaim.pop(endpoint)
                await self._registrar.reclaim(former)
                await self._registrar.reconcile(endpoint)
        except (Unreachable, MasterError) as error:
            log.warning("%s. The proxy makes the missing registrations later", error)

    async def _inspect(self, slaves: set[HostPort]) -> dict[HostPort, NodeInfo]:
        """What the nodes at slave addresses say about themselves, for addresses with a node."""
        answers = await asyncio.gather(*map(self._context.nodes.inspect, slaves))
        return {slave: info for slave, info in zip(slaves, answers, strict=True) if info}

    async def _verify(
        self, nodes: Sequence[DirectNode], infos: Mapping[HostPort, NodeInfo]
    ) -> set[tuple[str, HostPort]]:
        """The names that are confirmed, each with the slave address of the node."""
        judge = Verifier(self._context.nodes).judge
        tried = [(node, slave) for node in nodes for slave in node.slaves if slave in infos]
        confirmations = await asyncio.gather(
            *(judge(slave, node.registrations, infos[slave]) for node, slave in tried)
        )
        return {
            (node.caller_id, slave)
            for (node, slave), is_verified in zip(tried, confirmations, strict=True)
            if is_verified
        }

    async def _take_in(
        self, located: Mapping[HostPort, list[DirectNode]], infos: Mapping[HostPort, NodeInfo]
    ) -> int:
        """Give each node a port and register the node anew; return the number of adopted names."""
        former: dict[str, tuple[Endpoint, str]] = {}
        endpoints: dict[Endpoint, NodeInfo] = {}
        try:
            for slave, nodes in located.items():
                endpoint = await self._make_endpoint(slave, nodes, infos[slave])
                if endpoint is None:
                    for node in nodes:
                        fix = how_to_in_a_sentence("larger range")
                        self._report(node.caller_id, f"{NO_PORT_TEXT}. {fix}")
                    continue
                endpoints[endpoint] = infos[slave]
                former |= {node.caller_id: (endpoint, node.uri) for node in nodes}
            await self._registrar.reclaim(former)
            for endpoint, info in endpoints.items():
                await self._registrar.register_missing(endpoint, info)
        finally:
            for endpoint in endpoints:
                endpoint.pending -= 1
        adopted = {name: e for name, (e, _) in former.items() if name in e.callers}
        for name, endpoint in adopted.items():
            uri = self._context.addressing.advertised_uri(endpoint)
            log.info("%s adopted: advertised as %s", name, uri)
        return len(adopted)

    async def _make_endpoint(
        self, slave: HostPort, nodes: Sequence[DirectNode], info: NodeInfo
    ) -> Endpoint | None:
        """Make the endpoint of nodes at a slave address, with their registrations.

        None if no port of the range is left. The caller has to decrement ``pending``. The registry
        has the registrations from the start, so the proxy repeats the calls to the master if these
        fail at first.
        """
        uri = nodes[0].uri
        own_slave = parse_slave_uri(uri) or slave
        host = self._context.upstream.reach(own_slave).host
        named = slave.host in await resolve(host, slave.host)
        caller = Caller(slave.host, "", nodes[0].caller_id)
        location = NodeLocation(slave.host, named, confirmed=False)
        endpoint = await self._admission.take_in(uri, own_slave, location, caller, answers=True)
        if not isinstance(endpoint, Endpoint):
            return None
        endpoint.pending += 1
        await self._leases.wait_until_unforwarded(endpoint)
        now = self._context.now()
        known_pid = endpoint.health.pid
        endpoint.mark_alive(info.pid, info.topic_ports, now)
        # Another process had this endpoint before. The prober unregisters what the former process
        # has left.
        if known_pid not in (None, info.pid):
            endpoint.health.suspect()
        self._leases.open(endpoint)
        for node in nodes:
            endpoint.former_uris.add(node.uri)
            for registration in node.registrations:
                type_ = info.by_kind.get(registration.kind, {}).get(
                    registration.name, registration.type
                )
                self._context.registry.register(
                    endpoint, replace(registration, type=type_, since=now)
                )
        return endpoint

    def _report(self, name: str, reason: str) -> None:
        log.warning("%s: %s", name, reason)
        self._context.problems.add(name, reason)

    async def _look_up(self, caller_id: str) -> str | None:
        uris = await self._context.upstream.look_up("lookupNode", [caller_id])
        return uris.get(caller_id)
