"""Keeping the master right: registering nodes again, and unregistering those that are gone.

Everything that the proxy itself registers or unregisters goes through the `Registrar`; the rooms
beside this one decide when. `Registrar.register` is the way for all of it: it asks the master who
has each name now, leaves a name to whoever else has it, frees one that the master has by a former
URI of the same node, makes the calls, and hands subscribers the publishers that the replies name.
"""

import asyncio
import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from rosproxy.ros1.clients.master import CALLER_ID
from rosproxy.ros1.clients.master_graph import look_up_nodes, look_up_services, read_registrations
from rosproxy.ros1.clients.node import NodeClient
from rosproxy.ros1.context import Context
from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.registry.endpoint import Endpoint, Registration
from rosproxy.ros1.registry.graph import NodeInfo
from rosproxy.ros1.upkeep.publisher_updates import PublisherUpdates
from rosproxy.ros1.upkeep.registration import policy
from rosproxy.ros1.upkeep.registration.policy import Held

log = logging.getLogger(__name__)

Former = Mapping[str, tuple[Endpoint, str]]
"""Names with their endpoints, and the former URIs by which the master has them."""
SETTLE_TIME = 2.0
"""Seconds in which the master's news of a publisher that is registered anew come in."""


class Registrar:
    """Calls to the master on behalf of inside nodes, and what follows from the replies."""

    def __init__(self, context: Context, nodes: NodeClient, updates: PublisherUpdates) -> None:
        self._context, self._nodes, self._updates = context, nodes, updates

    async def register(self, held: Sequence[Held]) -> None:
        """Register again what the master has lost. Raises Unreachable, MasterError.

        A name that somebody else holds by now is left to them; what it holds with a former URI
        of the same node is taken back first.
        """
        at_master = await look_up_nodes(self._context.upstream, {one.caller_id for _, one in held})
        kept: list[Held] = []
        former: dict[str, tuple[Endpoint, str]] = {}
        for endpoint, one in held:
            uri = at_master.get(one.caller_id)
            if uri in (None, self._context.addressing.advertised_uri(endpoint)):
                kept.append((endpoint, one))
            elif policy.known_as(endpoint, uri):
                former[one.caller_id] = endpoint, uri
            else:
                log.info("%s is registered as %s by now; left to it", one.caller_id, uri)
                self._context.registry.drop_caller(endpoint, one.caller_id)
        await self._register(kept + await self._free(former))

    async def reclaim(self, former: Former) -> None:
        """Register nodes anew that the master has by former URIs. Raises Unreachable, MasterError.

        What it has of them that the registry has not is taken in.
        """
        await self._register(await self._free(former))

    async def resettle(self, endpoints: Iterable[Endpoint]) -> None:
        """Register nodes anew that have moved to another address. Raises Unreachable, MasterError.

        Their own connections have lost their address: roscpp makes new ones if it is told that
        the publishers have gone before it is told that they are there.
        """
        moved = list(endpoints)
        topics = [(e, topic) for e in moved for topic in e.names(Kind.SUBSCRIBER)]
        await asyncio.gather(*(self._updates.send_inside(e, t, []) for e, t in topics))
        await self.register([(e, held) for e in moved for held in e.registrations.values()])
        for endpoint in moved:
            endpoint.note_settled()

    async def register_missing(self, endpoint: Endpoint, info: NodeInfo) -> None:
        """Register what a node has and the master does not know of. Raises Unreachable."""
        found = policy.unregistered(endpoint, info)
        for held in found:
            self._context.registry.register(endpoint, held)
        if found:
            log.info(
                "%s: %d topics were not registered; they are now",
                endpoint.label,
                len(found),
                extra=endpoint.log_fields,
            )
            await self.register([(endpoint, held) for held in found])

    async def register_lost(self) -> None:
        """Register what the master no longer has of live nodes. Raises Unreachable, MasterError."""
        started = self._context.now()
        state = await read_registrations(self._context.upstream)
        ours = {
            held: endpoint
            for endpoint, held in self._context.registry.registrations()
            if endpoint.trusted and not endpoint.health.cleaned and not endpoint.health.down
        }
        lost = policy.lost(list(ours), state, started)
        unsettled = [e for e in self._context.registry if e.unsettled and not e.health.down]
        if unsettled:
            await self.resettle(unsettled)
        if lost:
            log.warning("the master has lost %d registrations; making them again", len(lost))
            await self.register([(ours[held], held) for held in lost])

    async def clean_up(self, endpoint: Endpoint) -> None:
        """Unregister a node that is gone at the master. Raises Unreachable."""
        started, held = self._context.now(), list(endpoint.registrations.values())
        await self._unregister(endpoint, held)
        endpoint.health.note_cleaned(started)
        self._context.metrics.cleanups.inc()
        log.info(
            "cleaned up %s: %d registrations taken back",
            endpoint.label,
            len(held),
            extra=endpoint.log_fields,
        )

    async def come_back(self, endpoint: Endpoint, pid: int | None) -> None:
        """Register a node again that was cleaned up and answers after all, as process ``pid``.

        Raises Unreachable, MasterError.
        """
        info = await self._nodes.inspect(endpoint.slave)
        if info is None:
            return
        kept = policy.still_held(endpoint, info, pid == endpoint.health.pid)
        for held in list(endpoint.registrations.values()):
            if held not in kept and held.since < endpoint.health.cleaned_at:
                self._context.registry.unregister(held.kind, held.name, held.caller_id)
        endpoint.health.note_back(pid)
        await self.register([(endpoint, held) for held in kept])
        log.info(
            "%s is back: %d registrations made again",
            endpoint.label,
            len(kept),
            extra=endpoint.log_fields,
        )

    async def unregister_left_over(self, endpoint: Endpoint) -> None:
        """Take back what a former process left: topics that the node there does not have.

        Raises Unreachable.
        """
        started = self._context.now()
        info = await self._nodes.inspect(endpoint.slave)
        if info is not None:
            endpoint.replace_tcpros_ports(info.tcpros_port)
            await self._forget(endpoint, policy.left_over(endpoint, info, started))

    async def reconcile(self, endpoint: Endpoint) -> None:
        """Make up for the calls that a node made around the proxy. Raises Unreachable, MasterError.

        A service that it has unregistered stays until it ends: it can't be asked for those.
        """
        started = self._context.now()
        info = await self._nodes.inspect(endpoint.slave)
        if info is not None:
            await self._forget(endpoint, policy.vanished(endpoint, info, started))
            await self.register_missing(endpoint, info)

    async def _register(self, held: Sequence[Held]) -> None:
        """Register at the master; subscribers are handed the publishers that the replies name."""
        if self._context.retired:
            return
        addressing, wanted = self._context.addressing, policy.to_register(held)
        calls = [
            policy.register_call(
                one, addressing.advertised_uri(e), addressing.advertised_service(e)
            )
            for e, one in wanted
        ]
        values = await self._context.upstream.multicall(calls)
        updates = (
            self._updates.send_inside(endpoint, one.name, publishers)
            for (endpoint, one), publishers in zip(wanted, values, strict=True)
            if one.kind is Kind.SUBSCRIBER and isinstance(publishers, list)
        )
        await asyncio.gather(*updates)

    async def _forget(self, endpoint: Endpoint, ended: Sequence[Registration]) -> None:
        await self._unregister(endpoint, ended)
        for held in ended:
            log.info(
                "%s of %s is no longer at %s",
                held.name,
                held.caller_id,
                endpoint.uri,
                extra=endpoint.log_fields,
            )
            self._context.registry.unregister(held.kind, held.name, held.caller_id)

    async def _unregister(self, endpoint: Endpoint, held: Sequence[Registration]) -> None:
        addressing = self._context.addressing
        uri, service = addressing.advertised_uri(endpoint), addressing.advertised_service(endpoint)
        calls = [policy.unregister_call(one, uri, service) for one in held]
        await self._context.upstream.multicall(calls)

    async def _free(self, former: Former) -> list[Held]:
        """All that some names hold, once it is taken back at the master.

        It has nodes that have moved by former advertised URIs: they hold what the registry has.
        Those that registered around the proxy it has by their own: what they hold it alone knows.
        """
        registry, direct = self._context.registry, dict[str, str]()
        calls: list[policy.MethodCall] = []
        for name, (endpoint, uri) in former.items():
            endpoint.note_former_uri(uri)
            if self._context.addressing.identify(uri) is None:
                direct[name] = uri
                endpoint.expect_updates(self._context.now() + SETTLE_TIME)
            else:
                service = self._context.addressing.advertised_service(endpoint)
                held = endpoint.registrations.values()
                mine = [one for one in held if one.caller_id == name]
                calls += [policy.unregister_call(one, uri, service) for one in mine]
        await self._context.upstream.multicall(calls)
        freed = {name: list[Registration]() for name in former if name not in direct}
        for name, found in (await self._free_direct(direct)).items():
            if found is None:
                registry.drop_caller(former[name][0], name)
            else:
                freed[name] = found
        for name, found in freed.items():
            endpoint = former[name][0]
            for one in found:
                if one.key not in endpoint.registrations:
                    registry.register(endpoint, replace(one, since=self._context.now()))
        return [
            (former[name][0], one)
            for name in freed
            for one in former[name][0].registrations.values()
            if one.caller_id == name
        ]

    async def _free_direct(self, uris: Mapping[str, str]) -> dict[str, list[Registration] | None]:
        """End everything that names hold which the master has by their nodes' own URIs.

        What that was, of the names that are free now; None of those that are not, because of a
        parameter subscription that the master does not tell of: they get back what they had. A
        name that was registered otherwise meanwhile is left out. Raises Unreachable, MasterError.
        """
        if not uris:
            return {}
        upstream = self._context.upstream
        held = await read_registrations(upstream)
        mine = (one for name in uris for one in held.get(name, []))
        services = await look_up_services(
            upstream, {one.name for one in mine if one.kind is Kind.SERVICE}
        )
        release = {name: policy.release_calls(name, uri, CALLER_ID) for name, uri in uris.items()}
        calls = policy.free_calls(uris, held, services)
        values = await upstream.multicall([*calls, *(c for part in release.values() for c in part)])
        found: dict[str, list[Registration] | None] = {}
        stuck: dict[str, str] = {}
        for place, (name, uri) in enumerate(uris.items()):
            answers = values[len(calls) + 3 * place :][:3]
            parameters = policy.released_parameters(answers)
            if parameters is not None:
                params = [Registration(Kind.PARAM, key, name) for key in parameters]
                found[name] = [*held.get(name, []), *params]
            elif answers[-1] == uri:
                found[name], stuck[name] = None, uri
        await upstream.multicall(policy.restore_calls(stuck, held, services))
        for name, uri in stuck.items():
            text = (
                f"registered as {uri} around the proxy and can't be taken over: it is subscribed "
                "to a parameter, which the master does not tell of. Restart its container"
            )
            log.warning("%s: %s", name, text)
            self._context.problems.add(name, text)
        return found
