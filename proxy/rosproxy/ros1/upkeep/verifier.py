"""Check whether the node at an address is the node that the master or an operator names.

The master names the node after a restart of the proxy, an operator when a container moves or
arrives. Any program can write to the master, so both are only claims, and the node itself has to
confirm the claim. The topics that the node names decide first.

Some client libraries do not tell their topics, because no library has to implement the whole slave
API. The proxy asks such a node for a registered topic. If the node names a TCPROS port for the
topic, and a program at this port answers by a registered name, the node confirms the claim. The
same holds if a program answers for a registered service by such a name.

If the master has several names at one address, several processes have usually left these names.
Nearly every node has /rosout, which identifies no node. So a name without other topics has to be
confirmed by a service.
"""

from collections.abc import Collection, Iterable
from dataclasses import dataclass

from rosproxy.ros1.clients.master_client import MasterError, Unreachable
from rosproxy.ros1.clients.node_client import NodeClient
from rosproxy.ros1.registry.endpoint import Registration
from rosproxy.ros1.registry.graph import ROSOUT, NodeInfo
from rosproxy.ros1.upkeep.decisions import recovery_claims
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.uris import parse_service_uri


@dataclass(frozen=True, slots=True)
class Verifier:
    """Asks nodes whether they have the registrations that the master has for them."""

    _nodes: NodeClient

    async def ask(
        self,
        slave: HostPort,
        registrations: Collection[Registration],
        service_ports: Iterable[int] = (),
    ) -> tuple[NodeInfo | None, bool | None]:
        """Ask the node at an address about itself, and judge whether it made the registrations.

        ``service_ports`` are TCPROS ports at which the node may have services.

        Returns:
            What the node says about itself, and the verdict of `judge`. Both are None if no node
            answers.
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
        """Whether a node made the registrations: a single confirmed name is enough.

        ``info`` is what the node says about itself. None if the node confirms nothing, and names
        are left that the proxy cannot check, or if there are no registrations.
        """
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
        """The registrations of names that the master has here, but that belong to other nodes."""
        by_name = recovery_claims.by_name(registrations)
        refuted = recovery_claims.unconfirmed_registrations(registrations, info)
        borne_out = by_name.keys() - {r.caller_id for r in refuted}
        doubtful = {n for n in borne_out if not recovery_claims.has_own_topic(by_name[n])}
        if len(borne_out) > 1 and doubtful:
            ports = {*info.topic_ports.values(), *service_ports}
            groups = (by_name[name] for name in doubtful)
            proven = {r[0].caller_id for r in groups if await self._serves(slave, r, ports)}
            # If no name has better evidence than the others, the verifier refutes none.
            if proven or borne_out > doubtful:
                refuted += [r for name in doubtful - proven for r in by_name[name]]
        return refuted

    async def _answers_for(
        self, slave: HostPort, undecided: Collection[Registration], info: NodeInfo, ports: set[int]
    ) -> bool:
        """Whether the node answers for a topic or service, by a name that registered this topic."""
        callers = {r.caller_id for r in undecided}
        topics, services = recovery_claims.topics_and_services_to_ask(undecided)
        for topic in topics:
            port = info.topic_ports.get(topic) or await self._topic_port(slave, topic)
            if port is None:
                continue
            ports.add(port)
            name = await self._nodes.publisher(HostPort(slave.host, port), topic)
            # Some libraries do not answer a caller that accepts any type, and so give no name. A
            # port for the topic is enough then, but not for /rosout, which nearly every node has.
            if name in callers or (name is None and topic != ROSOUT):
                return True
        return await self._serves(slave, services, ports)

    async def _serves(
        self, slave: HostPort, registrations: Collection[Registration], ports: Collection[int]
    ) -> bool:
        """Whether the node answers for a service, by a name that has registered a service."""
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
