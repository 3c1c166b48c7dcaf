"""Asks the master for the publishers of topics, one question at a time.

The answer is the whole graph: the master has no shorter one. Any program outside can cause a
question, so there is a pause after each question. Meanwhile the proxy uses the processor for other
work.
"""

import asyncio
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from rosproxy.ros1.clients.master_client import MasterClient, MasterError, Unreachable
from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.registry.graph import Graph

log = logging.getLogger(__name__)

SHARE = 0.1
"""Share of a processor that the questions take, unless LONGEST_PAUSE_S cuts the pause short."""
LONGEST_PAUSE_S = 5.0
"""Longest pause: nodes inside do not learn of new publishers outside meanwhile."""


@dataclass(slots=True, eq=False)
class _Question:
    """A question for the publishers of topics. ``publishers``: the answer, None before it."""

    topics: set[str] = field(default_factory=set)
    publishers: dict[str, set[str]] | None = None


class PublisherLookup:
    """The publishers of topics, as the master knows them.

    The master gets one question at a time. Callers that wait meanwhile share the next question.
    ``clock`` measures the processor time of a question, in seconds.
    """

    def __init__(
        self, upstream: MasterClient, clock: Callable[[], float] = time.thread_time
    ) -> None:
        self._upstream = upstream
        self._clock = clock
        self._query_lock = asyncio.Lock()
        self._next_question = _Question()
        self._due = 0.0

    async def publishers_of(self, topic: str) -> set[str]:
        """The slave URIs of a topic's publishers at the master; empty without an answer."""
        question = self._next_question
        question.topics.add(topic)
        async with self._query_lock:
            # None: no other caller has asked this question, or that caller was cancelled.
            if question.publishers is None:
                if (pause := self._due - asyncio.get_running_loop().time()) > 0:
                    await asyncio.sleep(pause)
                self._next_question = _Question()
                question.publishers = await self._ask(question.topics)
            return question.publishers.get(topic, set())

    async def _ask(self, topics: set[str]) -> dict[str, set[str]]:
        """The slave URIs of the publishers of each topic; empty without an answer."""
        began = self._clock()
        try:
            _, state = await self._upstream.read_changes(b"")
            names = [
                name
                for name, registrations in (state or {}).items()
                if any(r.kind is Kind.PUBLISHER and r.name in topics for r in registrations)
            ]
            graph = Graph(state or {}, await self._upstream.look_up("lookupNode", names))
        except (Unreachable, MasterError) as error:
            log.debug("the master gives no list of publishers: %s", error)
            return {}
        finally:
            pause = min((self._clock() - began) * (1 / SHARE - 1), LONGEST_PAUSE_S)
            self._due = asyncio.get_running_loop().time() + pause
        publishers = graph.by_topic(Kind.PUBLISHER)
        return {topic: set(publishers.get(topic, ())) for topic in topics}
