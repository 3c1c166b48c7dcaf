"""Asking a node who it is: does it answer, as which process, with which topics, on which port?

There are two questions. `NodeClient.probe` is the cheap one (``getPid``), asked over and over.
`NodeClient.inspect` has the node describe itself; whoever is about to believe what somebody else
said of a node (the master after a restart, an operator, the node's former process) inspects it
first. Both only ask: what follows for the endpoint is decided in `upkeep`.
"""

import asyncio
import logging

import msgspec

from rosproxy.net.addresses import HostPort
from rosproxy.ros1.clients.master import MasterClient, MasterError, Unreachable
from rosproxy.ros1.registry.graph import NodeInfo, read_types
from rosproxy.ros1.registry.health import ProbeResult

log = logging.getLogger(__name__)

TOPICS_ASKED = 3
"""How many of its topics a node is asked for at most before its TCPROS port counts as unknown."""


class ProbeAnswer(msgspec.Struct, frozen=True):
    """How a probe ended; ``pid`` if the node answered, ``reason`` if it didn't."""

    probe: ProbeResult
    pid: int | None = None
    reason: str = ""


class NodeClient:
    """Questions to nodes; ``within`` is the time-out of each in seconds."""

    def __init__(self, upstream: MasterClient, within: float) -> None:
        self._upstream, self._within = upstream, within

    async def probe(self, where: HostPort, within: float | None = None) -> ProbeAnswer:
        """Call ``getPid``; anything but a ROS triple with a number is no node."""
        try:
            pid = await self._upstream.call_node(where, within or self._within, "getPid")
        except Unreachable as error:
            return ProbeAnswer(error.probe, reason=str(error))
        except MasterError as error:
            return ProbeAnswer(ProbeResult.SILENT, reason=str(error))
        return ProbeAnswer(ProbeResult.ANSWERED, pid if isinstance(pid, int) else None)

    async def inspect(self, where: HostPort) -> NodeInfo | None:
        """What the node at an address says of itself; None if it gives no proper answer."""
        try:
            answer, published, subscribed = await asyncio.gather(
                self.probe(where),
                self._topics(where, "getPublications"),
                self._topics(where, "getSubscriptions"),
            )
        except (Unreachable, MasterError) as error:
            log.debug("%s does not describe itself: %s", where, error)
            return None
        port = await self._tcpros_port(where, sorted(published))
        return NodeInfo(answer.pid, published, subscribed, port)

    async def _topics(self, where: HostPort, method: str) -> dict[str, str]:
        return read_types(await self._upstream.call_node(where, self._within, method))

    async def _tcpros_port(self, where: HostPort, topics: list[str]) -> int | None:
        for topic in topics[:TOPICS_ASKED]:
            try:
                answer = await self._upstream.call_node(
                    where, self._within, "requestTopic", topic, [["TCPROS"]]
                )
            except (Unreachable, MasterError) as error:
                log.debug("%s gives no TCPROS port for %s: %s", where, topic, error)
                continue
            if isinstance(answer, list) and len(answer) == 3 and isinstance(answer[2], int):
                return answer[2]
        return None
