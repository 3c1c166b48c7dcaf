"""Asking inside nodes: are you there, what do you publish, where is your TCPROS port?"""

import asyncio
import logging
from collections.abc import Mapping
from dataclasses import dataclass

from rosproxy.net.addresses import HostPort
from rosproxy.ros1.clients.master import CALLER_ID, MasterClient, MasterError, Unreachable
from rosproxy.ros1.registry.endpoint import Endpoint
from rosproxy.ros1.registry.graph import read_types
from rosproxy.ros1.registry.health import ProbeResult

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Answer:
    """How a probe ended; ``pid`` if the node answered, ``reason`` if it didn't."""

    probe: ProbeResult
    pid: int | None = None
    reason: str = ""


@dataclass(frozen=True, slots=True)
class SelfDescription:
    """What a node says of itself: its topics with their types, and its TCPROS port if known."""

    published: Mapping[str, str]
    subscribed: Mapping[str, str]
    tcpros_port: int | None

    @property
    def topics(self) -> set[str]:
        """All topics that it publishes or subscribes to."""
        return {*self.published, *self.subscribed}


class NodeClient:
    """Questions to nodes; ``within`` is the time-out of each in seconds."""

    def __init__(self, upstream: MasterClient, within: float) -> None:
        self._upstream, self._within = upstream, within

    async def probe(self, where: HostPort, within: float | None = None) -> Answer:
        """Call ``getPid``; anything but a ROS triple with a number is no node."""
        try:
            pid = await self._upstream.ask_node(where, within or self._within, "getPid")
        except Unreachable as error:
            return Answer(error.probe, reason=str(error))
        except MasterError as error:
            return Answer(ProbeResult.SILENT, reason=str(error))
        return Answer(ProbeResult.ANSWERED, pid if isinstance(pid, int) else None)

    async def describe(self, where: HostPort) -> SelfDescription | None:
        """What a node says of itself; None if it gives no proper answer."""
        try:
            published, subscribed = await asyncio.gather(
                self._topics(where, "getPublications"), self._topics(where, "getSubscriptions")
            )
        except (Unreachable, MasterError) as error:
            log.debug("%s does not describe itself: %s", where, error)
            return None
        port = await self._tcpros_port(where, sorted(published))
        return SelfDescription(published, subscribed, port)

    async def learn_tcpros_port(self, endpoint: Endpoint) -> int | None:
        """Ask an endpoint's node for its TCPROS port anew and note it."""
        said = await self.describe(endpoint.slave)
        endpoint.replace_tcpros_ports(said.tcpros_port if said else None)
        return endpoint.tcpros_port

    async def _topics(self, where: HostPort, method: str) -> dict[str, str]:
        return read_types(await self._upstream.ask_node(where, self._within, method))

    async def _tcpros_port(self, where: HostPort, topics: list[str]) -> int | None:
        for topic in topics[:3]:
            try:
                answer = await self._upstream.ask_node(
                    where, self._within, "requestTopic", topic, [["TCPROS"]]
                )
            except (Unreachable, MasterError) as error:
                log.debug("%s gives no TCPROS port (asked by %s): %s", where, CALLER_ID, error)
                continue
            if isinstance(answer, list) and len(answer) == 3 and isinstance(answer[2], int):
                return answer[2]
        return None
