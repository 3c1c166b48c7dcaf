"""Asks the master for the publishers of topics, one question at a time."""

import asyncio
import logging
from dataclasses import dataclass, field

from rosproxy.ros1.clients.master_client import MasterClient, MasterError, Unreachable
from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.registry.graph import Graph

log = logging.getLogger(__name__)


@dataclass(slots=True, eq=False)
class _Question:
    """A question for the publishers of topics. ``publishers``: the answer, None before it."""

    topics: set[str] = field(default_factory=set)
    publishers: dict[str, set[str]] | None = None


class PublisherLookup:
    """The publishers of topics, as the master knows them.

    The master gets one question at a time. Callers that wait meanwhile share the next question.
    """

    def __init__(self, upstream: MasterClient) -> None:
        self._upstream = upstream
        self._query_lock = asyncio.Lock()
        self._next_question = _Question()

    async def publishers_of(self, topic: str) -> set[str]:
        """The slave URIs of a topic's publishers at the master; empty without an answer."""
        question = self._next_question
        question.topics.add(topic)
        async with self._query_lock:
            # None: no other caller has asked this question, or that caller was cancelled.
            if question.publishers is None:
                self._next_question = _Question()
                question.publishers = await self._ask(question.topics)
            return question.publishers.get(topic, set())

    async def _ask(self, topics: set[str]) -> dict[str, set[str]]:
        """The slave URIs of the publishers of each topic; empty without an answer."""
        try:
            state = await self._upstream.read_registrations()
            names = [
                name
                for name, registrations in state.items()
                if any(r.kind is Kind.PUBLISHER and r.name in topics for r in registrations)
            ]
            graph = Graph(state, await self._upstream.look_up("lookupNode", names))
        except (Unreachable, MasterError) as error:
            log.debug("the master gives no list of publishers: %s", error)
            return {}
        publishers = graph.by_topic(Kind.PUBLISHER)
        return {topic: set(publishers.get(topic, ())) for topic in topics}
