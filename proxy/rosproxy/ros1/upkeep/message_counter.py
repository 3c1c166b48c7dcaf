"""Messages by topic, for the metrics: the proxy asks the nodes for their own counts.

Neither the relay nor the kernel reads messages, but nodes count the messages of their connections.
While a program reads the metrics, the proxy asks the healthy nodes for these counts
(``getBusStats``), at most `MOST_ASKED` nodes a second. Messages before the first answer of a node
do not count.
"""

import asyncio
import logging
import math
from dataclasses import dataclass

from rosproxy.ros1.clients.master_client import MasterError, Unreachable
from rosproxy.ros1.context import Context
from rosproxy.ros1.protocol.bus_stats import BusStats, read_bus_stats
from rosproxy.ros1.protocol.xmlrpc.limits import BUS_STATS
from rosproxy.ros1.registry.endpoint import Endpoint
from rosproxy.ros1.registry.node_health import ProbeResult
from rosproxy.ros1.upkeep.decisions.topic_growth import (
    SIDES,
    TopicSums,
    growth,
    registered_stats,
)

log = logging.getLogger(__name__)

COUNT_TICK = 1.0
"""Seconds between two rounds of questions."""
MOST_ASKED = 20
"""The highest number of nodes that the proxy asks in a round."""
AT_ONCE = 4
"""Answers that the proxy awaits at the same time. All may arrive at once, and be long."""
EVERY = 10.0
"""Seconds after which the proxy asks a node again."""
AFTER_SILENCE = 30.0
"""Seconds after which the proxy asks a node again that gave no answer."""
PATIENCE = 300.0
"""Seconds after which the proxy asks a node again that answered with an error or too much."""
READ_LATELY = 180.0
"""Seconds for which the questions go on after a read: Prometheus reads about once a minute."""


@dataclass(frozen=True, slots=True)
class _Answer:
    """The last answer of a node, and the time of the next question."""

    ask_at: float
    stats: BusStats | None = None


class MessageCounter:
    """Sums up the messages that the nodes inside have counted."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self._sums = TopicSums()
        self._answers: dict[Endpoint, _Answer] = {}
        self._read_at = -math.inf
        self._limit = asyncio.Semaphore(AT_ONCE)

    def read(self) -> TopicSums:
        """The sums, for a program that reads the metrics. Keeps the questions going."""
        self._read_at = self._context.now()
        return self._sums

    async def look(self) -> None:
        """Ask the nodes that are due, if a program has read the metrics lately."""
        now = self._context.now()
        if self._context.retired or now - self._read_at > READ_LATELY:
            self._answers.clear()
            return
        endpoints = {*self._context.registry}
        self._answers = {e: a for e, a in self._answers.items() if e in endpoints}
        due = sorted(filter(self._is_well, endpoints), key=self._ask_at)[:MOST_ASKED]
        await asyncio.gather(*(self._ask(e) for e in due if self._ask_at(e) <= now))

    def _is_well(self, endpoint: Endpoint) -> bool:
        return endpoint.trusted and endpoint.health.steady and bool(endpoint.registrations)

    def _ask_at(self, endpoint: Endpoint) -> float:
        answer = self._answers.get(endpoint)
        return answer.ask_at if answer else 0.0

    async def _ask(self, endpoint: Endpoint) -> None:
        former = self._answers.get(endpoint, _Answer(0.0))
        slave = endpoint.slave
        within = self._context.settings.probe_timeout
        try:
            async with self._limit:
                reply = await self._context.upstream.call_node(
                    slave, within, "getBusStats", limits=BUS_STATS
                )
        except (Unreachable, MasterError) as error:
            log.debug("%s gives no message counts: %s", endpoint.label, error)
            self._answers[endpoint] = self._after_failure(former, error)
            return
        if endpoint.slave != slave:
            return  # the node has moved meanwhile: another node may have answered
        stats = registered_stats(endpoint, read_bus_stats(reply))
        self._answers[endpoint] = _Answer(self._context.now() + EVERY, stats)
        # The proxy does not know since when the first answer counts, so the sums start there.
        since = stats if former.stats is None else former.stats
        for (direction, topic), count in growth(since, stats).items():
            self._sums.add(topic, SIDES[direction], count)

    def _after_failure(self, former: _Answer, error: Exception) -> _Answer:
        """The record of a node without counts. After silence, the last counts stay the base."""
        now = self._context.now()
        if isinstance(error, Unreachable) and error.probe is not ProbeResult.ANSWERED:
            return _Answer(now + AFTER_SILENCE, former.stats)
        return _Answer(now + PATIENCE)
