"""Register nodes at the master again, and unregister nodes that are gone.

All registrations that the proxy makes or takes back on its own initiative pass the `Registrar`. The
modules beside this module decide when. `Registrar.register` works in these steps:

1. Ask the master for the present URI of each name. If another node has the name by now, do not
   register the name. If the master has a former URI of the same node, take back the registrations
   first.
2. Make the calls.
3. Send subscribers the publishers that the replies name. The master does the same with
   ``publisherUpdate``.

The `Registrar` hides what the policy denies, and takes back these registrations at the master
(`_conceal`).
"""

import asyncio
import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from rosproxy.ros1.clients.master_client import CALLER_ID, Unreachable
from rosproxy.ros1.context import Context
from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.registry.endpoint import Endpoint, EndpointRegistration, Registration
from rosproxy.ros1.registry.graph import NodeInfo
from rosproxy.ros1.upkeep.decisions import registration as decisions
from rosproxy.ros1.upkeep.lease_memory import LeaseMemory
from rosproxy.ros1.upkeep.publisher_updates import PublisherUpdates
from rosproxy.shared.uris import parse_slave_uri, service_uri

log = logging.getLogger(__name__)

FormerUris = Mapping[str, tuple[Endpoint, str]]
"""By node name: the endpoint, and the former URI that the master has for the name."""
MOST_CHECKS_PER_TURN = 100
"""Registrations that the proxy checks before other tasks run: a policy may have many rules."""
UPDATE_ARRIVAL_S = 2.0
"""Seconds within which the master's updates about a newly registered publisher arrive."""


class Registrar:
    """Calls the master on behalf of nodes inside, and acts on the replies."""

    def __init__(
        self, context: Context, publisher_updates: PublisherUpdates, memory: LeaseMemory
    ) -> None:
        self._context = context
        self._publisher_updates = publisher_updates
        self._memory = memory
        self._complete_state: tuple[bytes, int, frozenset[int]] = b"", -1, frozenset()
        """The state when no registration was missing: digest of the master's state, number of
        changes of the registry, and ports of the nodes that answered."""

    async def register(self, registrations: Sequence[EndpointRegistration]) -> None:
        """Make registrations at the master again. Raises Unreachable, MasterError.

        If another node has a name by now, the proxy leaves the name to the other node, and drops
        the name from the registry. If the master has a former URI of the same node, the proxy first
        takes back the registrations with this URI.
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

        Adds to the registry what only the master has of these nodes.
        """
        await self._register(await self._free(former))

    async def resettle(self, endpoints: Sequence[Endpoint]) -> None:
        """Register nodes anew that have moved to another address. Raises Unreachable, MasterError.

        The nodes' own connections have lost their local address. roscpp makes new connections if it
        first gets an empty list of publishers, and then the full list.
        """
        topics = [(e, topic) for e in endpoints for topic in e.names(Kind.SUBSCRIBER)]
        update = self._publisher_updates.update_inside
        await asyncio.gather(*(update(e, topic, []) for e, topic in topics))
        await self.register([(e, r) for e in endpoints for r in e.registrations.values()])
        for endpoint in endpoints:
            endpoint.unsettled = False

    async def register_missing(self, endpoint: Endpoint, info: NodeInfo) -> None:
        """Register the topics that a node has, but that the registry lacks.

        Does nothing if several node names share the slave API. Raises Unreachable, MasterError.
        """
        missing = decisions.unregistered_topics(endpoint, info)
        for registration in missing:
            self._context.registry.register(endpoint, registration)
        if missing:
            _log(endpoint, "%s: the proxy registered %d missing topics", len(missing))
            await self.register([(endpoint, r) for r in missing])

    async def register_lost(self) -> None:
        """Register what the master no longer has of live nodes. Raises Unreachable, MasterError.

        Also register nodes anew that have moved (`resettle`). The method skips the comparison if
        master and registry have not changed since the last comparison without a lost registration.
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
        missing = list[EndpointRegistration]()
        for endpoint in alive:
            recorded = list(endpoint.registrations.values())
            lost = decisions.lost_registrations(recorded, state, started)
            missing += [(endpoint, registration) for registration in lost]
            await asyncio.sleep(0)  # a node may have thousands of registrations
        if missing:
            log.warning(
                "the master has lost %d registrations; the proxy makes them again", len(missing)
            )
            await self.register(missing)
        elif our_state[0] == registry.changes:  # no node registered while the master was asked
            self._complete_state = digest, *our_state

    async def clean_up(self, endpoint: Endpoint) -> None:
        """Unregister at the master a node that is gone. Raises Unreachable."""
        started = self._context.now()
        registrations = list(endpoint.registrations.values())
        await self._unregister(endpoint, registrations)
        endpoint.health.note_cleaned(started)
        self._context.metrics.cleanups.inc()
        _log(endpoint, "%s unregistered: %d registrations taken back", len(registrations))

    async def give_up(self, endpoint: Endpoint) -> None:
        """Unregister a silent node whose port another node needs. Raises Unreachable."""
        if not endpoint.health.cleaned:
            await self.clean_up(endpoint)

    async def take_back(self, uri: str, registrations: Sequence[Registration]) -> None:
        """Unregister names that the master has at an advertised URI, but that have no endpoint.

        The names that have another URI by now stay. Raises Unreachable.
        """
        addressing = self._context.addressing
        upstream = self._context.upstream
        uris = await upstream.look_up("lookupNode", {r.caller_id for r in registrations})
        slave = parse_slave_uri(uri)
        if slave is None:
            return
        endpoint = addressing.endpoint_of(uri)  # of another node, which has the port now
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

        The names are no longer former names of this endpoint. So if the master calls ``shutdown``
        for such a name, the proxy does not pass the call on (`Adopter.absorb_shutdown`).
        """
        current = [r for r in registrations if endpoint.registrations.get(r.key) is r]
        await self._forget(endpoint, current)
        for registration in current:
            endpoint.former_callers.pop(registration.caller_id, None)

    async def come_back(self, endpoint: Endpoint, pid: int | None) -> None:
        """Register a node again that was unregistered, and that answers now as process ``pid``.

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
        """Take back registrations that a former process left, such as topics that the node lacks.

        Raises Unreachable.
        """
        started = self._context.now()
        info = await self._context.nodes.inspect(endpoint.slave)
        if info is not None:
            endpoint.topic_ports = dict(info.topic_ports)
            await self._forget(endpoint, decisions.left_over_registrations(endpoint, info, started))

    async def reconcile(self, endpoint: Endpoint) -> None:
        """Repair the effects of direct calls to the master. Raises Unreachable, MasterError.

        A service that the node unregistered directly stays registered until the node ends, because
        no node tells its services.
        """
        started = self._context.now()
        info = await self._context.nodes.inspect(endpoint.slave)
        if info is not None:
            await self._forget(endpoint, decisions.vanished_topics(endpoint, info, started))
            await self.register_missing(endpoint, info)

    async def apply_policy(self, has_changed: bool = False) -> tuple[int, int]:
        """Hide what the policy denies now, and show what it allows again. Return both numbers.

        Only registrations of live nodes are shown again. If the policy ``has_changed``, also report
        which registrations audit rules would deny.
        Raises Unreachable, MasterError.
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
            if not count % MOST_CHECKS_PER_TURN:
                await asyncio.sleep(0)
        await self._conceal(to_hide)
        alive = [(e, r) for e, r in to_show if e.answers and not e.health.cleaned]
        await self.register(alive)
        return len(to_hide), len(alive)

    async def _conceal(self, registrations: Sequence[EndpointRegistration]) -> None:
        """Hide registrations, and take back what the master has of them. Raises Unreachable.

        The proxy hides the registrations before the call to the master. So the proxy adds hidden
        publishers to the lists that the master then sends, and no node inside loses a connection.
        Parameter subscriptions cannot be hidden; they end.
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
            # The master may still have the registrations. Show them again, so that the next
            # `apply_policy` hides them.
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
        # `Ros1Policy.publishers_for` adds the publishers inside to the empty list.
        await asyncio.gather(*(update(e, r.name, []) for e, r in subscribers))
        self._publisher_updates.update_subscribers(
            {r.name for _, r in registrations if r.kind is Kind.PUBLISHER}
        )

    async def _take_back(self, registrations: Iterable[EndpointRegistration]) -> None:
        addressing = self._context.addressing
        # rosmaster ignores a URI that it does not have (registrations.py, unregister).
        calls = [
            decisions.unregister_call(r, uri, addressing.advertised_service(e))
            for e, r in registrations
            for uri in addressing.uris_at_master(e)
        ]
        await self._context.upstream.multicall(calls)

    async def _register(self, registrations: Sequence[EndpointRegistration]) -> None:
        """Register at the master, and send subscribers the publishers that the replies name.

        Hides what the policy denies. Does nothing if the proxy has retired.
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
        self._publisher_updates.update_subscribers(topics, all_inside=False)

    async def _forget(self, endpoint: Endpoint, ended: Sequence[Registration]) -> None:
        await self._unregister(endpoint, ended)
        for registration in ended:
            _log(endpoint, "%s no longer has %s of %s", registration.name, registration.caller_id)
            self._context.registry.unregister(
                registration.kind, registration.name, registration.caller_id
            )

    async def _unregister(self, endpoint: Endpoint, registrations: Iterable[Registration]) -> None:
        """Take back registrations of an endpoint at the master, and tell subscribers inside."""
        ended = list(registrations)
        await self._take_back((endpoint, r) for r in ended if not r.hidden)
        for registration in ended:
            self._publisher_updates.note_registration(registration)

    async def _free(self, former: FormerUris) -> list[EndpointRegistration]:
        """Take back all registrations of some names at the master, and return them.

        If a node has moved, the master has a former advertised URI, and the registry knows the
        registrations. If a node registered directly, the master has the node's own URI, and only
        the master knows all registrations.
        """
        registry = self._context.registry
        addressing = self._context.addressing
        calls: list[decisions.MethodCall] = []
        direct: dict[str, tuple[Endpoint, str]] = {}
        for name, (endpoint, uri) in former.items():
            endpoint.former_uris.add(uri)
            if addressing.lease_of(uri) is None:
                direct[name] = endpoint, uri
                endpoint.settles_at = self._context.now() + UPDATE_ARRIVAL_S
            else:
                service = addressing.advertised_service(endpoint)
                shown = [r for r in endpoint.registrations_of(name) if not r.hidden]
                calls += [decisions.unregister_call(r, uri, service) for r in shown]
        await self._context.upstream.multicall(calls)
        freed, known_uris = await self._free_direct(direct)
        for registration in freed:
            endpoint = former[registration.caller_id][0]
            if registration.key not in endpoint.registrations:
                registry.register(endpoint, replace(registration, since=self._context.now()))
        names = {name: e for name, (e, _) in former.items() if name not in known_uris}
        return [(e, r) for name, e in names.items() for r in e.registrations_of(name)]

    async def _free_direct(self, former: FormerUris) -> tuple[list[Registration], dict[str, str]]:
        """Take back all registrations of names that the master has by the nodes' own URIs.

        A name stays known for two reasons. The name may have another URI by now. Or the node has a
        parameter subscription, which the master does not list, besides the usual subscription. Then
        the node gets its registrations back.

        Returns:
            The registrations that were taken back, and the URIs of names that the master still
            knows.

        Raises Unreachable, MasterError.
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


def _log(endpoint: Endpoint, text: str, *values: object) -> None:
    """Log a line with the label of an endpoint first."""
    log.info(text, endpoint.label, *values, extra=endpoint.log_fields)
