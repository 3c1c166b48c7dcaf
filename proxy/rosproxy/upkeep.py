"""Keeping the master right: registering nodes again, cleaning up after those that are gone."""

import asyncio
import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from rosproxy.context import Context
from rosproxy.core import strays, upkeep, xmlrpc
from rosproxy.core.addressing import Asker
from rosproxy.core.methods import Kind
from rosproxy.core.registry import Endpoint, Registration
from rosproxy.core.uris import HostPort, parse_slave_uri
from rosproxy.master_graph import read_graph
from rosproxy.mirror import Mirror
from rosproxy.node_client import NodeClient, SelfDescription
from rosproxy.reclaim import Reclaim
from rosproxy.upstream import CALLER_ID, Unreachable

log = logging.getLogger(__name__)

Held = tuple[Endpoint, Registration]
Former = Mapping[str, tuple[Endpoint, str]]
"""Names with their endpoints, and the former URIs by which the master has them."""
PARALLEL_CALLS = 32
SETTLE_TIME = 2.0
"""Seconds in which the master's news of a publisher that is registered anew come in."""
OUTSIDER = Asker("", "")
"""A subscriber outside, who is given addresses as the master holds them."""


class Upkeep:
    """Calls to the master on behalf of inside nodes, and what follows from the replies."""

    def __init__(self, context: Context, nodes: NodeClient, mirror: Mirror) -> None:
        self._context, self._nodes, self._mirror = context, nodes, mirror
        self._limit = asyncio.Semaphore(PARALLEL_CALLS)
        self._reclaim = Reclaim(context)

    async def register(self, held: Sequence[Held]) -> None:
        """Register again what the master has lost. Raises Unreachable, MasterError.

        A name that somebody else holds by now is left to them; what it holds with a former URI
        of the same node is taken back first.
        """
        await self._make(await self._not_superseded(held))

    async def reclaim(self, former: Former) -> None:
        """Register nodes anew that the master has by former URIs. Raises Unreachable, MasterError.

        What it has of them that the registry has not is taken in.
        """
        await self._make(await self._reclaimed(former))

    async def resettle(self, endpoints: Iterable[Endpoint]) -> None:
        """Register nodes anew that have moved to another address. Raises Unreachable, MasterError.

        Their own connections have lost their address: roscpp makes new ones if it is told that
        the publishers have gone before it is told that they are there.
        """
        moved = list(endpoints)
        topics = [(e, topic) for e in moved for topic in e.names(Kind.SUBSCRIBER)]
        await asyncio.gather(*(self._update(e.slave, topic, []) for e, topic in topics))
        await self.register([(e, held) for e in moved for held in e.registrations.values()])
        for endpoint in moved:
            endpoint.unsettled = False

    async def _make(self, held: Sequence[Held]) -> None:
        """Register at the master; subscribers are handed the publishers that the replies name."""
        if self._context.retired:
            return
        wanted = sorted(filter(_current, held), key=lambda item: _ORDER.index(item[1].kind))
        calls = [upkeep.register_call(*item, self._context.addressing) for item in wanted]
        values = await self._context.upstream.batch(calls)
        updates = [
            (item, value)
            for item, value in zip(wanted, values, strict=False)
            if item[1].kind is Kind.SUBSCRIBER and isinstance(value, list)
        ]
        await self._tell_publishers(updates)

    async def announce(self, endpoints: Iterable[Endpoint]) -> None:
        """Make up for what was missed while the proxy was away. Raises Unreachable, MasterError.

        Subscribers are told first that the relayed publishers have gone and then, by the master,
        that they are there: roscpp never tries again after a connection that was refused at once
        (transport_publisher_link.cpp, onRetryTimer), and rospy doesn't try at all. Registering
        one publisher of a topic makes the master notify all of its subscribers; registering a
        subscriber again yields its publishers.
        """
        topics: dict[str, Held] = {}
        subscribers: list[Held] = []
        for endpoint in endpoints:
            for held in endpoint.registrations.values():
                if held.kind is Kind.PUBLISHER:
                    topics.setdefault(held.name, (endpoint, held))
                elif held.kind is Kind.SUBSCRIBER:
                    subscribers.append((endpoint, held))
        await self._withdraw(topics)
        await self.register([*topics.values(), *subscribers])

    async def remind(self, endpoint: Endpoint) -> None:
        """Make up for what was missed while a node's port refused. Raises Unreachable, MasterError.

        A subscriber whose requestTopic was refused does not ask again by itself: it is told of
        its publishers once more when one registers. Connections that have lasted stay.
        """
        topics = (Kind.PUBLISHER, Kind.SUBSCRIBER)
        held = [one for one in endpoint.registrations.values() if one.kind in topics]
        await self.register([(endpoint, one) for one in held])

    async def adopt(self, endpoint: Endpoint, said: SelfDescription) -> None:
        """Register what a node has and the master does not know of. Raises Unreachable."""
        found = upkeep.unregistered(endpoint, said.published, said.subscribed)
        for held in found:
            self._context.registry.register(endpoint, held)
        if found:
            log.info("%s: %d topics were not registered; they are now", endpoint.label, len(found))
            await self.register([(endpoint, held) for held in found])

    async def clean_up(self, endpoint: Endpoint) -> None:
        """Unregister a node that is gone at the master. Raises Unreachable."""
        started, held = self._context.now(), list(endpoint.registrations.values())
        await self._unregister(endpoint, held)
        endpoint.health.cleaned, endpoint.health.cleaned_at = True, started
        self._context.metrics.cleanups.inc()
        log.info("cleaned up %s: %d registrations taken back", endpoint.label, len(held))

    async def reconcile(self, endpoint: Endpoint) -> None:
        """Make up for the calls that a node made around the proxy. Raises Unreachable, MasterError.

        A service that it has unregistered stays until it ends: it can't be asked for those.
        """
        started = self._context.now()
        said = await self._nodes.describe(endpoint.slave)
        if said is not None:
            gone = strays.vanished(endpoint, said.published, said.subscribed, started)
            await self._forget(endpoint, gone)
            await self.adopt(endpoint, said)

    async def audit(self, endpoint: Endpoint) -> None:
        """Take back what a former process left: topics that the node there does not have.

        Raises Unreachable.
        """
        started = self._context.now()
        said = await self._nodes.describe(endpoint.slave)
        if said is None:
            return
        endpoint.topic_ports.clear()
        endpoint.tcpros_port = said.tcpros_port
        stale = upkeep.left_over(endpoint, said.published, said.subscribed, started)
        await self._forget(endpoint, stale)

    async def _forget(self, endpoint: Endpoint, stale: Sequence[Registration]) -> None:
        await self._unregister(endpoint, stale)
        for held in stale:
            log.info("%s of %s is no longer at %s", held.name, held.caller_id, endpoint.uri)
            self._context.registry.unregister(held.kind, held.name, held.caller_id)

    async def _unregister(self, endpoint: Endpoint, held: Sequence[Registration]) -> None:
        addressing = self._context.addressing
        await self._context.upstream.batch(
            [upkeep.unregister_call(endpoint, one, addressing) for one in held]
        )

    async def come_back(self, endpoint: Endpoint, pid: int | None) -> None:
        """Register a node again that was cleaned up and answers after all, as process ``pid``.

        Raises Unreachable.
        """
        said = await self._nodes.describe(endpoint.slave)
        if said is None:
            return
        same = pid == endpoint.health.pid
        kept = upkeep.still_held(endpoint, said.published, said.subscribed, same)
        for held in list(endpoint.registrations.values()):
            if held not in kept and held.since < endpoint.health.cleaned_at:
                self._context.registry.unregister(held.kind, held.name, held.caller_id)
        endpoint.health.pid, endpoint.health.cleaned = pid, False
        await self.register([(endpoint, held) for held in kept])
        log.info("%s is back: %d registrations made again", endpoint.label, len(kept))

    async def _not_superseded(self, held: Sequence[Held]) -> list[Held]:
        names = sorted({one.caller_id for _, one in held})
        uris = await self._context.upstream.batch(
            [("lookupNode", [CALLER_ID, name]) for name in names]
        )
        at_master = dict(zip(names, uris, strict=False))
        kept: list[Held] = []
        former: dict[str, tuple[Endpoint, str]] = {}
        for endpoint, one in held:
            uri = at_master.get(one.caller_id)
            if uri in (None, self._context.addressing.advertised_uri(endpoint)):
                kept.append((endpoint, one))
            elif strays.known_as(endpoint, uri):
                former[one.caller_id] = endpoint, uri
            else:
                log.info("%s is registered as %s by now; left to it", one.caller_id, uri)
                self._context.registry.drop_caller(endpoint, one.caller_id)
        return kept + await self._reclaimed(former)

    async def _reclaimed(self, former: Former) -> list[Held]:
        """All that some names hold, once it is taken back at the master."""
        if not former:
            return []
        (found, stuck), registry = await self._taken_back(former), self._context.registry
        for name in stuck:
            registry.drop_caller(former[name][0], name)
        kept: list[Held] = []
        for name, had in found.items():
            endpoint = former[name][0]
            for held in had:
                if held.key not in endpoint.registrations:
                    registry.register(endpoint, replace(held, since=self._context.now()))
            mine = [held for held in endpoint.registrations.values() if held.caller_id == name]
            kept += [(endpoint, held) for held in mine]
        return kept

    async def _taken_back(self, former: Former) -> tuple[dict[str, list[Registration]], set[str]]:
        """Take back what some names hold: what the master had of those now free, and the others."""
        direct: dict[str, str] = {}
        calls: list[upkeep.MethodCall] = []
        for name, (endpoint, uri) in former.items():
            endpoint.former_uris.add(uri)
            if self._context.addressing.identify(uri) is None:
                direct[name] = uri
                endpoint.settles_at = self._context.now() + SETTLE_TIME
                continue
            service = self._context.addressing.advertised_service(endpoint)
            mine = [held for held in endpoint.registrations.values() if held.caller_id == name]
            calls += [upkeep.unregistering(held, uri, service) for held in mine]
        await self._context.upstream.batch(calls)
        moved: dict[str, list[Registration]] = {n: [] for n in former if n not in direct}
        if not direct:
            return moved, set()
        found, stuck = await self._reclaim.take_back(direct)
        return moved | found, stuck

    async def _withdraw(self, topics: Iterable[str]) -> None:
        """Tell the subscribers of topics that none but directly reached publishers are left."""
        graph = await read_graph(self._context.upstream)
        publishers = graph.by_topic(Kind.PUBLISHER)
        subscribers = graph.by_topic(Kind.SUBSCRIBER)
        calls = [
            self._tell(topic, uri, publishers.get(topic, []))
            for topic in topics
            for uri in subscribers.get(topic, [])
        ]
        await asyncio.gather(*calls)

    async def _tell(self, topic: str, subscriber: str, publishers: list[str]) -> None:
        endpoint = self._context.addressing.stands_for(subscriber)
        where = endpoint.slave if endpoint else parse_slave_uri(subscriber)
        if where is None:
            return
        asker = self._context.node_asker(endpoint) if endpoint else OUTSIDER
        left = upkeep.reached_directly(publishers, asker, self._context.addressing)
        if endpoint:
            await self._mirror.hand_over(left)
        await self._update(where, topic, left)

    async def _tell_publishers(self, updates: Sequence[tuple[Held, list[str]]]) -> None:
        await asyncio.gather(*(self._tell_all(item, uris) for item, uris in updates))

    async def _tell_all(self, item: Held, uris: list[str]) -> None:
        endpoint, held = item
        asker = self._context.node_asker(endpoint)
        publishers = self._context.addressing.import_slaves(uris, asker)
        await self._mirror.hand_over(uris)
        await self._update(endpoint.slave, held.name, publishers)

    async def _update(self, where: HostPort, topic: str, publishers: list[str]) -> None:
        body = xmlrpc.dump_call("publisherUpdate", "/master", topic, publishers)
        async with self._limit:
            try:
                await self._context.upstream.node(where, body, self._context.settings.probe_timeout)
            except Unreachable as error:
                log.debug("publisherUpdate of %s: %s", topic, error)


_ORDER = (Kind.PUBLISHER, Kind.SERVICE, Kind.SUBSCRIBER, Kind.PARAM)
"""Subscribers come after publishers, so that they are handed all of them at once."""


def _current(item: Held) -> bool:
    """Whether a registration has not ended meanwhile."""
    endpoint, held = item
    return endpoint.registrations.get(held.key) is held
