"""A subscriber that hears nothing though its publisher is there: having it connect again.

After the proxy was away, or a port has refused for a time, subscribers may have given up for good
(see `decisions.resubscription`). There is one fix for roscpp and rospy: a ``publisherUpdate``
without the publisher, then one with it. The proxy sends the first itself (`_withdraw`), and only
to subscribers without a connection, since it costs the others theirs. For the second, one publisher
of each topic is registered again, which makes the master tell all of the topic's subscribers.

Inside subscribers can have missed publishers outside in the same way. Registering a subscriber
again yields its publishers, which it is then handed; with ``--direction both`` those that it has no
relay to are withdrawn first, too.

`announce` does this for endpoints that a fresh proxy has found at the master, `remind` for a node
that answers again. Both have the endpoints looked at again later (`look`): what a subscriber does
in the meantime takes up to three minutes.
"""

import asyncio
import logging
from collections.abc import Iterable, Sequence

from rosproxy.forwarding.kernel.plane import KernelPlane
from rosproxy.net.resolver import NODES, resolve
from rosproxy.ros1.clients.master_client import MasterError, Unreachable
from rosproxy.ros1.context import Context
from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.protocol.uris import parse_slave_uri
from rosproxy.ros1.registry.endpoint import Endpoint, EndpointRegistration, Registration
from rosproxy.ros1.registry.graph import Graph
from rosproxy.ros1.registry.stand_ins import StandIn
from rosproxy.ros1.servers.tcpros_server import TcprosServer
from rosproxy.ros1.stand_ins.stand_in_ports import StandInPorts
from rosproxy.ros1.upkeep.decisions import resubscription as decisions
from rosproxy.ros1.upkeep.decisions.registration import one_publisher_per_topic
from rosproxy.ros1.upkeep.decisions.resubscription import BusRow, TopicSubscription
from rosproxy.ros1.upkeep.publisher_updates import PARALLEL_CALLS, PublisherUpdates
from rosproxy.ros1.upkeep.registrar import Registrar

log = logging.getLogger(__name__)

LOOK_DELAYS = (4.0, 10.0, 25.0, 75.0, 165.0)
"""Seconds after which endpoints are looked after that were out of reach for a time.

Before the first a proxy that is replaced by force has ended, and roscpp's first retries are over.
Before the last two rospy gives up a connection whose other end has vanished without a word: its
keep-alive probes begin after 60 seconds, and are answered by a reset, or for 90 more by nothing.
"""
RESUBSCRIBE_TICK = 1.0
"""Seconds between checks whether it is time to look at any."""
MissedPublisher = tuple[str, str, str]
"""A topic, a subscriber's name, and the URI at the master of a publisher that it does not hear."""
OutsidePath = tuple[StandIn | None, str]
"""The stand-in for a node outside (None: it has none), and the address of a node inside."""


class Resubscriber:
    """Looks after the subscribers of publishers that were out of reach for a time."""

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
        self._limit = asyncio.Semaphore(PARALLEL_CALLS)
        self._look_times: dict[Endpoint, list[float]] = {}

    def watch(self, endpoints: Iterable[Endpoint]) -> None:
        """Have endpoints looked at some times from now on."""
        now = self._context.now()
        for endpoint in endpoints:
            self._look_times[endpoint] = [now + delay for delay in LOOK_DELAYS]

    async def announce(self, endpoints: Sequence[Endpoint]) -> None:
        """Make up for what was missed while the proxy was away. Raises Unreachable, MasterError."""
        self.watch(endpoints)
        await self._withdraw(endpoints, ask=False)
        await self._registrar.register(
            [*one_publisher_per_topic(endpoints), *_subscribers(endpoints)]
        )

    async def remind(self, endpoint: Endpoint) -> None:
        """Make up for what was missed while a node's port refused. Raises Unreachable, MasterError.

        A subscriber whose requestTopic was refused does not ask again by itself: it is told of
        its publishers once more when one registers. Connections that have lasted stay.
        """
        self.watch([endpoint])
        kinds = (Kind.PUBLISHER, Kind.SUBSCRIBER)
        registrations = [r for r in endpoint.registrations.values() if r.kind in kinds]
        await self._registrar.register([(endpoint, r) for r in registrations])

    async def look(self) -> None:
        """Have subscribers connect that have lost a publisher in spite of `announce`."""
        endpoints = [] if self._context.retired else self._due()
        try:
            topics = await self._withdraw(endpoints) if endpoints else set()
            if topics:
                text = "subscribers of %d topics had no connection; sent publisherUpdate again"
                log.info(text, len(topics))
                pairs = [*one_publisher_per_topic(endpoints), *_subscribers(endpoints)]
                await self._registrar.register([pair for pair in pairs if pair[1].name in topics])
        except (Unreachable, MasterError) as error:  # there are further looks (LOOK_DELAYS)
            log.debug("the proxy could not look for subscribers without a connection: %s", error)

    def _due(self) -> list[Endpoint]:
        """The endpoints that it is time to look at; each is named once per look."""
        now = self._context.now()
        by_port = self._context.registry.by_port
        current = {e: times for e, times in self._look_times.items() if by_port.get(e.port) is e}
        remaining = {e: [time for time in times if time > now] for e, times in current.items()}
        self._look_times = {e: times for e, times in remaining.items() if times}
        due = [e for e, times in remaining.items() if len(times) < len(current[e])]
        return [e for e in due if e.answers and not e.health.cleaned]

    async def _withdraw(self, endpoints: Sequence[Endpoint], ask: bool = True) -> set[str]:
        """Tell subscribers without connection that these publishers have gone; the topics.

        They make a new connection once they are told that the publishers are there again. Unless
        the publishers are asked (``ask``), those served by UDPROS are told as well. Raises
        Unreachable, MasterError.
        """
        state = await self._context.upstream.read_registrations()
        subscriptions = decisions.subscriptions(state, endpoints, self._context.addressing)
        unrelayed = decisions.without_relay(subscriptions, self._tcpros.topic_connections())
        if not unrelayed and not self._context.stand_ins.is_bidirectional:
            return set()
        graph = Graph(state, await self._context.upstream.look_up("lookupNode", state))
        unrelayed = self._through_proxy(graph, unrelayed)
        buses = await self._read_buses(unrelayed) if ask else {}
        outside_publishers = self._outside_publishers(graph, endpoints)
        for endpoint, _, uris in outside_publishers:
            await self._stand_ins.listen_for(uris, self._context.caller_at(endpoint))
        # The kernel's connections are read every few seconds: those of now are wanted.
        if self._context.stand_ins.by_port or any(
            s.endpoint.fast_port or s.endpoint.fast_peers for s in unrelayed
        ):
            await self._plane.look()
        addresses = await self._resolve_hosts(graph, unrelayed)
        # Once more: some have connected while others were asked.
        unrelayed = decisions.without_relay(unrelayed, self._tcpros.topic_connections())
        missed = [
            (s.topic, s.caller_id, self._context.addressing.advertised_uri(s.endpoint))
            for s in decisions.unconnected(unrelayed, buses, addresses)
        ]
        return await self._send_without(graph, missed + self._missed_outside(outside_publishers))

    def _through_proxy(
        self, graph: Graph, unrelayed: Iterable[TopicSubscription]
    ) -> list[TopicSubscription]:
        """The subscriptions whose nodes reach the publisher through the proxy."""
        addressing = self._context.addressing

        def is_relayed(sub: TopicSubscription) -> bool:
            uri = graph.uris.get(sub.caller_id)
            subscriber = addressing.endpoint_of(uri) if uri else None
            if subscriber is None:
                return uri is not None
            caller = self._context.caller_at(subscriber)
            inside_uri = addressing.import_slave(addressing.advertised_uri(sub.endpoint), caller)
            return addressing.is_own_uri(inside_uri, caller)

        return [s for s in unrelayed if is_relayed(s)]

    async def _read_buses(self, subs: Iterable[TopicSubscription]) -> dict[Endpoint, list[BusRow]]:
        """What the publishers themselves say of their connections."""

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
        """The addresses of the subscribers' hosts, where the kernel's connections are by host."""

        async def resolve_host(uri: str) -> list[str]:
            endpoint = self._context.addressing.endpoint_of(uri)
            slave = endpoint.slave if endpoint else parse_slave_uri(uri)
            return await resolve(self._context.upstream.reach(slave).host, NODES) if slave else []

        nodes = sorted({s.caller_id for s in unrelayed if s.endpoint.fast_peers})
        addresses = await asyncio.gather(*(resolve_host(graph.uris[node]) for node in nodes))
        return dict(zip(nodes, addresses, strict=True))

    def _outside_publishers(
        self, graph: Graph, endpoints: Iterable[Endpoint]
    ) -> list[tuple[Endpoint, Registration, list[str]]]:
        """What the nodes of some endpoints subscribe to, with the URIs of publishers outside.

        Nothing where these are reached without the proxy.
        """
        both = self._context.stand_ins.is_bidirectional
        publishers = graph.by_topic(Kind.PUBLISHER)
        foreign = self._context.addressing.stand_in_target
        return [
            (endpoint, r, list(filter(foreign, publishers.get(r.name, ()))))
            for endpoint in (endpoints if both else ())
            for r in endpoint.registrations.values()
            if r.kind is Kind.SUBSCRIBER and not r.hidden
        ]

    def _missed_outside(
        self, outside_publishers: Iterable[tuple[Endpoint, Registration, list[str]]]
    ) -> list[MissedPublisher]:
        """The publishers outside that subscribers inside are not connected to, but ought to be.

        What the kernel forwards is known by addresses alone: unless there are as many connections
        as a node inside has subscriptions to one outside, all of these count.
        """
        context = self._context
        relays = self._tcpros.topic_connections() | self._stand_ins.udpros.connections()
        unconnected: dict[OutsidePath, list[MissedPublisher]] = {}
        for endpoint, sub, uris in outside_publishers:
            proxy = context.caller_at(endpoint).proxy
            for uri in uris:
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

    async def _send_without(self, graph: Graph, missed: Iterable[MissedPublisher]) -> set[str]:
        """Send each subscriber its publishers without those that it misses; the topics."""
        missed_uris: dict[tuple[str, str], set[str]] = {}
        for topic, node, uri in missed:
            missed_uris.setdefault((topic, node), set()).add(uri)
        publishers = graph.by_topic(Kind.PUBLISHER)
        calls = (
            self._publisher_updates.update(
                graph.uris[node], topic, [u for u in publishers.get(topic, []) if u not in uris]
            )
            for (topic, node), uris in missed_uris.items()
        )
        topics = set()
        for (topic, node), answered in zip(missed_uris, await asyncio.gather(*calls), strict=True):
            if answered:
                log.debug(
                    "%s has no connection for topic %s: the proxy sent publisherUpdate", node, topic
                )
                topics.add(topic)
        return topics


def _subscribers(endpoints: Iterable[Endpoint]) -> list[EndpointRegistration]:
    """All that the nodes of some endpoints subscribe to."""
    registrations = [(e, r) for e in endpoints for r in e.registrations.values()]
    return [pair for pair in registrations if pair[1].kind is Kind.SUBSCRIBER]
