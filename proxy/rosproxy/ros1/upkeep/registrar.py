"""Keeping the master right: registering nodes again, and unregistering those that are gone.

Everything that the proxy itself registers or unregisters goes through the `Registrar`; the modules
beside this one decide when. `Registrar.register` is the way for all of it: it asks the master who
has each name now, leaves a name to any other node that has it, frees one that the master has by a
former URI of the same node, makes the calls, and hands subscribers the publishers that the replies
name, as the master does with ``publisherUpdate``. What the policy denies it hides instead, and
takes back where the master has it (`_conceal`).
"""

import asyncio
import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from rosproxy.ros1.clients.master_client import CALLER_ID, Unreachable
from rosproxy.ros1.context import Context
from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.protocol.uris import parse_slave_uri, service_uri
from rosproxy.ros1.registry.endpoint import Endpoint, EndpointRegistration, Registration
from rosproxy.ros1.registry.graph import NodeInfo
from rosproxy.ros1.upkeep.decisions import registration as decisions
from rosproxy.ros1.upkeep.lease_memory import LeaseMemory
from rosproxy.ros1.upkeep.publisher_updates import PublisherUpdates

log = logging.getLogger(__name__)

FormerUris = Mapping[str, tuple[Endpoint, str]]
"""Names with their endpoints, and the former URIs by which the master has them."""
CHECKED_AT_ONCE = 100
"""Registrations that the proxy checks before other tasks have their turn: rules may be many."""
SETTLE_TIME = 2.0
"""Seconds in which the master's updates about a publisher that is registered anew come in."""


class Registrar:
    """Calls to the master on behalf of inside nodes, and what follows from the replies."""

    def __init__(
        self, context: Context, publisher_updates: PublisherUpdates, memory: LeaseMemory
    ) -> None:
        self._context = context
        self._publisher_updates = publisher_updates
        self._memory = memory
        self._complete_state: tuple[bytes, int, frozenset[int]] = b"", -1, frozenset()
        """The master's state, our own and the ports of nodes that answered, when nothing of theirs
        was missing."""

    async def register(self, registrations: Sequence[EndpointRegistration]) -> None:
        """Register again what the master has lost. Raises Unreachable, MasterError.

        A name that another node has by now is left to it; what the master has by a former URI of
        the same node is taken back first.
        """
        names = {r.caller_id for _, r in registrations}
        uris = await self._context.upstream.look_up("lookupNode", names)
        to_register: list[EndpointRegistration] = []
        former: dict[str, tuple[Endpoint, str]] = {}
        for endpoint, registration in registrations:
            uri = uris.get(registration.caller_id)
            if uri in (None, self._context.addressing.advertised_uri(endpoint)):
                to_register.append((endpoint, registration))
            elif decisions.is_known_as(endpoint, uri):
                former[registration.caller_id] = endpoint, uri
            else:
                log.info(
                    "%s is now the name of another node, at %s: not registered again",
                    registration.caller_id,
                    uri,
                )
                self._context.registry.drop_caller(endpoint, registration.caller_id)
        await self._register(to_register + await self._free(former))

    async def reclaim(self, former: FormerUris) -> None:
        """Register nodes anew that the master has by former URIs. Raises Unreachable, MasterError.

        Registrations of theirs that only the master has are added to the registry.
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
        await self.register([(e, r) for e in endpoints for r in e.registrations.values()])
        for endpoint in endpoints:
            endpoint.unsettled = False

    async def register_missing(self, endpoint: Endpoint, info: NodeInfo) -> None:
        """Register what a node has and the master does not know of. Raises Unreachable."""
        missing = decisions.unregistered_topics(endpoint, info)
        for registration in missing:
            self._context.registry.register(endpoint, registration)
        if missing:
            _log(endpoint, "%s: the proxy registered %d missing topics", len(missing))
            await self.register([(endpoint, r) for r in missing])

    async def register_lost(self) -> None:
        """Register what the master no longer has of live nodes. Raises Unreachable, MasterError.

        While the master's state and ours are as they were when nothing was missing, nothing is.
        """
        registry = self._context.registry
        started = self._context.now()
        alive = [e for e in registry if e.answers and not e.health.cleaned]
        our_state = registry.changes, frozenset(e.port for e in alive)
        last_digest = self._complete_state[0] if self._complete_state[1:] == our_state else b""
        digest, state = await self._context.upstream.read_changes(last_digest)
        unsettled = [e for e in registry if e.unsettled and not e.health.down]
        if unsettled:
            await self.resettle(unsettled)
        if state is None:
            return
        endpoints = {r: e for e in alive for r in e.registrations.values()}
        missing = decisions.lost_registrations(list(endpoints), state, started)
        if missing:
            log.warning(
                "the master has lost %d registrations; the proxy makes them again", len(missing)
            )
            await self.register([(endpoints[r], r) for r in missing])
        elif our_state[0] == registry.changes:  # nothing was registered while it was asked
            self._complete_state = digest, *our_state

    async def clean_up(self, endpoint: Endpoint) -> None:
        """Unregister a node that is gone at the master. Raises Unreachable."""
        started = self._context.now()
        registrations = list(endpoint.registrations.values())
        await self._unregister(endpoint, registrations)
        endpoint.health.note_cleaned(started)
        self._context.metrics.cleanups.inc()
        _log(endpoint, "%s unregistered: %d registrations taken back", len(registrations))

    async def give_up(self, endpoint: Endpoint) -> None:
        """Unregister a node that does not answer, whose port another needs. Raises Unreachable."""
        if not endpoint.health.cleaned:
            await self.clean_up(endpoint)

    async def take_back(self, uri: str, registrations: Sequence[Registration]) -> None:
        """Unregister what the master has by an advertised URI of names that are at no endpoint.

        Names that have another URI by now are left alone. Raises Unreachable.
        """
        addressing = self._context.addressing
        upstream = self._context.upstream
        uris = await upstream.look_up("lookupNode", {r.caller_id for r in registrations})
        slave = parse_slave_uri(uri)
        if slave is None:
            return
        endpoint = addressing.endpoint_of(uri)  # another node's, which has the port by now
        names = endpoint.callers if endpoint else ()
        stale = [
            r for r in registrations if uris.get(r.caller_id) == uri and r.caller_id not in names
        ]
        service = service_uri(slave)
        await upstream.multicall([decisions.unregister_call(r, uri, service) for r in stale])
        if stale:
            log.info(
                "unregistered %d registrations that a former proxy left for %s", len(stale), uri
            )

    async def disown(self, endpoint: Endpoint, registrations: Sequence[Registration]) -> None:
        """Unregister names that another node had on this port before. Raises Unreachable.

        They are no former names of the endpoint's node either: a ``shutdown`` by the master for
        such a name is not meant for it (`Adopter.absorb_shutdown`).
        """
        current = [r for r in registrations if endpoint.registrations.get(r.key) is r]
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
        kept = decisions.valid_registrations(endpoint, info, pid == endpoint.health.pid)
        for registration in list(endpoint.registrations.values()):
            if registration not in kept and registration.since < endpoint.health.cleaned_at:
                self._context.registry.unregister(
                    registration.kind, registration.name, registration.caller_id
                )
        endpoint.health.note_back(pid)
        await self.register([(endpoint, r) for r in kept])
        _log(endpoint, "%s is back: %d registrations made again", len(kept))

    async def unregister_left_over(self, endpoint: Endpoint) -> None:
        """Take back what a former process left behind: topics that the node does not have.

        Raises Unreachable.
        """
        started = self._context.now()
        info = await self._context.nodes.inspect(endpoint.slave)
        if info is not None:
            endpoint.topic_ports = dict(info.topic_ports)
            await self._forget(endpoint, decisions.left_over_registrations(endpoint, info, started))

    async def reconcile(self, endpoint: Endpoint) -> None:
        """Make up for the calls that a node made around the proxy. Raises Unreachable, MasterError.

        A service that it unregistered stays until the node ends: no node can be asked for services.
        """
        started = self._context.now()
        info = await self._context.nodes.inspect(endpoint.slave)
        if info is not None:
            await self._forget(endpoint, decisions.vanished_topics(endpoint, info, started))
            await self.register_missing(endpoint, info)

    async def apply_policy(self, has_changed: bool = False) -> tuple[int, int]:
        """Hide what is denied now, show what no longer is; returns how many registrations of each.

        After a change of the policy, also report what would be denied (audit). Raises Unreachable,
        MasterError.
        """
        policy = self._context.policy
        to_hide = list[EndpointRegistration]()
        to_show = list[EndpointRegistration]()
        for count, (endpoint, registration) in enumerate(self._context.registry.registrations(), 1):
            verdict = policy.verdict(endpoint, registration)
            if verdict.allowed == registration.hidden:
                (to_show if registration.hidden else to_hide).append((endpoint, registration))
            elif verdict.allowed and has_changed:
                policy.report_registration(endpoint, registration)
            if not count % CHECKED_AT_ONCE:
                await asyncio.sleep(0)
        await self._conceal(to_hide)
        alive = [(e, r) for e, r in to_show if e.answers and not e.health.cleaned]
        await self.register(alive)
        return len(to_hide), len(alive)

    async def _conceal(self, registrations: Sequence[EndpointRegistration]) -> None:
        """Hide registrations, and take back what the master has of them. Raises Unreachable.

        They are hidden before the master is called: so the lists of publishers that it then sends
        are completed on their way, and no node inside is cut off. Parameters can't be hidden.
        """
        registry = self._context.registry
        registrations = [(e, r) for e, r in registrations if e.registrations.get(r.key) is r]
        params = [(e, r) for e, r in registrations if r.kind is Kind.PARAM]
        shown = [(e, r) for e, r in registrations if not r.hidden and r.kind is not Kind.PARAM]
        concealed = [(e, replace(r, hidden=True)) for e, r in shown]
        for endpoint, registration in concealed:
            registry.register(endpoint, registration)
        try:
            await self._take_back([*shown, *params])
        except Unreachable:
            # The master may have them still. Shown again, they are hidden by the next try
            # (`apply_policy`).
            for endpoint, registration in concealed:
                if endpoint.registrations.get(registration.key) is registration:
                    registry.register(endpoint, replace(registration, hidden=False))
            raise
        for endpoint, registration in [*shown, *params]:
            self._context.policy.report_registration(endpoint, registration)
        for _, registration in params:
            registry.unregister(registration.kind, registration.name, registration.caller_id)
        subscribers = [(e, r) for e, r in registrations if r.kind is Kind.SUBSCRIBER]
        update = self._publisher_updates.update_inside
        # To the empty list the publishers inside are added (`Ros1Policy.publishers_for`).
        await asyncio.gather(*(update(e, r.name, []) for e, r in subscribers))
        self._publisher_updates.update_subscribers(
            {r.name for _, r in registrations if r.kind is Kind.PUBLISHER}
        )

    async def _take_back(self, registrations: Iterable[EndpointRegistration]) -> None:
        addressing = self._context.addressing
        # rosmaster passes over a URI that it does not have (registrations.py, unregister).
        calls = [
            decisions.unregister_call(r, uri, addressing.advertised_service(e))
            for e, r in registrations
            for uri in addressing.uris_at_master(e)
        ]
        await self._context.upstream.multicall(calls)

    async def _register(self, registrations: Sequence[EndpointRegistration]) -> None:
        """Register at the master; subscribers are handed the publishers that the replies name.

        What the policy denies is hidden.
        """
        if self._context.retired:
            return
        addressing = self._context.addressing
        current = decisions.to_register(registrations)
        allowed = {(e, r): self._context.policy.verdict(e, r).allowed for e, r in current}
        await self._conceal([pair for pair, is_allowed in allowed.items() if not is_allowed])
        permitted = [pair for pair, is_allowed in allowed.items() if is_allowed]
        calls = [
            decisions.register_call(
                r, addressing.advertised_uri(e), addressing.advertised_service(e)
            )
            for e, r in permitted
        ]
        await self._memory.write()
        values = await self._context.upstream.multicall(calls)
        for endpoint, registration in permitted:
            if registration.hidden and endpoint.registrations.get(registration.key) is registration:
                self._context.registry.register(endpoint, replace(registration, hidden=False))
        updates = (
            self._publisher_updates.update_inside(endpoint, r.name, publishers)
            for (endpoint, r), publishers in zip(permitted, values, strict=True)
            if r.kind is Kind.SUBSCRIBER and isinstance(publishers, list)
        )
        await asyncio.gather(*updates)
        topics = {r.name for _, r in permitted if r.kind is Kind.PUBLISHER}
        self._publisher_updates.update_subscribers(topics, everybody=False)

    async def _forget(self, endpoint: Endpoint, ended: Sequence[Registration]) -> None:
        await self._unregister(endpoint, ended)
        for registration in ended:
            _log(endpoint, "%s no longer has %s of %s", registration.name, registration.caller_id)
            self._context.registry.unregister(
                registration.kind, registration.name, registration.caller_id
            )

    async def _unregister(self, endpoint: Endpoint, registrations: Iterable[Registration]) -> None:
        """Take back at the master what an endpoint's node has registered by its advertised URI."""
        ended = list(registrations)
        await self._take_back((endpoint, r) for r in ended if not r.hidden)
        for registration in ended:
            self._publisher_updates.note_registration(registration)

    async def _free(self, former: FormerUris) -> list[EndpointRegistration]:
        """All registrations of some names, once they are taken back at the master.

        The master has nodes that moved by former advertised URIs: the registry knows what is
        theirs. Those that registered around the proxy it has by their own: it alone knows that.
        """
        registry = self._context.registry
        addressing = self._context.addressing
        calls: list[decisions.MethodCall] = []
        direct: dict[str, tuple[Endpoint, str]] = {}
        for name, (endpoint, uri) in former.items():
            endpoint.former_uris.add(uri)
            if addressing.lease_of(uri) is None:
                direct[name] = endpoint, uri
                endpoint.settles_at = self._context.now() + SETTLE_TIME
            else:
                service = addressing.advertised_service(endpoint)
                shown = [r for r in _registrations_of(endpoint, name) if not r.hidden]
                calls += [decisions.unregister_call(r, uri, service) for r in shown]
        await self._context.upstream.multicall(calls)
        freed, known_uris = await self._free_direct(direct)
        for registration in freed:
            endpoint = former[registration.caller_id][0]
            if registration.key not in endpoint.registrations:
                registry.register(endpoint, replace(registration, since=self._context.now()))
        names = {name: e for name, (e, _) in former.items() if name not in known_uris}
        return [(e, r) for name, e in names.items() for r in _registrations_of(e, name)]

    async def _free_direct(self, former: FormerUris) -> tuple[list[Registration], dict[str, str]]:
        """Take back all registrations of names that the master has by their nodes' own URIs.

        Returns those, and the names that the master still knows, with their URIs. Such a URI may
        be another one by now. Otherwise the name has a parameter subscription, which the master
        does not list, beside the one that every node has: it gets its registrations back. Raises
        Unreachable, MasterError.
        """
        if not former:
            return [], {}
        upstream = self._context.upstream
        uris = {name: uri for name, (_, uri) in former.items()}
        state = await upstream.read_registrations()
        registrations = [r for name in uris for r in state.get(name, [])]
        provided = {r.name for r in registrations if r.kind is Kind.SERVICE}
        services = await upstream.look_up("lookupService", provided)
        calls = decisions.free_calls(registrations, uris, services)
        values = await upstream.multicall([*calls, *decisions.release_calls(uris, CALLER_ID)])
        params, known_uris = decisions.read_release(uris, values[len(calls) :])
        stuck = [name for name, uri in known_uris.items() if uri == uris[name]]
        restored = [r for r in registrations if r.caller_id in stuck]
        await upstream.multicall(decisions.restore_calls(restored, uris, services))
        for name in stuck:
            self._drop_stuck_name(former[name][0], name, uris[name])
        return [r for r in [*registrations, *params] if r.caller_id not in known_uris], known_uris

    def _drop_stuck_name(self, endpoint: Endpoint, name: str, uri: str) -> None:
        self._context.registry.drop_caller(endpoint, name)
        problem = (
            f"registered directly at the master as {uri}, and can't be taken over: the node is "
            "subscribed to a parameter, and the master lists no such subscriptions. Restart the "
            "container of the node"
        )
        log.warning("%s: %s", name, problem)
        self._context.problems.add(name, problem)


def _registrations_of(endpoint: Endpoint, name: str) -> list[Registration]:
    return [r for r in endpoint.registrations.values() if r.caller_id == name]


def _log(endpoint: Endpoint, text: str, *values: object) -> None:
    """Log something of an endpoint, whose label comes first."""
    log.info(text, endpoint.label, *values, extra=endpoint.log_fields)
