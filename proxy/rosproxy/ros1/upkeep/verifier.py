"""Is the node at an address the one that somebody says it is?

The master says so after a restart, an operator of a container that has moved or arrived. Anybody
can write to the master, so it is only a claim, and the node itself has to bear it out. First by the
topics that it names. A library that does not tell them (ROS makes none implement the whole slave
API) is asked for one of the topics that are registered for it: where it names a TCPROS port for
that, and is called there by a name that is registered, it is the one; so it is where it answers for
a service under that name.

Several names at one address are left by several processes, as a rule. Every node has /rosout, so of
names that have no other topic those count that it answers for by a service.
"""

from collections.abc import Collection, Iterable
from dataclasses import dataclass

from rosproxy.net.addresses import HostPort
from rosproxy.ros1.clients.master_client import MasterError, Unreachable
from rosproxy.ros1.clients.node_client import NodeClient
from rosproxy.ros1.protocol.uris import parse_service_uri
from rosproxy.ros1.registry.endpoint import Registration
from rosproxy.ros1.registry.graph import ROSOUT, NodeInfo
from rosproxy.ros1.upkeep.decisions import recovery_claims


@dataclass(frozen=True, slots=True)
class Verifier:
    """Asks nodes whether they are who they are said to be."""

    _nodes: NodeClient

    async def ask(
        self,
        slave: HostPort,
        registrations: Collection[Registration],
        service_ports: Iterable[int] = (),
    ) -> tuple[NodeInfo | None, bool | None]:
        """What the node at an address says of itself, and whether it is the one that registered.

        Both are None if nothing answers there; the second is, too, if it can't be told.
        ``service_ports`` are TCPROS ports at which it may have services.
        """
        info = await self._nodes.inspect(slave)
        if info is None:
            return None, None
        return info, await self.judge(slave, registrations, info, service_ports)

    async def judge(
        self,
        slave: HostPort,
        registrations: Collection[Registration],
        info: NodeInfo,
        service_ports: Iterable[int] = (),
    ) -> bool | None:
        """Whether the node that says this of itself is the one: one of the names is enough."""
        by_name = recovery_claims.by_name(registrations)
        verdicts = {name: recovery_claims.confirmed_by(by_name[name], info) for name in by_name}
        if True in verdicts.values():
            return True
        undecided = [r for r in registrations if verdicts[r.caller_id] is None]
        ports = {*info.topic_ports.values(), *service_ports}
        if await self._answers_for(slave, undecided, info, ports):
            return True
        return None if undecided or not registrations else False

    async def refuted(
        self,
        slave: HostPort,
        registrations: Collection[Registration],
        info: NodeInfo,
        service_ports: Iterable[int] = (),
    ) -> list[Registration]:
        """The registrations of names that are not the node's, which is one of several names."""
        by_name = recovery_claims.by_name(registrations)
        refuted = recovery_claims.unconfirmed_registrations(registrations, info)
        borne_out = by_name.keys() - {r.caller_id for r in refuted}
        doubtful = {n for n in borne_out if not recovery_claims.has_own_topic(by_name[n])}
        if len(borne_out) > 1 and doubtful:
            ports = {*info.topic_ports.values(), *service_ports}
            groups = (by_name[name] for name in doubtful)
            proven = {r[0].caller_id for r in groups if await self._serves(slave, r, ports)}
            # Where no name is better than the others, none is refuted.
            if proven or borne_out > doubtful:
                refuted += [r for name in doubtful - proven for r in by_name[name]]
        return refuted

    async def _answers_for(
        self, slave: HostPort, undecided: Collection[Registration], info: NodeInfo, ports: set[int]
    ) -> bool:
        """Whether it answers for a topic or service, by a name that has registered it."""
        callers = {r.caller_id for r in undecided}
        topics, services = recovery_claims.topics_and_services_to_ask(undecided)
        for topic in topics:
            port = info.topic_ports.get(topic) or await self._topic_port(slave, topic)
            if port is None:
                continue
            ports.add(port)
            name = await self._nodes.publisher(HostPort(slave.host, port), topic)
            # Some libraries answer nobody who takes any type, and so give no name: that they have a
            # port for the topic has to do. Of everybody's /rosout it shows nothing.
            if name in callers or (name is None and topic != ROSOUT):
                return True
        return await self._serves(slave, services, ports)

    async def _serves(
        self, slave: HostPort, registrations: Collection[Registration], ports: Collection[int]
    ) -> bool:
        """Whether it answers for a service, by a name that has registered one."""
        callers = {r.caller_id for r in registrations}
        _, services = recovery_claims.topics_and_services_to_ask(registrations)
        for service in services:
            provider = parse_service_uri(service.service_api or "")
            for port in {provider.port} if provider else ports:
                name = await self._nodes.provider(HostPort(slave.host, port), service.name)
                if name in callers:
                    return True
        return False

    async def _topic_port(self, slave: HostPort, topic: str) -> int | None:
        try:
            return await self._nodes.topic_port(slave, topic)
        except (Unreachable, MasterError):
            return None
