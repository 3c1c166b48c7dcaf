"""Finding subscribers without a connection, and having them make a new one."""

import asyncio
import logging
from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence

from rosproxy.net.resolver import resolve
from rosproxy.ros1.clients.master import MasterError, Unreachable
from rosproxy.ros1.clients.master_graph import locate, read_registrations
from rosproxy.ros1.context import Context
from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.protocol.uris import parse_slave_uri
from rosproxy.ros1.registry.endpoint import Endpoint, Registration
from rosproxy.ros1.registry.graph import Graph
from rosproxy.ros1.upkeep.resubscription import policy
from rosproxy.ros1.upkeep.resubscription.policy import BusRow, Connection, Subscription
from rosproxy.ros1.upkeep.resubscription.publisher_updates import PARALLEL_CALLS, PublisherUpdates

log = logging.getLogger(__name__)

LOOKS = (4.0, 10.0, 25.0, 75.0, 165.0)
"""Seconds after which endpoints are looked after that were out of reach for a time.

Before the first a proxy that is replaced by force has ended, and roscpp's first retries are over.
Before the last two rospy gives up a connection whose other end has vanished without a word: its
keep-alive probes begin after 60 seconds, and are answered by a reset, or for 90 more by nothing.
"""
SILENT_TICK = 1.0
"""Seconds between looks whether it is time for any."""

Missed = Mapping[tuple[str, str], set[Endpoint]]
"""Topics and subscribers with the endpoints to which these have no connection."""


class Resubscriber:
    """Looks after the subscribers of publishers that were out of reach for a time.

    ``connections`` gives those that relays serve, ``look`` takes in those that the kernel forwards.
    """

    def __init__(
        self,
        context: Context,
        updates: PublisherUpdates,
        connections: Callable[[], set[Connection]],
        look: Callable[[], Awaitable[None]],
    ) -> None:
        self._context, self._updates = context, updates
        self._connections, self._look = connections, look
        self._limit = asyncio.Semaphore(PARALLEL_CALLS)
        self._looks: dict[Endpoint, list[float]] = {}

    def watch(self, endpoints: Iterable[Endpoint]) -> None:
        """Have endpoints looked after some times from now on."""
        now = self._context.now()
        for endpoint in endpoints:
            self._looks[endpoint] = [now + after for after in LOOKS]

    def due(self) -> list[Endpoint]:
        """The endpoints for which it is time; each is told once per look."""
        now, found = self._context.now(), []
        for endpoint, times in list(self._looks.items()):
            if self._context.registry.by_port.get(endpoint.port) is not endpoint:
                del self._looks[endpoint]
            elif times[0] <= now:
                found.append(endpoint)
                self._looks[endpoint] = [time for time in times if time > now]
                if not self._looks[endpoint]:
                    del self._looks[endpoint]
        return [e for e in found if e.trusted and not (e.health.down or e.health.cleaned)]

    async def withdraw(self, endpoints: Iterable[Endpoint], ask: bool = True) -> set[str]:
        """Tell subscribers without connection that these publishers have gone; the topics.

        They make a new connection once they are told that the publishers are there again. Unless
        the publishers are asked (``ask``), those served by UDPROS are told as well. Raises
        Unreachable, MasterError.
        """
        held = await read_registrations(self._context.upstream)
        wanted = policy.subscriptions(held, endpoints, self._context.addressing)
        left = policy.without_relay(wanted, self._connections())
        if not left:
            return set()
        graph = await self._located(held, left)
        left = self._relayed(graph, left)
        bus = await self._buses(left) if ask else {}
        if any(one.endpoint.fast_port or one.endpoint.fast_peers for one in left):
            await self._look()
        addresses = await self._addresses(graph, left)
        left = policy.without_relay(left, self._connections())
        return await self._tell(graph, policy.silent(left, bus, addresses))

    async def _located(
        self, held: Mapping[str, list[Registration]], left: Sequence[Subscription]
    ) -> Graph:
        """What is registered, with the URIs of those whom it is about."""
        topics = {one.topic for one in left}
        publishers = (
            node
            for node, registrations in held.items()
            if any(one.kind is Kind.PUBLISHER and one.name in topics for one in registrations)
        )
        names = {one.caller_id for one in left}.union(publishers)
        return await locate(self._context.upstream, held, names)

    def _relayed(self, graph: Graph, left: Iterable[Subscription]) -> list[Subscription]:
        """Those whose subscribers reach the publisher through the proxy."""
        addressing, subscribers = self._context.addressing, {one.caller_id for one in left}
        uris = {node: graph.uris[node] for node in subscribers if node in graph.uris}
        inside = {node: addressing.stands_for(uri) for node, uri in uris.items()}
        askers = {e: self._context.node_asker(e) for e in inside.values() if e}

        def is_relayed(one: Subscription) -> bool:
            subscriber = inside.get(one.caller_id)
            if subscriber is None:
                return one.caller_id in inside
            asker, uri = askers[subscriber], addressing.advertised_uri(one.endpoint)
            return addressing.handed_out(addressing.import_slave(uri, asker), asker)

        return [one for one in left if is_relayed(one)]

    async def _buses(self, left: Iterable[Subscription]) -> dict[Endpoint, list[BusRow]]:
        endpoints = list(dict.fromkeys(one.endpoint for one in left))
        said = await asyncio.gather(*(self._bus(endpoint) for endpoint in endpoints))
        return dict(zip(endpoints, said, strict=True))

    async def _bus(self, endpoint: Endpoint) -> list[BusRow]:
        upstream, within = self._context.upstream, self._context.settings.probe_timeout
        async with self._limit:
            try:
                return policy.read_bus(
                    await upstream.ask_node(endpoint.slave, within, "getBusInfo")
                )
            except (Unreachable, MasterError) as error:
                log.debug("%s does not tell its connections: %s", endpoint.label, error)
                return []

    async def _addresses(self, graph: Graph, left: Iterable[Subscription]) -> dict[str, list[str]]:
        """The addresses of the subscribers' hosts, where the kernel's connections are by host."""
        nodes = sorted({one.caller_id for one in left if one.endpoint.fast_peers})
        found = await asyncio.gather(*(self._resolve(graph.uris[node]) for node in nodes))
        return dict(zip(nodes, found, strict=True))

    async def _resolve(self, uri: str) -> list[str]:
        endpoint = self._context.addressing.stands_for(uri)
        where = endpoint.slave if endpoint else parse_slave_uri(uri)
        return await resolve(self._context.upstream.reach(where).host) if where else []

    async def _tell(self, graph: Graph, found: Iterable[Subscription]) -> set[str]:
        missed: dict[tuple[str, str], set[Endpoint]] = {}
        for one in found:
            missed.setdefault((one.topic, one.caller_id), set()).add(one.endpoint)
        answered = await asyncio.gather(*self._tellings(graph, missed))
        told = [one for one, heard in zip(missed, answered, strict=True) if heard]
        for topic, node in told:
            log.debug("%s has no connection for %s; it is told anew", node, topic)
        return {topic for topic, _ in told}

    def _tellings(self, graph: Graph, missed: Missed) -> Iterable[Awaitable[bool]]:
        publishers = graph.by_topic(Kind.PUBLISHER)
        for (topic, node), endpoints in missed.items():
            uris = publishers.get(topic, [])
            left = policy.publishers_left(uris, endpoints, self._context.addressing)
            yield self._updates.tell(graph.uris[node], topic, left)
