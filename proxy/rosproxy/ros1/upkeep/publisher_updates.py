"""Handing subscribers the publishers of a topic, as the master does with ``publisherUpdate``."""

import asyncio
import logging
from collections.abc import Sequence

from rosproxy.net.addresses import HostPort
from rosproxy.ros1.alias.alias import Alias
from rosproxy.ros1.clients.master import Unreachable
from rosproxy.ros1.context import Context
from rosproxy.ros1.protocol.uris import parse_slave_uri
from rosproxy.ros1.protocol.xmlrpc import document as xmlrpc
from rosproxy.ros1.registry.endpoint import Endpoint

log = logging.getLogger(__name__)

PARALLEL_CALLS = 32


class PublisherUpdates:
    """Calls ``publisherUpdate`` at nodes; publishers are given as the master holds them."""

    def __init__(self, context: Context, alias: Alias) -> None:
        self._context, self._alias = context, alias
        self._limit = asyncio.Semaphore(PARALLEL_CALLS)

    async def send(self, subscriber: str, topic: str, publishers: Sequence[str]) -> bool:
        """Call the node at a slave URI that the master holds; whether it has answered."""
        endpoint = self._context.addressing.stands_for(subscriber)
        if endpoint:
            return await self.send_inside(endpoint, topic, publishers)
        where = parse_slave_uri(subscriber)
        return where is not None and await self._send(where, topic, publishers)

    async def send_inside(self, endpoint: Endpoint, topic: str, publishers: Sequence[str]) -> bool:
        """Call an endpoint's node, with URIs that it can use; whether it has answered."""
        asker = self._context.node_asker(endpoint)
        imported = self._context.addressing.import_slaves(publishers, asker)
        await self._alias.listen_for(publishers)
        return await self._send(endpoint.slave, topic, imported)

    async def _send(self, where: HostPort, topic: str, publishers: Sequence[str]) -> bool:
        body = xmlrpc.dump_call("publisherUpdate", "/master", topic, list(publishers))
        timeout = self._context.settings.probe_timeout
        async with self._limit:
            try:
                await self._context.upstream.post_to_node(where, body, timeout)
            except Unreachable as error:
                log.debug("publisherUpdate of %s: %s", topic, error)
                return False
        return True
