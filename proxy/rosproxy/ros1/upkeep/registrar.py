"""Keeping the master right: registering nodes again, and unregistering those that are gone.

Everything that the proxy itself registers or unregisters goes through the `Registrar`; the modules
beside this one decide when. `Registrar.register` is the way for all of it: it asks the master who
has each name now, leaves a name to whoever else has it, frees one that the master has by a former
URI of the same node, makes the calls, and hands subscribers the publishers that the replies name,
as the master does with ``publisherUpdate``. What the policy denies it hides instead, and takes back
where the master has it (`_conceal`).
"""

import asyncio
import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from rosproxy.access.layers import Verdict
from rosproxy.ros1.clients.master import CALLER_ID, Unreachable
from rosproxy.ros1.context import Context
from rosproxy.ros1.protocol.master_methods import Kind, prefix
from rosproxy.ros1.protocol.uris import parse_slave_uri, service_uri
from rosproxy.ros1.registry.endpoint import Endpoint, EndpointRegistration, Registration
from rosproxy.ros1.registry.graph import NodeInfo
from rosproxy.ros1.rewriting.policing import KINDS
from rosproxy.ros1.upkeep.decisions import registration as decisions
from rosproxy.ros1.upkeep.lease_memory import LeaseMemory
from rosproxy.ros1.upkeep.publisher_updates import PublisherUpdates

log = logging.getLogger(__name__)

FormerUris = Mapping[str, tuple[Endpoint, str]]
"""Names with their endpoints, and the former URIs by which the master has them."""
JUDGED_AT_ONCE = 100
"""Registrations that the policy is asked about before others have their turn: rules may be many."""
SETTLE_TIME = 2.0
"""Seconds in which the master's news of a publisher that is registered anew come in."""


class Registrar:
    """Calls to the master on behalf of inside nodes, and what follows from the replies."""

    def __init__(
        self, context: Context, publisher_updates: PublisherUpdates, memory: LeaseMemory
    ) -> None:
        self._context, self._publisher_updates, self._memory = context, publisher_updates, memory
        self._complete: tuple[bytes, int, frozenset[int]] = b"", -1, frozenset()
        """The master's state, our own and the ports of nodes that answered, when nothing of theirs
        was missing."""

    async def register(self, held: Sequence[EndpointRegistration]) -> None:
        """Register again what the master has lost. Raises Unreachable, MasterError.

        A name that somebody else holds by now is left to them; what it holds with a former URI
        of the same node is taken back first.
        """
        names = {one.caller_id for _, one in held}
        at_master = await self._context.upstream.look_up("lookupNode", names)
        kept: list[EndpointRegistration] = []
        former: dict[str, tuple[Endpoint, str]] = {}
        for endpoint, one in held:
            uri = at_master.get(one.caller_id)
            if uri in (None, self._context.addressing.advertised_uri(endpoint)):
                kept.append((endpoint, one))
            elif decisions.known_as(endpoint, uri):
                former[one.caller_id] = endpoint, uri
            else:
                log.info("%s is registered as %s by now; left to it", one.caller_id, uri)
                self._context.registry.drop_caller(endpoint, one.caller_id)
        await self._register(kept + await self._free(former))

    async def reclaim(self, former: FormerUris) -> None:
        """Register nodes anew that the master has by former URIs. Raises Unreachable, MasterError.

        What it has of them that the registry has not is taken in.
        """
        await self._register(await self._free(former))

    async def resettle(self, endpoints: Sequence[Endpoint]) -> None:
        """Register nodes anew that have moved to another address. Raises Unreachable, MasterError.

        Their own connections have lost their address: roscpp makes new ones if it is told that
        the publishers have gone before it is told that they are there.
        """
        topics = [(e, topic) for e in endpoints for topic in e.names(Kind.SUBSCRIBER)]
        update = self._publisher_updates.update_inside
        await asyncio.gather(*(update(e, topic, []) for e, topic in topics))
        await self.register([(e, held) for e in endpoints for held in e.registrations.values()])
        for endpoint in endpoints:
            endpoint.note_settled()

    async def register_missing(self, endpoint: Endpoint, info: NodeInfo) -> None:
        """Register what a node has and the master does not know of. Raises Unreachable."""
        found = decisions.unregistered(endpoint, info)
        for held in found:
            self._context.registry.register(endpoint, held)
        if found:
            _log(endpoint, "%s: %d topics were not registered; they are now", len(found))
            await self.register([(endpoint, held) for held in found])

    async def register_lost(self) -> None:
        """Register what the master no longer has of live nodes. Raises Unreachable, MasterError.

        Where neither the master's state nor ours has changed since nothing was missing, nothing is.
        """
        registry, started = self._context.registry, self._context.now()
        alive = [e for e in registry if e.answers and not e.health.cleaned]
        ours = registry.changes, frozenset(e.port for e in alive)
        seen = self._complete[0] if self._complete[1:] == ours else b""
        digest, state = await self._context.upstream.read_changes(seen)
        unsettled = [e for e in registry if e.unsettled and not e.health.down]
        if unsettled:
            await self.resettle(unsettled)
        if state is None:
            return
        held = {one: e for e in alive for one in e.registrations.values()}
        lost = decisions.lost(list(held), state, started)
        if lost:
            log.warning("the master has lost %d registrations; making them again", len(lost))
            await self.register([(held[one], one) for one in lost])
        elif ours[0] == registry.changes:
            self._complete = digest, *ours

    async def clean_up(self, endpoint: Endpoint) -> None:
        """Unregister a node that is gone at the master. Raises Unreachable."""
        started, held = self._context.now(), list(endpoint.registrations.values())
        await self._unregister(endpoint, held)
        endpoint.health.note_cleaned(started)
        self._context.metrics.cleanups.inc()
        _log(endpoint, "cleaned up %s: %d registrations taken back", len(held))

    async def give_up(self, endpoint: Endpoint) -> None:
        """Unregister a node that does not answer, whose port another needs. Raises Unreachable."""
        if not endpoint.health.cleaned:
            await self.clean_up(endpoint)

    async def take_back(self, uri: str, held: Sequence[Registration]) -> None:
        """Unregister what names hold by an advertised URI that are at no endpoint.

        Names that have another URI by now are left alone. Raises Unreachable.
        """
        addressing, upstream = self._context.addressing, self._context.upstream
        known = await upstream.look_up("lookupNode", {one.caller_id for one in held})
        where = parse_slave_uri(uri)
        if where is None:
            return
        endpoint = addressing.stands_for(uri)  # of another node, which has the port by now
        names = endpoint.callers if endpoint else ()
        left = [
            one for one in held if known.get(one.caller_id) == uri and one.caller_id not in names
        ]
        service = service_uri(where)
        await upstream.multicall([decisions.unregister_call(one, uri, service) for one in left])
        if left:
            log.info("took back %d registrations that a former proxy left for %s", len(left), uri)

    async def disown(self, endpoint: Endpoint, registrations: Sequence[Registration]) -> None:
        """Unregister names that are not its node's: they had the port before. Raises Unreachable.

        They are no former names of the node either, at which the master's ``shutdown`` is meant
        for it (`Adopter.absorb_shutdown`).
        """
        current = [one for one in registrations if endpoint.registrations.get(one.key) is one]
        await self._forget(endpoint, current)
        for registration in current:
            endpoint.former_callers.pop(registration.caller_id, None)

    async def come_back(self, endpoint: Endpoint, pid: int | None) -> None:
        """Register a node again that was cleaned up and answers after all, as process ``pid``.

        Raises Unreachable, MasterError.
        """
        info = await self._context.nodes.inspect(endpoint.slave)
        if info is None:
            return
        kept = decisions.still_held(endpoint, info, pid == endpoint.health.pid)
        for held in list(endpoint.registrations.values()):
            if held not in kept and held.since < endpoint.health.cleaned_at:
                self._context.registry.unregister(held.kind, held.name, held.caller_id)
        endpoint.health.note_back(pid)
        await self.register([(endpoint, held) for held in kept])
        _log(endpoint, "%s is back: %d registrations made again", len(kept))

    async def unregister_left_over(self, endpoint: Endpoint) -> None:
        """Take back what a former process left: topics that the node there does not have.

        Raises Unreachable.
        """
        started = self._context.now()
        info = await self._context.nodes.inspect(endpoint.slave)
        if info is not None:
            endpoint.replace_topic_ports(info.topic_ports)
            await self._forget(endpoint, decisions.left_over(endpoint, info, started))

    async def reconcile(self, endpoint: Endpoint) -> None:
        """Make up for the calls that a node made around the proxy. Raises Unreachable, MasterError.

        A service that it has unregistered stays until it ends: it can't be asked for those.
        """
        started = self._context.now()
        info = await self._context.nodes.inspect(endpoint.slave)
        if info is not None:
            await self._forget(endpoint, decisions.vanished(endpoint, info, started))
            await self.register_missing(endpoint, info)

    async def apply_policy(self) -> tuple[int, int]:
        """Hide what is denied now and show what no longer is; how many registrations of each.

        Raises Unreachable, MasterError.
        """
        to_hide, to_show = list[EndpointRegistration](), list[EndpointRegistration]()
        for count, (endpoint, held) in enumerate(self._context.registry.registrations(), 1):
            if self._verdict(endpoint, held).allowed == held.hidden:
                (to_show if held.hidden else to_hide).append((endpoint, held))
            if not count % JUDGED_AT_ONCE:
                await asyncio.sleep(0)
        await self._conceal(to_hide)
        alive = [(e, held) for e, held in to_show if e.answers and not e.health.cleaned]
        await self.register(alive)
        return len(to_hide), len(alive)

    def _verdict(self, endpoint: Endpoint, held: Registration) -> Verdict:
        policy, kind, address = self._context.policy, KINDS[held.kind], endpoint.address
        verdict = policy.judge(kind, held.name, [held.caller_id], address)
        if held.kind is Kind.PARAM and verdict.allowed:
            return policy.judge_below(kind, prefix(held.name), held.caller_id, address)
        return verdict

    async def _conceal(self, held: Sequence[EndpointRegistration]) -> None:
        """Hide registrations, and take back what the master has of them. Raises Unreachable.

        They are hidden before the master is told: the lists of publishers that it then sends are
        completed on their way, and nobody inside is cut off. Parameters can't be hidden.
        """
        registry = self._context.registry
        held = [(e, one) for e, one in held if e.registrations.get(one.key) is one]
        params = [(e, one) for e, one in held if one.kind is Kind.PARAM]
        shown = [(e, one) for e, one in held if not one.hidden and one.kind is not Kind.PARAM]
        concealed = [(e, replace(one, hidden=True)) for e, one in shown]
        for endpoint, one in concealed:
            registry.register(endpoint, one)
        try:
            await self._take_back([*shown, *params])
        except Unreachable:
            for endpoint, one in concealed:
                if endpoint.registrations.get(one.key) is one:
                    registry.register(endpoint, replace(one, hidden=False))
            raise
        for _, one in params:
            registry.unregister(one.kind, one.name, one.caller_id)
        subscribers = [(e, one) for e, one in held if one.kind is Kind.SUBSCRIBER]
        update = self._publisher_updates.update_inside
        await asyncio.gather(*(update(e, one.name, []) for e, one in subscribers))
        self._publisher_updates.tell({one.name for _, one in held if one.kind is Kind.PUBLISHER})

    async def _take_back(self, held: Iterable[EndpointRegistration]) -> None:
        addressing = self._context.addressing
        calls = [
            decisions.unregister_call(one, uri, addressing.advertised_service(e))
            for e, one in held
            for uri in addressing.uris_at_master(e)
        ]
        await self._context.upstream.multicall(calls)

    async def _register(self, held: Sequence[EndpointRegistration]) -> None:
        """Register at the master; subscribers are handed the publishers that the replies name.

        What the policy denies is hidden.
        """
        if self._context.retired:
            return
        addressing, current = self._context.addressing, decisions.to_register(held)
        allowed = {(e, one): self._verdict(e, one).allowed for e, one in current}
        await self._conceal([held for held, may in allowed.items() if not may])
        wanted = [held for held, may in allowed.items() if may]
        calls = [
            decisions.register_call(
                one, addressing.advertised_uri(e), addressing.advertised_service(e)
            )
            for e, one in wanted
        ]
        await self._memory.write()
        values = await self._context.upstream.multicall(calls)
        for endpoint, one in wanted:
            if one.hidden and endpoint.registrations.get(one.key) is one:
                self._context.registry.register(endpoint, replace(one, hidden=False))
        updates = (
            self._publisher_updates.update_inside(endpoint, one.name, publishers)
            for (endpoint, one), publishers in zip(wanted, values, strict=True)
            if one.kind is Kind.SUBSCRIBER and isinstance(publishers, list)
        )
        await asyncio.gather(*updates)
        topics = {one.name for _, one in wanted if one.kind is Kind.PUBLISHER}
        self._publisher_updates.tell(topics, everybody=False)

    async def _forget(self, endpoint: Endpoint, ended: Sequence[Registration]) -> None:
        await self._unregister(endpoint, ended)
        for held in ended:
            _log(endpoint, "%s no longer has %s of %s", held.name, held.caller_id)
            self._context.registry.unregister(held.kind, held.name, held.caller_id)

    async def _unregister(self, endpoint: Endpoint, held: Iterable[Registration]) -> None:
        """Take back what an endpoint's node holds by its advertised URI."""
        ended = list(held)
        await self._take_back((endpoint, one) for one in ended if not one.hidden)
        for one in ended:
            self._publisher_updates.note(one)

    async def _free(self, former: FormerUris) -> list[EndpointRegistration]:
        """All that some names hold, once it is taken back at the master.

        It has nodes that have moved by former advertised URIs: they hold what the registry has.
        Those that registered around the proxy it has by their own: what they hold it alone knows.
        """
        registry, addressing = self._context.registry, self._context.addressing
        calls: list[decisions.MethodCall] = []
        direct: dict[str, tuple[Endpoint, str]] = {}
        for name, (endpoint, uri) in former.items():
            endpoint.note_former_uri(uri)
            if addressing.lease_of(uri) is None:
                direct[name] = endpoint, uri
                endpoint.expect_updates(self._context.now() + SETTLE_TIME)
            else:
                service = addressing.advertised_service(endpoint)
                held = [one for one in _held_by(endpoint, name) if not one.hidden]
                calls += [decisions.unregister_call(one, uri, service) for one in held]
        await self._context.upstream.multicall(calls)
        freed, known = await self._free_direct(direct)
        for one in freed:
            endpoint = former[one.caller_id][0]
            if one.key not in endpoint.registrations:
                registry.register(endpoint, replace(one, since=self._context.now()))
        names = {name: endpoint for name, (endpoint, _) in former.items() if name not in known}
        return [
            (endpoint, one) for name, endpoint in names.items() for one in _held_by(endpoint, name)
        ]

    async def _free_direct(self, former: FormerUris) -> tuple[list[Registration], dict[str, str]]:
        """End everything that names hold which the master has by their nodes' own URIs.

        What that was; and the names that the master knows still, with their URIs. It may have
        another one by now. Else there is a parameter subscription, which the master does not
        tell of, beside the one that every node has: such a name gets back what it had. Raises
        Unreachable, MasterError.
        """
        if not former:
            return [], {}
        upstream, uris = self._context.upstream, {name: uri for name, (_, uri) in former.items()}
        state = await upstream.read_registrations()
        mine = [one for name in uris for one in state.get(name, [])]
        provided = {one.name for one in mine if one.kind is Kind.SERVICE}
        services = await upstream.look_up("lookupService", provided)
        free = decisions.free_calls(mine, uris, services)
        values = await upstream.multicall([*free, *decisions.release_calls(uris, CALLER_ID)])
        params, known = decisions.read_release(uris, values[len(free) :])
        stuck = [name for name, uri in known.items() if uri == uris[name]]
        restored = [one for one in mine if one.caller_id in stuck]
        await upstream.multicall(decisions.restore_calls(restored, uris, services))
        for name in stuck:
            self._give_up(former[name][0], name, uris[name])
        return [one for one in [*mine, *params] if one.caller_id not in known], known

    def _give_up(self, endpoint: Endpoint, name: str, uri: str) -> None:
        self._context.registry.drop_caller(endpoint, name)
        text = (
            f"registered as {uri} around the proxy and can't be taken over: it is subscribed to a "
            "parameter, which the master does not tell of. Restart its container"
        )
        log.warning("%s: %s", name, text)
        self._context.problems.add(name, text)


def _held_by(endpoint: Endpoint, name: str) -> list[Registration]:
    return [one for one in endpoint.registrations.values() if one.caller_id == name]


def _log(endpoint: Endpoint, text: str, *values: object) -> None:
    """Log something of an endpoint, whose label comes first."""
    log.info(text, endpoint.label, *values, extra=endpoint.log_fields)
