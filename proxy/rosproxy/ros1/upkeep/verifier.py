"""Is the node at an address the one that somebody says it is?

The master says so after a restart, an operator of a container that has moved or arrived. Anybody
can write to the master, so it is only a claim, and the node itself has to bear it out. First by the
topics that it names. A library that does not tell them (ROS makes none implement the whole slave
API) is asked for one of the topics that are registered for it: where it names a TCPROS port for
that, and is called there by a name that is registered, it is the one; so it is where it answers for
a service under that name.
"""

from collections.abc import Collection, Iterable
from dataclasses import dataclass

from rosproxy.net.addresses import HostPort
from rosproxy.ros1.clients.master import MasterError, Unreachable
from rosproxy.ros1.clients.node import NodeClient
from rosproxy.ros1.protocol.uris import parse_service_uri
from rosproxy.ros1.registry.endpoint import Registration
from rosproxy.ros1.registry.graph import ROSOUT, NodeInfo
from rosproxy.ros1.upkeep.decisions import recovery as decisions


@dataclass(frozen=True, slots=True)
class Verifier:
    """Asks nodes whether they are who they are said to be."""

    _nodes: NodeClient

    async def ask(
        self,
        where: HostPort,
        held: Collection[Registration],
        service_ports: Iterable[int] = (),
    ) -> tuple[NodeInfo | None, bool | None]:
        """What the node at an address says of itself, and whether it is the one that registered.

        The second is None if it can't be told; the first is, if nothing answers there.
        ``service_ports`` are TCPROS ports at which it may have services.
        """
        info = await self._nodes.inspect(where)
        if info is None:
            return None, None
        return info, await self.judge(where, held, info, service_ports)

    async def judge(
        self,
        where: HostPort,
        held: Collection[Registration],
        info: NodeInfo,
        service_ports: Iterable[int] = (),
    ) -> bool | None:
        """The same of a node that has said something of itself: one of the names is enough."""
        names = decisions.by_name(held)
        verdicts = {name: decisions.confirmed_by(names[name], info) for name in names}
        if True in verdicts.values():
            return True
        untold = [one for one in held if verdicts[one.caller_id] is None]
        ports = {*info.topic_ports.values(), *service_ports}
        if await self._answers_for(where, untold, info, ports):
            return True
        return None if untold or not held else False

    async def _answers_for(
        self, where: HostPort, held: Collection[Registration], info: NodeInfo, ports: set[int]
    ) -> bool:
        """Whether it answers for a topic or service, by a name that has registered it."""
        callers = {one.caller_id for one in held}
        topics, services = decisions.to_ask(held)
        for topic in topics:
            port = info.topic_ports.get(topic) or await self._port(where, topic)
            if port is None:
                continue
            ports.add(port)
            name = await self._nodes.publisher(HostPort(where.host, port), topic)
            if name in callers or (name is None and topic != ROSOUT):
                return True
        for service in services:
            own = parse_service_uri(service.service_api or "")
            for port in {own.port} if own else ports:
                name = await self._nodes.provider(HostPort(where.host, port), service.name)
                if name in callers:
                    return True
        return False

    async def _port(self, where: HostPort, topic: str) -> int | None:
        try:
            return await self._nodes.topic_port(where, topic)
        except (Unreachable, MasterError):
            return None
