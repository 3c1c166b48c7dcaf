"""The master's part where it is told nothing: which publishers subscribers inside hear of.

A list of publishers for a node inside is what the master says, and the hidden publishers besides
(`rosproxy.ros1.registry.hidden`). When those change, the subscribers inside are told. The ones that
the master knows need the master's list for that: registering them again yields it, and tells
nobody anything.

News of one topic wait for each other, so that an older list never comes after a newer one.
"""

import asyncio
import logging
from collections.abc import Iterable, Sequence

from rosproxy.net.addresses import HostPort
from rosproxy.ros1.clients.master import Unreachable
from rosproxy.ros1.context import Context
from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.protocol.uris import parse_slave_uri
from rosproxy.ros1.protocol.xmlrpc import document as xmlrpc
from rosproxy.ros1.registry import hidden
from rosproxy.ros1.registry.endpoint import Endpoint, EndpointRegistration, Registration
from rosproxy.ros1.rewriting import policing
from rosproxy.ros1.standins.ports import StandInPorts
from rosproxy.ros1.upkeep.decisions import registration as decisions

log = logging.getLogger(__name__)

PARALLEL_CALLS = 32
RETRY = 2.0
"""Seconds after which the master is asked again that was away."""


class PublisherUpdates:
    """Hands subscribers their publishers."""

    def __init__(self, context: Context, stand_ins: StandInPorts) -> None:
        self._context, self._stand_ins = context, stand_ins
        self._limit = asyncio.Semaphore(PARALLEL_CALLS)
        self._telling: set[str] = set()
        self._changed: dict[str, bool] = {}

    async def update(self, subscriber: str, topic: str, publishers: Sequence[str]) -> bool:
        """Hand the node at a slave URI the publishers of a topic; whether it has answered.

        All URIs are given as the master holds them.
        """
        endpoint = self._context.addressing.stands_for(subscriber)
        if endpoint:
            return await self.update_inside(endpoint, topic, publishers)
        where = parse_slave_uri(subscriber)
        return where is not None and await self._update(where, topic, publishers)

    async def update_inside(
        self, endpoint: Endpoint, topic: str, publishers: Sequence[str]
    ) -> bool:
        """The same for an endpoint's node, which gets the hidden ones, too, in its own form."""
        caller, addressing = self._context.caller_at(endpoint), self._context.addressing
        await self._stand_ins.listen_for(publishers, caller)
        found = policing.publishers_for(endpoint, topic, publishers, addressing)
        imported = dict.fromkeys(addressing.import_slave(uri, caller) for uri in found)
        return await self._update(endpoint.slave, topic, [*imported])

    def note(self, held: Registration) -> None:
        """Note that a registration was made or has ended: who needs to know of it is told."""
        if held.kind is Kind.PUBLISHER:
            self.tell([held.name], held.hidden)

    def tell(self, topics: Iterable[str], everybody: bool = True) -> None:
        """Tell the subscribers inside that publishers of some topics have changed.

        Not ``everybody``: only the hidden ones, since the master tells the others.
        """
        for topic in topics:
            if everybody or (Kind.SUBSCRIBER, topic) in self._context.registry.hidden:
                self._changed[topic] = everybody or self._changed.get(topic, False)
                if topic not in self._telling:
                    self._telling.add(topic)
                    self._context.tasks.spawn(self._tell(topic), f"publishers of {topic}")

    async def _tell(self, topic: str) -> None:
        """Tell the subscribers inside of a topic, until nothing of it has changed meanwhile."""
        try:
            while topic in self._changed:
                everybody = self._changed.pop(topic)
                held = hidden.subscribers_inside(self._context.registry, topic)
                held = [(e, one) for e, one in held if e.answers and (everybody or one.hidden)]
                try:
                    await self._hand_out(held)
                except Unreachable as error:
                    log.debug("publishers of %s: %s", topic, error)
                    self._changed[topic] = True
                    await asyncio.sleep(RETRY)
        finally:
            self._telling.discard(topic)

    async def _hand_out(self, held: Sequence[EndpointRegistration]) -> None:
        """Hand subscribers of one topic their publishers. Raises Unreachable."""
        addressing = self._context.addressing
        shown = [(e, one) for e, one in held if not one.hidden]
        calls = [decisions.register_call(one, addressing.advertised_uri(e), "") for e, one in shown]
        values = await self._context.upstream.multicall(calls)
        lists = {
            e: value if isinstance(value, list) else []
            for (e, _), value in zip(shown, values, strict=True)
        }
        await asyncio.gather(*(self._hand(e, one.name, lists.get(e, [])) for e, one in held))

    async def _hand(self, endpoint: Endpoint, topic: str, publishers: Sequence[str]) -> None:
        await self._context.after_registration(endpoint)
        await self.update_inside(endpoint, topic, publishers)

    async def _update(self, where: HostPort, topic: str, publishers: Sequence[str]) -> bool:
        body = xmlrpc.dump_call("publisherUpdate", "/master", topic, list(publishers))
        async with self._limit:
            try:
                timeout = self._context.settings.probe_timeout
                await self._context.upstream.post_to_node(where, body, timeout)
            except Unreachable as error:
                log.debug("publisherUpdate of %s: %s", topic, error)
                return False
        return True
