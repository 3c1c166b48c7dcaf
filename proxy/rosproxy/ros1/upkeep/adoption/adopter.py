"""Adopting nodes that registered around the proxy (see `core.strays`)."""

import asyncio
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from rosproxy.admin.requests import Arrival
from rosproxy.leases.leases import Leases
from rosproxy.net.addresses import HostPort, is_inside
from rosproxy.net.resolver import resolve
from rosproxy.ros1.clients.master import MasterError, Unreachable
from rosproxy.ros1.clients.master_graph import read_graph
from rosproxy.ros1.clients.node import NodeClient, SelfDescription
from rosproxy.ros1.context import Context
from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.protocol.uris import parse_slave_uri
from rosproxy.ros1.registry.endpoint import Endpoint, Place
from rosproxy.ros1.registry.health import ProbeResult
from rosproxy.ros1.rewriting.addressing import Asker
from rosproxy.ros1.servers.admission import NodeAdmission
from rosproxy.ros1.upkeep.adoption import policy
from rosproxy.ros1.upkeep.adoption.policy import Stray, Verdict
from rosproxy.ros1.upkeep.registrar import Registrar

log = logging.getLogger(__name__)

SPARE_TIMEOUT = 2.0
"""Seconds in which the master must say where a node is that is to be shut down."""


@dataclass(frozen=True, slots=True)
class _Sight:
    """A node that was found at a place."""

    pid: int
    said: SelfDescription


@dataclass(slots=True)
class Adopted:
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
        upkeep: Registrar,
    ) -> None:
        self._context, self._leases, self._admission = context, leases, admission
        self._nodes, self._upkeep = nodes, upkeep
        self._one_at_a_time = asyncio.Lock()

    async def adopt(self, arrived: Sequence[Arrival]) -> Adopted:
        """Adopt the nodes of containers that have arrived. Raises Unreachable, MasterError.

        A node is adopted if one answers at the container's address and the port that it gave,
        and names its topics. The others are left as they are.
        """
        async with self._one_at_a_time:
            graph = await read_graph(self._context.upstream)
            found = policy.find(graph, self._inside(arrived), self._context.addressing)
            sights = await self._look({place for stray in found for place in stray.places})
            topics = {place: sight.said.topics for place, sight in sights.items()}
            settled, doubts = policy.settle(found, topics)
            adopted = Adopted(doubts=doubts)
            await self._take_in(settled, sights, adopted)
        for name, why in adopted.doubts.items():
            log.warning("%s: %s", name, why)
            self._context.problems.add(name, why)
        return adopted

    async def take_over(self, endpoint: Endpoint, caller_id: str) -> None:
        """Before a name registers: take back what the same node registered around the proxy.

        The master would else call shutdown at the node's own URI. Raises Unreachable.
        """
        if caller_id in endpoint.caller_ids and not endpoint.direct:
            return
        uri = await self._at_master(caller_id)
        if uri and uri != self._advertised(endpoint) and policy.known_as(endpoint, uri):
            log.info("%s was registered as %s around the proxy; taken over", caller_id, uri)
            try:
                async with self._one_at_a_time:
                    await self._upkeep.reclaim({caller_id: (endpoint, uri)})
            except MasterError as error:
                raise Unreachable(str(error)) from error

    async def absorb_shutdown(self, endpoint: Endpoint, caller_id: str, reason: str) -> bool:
        """Whether a ``shutdown`` at an endpoint is only due to what its own node has registered.

        The master sends it to a name that changes its URI, at the one before. If that is a former
        URI of the same node again, or if by now it is the endpoint's own, no other node has taken
        the name.
        """
        name = policy.accused(caller_id, reason)
        if name is None or name not in endpoint.caller_ids:
            return False
        try:
            async with asyncio.timeout(SPARE_TIMEOUT):
                uri = await self._at_master(name)
        except (TimeoutError, Unreachable):
            return False
        verdict = policy.judge(endpoint, uri, self._advertised(endpoint))
        if verdict is Verdict.GUILTY:
            return False
        log.info("%s registered around the proxy; not shut down", name)
        former = {name: (endpoint, uri or endpoint.uri)} if verdict is Verdict.ASTRAY else {}
        self._context.tasks.spawn(self._again(endpoint, former), f"taking over {endpoint.uri}")
        return True

    async def _again(self, endpoint: Endpoint, former: Mapping[str, tuple[Endpoint, str]]) -> None:
        """Take names over once more; and what is at the master neither way by now."""
        try:
            async with self._one_at_a_time:
                await self._upkeep.reclaim(former)
                await self._upkeep.reconcile(endpoint)
        except (Unreachable, MasterError) as error:
            log.warning("%s; what is lost is registered later", error)

    def _inside(self, arrived: Sequence[Arrival]) -> list[Arrival]:
        """Those at addresses in inside networks; published ports lead nowhere else."""
        networks = self._context.addressing.networks
        for arrival in arrived:
            if not is_inside(arrival.address, networks):
                text = "is in none of the inside networks: its nodes are not looked at"
                self._context.problems.add(arrival.address, text)
        return [arrival for arrival in arrived if is_inside(arrival.address, networks)]

    async def _look(self, places: set[HostPort]) -> dict[HostPort, _Sight]:
        found = await asyncio.gather(*(self._see(place) for place in places))
        return {place: sight for place, sight in zip(places, found, strict=True) if sight}

    async def _see(self, place: HostPort) -> _Sight | None:
        answer = await self._nodes.probe(place)
        said = await self._nodes.describe(place) if answer.pid is not None else None
        return _Sight(answer.pid, said) if answer.pid is not None and said else None

    async def _take_in(
        self,
        settled: Mapping[HostPort, list[Stray]],
        sights: Mapping[HostPort, _Sight],
        adopted: Adopted,
    ) -> None:
        """Give each a port and register all of them anew."""
        former: dict[str, tuple[Endpoint, str]] = {}
        endpoints: dict[Endpoint, SelfDescription] = {}
        try:
            for place, found in settled.items():
                endpoint = await self._endpoint(place, found, sights[place])
                if endpoint is None:
                    adopted.doubts |= {stray.caller_id: NO_PORT for stray in found}
                    continue
                endpoints[endpoint] = sights[place].said
                former |= {stray.caller_id: (endpoint, stray.uri) for stray in found}
            await self._upkeep.reclaim(former)
            for endpoint, said in endpoints.items():
                await self._upkeep.adopt(endpoint, said)
        finally:
            for endpoint in endpoints:
                endpoint.pending -= 1
        names = [name for name, (e, _) in former.items() if name in e.caller_ids]
        adopted.names += names
        for name in names:
            log.info("%s adopted: %s", name, self._advertised(former[name][0]))

    async def _endpoint(
        self, place: HostPort, found: Sequence[Stray], sight: _Sight
    ) -> Endpoint | None:
        """The endpoint of strays at a place, with what they hold; marked as ``pending``."""
        uri = found[0].uri
        node = parse_slave_uri(uri) or place
        named = place.host in await resolve(self._context.upstream.reach(node).host)
        asker = Asker(place.host, "", found[0].caller_id)
        where = Place(place.host, named, confirmed=False)
        endpoint = self._admission.take_in(uri, node, where, asker)
        if not isinstance(endpoint, Endpoint):
            return None
        endpoint.pending += 1
        await self._leases.cleared(endpoint)
        self._note(endpoint, sight)
        for stray in found:
            endpoint.former_uris.add(stray.uri)
            self._hold(endpoint, stray, sight.said)
        return endpoint

    def _note(self, endpoint: Endpoint, sight: _Sight) -> None:
        """Take in that its node answers."""
        endpoint.trusted, endpoint.tcpros_port = True, sight.said.tcpros_port
        endpoint.health.note(ProbeResult.ANSWERED, self._context.now())
        if endpoint.health.pid not in (None, sight.pid):
            endpoint.health.suspect()
        else:
            endpoint.health.pid = sight.pid
        endpoint.health.cleaned = False
        self._leases.open(endpoint)

    def _hold(self, endpoint: Endpoint, stray: Stray, said: SelfDescription) -> None:
        """Note what a stray holds, so that it is registered anew even if that fails at first."""
        types = {Kind.PUBLISHER: said.published, Kind.SUBSCRIBER: said.subscribed}
        for held in stray.registrations:
            type_ = types.get(held.kind, {}).get(held.name, held.type)
            one = replace(held, type=type_, since=self._context.now())
            self._context.registry.register(endpoint, one)

    async def _at_master(self, caller_id: str) -> str | None:
        try:
            uri = await self._context.upstream.ask_master("lookupNode", caller_id)
        except MasterError:
            return None
        return uri if isinstance(uri, str) else None

    def _advertised(self, endpoint: Endpoint) -> str:
        return self._context.addressing.advertised_uri(endpoint)


NO_PORT = "registered around the proxy and can't be adopted: no port of the range is left"
