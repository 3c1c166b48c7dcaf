"""Keeping the master right: registering nodes again, cleaning up after those that are gone."""

import asyncio
import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from rosproxy.ros1.clients.master import CALLER_ID, MasterError, Unreachable
from rosproxy.ros1.clients.node import NodeClient, SelfDescription
from rosproxy.ros1.context import Context
from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.registry.endpoint import Endpoint, Registration
from rosproxy.ros1.upkeep import policy
from rosproxy.ros1.upkeep.adoption import policy as adoption_policy
from rosproxy.ros1.upkeep.adoption.reclaim import Reclaim
from rosproxy.ros1.upkeep.resubscription.publisher_updates import PublisherUpdates
from rosproxy.ros1.upkeep.resubscription.resubscriber import Resubscriber

log = logging.getLogger(__name__)

Held = tuple[Endpoint, Registration]
Former = Mapping[str, tuple[Endpoint, str]]
"""Names with their endpoints, and the former URIs by which the master has them."""
SETTLE_TIME = 2.0
"""Seconds in which the master's news of a publisher that is registered anew come in."""


class Registrar:
    """Calls to the master on behalf of inside nodes, and what follows from the replies."""

    def __init__(
        self, context: Context, nodes: NodeClient, updates: PublisherUpdates, silent: Resubscriber
    ) -> None:
        self._context, self._nodes = context, nodes
        self._updates, self._silent = updates, silent
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
        await asyncio.gather(*(self._updates.tell_inside(e, t, []) for e, t in topics))
        await self.register([(e, held) for e in moved for held in e.registrations.values()])
        for endpoint in moved:
            endpoint.unsettled = False

    async def _make(self, held: Sequence[Held]) -> None:
        """Register at the master; subscribers are handed the publishers that the replies name."""
        if self._context.retired:
            return
        wanted = sorted(filter(_current, held), key=lambda item: _ORDER.index(item[1].kind))
        calls = [policy.register_call(*item, self._context.addressing) for item in wanted]
        values = await self._context.upstream.batch(calls)
        updates = [
            (item, value)
            for item, value in zip(wanted, values, strict=False)
            if item[1].kind is Kind.SUBSCRIBER and isinstance(value, list)
        ]
        await self._tell_publishers(updates)

    async def announce(self, endpoints: Iterable[Endpoint]) -> None:
        """Make up for what was missed while the proxy was away. Raises Unreachable, MasterError.

        Subscribers that have no connection are told first that the relayed publishers have gone
        and then, by the master, that they are there: roscpp never tries again after a connection
        that was refused at once (see `core.silent`), and rospy doesn't try at all. Registering
        one publisher of a topic makes the master notify all of its subscribers; registering a
        subscriber again yields its publishers.
        """
        found = list(endpoints)
        self._silent.watch(found)
        await self._silent.withdraw(found, ask=False)
        held = [(e, held) for e in found for held in e.registrations.values()]
        subscribers = [one for one in held if one[1].kind is Kind.SUBSCRIBER]
        await self.register([*_one_per_topic(found), *subscribers])

    async def look_for_silent(self) -> None:
        """Have subscribers connect that have lost a publisher in spite of `announce`."""
        endpoints = [] if self._context.retired else self._silent.due()
        try:
            topics = await self._silent.withdraw(endpoints) if endpoints else set()
            if topics:
                log.info("subscribers of %d topics had no connection; told anew", len(topics))
                held = _one_per_topic(endpoints)
                await self.register([one for one in held if one[1].name in topics])
        except (Unreachable, MasterError) as error:
            log.debug("looking for silent subscribers: %s", error)

    async def remind(self, endpoint: Endpoint) -> None:
        """Make up for what was missed while a node's port refused. Raises Unreachable, MasterError.

        A subscriber whose requestTopic was refused does not ask again by itself: it is told of
        its publishers once more when one registers. Connections that have lasted stay.
        """
        self._silent.watch([endpoint])
        topics = (Kind.PUBLISHER, Kind.SUBSCRIBER)
        held = [one for one in endpoint.registrations.values() if one.kind in topics]
        await self.register([(endpoint, one) for one in held])

    async def adopt(self, endpoint: Endpoint, said: SelfDescription) -> None:
        """Register what a node has and the master does not know of. Raises Unreachable."""
        found = policy.unregistered(endpoint, said.published, said.subscribed)
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
            gone = adoption_policy.vanished(endpoint, said.published, said.subscribed, started)
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
        endpoint.replace_tcpros_ports(said.tcpros_port)
        stale = policy.left_over(endpoint, said.published, said.subscribed, started)
        await self._forget(endpoint, stale)

    async def _forget(self, endpoint: Endpoint, stale: Sequence[Registration]) -> None:
        await self._unregister(endpoint, stale)
        for held in stale:
            log.info("%s of %s is no longer at %s", held.name, held.caller_id, endpoint.uri)
            self._context.registry.unregister(held.kind, held.name, held.caller_id)

    async def _unregister(self, endpoint: Endpoint, held: Sequence[Registration]) -> None:
        addressing = self._context.addressing
        await self._context.upstream.batch(
            [policy.unregister_call(endpoint, one, addressing) for one in held]
        )

    async def come_back(self, endpoint: Endpoint, pid: int | None) -> None:
        """Register a node again that was cleaned up and answers after all, as process ``pid``.

        Raises Unreachable.
        """
        said = await self._nodes.describe(endpoint.slave)
        if said is None:
            return
        same = pid == endpoint.health.pid
        kept = policy.still_held(endpoint, said.published, said.subscribed, same)
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
            elif adoption_policy.known_as(endpoint, uri):
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
        calls: list[policy.MethodCall] = []
        for name, (endpoint, uri) in former.items():
            endpoint.former_uris.add(uri)
            if self._context.addressing.identify(uri) is None:
                direct[name] = uri
                endpoint.settles_at = self._context.now() + SETTLE_TIME
                continue
            service = self._context.addressing.advertised_service(endpoint)
            mine = [held for held in endpoint.registrations.values() if held.caller_id == name]
            calls += [policy.unregistering(held, uri, service) for held in mine]
        await self._context.upstream.batch(calls)
        moved: dict[str, list[Registration]] = {n: [] for n in former if n not in direct}
        if not direct:
            return moved, set()
        found, stuck = await self._reclaim.take_back(direct)
        return moved | found, stuck

    async def _tell_publishers(self, updates: Sequence[tuple[Held, list[str]]]) -> None:
        await asyncio.gather(
            *(self._updates.tell_inside(e, held.name, uris) for (e, held), uris in updates)
        )


_ORDER = (Kind.PUBLISHER, Kind.SERVICE, Kind.SUBSCRIBER, Kind.PARAM)
"""Subscribers come after publishers, so that they are handed all of them at once."""


def _current(item: Held) -> bool:
    """Whether a registration has not ended meanwhile."""
    endpoint, held = item
    return endpoint.registrations.get(held.key) is held


def _one_per_topic(endpoints: Iterable[Endpoint]) -> list[Held]:
    """One publisher of each topic that some endpoints' nodes publish."""
    topics: dict[str, Held] = {}
    for endpoint in endpoints:
        for held in endpoint.registrations.values():
            if held.kind is Kind.PUBLISHER:
                topics.setdefault(held.name, (endpoint, held))
    return list(topics.values())
