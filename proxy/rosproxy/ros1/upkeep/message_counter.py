"""Count messages by topic, for the metrics: the proxy asks the nodes for their counts.

Neither the relay nor the kernel reads messages, but nodes count the messages of their connections.
While a program reads the metrics, the proxy asks the healthy nodes for these counts
(``getBusStats``), at most `MOST_ASKED_NODES` a second. The count of a node begins with its first
answer after the start, after an error, or after a pause in the reads of the metrics. Messages
before this answer do not count.
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

COUNT_INTERVAL_S = 1.0
"""Seconds between two rounds of questions."""
MOST_ASKED_NODES = 20
"""The highest number of nodes that the proxy asks in a round."""
MOST_PARALLEL_QUESTIONS = 4
"""The highest number of nodes that the proxy asks at the same time. The number is low, because
all answers may be long and arrive together."""
ASK_INTERVAL_S = 10.0
"""Seconds after which the proxy asks a node again."""
INTERVAL_AFTER_SILENCE_S = 30.0
"""Seconds after which the proxy asks a node again that gave no answer."""
INTERVAL_AFTER_ERROR_S = 300.0
"""Seconds after which the proxy asks a node again that answered with an error or too much."""
ASK_AFTER_READ_S = 180.0
"""Seconds for which the questions go on after a read: Prometheus reads about once a minute."""


@dataclass(frozen=True, slots=True)
class _Record:
    """The time of the next question to a node, and the last counts of the node, if any."""

    ask_at: float
    stats: BusStats | None = None


class MessageCounter:
    """Sums up the messages that the nodes inside have counted."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self._sums = TopicSums()
        self._records: dict[Endpoint, _Record] = {}
        self._read_at = -math.inf
        self._limit = asyncio.Semaphore(MOST_PARALLEL_QUESTIONS)

    def read(self) -> TopicSums:
        """The sums, for a program that reads the metrics.

        The proxy then asks the nodes for `ASK_AFTER_READ_S` from now.
        """
        self._read_at = self._context.now()
        return self._sums

    async def ask_due_nodes(self) -> None:
        """Ask the nodes that are due, if a program has read the metrics lately."""
        now = self._context.now()
        if self._context.retired or now - self._read_at > ASK_AFTER_READ_S:
            self._records.clear()
            return
        endpoints = {*self._context.registry}
        self._records = {e: r for e, r in self._records.items() if e in endpoints}
        due = sorted(filter(self._may_be_asked, endpoints), key=self._ask_at)[:MOST_ASKED_NODES]
        await asyncio.gather(*(self._ask(e) for e in due if self._ask_at(e) <= now))

    def _may_be_asked(self, endpoint: Endpoint) -> bool:
        return endpoint.trusted and endpoint.health.steady and bool(endpoint.registrations)

    def _ask_at(self, endpoint: Endpoint) -> float:
        record = self._records.get(endpoint)
        return record.ask_at if record else 0.0

    async def _ask(self, endpoint: Endpoint) -> None:
        former = self._records.get(endpoint, _Record(0.0))
        slave = endpoint.slave
        timeout = self._context.settings.probe_timeout
        try:
            async with self._limit:
                reply = await self._context.upstream.call_node(
                    slave, timeout, "getBusStats", limits=BUS_STATS
                )
        except (Unreachable, MasterError) as error:
            log.debug("%s gives no message counts: %s", endpoint.label, error)
            self._records[endpoint] = self._after_failure(former, error)
            return
        if endpoint.slave != slave:
            return  # the node has moved meanwhile: another node may have answered
        stats = registered_stats(endpoint, read_bus_stats(reply))
        self._records[endpoint] = _Record(self._context.now() + ASK_INTERVAL_S, stats)
        # The first answer also counts messages from before the proxy started, so the growth begins
        # with this answer.
        since = stats if former.stats is None else former.stats
        for (direction, topic), count in growth(since, stats).items():
            self._sums.add(topic, SIDES[direction], count)

    def _after_failure(self, former: _Record, error: Exception) -> _Record:
        """The record after a failed question.

        If the node gave no answer, its last counts remain the base of the next growth.
        """
        now = self._context.now()
        if isinstance(error, Unreachable) and error.probe is not ProbeResult.ANSWERED:
            return _Record(now + INTERVAL_AFTER_SILENCE_S, former.stats)
        return _Record(now + INTERVAL_AFTER_ERROR_S)
