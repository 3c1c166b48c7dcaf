"""A node that registered around the proxy: making the master know it through the proxy.

There are three occasions. A container has arrived whose nodes may have registered before
(`adopt`); a node that did registers something through the proxy (`take_over`); the master wants a
node shut down that has registered around the proxy once more (`absorb_shutdown`). Each ends with
`Registrar.reclaim`, which registers anew what the master has by the node's own URI.
"""

import asyncio
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from rosproxy.leases.leases import Leases
from rosproxy.net.addresses import HostPort, is_inside
from rosproxy.net.resolver import resolve
from rosproxy.ros1.clients.master import MasterError, Unreachable
from rosproxy.ros1.context import Context
from rosproxy.ros1.protocol.uris import parse_slave_uri
from rosproxy.ros1.registry.endpoint import Endpoint, NodeLocation
from rosproxy.ros1.registry.graph import NodeInfo
from rosproxy.ros1.rewriting.addressing import Caller
from rosproxy.ros1.servers.admission import NodeAdmission
from rosproxy.ros1.upkeep.decisions import adoption as decisions
from rosproxy.ros1.upkeep.decisions.adoption import Container, DirectNode
from rosproxy.ros1.upkeep.decisions.registration import known_as
from rosproxy.ros1.upkeep.registrar import FormerUris, Registrar
from rosproxy.ros1.upkeep.verifier import Verifier

log = logging.getLogger(__name__)

SHUTDOWN_TIMEOUT = 2.0
"""Seconds in which the master must say where a node is that is to be shut down."""
NO_PORT = "registered around the proxy and can't be adopted: no port of the range is left"


@dataclass(slots=True, eq=False)
class Adopter:
    """Finds nodes that registered around the proxy, and makes the master know them through it."""

    _context: Context
    _leases: Leases[Endpoint]
    _admission: NodeAdmission
    _registrar: Registrar
    _one_at_a_time: asyncio.Lock = field(default_factory=asyncio.Lock)

    async def adopt(self, arrived: Sequence[Container]) -> int:
        """Adopt the nodes of containers that have arrived.

        A node is adopted if one answers at the container's address and the port that it gave,
        and bears out what is registered for it. The others are left as they are. Returns how many
        were adopted. Raises Unreachable, MasterError.
        """
        context = self._context
        inside: list[Container] = []
        for address, names in arrived:  # published ports lead nowhere else than inside
            if is_inside(address, context.addressing.networks):
                inside.append((address, names))
            else:
                text = "is in none of the inside networks: its nodes are not looked at"
                context.problems.add(address, text)
        if not inside:
            return 0
        async with self._one_at_a_time:
            graph = await context.upstream.read_graph()
            nodes = decisions.find_direct(graph, inside, context.addressing)
            infos = await self._inspect({place for node in nodes for place in node.places})
            sure = await self._verify(nodes, infos)
            located, doubts = decisions.locate(nodes, infos, sure)
            for name, why in doubts.items():
                self._report(name, why)
            return await self._take_in(located, infos)

    async def take_over(self, endpoint: Endpoint, caller_id: str) -> None:
        """Before a name registers: take back what the same node registered around the proxy.

        The master would else call shutdown at the node's own URI. Raises Unreachable.
        """
        if caller_id in endpoint.caller_ids and not endpoint.direct:
            return
        uri = await self._look_up(caller_id)
        advertised = self._context.addressing.advertised_uri(endpoint)
        if uri and uri != advertised and known_as(endpoint, uri):
            log.info("%s was registered as %s around the proxy; taken over", caller_id, uri)
            try:
                async with self._one_at_a_time:
                    await self._registrar.reclaim({caller_id: (endpoint, uri)})
            except MasterError as error:
                raise Unreachable(str(error)) from error

    async def absorb_shutdown(self, endpoint: Endpoint, caller_id: str, reason: str) -> bool:
        """Keep a ``shutdown`` from a node that no other has replaced; whether that is so.

        What the node registered around the proxy is then registered anew. Nor is it meant for one
        that never had the name: another had this port before.
        """
        name = decisions.renamed_node(caller_id, reason)
        if name is None:
            return False
        if name not in endpoint.callers:
            return name not in endpoint.former_callers
        try:
            async with asyncio.timeout(SHUTDOWN_TIMEOUT):
                uri = await self._look_up(name)
        except (TimeoutError, Unreachable):
            return False
        advertised = self._context.addressing.advertised_uri(endpoint)
        if not decisions.has_name_still(endpoint, uri, advertised):
            return False
        log.info("%s registered around the proxy; not shut down", name)
        former = {} if uri == advertised else {name: (endpoint, uri or endpoint.uri)}
        self._context.tasks.spawn(self._repeat(endpoint, former), f"taking over {endpoint.uri}")
        return True

    async def _repeat(self, endpoint: Endpoint, former: FormerUris) -> None:
        """Take names over once more; and what is at the master neither way by now."""
        try:
            async with self._one_at_a_time:
                await self._registrar.reclaim(former)
                await self._registrar.reconcile(endpoint)
        except (Unreachable, MasterError) as error:
            log.warning("%s; what is lost is registered later", error)

    async def _inspect(self, places: set[HostPort]) -> dict[HostPort, NodeInfo]:
        """What nodes say of themselves, where one answers."""
        found = await asyncio.gather(*map(self._context.nodes.inspect, places))
        return {place: info for place, info in zip(places, found, strict=True) if info}

    async def _verify(
        self, nodes: Sequence[DirectNode], infos: Mapping[HostPort, NodeInfo]
    ) -> set[tuple[str, HostPort]]:
        """Which nodes are at which of their places for sure, by name."""
        judge = Verifier(self._context.nodes).judge
        tried = [(node, place) for node in nodes for place in node.places if place in infos]
        borne_out = await asyncio.gather(
            *(judge(place, node.registrations, infos[place]) for node, place in tried)
        )
        return {
            (node.caller_id, place)
            for (node, place), sure in zip(tried, borne_out, strict=True)
            if sure
        }

    async def _take_in(
        self, located: Mapping[HostPort, list[DirectNode]], infos: Mapping[HostPort, NodeInfo]
    ) -> int:
        """Give each a port and register all of them anew; how many names could be."""
        former: dict[str, tuple[Endpoint, str]] = {}
        endpoints: dict[Endpoint, NodeInfo] = {}
        try:
            for place, nodes in located.items():
                endpoint = await self._make_endpoint(place, nodes, infos[place])
                if endpoint is None:
                    for node in nodes:
                        self._report(node.caller_id, NO_PORT)
                    continue
                endpoints[endpoint] = infos[place]
                former |= {node.caller_id: (endpoint, node.uri) for node in nodes}
            await self._registrar.reclaim(former)
            for endpoint, info in endpoints.items():
                await self._registrar.register_missing(endpoint, info)
        finally:
            for endpoint in endpoints:
                endpoint.release()
        adopted = {name: e for name, (e, _) in former.items() if name in e.caller_ids}
        for name, endpoint in adopted.items():
            uri = self._context.addressing.advertised_uri(endpoint)
            log.info("%s adopted: %s", name, uri)
        return len(adopted)

    async def _make_endpoint(
        self, place: HostPort, nodes: Sequence[DirectNode], info: NodeInfo
    ) -> Endpoint | None:
        """The endpoint of nodes at a place, with what they hold; marked as ``pending``.

        So what they hold is registered anew even if that fails at first.
        """
        uri = nodes[0].uri
        own = parse_slave_uri(uri) or place
        host = self._context.upstream.reach(own).host
        named = place.host in await resolve(host, place.host)
        caller = Caller(place.host, "", nodes[0].caller_id)
        where = NodeLocation(place.host, named, confirmed=False)
        endpoint = await self._admission.take_in(uri, own, where, caller, answers=True)
        if not isinstance(endpoint, Endpoint):
            return None
        endpoint.hold()
        await self._leases.cleared(endpoint)
        now, known_pid = self._context.now(), endpoint.health.pid
        endpoint.mark_alive(info.pid, info.topic_ports, now)
        if known_pid not in (None, info.pid):
            endpoint.health.suspect()
        self._leases.open(endpoint)
        for node in nodes:
            endpoint.note_former_uri(node.uri)
            for held in node.registrations:
                type_ = info.by_kind.get(held.kind, {}).get(held.name, held.type)
                self._context.registry.register(endpoint, replace(held, type=type_, since=now))
        return endpoint

    def _report(self, name: str, why: str) -> None:
        log.warning("%s: %s", name, why)
        self._context.problems.add(name, why)

    async def _look_up(self, caller_id: str) -> str | None:
        known = await self._context.upstream.look_up("lookupNode", [caller_id])
        return known.get(caller_id)
