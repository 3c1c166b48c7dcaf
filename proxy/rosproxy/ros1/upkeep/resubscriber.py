"""Reconnect subscribers that receive nothing although a publisher is there.

After an outage of the proxy or of a port, subscribers may have given up (see
`decisions.resubscription`). The same fix works for roscpp and rospy: a ``publisherUpdate`` without
the publisher, then a ``publisherUpdate`` with the publisher. The proxy sends the first update
(`_withdraw`), only to subscribers without a connection, because the update ends existing
connections. For the second update, the proxy registers a publisher of each topic again. The master
then sends the update to all subscribers of the topic.

Subscribers inside can lose publishers outside in the same way. The proxy registers such a
subscriber again, and sends the subscriber the publishers from the reply. With ``--direction both``
the proxy first withdraws the publishers to which the subscriber has no relay.

`announce` does this for endpoints that a new process of the proxy has found at the master, `remind`
for a node that answers again. Both schedule further looks (`look`), because subscribers try by
themselves for up to three minutes.
"""

import asyncio
import logging
from collections.abc import Iterable, Mapping, Sequence
from itertools import islice
from random import randrange

from rosproxy.forwarding.kernel.plane import KernelPlane
from rosproxy.ros1.clients.master_client import MasterError, Unreachable
from rosproxy.ros1.context import Context
from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.registry.endpoint import Endpoint, EndpointRegistration, Registration
from rosproxy.ros1.registry.graph import Graph
from rosproxy.ros1.registry.stand_ins import StandIn
from rosproxy.ros1.servers.tcpros_server import TcprosServer
from rosproxy.ros1.stand_ins.stand_in_ports import StandInPorts
from rosproxy.ros1.upkeep.decisions import resubscription as decisions
from rosproxy.ros1.upkeep.decisions.registration import one_publisher_per_topic
from rosproxy.ros1.upkeep.decisions.resubscription import BusRow, TopicSubscription
from rosproxy.ros1.upkeep.publisher_updates import MOST_PARALLEL_CALLS, PublisherUpdates
from rosproxy.ros1.upkeep.registrar import Registrar
from rosproxy.shared.machine.resolver import NODES, resolve
from rosproxy.shared.tasks import in_turns
from rosproxy.shared.uris import parse_slave_uri

log = logging.getLogger(__name__)

LOOK_DELAYS_S = (4.0, 10.0, 25.0, 75.0, 165.0)
"""Seconds from an outage to each look at the affected endpoints.

Before the first look, a proxy that is replaced by force has ended, and roscpp's first retries are
over. Before the last two looks, rospy gives up a connection to a vanished peer: TCP keep-alive
probes begin after 60 seconds. Then a reset answers, or no answer comes for 90 seconds.
"""
RESUBSCRIBE_INTERVAL_S = 1.0
"""Seconds between two checks which looks are due."""
REGISTRATIONS_PER_TURN = 2000
"""Registrations, and pairs of these with a publisher, that the proxy looks at before the event loop
does other work: some milliseconds."""
PAIRS_PER_TURN = 200
"""Pairs of a subscriber and a publisher that the proxy compares before the event loop does other
work: some milliseconds."""
MOST_PAIRS = 50_000
"""The highest number of pairs without a connection that a look takes. A later look takes others."""
MissedPublisher = tuple[str, str, str]
"""A topic, a subscriber's name, and the master's URI of a publisher that is not connected."""
OutsidePath = tuple[StandIn | None, str]
"""The stand-in for a node outside (None if there is none), and the address of a node inside."""


class Resubscriber:
    """Reconnects the subscribers of publishers that were out of reach for a time."""

    def __init__(
        self,
        context: Context,
        registrar: Registrar,
        publisher_updates: PublisherUpdates,
        tcpros: TcprosServer,
        plane: KernelPlane,
        stand_ins: StandInPorts,
    ) -> None:
        self._context = context
        self._registrar = registrar
        self._publisher_updates = publisher_updates
        self._tcpros = tcpros
        self._plane = plane
        self._stand_ins = stand_ins
        self._limit = asyncio.Semaphore(MOST_PARALLEL_CALLS)
        self._look_times: dict[Endpoint, list[float]] = {}

    def watch(self, endpoints: Iterable[Endpoint]) -> None:
        """Schedule looks at endpoints, after each of `LOOK_DELAYS_S`."""
        now = self._context.now()
        for endpoint in endpoints:
            self._look_times[endpoint] = [now + delay for delay in LOOK_DELAYS_S]

    async def announce(self, endpoints: Sequence[Endpoint]) -> None:
        """Repair connections after an outage of the proxy. Raises Unreachable, MasterError."""
        self.watch(endpoints)
        await self._withdraw(endpoints, ask=False)
        await self._registrar.register(
            [*one_publisher_per_topic(endpoints), *_subscribers(endpoints)]
        )

    async def remind(self, endpoint: Endpoint) -> None:
        """Repair connections after the port of a node has refused some.

        After a refused requestTopic, a subscriber does not ask again. When a publisher registers,
        the master sends the subscriber all publishers once more. Existing connections stay.
        Raises Unreachable, MasterError.
        """
        self.watch([endpoint])
        kinds = (Kind.PUBLISHER, Kind.SUBSCRIBER)
        registrations = [r for r in endpoint.registrations.values() if r.kind in kinds]
        await self._registrar.register([(endpoint, r) for r in registrations])

    async def look(self) -> None:
        """Reconnect subscribers that still lack a publisher, for endpoints due now (`watch`)."""
        endpoints = [] if self._context.retired else self._due()
        try:
            topics = await self._withdraw(endpoints) if endpoints else set()
            if topics:
                text = "subscribers of %d topics had no connection; sent publisherUpdate again"
                log.info(text, len(topics))
                pairs = [*one_publisher_per_topic(endpoints), *_subscribers(endpoints)]
                await self._registrar.register([pair for pair in pairs if pair[1].name in topics])
        except (Unreachable, MasterError) as error:  # later looks follow (LOOK_DELAYS_S)
            log.debug("the proxy could not look for subscribers without a connection: %s", error)

    def _due(self) -> list[Endpoint]:
        """The endpoints to look at now, each once."""
        now = self._context.now()
        by_port = self._context.registry.by_port
        current = {e: times for e, times in self._look_times.items() if by_port.get(e.port) is e}
        remaining = {e: [time for time in times if time > now] for e, times in current.items()}
        self._look_times = {e: times for e, times in remaining.items() if times}
        due = [e for e, times in remaining.items() if len(times) < len(current[e])]
        return [e for e in due if e.answers and not e.health.cleaned]

    async def _withdraw(self, endpoints: Sequence[Endpoint], ask: bool = True) -> set[str]:
        """Tell subscribers without a connection that their publishers have gone. Return the topics.

        This concerns publishers and subscribers at ``endpoints``. The subscribers connect again
        when the master announces the publishers again. With ``ask``, the proxy asks the publishers
        for their connections, and spares subscribers with UDPROS.
        Raises Unreachable, MasterError.
        """
        state = await self._context.upstream.read_registrations()
        unrelayed = await self._unrelayed(state, endpoints)
        if not unrelayed and not self._context.stand_ins.is_bidirectional:
            return set()
        graph = Graph(state, await self._context.upstream.look_up("lookupNode", state))
        unrelayed = await self._through_proxy(graph, unrelayed)
        buses = await self._read_buses(unrelayed) if ask else {}
        publishers = await _publishers_by_topic(graph)
        outside_publishers = await self._outside_publishers(publishers, endpoints)
        for endpoint, _, uris in outside_publishers:
            await self._stand_ins.listen_for(uris, self._context.caller_at(endpoint))
        # The plane reads the kernel's connections only every few seconds, so read these now.
        if self._context.stand_ins.by_port or any(
            s.endpoint.fast_port or s.endpoint.fast_peers for s in unrelayed
        ):
            await self._plane.look()
        addresses = await self._resolve_hosts(graph, unrelayed)
        # Once more: some subscribers have connected meanwhile.
        unrelayed = decisions.without_relay(unrelayed, self._tcpros.topic_connections())
        missed = [
            (s.topic, s.caller_id, self._context.addressing.advertised_uri(s.endpoint))
            for s in decisions.unconnected(unrelayed, buses, addresses)
        ]
        missed += await self._missed_outside(outside_publishers)
        return await self._send_without(graph.uris, publishers, missed)

    async def _unrelayed(
        self, state: Mapping[str, Sequence[Registration]], endpoints: Iterable[Endpoint]
    ) -> list[TopicSubscription]:
        """The subscriptions without a relay, MOST_PAIRS at most.

        Each look begins with another node, so that no node hides the others for good.
        """
        relays = self._tcpros.topic_connections()
        nodes = list(state.items())
        first = randrange(len(nodes)) if nodes else 0  # noqa: S311 - no secret
        nodes = nodes[first:] + nodes[:first]
        unrelayed = list[TopicSubscription]()
        work = 0
        for pairs in decisions.subscriptions(nodes, endpoints, self._context.addressing):
            unrelayed += decisions.without_relay(pairs, relays)
            if len(unrelayed) >= MOST_PAIRS:
                break
            work += 1 + len(pairs)
            if work >= REGISTRATIONS_PER_TURN:
                work = 0
                await asyncio.sleep(0)
        return unrelayed[:MOST_PAIRS]

    async def _through_proxy(
        self, graph: Graph, unrelayed: Iterable[TopicSubscription]
    ) -> list[TopicSubscription]:
        """The subscriptions of nodes that reach the publisher through the proxy."""
        addressing = self._context.addressing

        def is_relayed(sub: TopicSubscription) -> bool:
            uri = graph.uris.get(sub.caller_id)
            subscriber = addressing.endpoint_of(uri) if uri else None
            if subscriber is None:
                return uri is not None
            caller = self._context.caller_at(subscriber)
            inside_uri = addressing.import_slave(addressing.advertised_uri(sub.endpoint), caller)
            return addressing.is_own_uri(inside_uri, caller)

        return [s async for s in in_turns(unrelayed, PAIRS_PER_TURN) if is_relayed(s)]

    async def _read_buses(self, subs: Iterable[TopicSubscription]) -> dict[Endpoint, list[BusRow]]:
        """The connections of the publishers, by ``getBusInfo``."""

        async def read(endpoint: Endpoint) -> list[BusRow]:
            upstream = self._context.upstream
            timeout = self._context.settings.probe_timeout
            async with self._limit:
                try:
                    rows = await upstream.call_node(endpoint.slave, timeout, "getBusInfo")
                except (Unreachable, MasterError) as error:
                    log.debug("%s gives no list of connections: %s", endpoint.label, error)
                    return []
            return decisions.read_bus(rows)

        endpoints = list(dict.fromkeys(s.endpoint for s in subs))
        buses = await asyncio.gather(*map(read, endpoints))
        return dict(zip(endpoints, buses, strict=True))

    async def _resolve_hosts(
        self, graph: Graph, unrelayed: Iterable[TopicSubscription]
    ) -> dict[str, list[str]]:
        """The addresses of subscribers' hosts, if the publisher has connections in the kernel."""

        async def resolve_host(uri: str) -> list[str]:
            endpoint = self._context.addressing.endpoint_of(uri)
            slave = endpoint.slave if endpoint else parse_slave_uri(uri)
            return await resolve(self._context.upstream.reach(slave).host, NODES) if slave else []

        nodes = sorted({s.caller_id for s in unrelayed if s.endpoint.fast_peers})
        addresses = await asyncio.gather(*(resolve_host(graph.uris[node]) for node in nodes))
        return dict(zip(nodes, addresses, strict=True))

    async def _outside_publishers(
        self, publishers: Mapping[str, Sequence[str]], endpoints: Iterable[Endpoint]
    ) -> list[tuple[Endpoint, Registration, list[str]]]:
        """The subscriptions of some endpoints, with the URIs of publishers outside.

        The list is empty if nodes inside reach outside without the proxy.
        """
        if not self._context.stand_ins.is_bidirectional:
            return []
        foreign = self._context.addressing.stand_in_target
        outside: dict[str, list[str]] = {}
        subscriptions = []
        async for endpoint, sub in in_turns(_subscribers(endpoints), PAIRS_PER_TURN):
            if sub.hidden:
                continue
            if sub.name not in outside:
                uris = in_turns(publishers.get(sub.name, ()), PAIRS_PER_TURN)
                outside[sub.name] = [uri async for uri in uris if foreign(uri)]
            subscriptions.append((endpoint, sub, outside[sub.name]))
        return subscriptions

    async def _missed_outside(
        self, outside_publishers: Iterable[tuple[Endpoint, Registration, list[str]]]
    ) -> list[MissedPublisher]:
        """The publishers outside that subscribers inside lack a connection to, MOST_PAIRS at most.

        The proxy knows connections in the kernel only by address. If a node inside has fewer such
        connections to a node outside than subscriptions, all these subscriptions count as missing.
        """
        context = self._context
        relays = self._tcpros.topic_connections() | self._stand_ins.udpros.connections()
        unconnected: dict[OutsidePath, list[MissedPublisher]] = {}
        pairs = ((e, sub, uri) for e, sub, uris in outside_publishers for uri in uris)
        async for endpoint, sub, uri in in_turns(islice(pairs, MOST_PAIRS), PAIRS_PER_TURN):
            proxy = context.caller_at(endpoint).proxy
            stand_in = context.stand_ins.find(proxy, uri)
            if stand_in is None or (stand_in.local.port, sub.name, sub.caller_id) not in relays:
                publisher = sub.name, sub.caller_id, uri
                unconnected.setdefault((stand_in, endpoint.address), []).append(publisher)
        return [
            publisher
            for (stand_in, address), missing in unconnected.items()
            if stand_in is None or stand_in.fast_peers.get(address, 0) < len(missing)
            for publisher in missing
        ]

    async def _send_without(
        self,
        uris: Mapping[str, str],
        publishers: Mapping[str, Sequence[str]],
        missed: Iterable[MissedPublisher],
    ) -> set[str]:
        """Send subscribers their publishers without the missed publishers; return the topics.

        ``uris``: the slave URIs of the nodes. ``publishers``: those of the publishers by topic.
        """
        missed_uris: dict[tuple[str, str], set[str]] = {}
        for topic, node, uri in missed:
            if node in uris:  # otherwise the node has registered after the master's answer
                missed_uris.setdefault((topic, node), set()).add(uri)
        calls = (
            self._publisher_updates.update(
                uris[node], topic, [u for u in publishers.get(topic, []) if u not in missing]
            )
            for (topic, node), missing in missed_uris.items()
        )
        topics = set()
        for (topic, node), answered in zip(missed_uris, await asyncio.gather(*calls), strict=True):
            if answered:
                log.debug(
                    "%s has no connection for topic %s: the proxy sent publisherUpdate", node, topic
                )
                topics.add(topic)
        return topics


async def _publishers_by_topic(graph: Graph) -> dict[str, list[str]]:
    """The slave URIs of the publishers, by topic."""
    publishers: dict[str, list[str]] = {}
    rows = ((node, r) for node, rows in graph.registrations.items() for r in rows)
    async for node, registration in in_turns(rows, REGISTRATIONS_PER_TURN):
        if registration.kind is Kind.PUBLISHER and node in graph.uris:
            publishers.setdefault(registration.name, []).append(graph.uris[node])
    return publishers


def _subscribers(endpoints: Iterable[Endpoint]) -> list[EndpointRegistration]:
    """All subscriptions of the nodes of some endpoints."""
    registrations = [(e, r) for e in endpoints for r in e.registrations.values()]
    return [pair for pair in registrations if pair[1].kind is Kind.SUBSCRIBER]
