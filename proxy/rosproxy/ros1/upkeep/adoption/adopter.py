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

from rosproxy.admin.requests import Arrival
from rosproxy.leases.leases import Leases
from rosproxy.net.addresses import HostPort, is_inside
from rosproxy.net.resolver import resolve
from rosproxy.ros1.clients.master import MasterError, Unreachable
from rosproxy.ros1.clients.master_graph import look_up_nodes, read_graph
from rosproxy.ros1.clients.node import NodeClient
from rosproxy.ros1.context import Context
from rosproxy.ros1.protocol.uris import parse_slave_uri
from rosproxy.ros1.registry.endpoint import Endpoint, Place
from rosproxy.ros1.registry.graph import NodeInfo
from rosproxy.ros1.rewriting.addressing import Asker
from rosproxy.ros1.servers.admission import NodeAdmission
from rosproxy.ros1.upkeep.adoption import policy
from rosproxy.ros1.upkeep.adoption.policy import DirectNode, ShutdownCause
from rosproxy.ros1.upkeep.registration.policy import known_as
from rosproxy.ros1.upkeep.registration.registrar import Former, Registrar

log = logging.getLogger(__name__)

SHUTDOWN_TIMEOUT = 2.0
"""Seconds in which the master must say where a node is that is to be shut down."""
NO_PORT = "registered around the proxy and can't be adopted: no port of the range is left"


@dataclass(slots=True)
class Adoption:
    """The names of the nodes that were adopted, and why others were not, by name."""

    names: list[str] = field(default_factory=list)
    doubts: dict[str, str] = field(default_factory=dict)


class Adopter:
    """Finds nodes that registered around the proxy, and makes the master know them through it."""

    def __init__(
        self,
        context: Context,
        leases: Leases[Endpoint],
        admission: NodeAdmission,
        nodes: NodeClient,
        registrar: Registrar,
    ) -> None:
        self._context, self._leases, self._admission = context, leases, admission
        self._nodes, self._registrar = nodes, registrar
        self._one_at_a_time = asyncio.Lock()

    async def adopt(self, arrived: Sequence[Arrival]) -> Adoption:
        """Adopt the nodes of containers that have arrived. Raises Unreachable, MasterError.

        A node is adopted if one answers at the container's address and the port that it gave,
        and names its topics. The others are left as they are.
        """
        addressing = self._context.addressing
        async with self._one_at_a_time:
            graph = await read_graph(self._context.upstream)
            nodes = policy.find_direct(graph, self._inside(arrived), addressing)
            infos = await self._inspect({place for node in nodes for place in node.places})
            topics = {place: info.topics for place, info in infos.items()}
            located, doubts = policy.locate(nodes, topics)
            adoption = Adoption(doubts=doubts)
            await self._take_in(located, infos, adoption)
        for name, why in adoption.doubts.items():
            log.warning("%s: %s", name, why)
            self._context.problems.add(name, why)
        return adoption

    async def take_over(self, endpoint: Endpoint, caller_id: str) -> None:
        """Before a name registers: take back what the same node registered around the proxy.

        The master would else call shutdown at the node's own URI. Raises Unreachable.
        """
        if caller_id in endpoint.caller_ids and not endpoint.direct:
            return
        uri = await self._look_up(caller_id)
        if uri and uri != self._advertised(endpoint) and known_as(endpoint, uri):
            log.info("%s was registered as %s around the proxy; taken over", caller_id, uri)
            try:
                async with self._one_at_a_time:
                    await self._registrar.reclaim({caller_id: (endpoint, uri)})
            except MasterError as error:
                raise Unreachable(str(error)) from error

    async def absorb_shutdown(self, endpoint: Endpoint, caller_id: str, reason: str) -> bool:
        """Keep a ``shutdown`` from a node that no other has replaced; whether that is so.

        What the node registered around the proxy is then registered anew.
        """
        name = policy.renamed_node(caller_id, reason)
        if name is None or name not in endpoint.caller_ids:
            return False
        try:
            async with asyncio.timeout(SHUTDOWN_TIMEOUT):
                uri = await self._look_up(name)
        except (TimeoutError, Unreachable):
            return False
        cause = policy.shutdown_cause(endpoint, uri, self._advertised(endpoint))
        if cause is ShutdownCause.NAME_TAKEN:
            return False
        log.info("%s registered around the proxy; not shut down", name)
        direct = cause is ShutdownCause.REGISTERED_DIRECTLY
        former = {name: (endpoint, uri or endpoint.uri)} if direct else {}
        self._context.tasks.spawn(self._repeat(endpoint, former), f"taking over {endpoint.uri}")
        return True

    async def _repeat(self, endpoint: Endpoint, former: Former) -> None:
        """Take names over once more; and what is at the master neither way by now."""
        try:
            async with self._one_at_a_time:
                await self._registrar.reclaim(former)
                await self._registrar.reconcile(endpoint)
        except (Unreachable, MasterError) as error:
            log.warning("%s; what is lost is registered later", error)

    def _inside(self, arrived: Sequence[Arrival]) -> list[Arrival]:
        """Those at addresses in inside networks; published ports lead nowhere else."""
        networks, inside = self._context.addressing.networks, []
        for arrival in arrived:
            if is_inside(arrival.address, networks):
                inside.append(arrival)
            else:
                text = "is in none of the inside networks: its nodes are not looked at"
                self._context.problems.add(arrival.address, text)
        return inside

    async def _inspect(self, places: set[HostPort]) -> dict[HostPort, NodeInfo]:
        """What nodes say of themselves, where one answers with a pid."""
        found = await asyncio.gather(*map(self._nodes.inspect, places))
        infos = zip(places, found, strict=True)
        return {place: info for place, info in infos if info and info.pid is not None}

    async def _take_in(
        self,
        located: Mapping[HostPort, list[DirectNode]],
        infos: Mapping[HostPort, NodeInfo],
        adoption: Adoption,
    ) -> None:
        """Give each a port and register all of them anew."""
        former: dict[str, tuple[Endpoint, str]] = {}
        endpoints: dict[Endpoint, NodeInfo] = {}
        try:
            for place, nodes in located.items():
                endpoint = await self._make_endpoint(place, nodes, infos[place])
                if endpoint is None:
                    adoption.doubts |= {node.caller_id: NO_PORT for node in nodes}
                    continue
                endpoints[endpoint] = infos[place]
                former |= {node.caller_id: (endpoint, node.uri) for node in nodes}
            await self._registrar.reclaim(former)
            for endpoint, info in endpoints.items():
                await self._registrar.register_missing(endpoint, info)
        finally:
            for endpoint in endpoints:
                endpoint.release()
        adoption.names += [name for name, (e, _) in former.items() if name in e.caller_ids]
        for name in adoption.names:
            log.info("%s adopted: %s", name, self._advertised(former[name][0]))

    async def _make_endpoint(
        self, place: HostPort, nodes: Sequence[DirectNode], info: NodeInfo
    ) -> Endpoint | None:
        """The endpoint of nodes at a place, with what they hold; marked as ``pending``.

        So what they hold is registered anew even if that fails at first.
        """
        uri = nodes[0].uri
        own = parse_slave_uri(uri) or place
        named = place.host in await resolve(self._context.upstream.reach(own).host)
        asker = Asker(place.host, "", nodes[0].caller_id)
        where = Place(place.host, named, confirmed=False)
        endpoint = self._admission.take_in(uri, own, where, asker)
        if not isinstance(endpoint, Endpoint):
            return None
        endpoint.hold()
        await self._leases.cleared(endpoint)
        now, known_pid = self._context.now(), endpoint.health.pid
        endpoint.mark_alive(info.pid, info.tcpros_port, now)
        if known_pid not in (None, info.pid):
            endpoint.health.suspect()
        self._leases.open(endpoint)
        for node in nodes:
            endpoint.note_former_uri(node.uri)
            for held in node.registrations:
                type_ = info.by_kind.get(held.kind, {}).get(held.name, held.type)
                self._context.registry.register(endpoint, replace(held, type=type_, since=now))
        return endpoint

    async def _look_up(self, caller_id: str) -> str | None:
        return (await look_up_nodes(self._context.upstream, [caller_id])).get(caller_id)

    def _advertised(self, endpoint: Endpoint) -> str:
        return self._context.addressing.advertised_uri(endpoint)
