"""Send subscribers the publishers of a topic, also those that the master does not know.

The list for a node inside has the publishers of the master and the hidden publishers
(`rosproxy.ros1.policy`). The list for a hidden subscriber has all publishers inside, and none
outside. When hidden publishers change, the proxy tells the subscribers inside. For a subscriber
that the master knows, the proxy needs the list of the master. To get the list, the proxy registers
the subscriber again, which sends no node an update.

Updates of the same topic by `PublisherUpdates.update_subscribers` wait for each other, so that an
older list never follows a newer list. Other updates do not wait.
"""

import asyncio
import logging
from collections.abc import Iterable, Sequence

from rosproxy.ros1.clients.master_client import Unreachable
from rosproxy.ros1.context import Context
from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.protocol.xmlrpc import document as xmlrpc
from rosproxy.ros1.registry.endpoint import Endpoint, EndpointRegistration, Registration
from rosproxy.ros1.stand_ins.stand_in_ports import StandInPorts
from rosproxy.ros1.upkeep.decisions import registration as decisions
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.uris import parse_slave_uri

log = logging.getLogger(__name__)

MOST_PARALLEL_CALLS = 32
MASTER_RETRY_INTERVAL_S = 2.0
"""Seconds after which the proxy tries again to reach the master."""


class PublisherUpdates:
    """Sends ``publisherUpdate`` to subscribers."""

    def __init__(self, context: Context, stand_ins: StandInPorts) -> None:
        self._context = context
        self._stand_ins = stand_ins
        self._limit = asyncio.Semaphore(MOST_PARALLEL_CALLS)
        self._topics_underway: set[str] = set()
        self._changed_topics: dict[str, bool] = {}

    async def update(self, subscriber: str, topic: str, publishers: Sequence[str]) -> bool:
        """Send the publishers of a topic to the node at a slave URI, inside or outside.

        All URIs are in the form that the master has. Return whether the node has answered.
        """
        endpoint = self._context.addressing.endpoint_of(subscriber)
        if endpoint:
            return await self.update_inside(endpoint, topic, publishers)
        slave = parse_slave_uri(subscriber)
        return slave is not None and await self._update(slave, topic, publishers)

    async def update_inside(
        self, endpoint: Endpoint, topic: str, publishers: Sequence[str]
    ) -> bool:
        """Send the publishers of a topic to the node of an endpoint.

        ``publishers`` are URIs in the form that the master holds. The method adds the hidden
        publishers, and imports all URIs. Return whether the node has answered.
        """
        caller = self._context.caller_at(endpoint)
        addressing = self._context.addressing
        await self._stand_ins.listen_for(publishers, caller)
        uris = self._context.policy.publishers_for(endpoint, topic, publishers)
        imported = dict.fromkeys(addressing.import_slave(uri, caller) for uri in uris)
        return await self._update(endpoint.slave, topic, [*imported])

    def note_registration(self, registration: Registration) -> None:
        """Tell the affected subscribers inside if a publisher was registered or has ended."""
        if registration.kind is Kind.PUBLISHER:
            self.update_subscribers([registration.name], registration.hidden)

    def update_subscribers(self, topics: Iterable[str], all_inside: bool = True) -> None:
        """Tell the subscribers inside that publishers of some topics have changed.

        Without ``all_inside``, only the hidden subscribers: the master tells all other subscribers.
        """
        registry = self._context.registry
        for topic in topics:
            if all_inside or registry.hidden_holders(Kind.SUBSCRIBER, topic):
                self._changed_topics[topic] = all_inside or self._changed_topics.get(topic, False)
                if topic not in self._topics_underway:
                    self._topics_underway.add(topic)
                    self._context.tasks.spawn(self._update_topic(topic), f"publishers of {topic}")

    async def _update_topic(self, topic: str) -> None:
        """Tell the subscribers of a topic inside; again, if the topic changes meanwhile."""
        try:
            while topic in self._changed_topics:
                all_inside = self._changed_topics.pop(topic)
                inside = self._context.registry.subscriptions(topic)
                inside = [(e, r) for e, r in inside if e.answers and (all_inside or r.hidden)]
                try:
                    await self._update_all(inside)
                except Unreachable as error:
                    text = (
                        "topic %s: the proxy could not send the publishers to subscribers yet: %s"
                    )
                    log.debug(text, topic, error)
                    self._changed_topics[topic] = True
                    await asyncio.sleep(MASTER_RETRY_INTERVAL_S)
        finally:
            self._topics_underway.discard(topic)

    async def _update_all(self, subscribers: Sequence[EndpointRegistration]) -> None:
        """Send the publishers of one topic to its subscribers. Raises Unreachable."""
        addressing = self._context.addressing
        shown = [(e, r) for e, r in subscribers if not r.hidden]
        calls = [decisions.register_call(r, addressing.advertised_uri(e), "") for e, r in shown]
        values = await self._context.upstream.multicall(calls)
        lists = {
            e: value if isinstance(value, list) else []
            for (e, _), value in zip(shown, values, strict=True)
        }
        await asyncio.gather(
            *(self._update_one(e, r.name, lists.get(e, [])) for e, r in subscribers)
        )

    async def _update_one(self, endpoint: Endpoint, topic: str, publishers: Sequence[str]) -> None:
        await self._context.wait_for_registration(endpoint)
        await self.update_inside(endpoint, topic, publishers)

    async def _update(self, slave: HostPort, topic: str, publishers: Sequence[str]) -> bool:
        # "/master" is the caller_id of rosmaster (master_api.py, publisher_update_task).
        body = xmlrpc.dump_call("publisherUpdate", "/master", topic, list(publishers))
        async with self._limit:
            try:
                timeout = self._context.settings.probe_timeout
                await self._context.upstream.post_to_node(slave, body, timeout)
            except Unreachable as error:
                log.debug("publisherUpdate of topic %s was not answered: %s", topic, error)
                return False
        return True
