"""Messages by topic, for whoever reads the metrics: nodes are asked what they have counted.

Neither the relay nor the kernel reads messages, but nodes count their own. While the metrics are
read, those that are well are asked for it (``getBusStats``), so many a second at most; when nobody
reads them, nobody is asked. What a node counts before it is asked for the first time is not added.
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
"""Seconds between two looks at who is to be asked."""
MOST_ASKED = 20
"""Nodes that are asked in one look at most."""
AT_ONCE = 4
"""Answers that are waited for at once: they may all come in the same moment, and long."""
EVERY = 10.0
"""Seconds after which a node is asked again."""
AFTER_SILENCE = 30.0
"""Seconds after which one is asked again that has not answered in time."""
PATIENCE = 300.0
"""Seconds after which one is asked again that does not count, or has counted too far to tell."""
READ_LATELY = 180.0
"""Seconds for which it goes on after the metrics were read: Prometheus comes each minute or so."""


@dataclass(frozen=True, slots=True)
class _Answer:
    """What a node has said last, and when it is asked again."""

    ask_at: float
    stats: BusStats | None = None


class MessageCounter:
    """Sums up what the nodes inside count."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self._sums = TopicSums()
        self._answers: dict[Endpoint, _Answer] = {}
        self._read_at = -math.inf
        self._limit = asyncio.Semaphore(AT_ONCE)

    def read(self) -> TopicSums:
        """The sums, for somebody who reads the metrics."""
        self._read_at = self._context.now()
        return self._sums

    async def look(self) -> None:
        """Ask those that are due, if somebody reads the metrics."""
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
            return  # it has moved meanwhile, and who has answered may be somebody else
        stats = registered_stats(endpoint, read_bus_stats(reply))
        self._answers[endpoint] = _Answer(self._context.now() + EVERY, stats)
        # Of the first answer it is not known since when: counting begins there.
        since = stats if former.stats is None else former.stats
        for (direction, topic), count in growth(since, stats).items():
            self._sums.add(topic, SIDES[direction], count)

    def _after_failure(self, former: _Answer, error: Exception) -> _Answer:
        """What is known of a node that gave no counts: those it told before are not lost."""
        now = self._context.now()
        if isinstance(error, Unreachable) and error.probe is not ProbeResult.ANSWERED:
            return _Answer(now + AFTER_SILENCE, former.stats)
        return _Answer(now + PATIENCE)
