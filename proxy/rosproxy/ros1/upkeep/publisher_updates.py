"""The master's part for what it does not know: which publishers subscribers inside hear of.

A list of publishers for a node inside is what the master says, and the hidden publishers besides
(`rosproxy.ros1.policy`). When those change, the subscribers inside are told.
The ones that the master knows need the master's list for that: registering them again yields it,
and tells nobody anything.

Updates of one topic wait for each other, so that an older list never comes after a newer one.
"""

import asyncio
import logging
from collections.abc import Iterable, Sequence

from rosproxy.net.addresses import HostPort
from rosproxy.ros1.clients.master_client import Unreachable
from rosproxy.ros1.context import Context
from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.protocol.uris import parse_slave_uri
from rosproxy.ros1.protocol.xmlrpc import document as xmlrpc
from rosproxy.ros1.registry.endpoint import Endpoint, EndpointRegistration, Registration
from rosproxy.ros1.stand_ins.stand_in_ports import StandInPorts
from rosproxy.ros1.upkeep.decisions import registration as decisions

log = logging.getLogger(__name__)

PARALLEL_CALLS = 32
RETRY = 2.0
"""Seconds after which a master that could not be reached is asked again."""


class PublisherUpdates:
    """Hands subscribers their publishers."""

    def __init__(self, context: Context, stand_ins: StandInPorts) -> None:
        self._context = context
        self._stand_ins = stand_ins
        self._limit = asyncio.Semaphore(PARALLEL_CALLS)
        self._topics_underway: set[str] = set()
        self._changed_topics: dict[str, bool] = {}

    async def update(self, subscriber: str, topic: str, publishers: Sequence[str]) -> bool:
        """Hand the node at a slave URI the publishers of a topic; whether it has answered.

        All URIs are given as the master holds them.
        """
        endpoint = self._context.addressing.endpoint_of(subscriber)
        if endpoint:
            return await self.update_inside(endpoint, topic, publishers)
        slave = parse_slave_uri(subscriber)
        return slave is not None and await self._update(slave, topic, publishers)

    async def update_inside(
        self, endpoint: Endpoint, topic: str, publishers: Sequence[str]
    ) -> bool:
        """The same for an endpoint's node: with the hidden publishers, by URIs that it can use."""
        caller = self._context.caller_at(endpoint)
        addressing = self._context.addressing
        await self._stand_ins.listen_for(publishers, caller)
        uris = self._context.policy.publishers_for(endpoint, topic, publishers)
        imported = dict.fromkeys(addressing.import_slave(uri, caller) for uri in uris)
        return await self._update(endpoint.slave, topic, [*imported])

    def note_registration(self, registration: Registration) -> None:
        """Note that a registration was made or has ended: subscribers that need it are told."""
        if registration.kind is Kind.PUBLISHER:
            self.update_subscribers([registration.name], registration.hidden)

    def update_subscribers(self, topics: Iterable[str], everybody: bool = True) -> None:
        """Tell the subscribers inside that publishers of some topics have changed.

        Not ``everybody``: only the hidden subscribers, since the master tells the others.
        """
        for topic in topics:
            if everybody or self._context.policy.hides_subscribers(topic):
                self._changed_topics[topic] = everybody or self._changed_topics.get(topic, False)
                if topic not in self._topics_underway:
                    self._topics_underway.add(topic)
                    self._context.tasks.spawn(self._update_topic(topic), f"publishers of {topic}")

    async def _update_topic(self, topic: str) -> None:
        """Tell a topic's subscribers inside, until nothing of it has changed meanwhile."""
        try:
            while topic in self._changed_topics:
                everybody = self._changed_topics.pop(topic)
                inside = self._context.registry.subscriptions(topic)
                inside = [(e, r) for e, r in inside if e.answers and (everybody or r.hidden)]
                try:
                    await self._hand_out(inside)
                except Unreachable as error:
                    text = (
                        "topic %s: the proxy could not send the publishers to subscribers yet: %s"
                    )
                    log.debug(text, topic, error)
                    self._changed_topics[topic] = True
                    await asyncio.sleep(RETRY)
        finally:
            self._topics_underway.discard(topic)

    async def _hand_out(self, subscribers: Sequence[EndpointRegistration]) -> None:
        """Hand subscribers of one topic their publishers. Raises Unreachable."""
        addressing = self._context.addressing
        shown = [(e, r) for e, r in subscribers if not r.hidden]
        calls = [decisions.register_call(r, addressing.advertised_uri(e), "") for e, r in shown]
        values = await self._context.upstream.multicall(calls)
        lists = {
            e: value if isinstance(value, list) else []
            for (e, _), value in zip(shown, values, strict=True)
        }
        await asyncio.gather(*(self._hand(e, r.name, lists.get(e, [])) for e, r in subscribers))

    async def _hand(self, endpoint: Endpoint, topic: str, publishers: Sequence[str]) -> None:
        await self._context.wait_for_registration(endpoint)
        await self.update_inside(endpoint, topic, publishers)

    async def _update(self, slave: HostPort, topic: str, publishers: Sequence[str]) -> bool:
        # In the name that rosmaster gives (master_api.py, publisher_update_task).
        body = xmlrpc.dump_call("publisherUpdate", "/master", topic, list(publishers))
        async with self._limit:
            try:
                timeout = self._context.settings.probe_timeout
                await self._context.upstream.post_to_node(slave, body, timeout)
            except Unreachable as error:
                log.debug("publisherUpdate of topic %s was not answered: %s", topic, error)
                return False
        return True
