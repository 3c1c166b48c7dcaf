"""Act on reports of an operator about containers (``POST /containers``) and retire (``/retire``).

- *gone*: the proxy unregisters nodes at these addresses at once if they do not answer, and the
  ports refuse connections.
- *moved*: nodes that answer at the new address keep their ports, and the proxy tells subscribers.
- *arrived*: the proxy adopts nodes that registered at the real master directly (`adopter`).
"""

import asyncio
import contextlib
import logging
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

from rosproxy.forwarding.kernel.plane import KernelPlane
from rosproxy.ros1.clients.master_client import MasterError, Unreachable
from rosproxy.ros1.context import Context
from rosproxy.ros1.leases import Leases
from rosproxy.ros1.registry.endpoint import Endpoint
from rosproxy.ros1.registry.graph import NodeInfo
from rosproxy.ros1.registry.node_health import ProbeResult
from rosproxy.ros1.servers.tcpros_server import TcprosServer
from rosproxy.ros1.upkeep.adopter import Adopter
from rosproxy.ros1.upkeep.decisions import liveness
from rosproxy.ros1.upkeep.decisions.adoption import Container
from rosproxy.ros1.upkeep.recovery import Recovery
from rosproxy.ros1.upkeep.registrar import Registrar
from rosproxy.ros1.upkeep.resubscriber import Resubscriber
from rosproxy.ros1.upkeep.verifier import Verifier
from rosproxy.shared.addresses import HostPort

log = logging.getLogger(__name__)

GONE_PROBE_TIMEOUT_S = 0.5
"""Seconds within which a node must answer at an address that the operator reports as gone."""
YOUNG_NODE_AGE_S = 3.0
"""Age of the last registration, in seconds, up to which a silent node gets a second chance."""
SECOND_PROBE_DELAY_S = 1.0
"""Seconds after which the proxy probes a silent node a second time."""
RETIRE_TIMEOUT_S = 3.0
"""Seconds that the proxy waits for pending registrations before it retires."""


@dataclass(slots=True)
class ContainerEvents:
    """Acts on reports of an operator, which knows of changes before any time-out ends."""

    context: Context
    leases: Leases
    registrar: Registrar
    adopter: Adopter
    recovery: Recovery
    resubscriber: Resubscriber
    tcpros: TcprosServer
    plane: KernelPlane
    _lock: asyncio.Lock = field(default_factory=asyncio.Lock)

    async def handle(
        self, gone: Collection[str], moved: Mapping[str, str], arrived: Sequence[Container]
    ) -> dict[str, int]:
        """``POST /containers``: return how many nodes were unregistered, moved and adopted.

        ``moved`` maps old addresses to new addresses. An operator may safely send the same report
        again. Raises Unreachable or MasterError after all steps were tried.
        """
        # In this order: after the move, no moved node is left at an address that is also gone.
        steps = {
            "moved": partial(self._move, moved),
            "unregistered": partial(self._remove, gone),
            "adopted": partial(self.adopter.adopt, arrived),
        }
        counts: dict[str, int] = {}
        failed: Exception | None = None
        async with self._lock:
            await self.recovery.ensure()
            self.context.read_networks()
            for action, step in steps.items():
                try:
                    counts[action] = await step()
                except (Unreachable, MasterError) as error:
                    failed = failed or error
        if failed:
            raise failed
        return counts

    async def retire(self) -> int:
        """``POST /retire``: unregister all nodes, and register none from now on.

        Returns the number of node names. Raises Unreachable, MasterError.
        """
        self.context.retired = True  # before the wait: no node registers meanwhile
        async with self._lock:
            await self.recovery.ensure()
            end = self.context.now() + RETIRE_TIMEOUT_S
            registry = self.context.registry
            while any(e.pending for e in registry) and self.context.now() < end:  # noqa: ASYNC110
                await asyncio.sleep(0.01)
            endpoints = list(registry)
            count = await self._unregister(e for e in endpoints if not e.health.cleaned)
            for endpoint in endpoints:
                self._cut(endpoint)
                self.leases.end(endpoint)
        log.info("retired: %d nodes unregistered; waiting to be stopped", count)
        return count

    async def _remove(self, addresses: Collection[str]) -> int:
        """Unregister the nodes at addresses that are gone, unless the nodes answer."""
        endpoints = [e for e in self.context.registry if e.location.address in addresses]
        return await self._remove_dead(endpoints, self.context.now() - YOUNG_NODE_AGE_S)

    async def _remove_dead(self, endpoints: Sequence[Endpoint], since: float) -> int:
        """Unregister nodes that do not answer; probe silent nodes with newer registrations later.

        ``since``: the time from which registrations count as new.
        """
        probe = self.context.nodes.probe
        answers = await asyncio.gather(*(probe(e.slave, GONE_PROBE_TIMEOUT_S) for e in endpoints))
        outcomes = {e: answer.probe for e, answer in zip(endpoints, answers, strict=True)}
        dead = liveness.dead_endpoints(outcomes, since)
        for endpoint in dead:
            self._close(endpoint)
        alive = [endpoint for endpoint in endpoints if endpoint not in dead]
        for endpoint in alive:
            endpoint.health.probe_soon()  # another process may have the address meanwhile
        silent = [e for e in alive if outcomes[e] is ProbeResult.SILENT]
        if silent:
            self.context.tasks.spawn(self._remove_later(silent), "probing silent nodes again")
        return await self._unregister(e for e in dead if not e.health.cleaned)

    async def _remove_later(self, silent: Sequence[Endpoint]) -> None:
        """Probe silent nodes again. If this fails, the prober unregisters the nodes later."""
        await asyncio.sleep(SECOND_PROBE_DELAY_S)
        async with self._lock:
            current = [e for e in silent if self.context.registry.by_port.get(e.port) is e]
            with contextlib.suppress(Unreachable, MasterError):
                await self._remove_dead(current, float("inf"))

    async def _move(self, moved: Mapping[str, str]) -> int:
        """Move endpoints to the new addresses of their containers; return the number of nodes."""
        registry = self.context.registry
        addressing = self.context.addressing
        candidates = liveness.new_addresses(registry, moved, addressing.networks)
        answers = await asyncio.gather(*(self._inspect(e, new) for e, new in candidates.items()))
        infos = {e: info for e, info in zip(candidates, answers, strict=True) if info}
        former_uris = {endpoint: addressing.advertised_uri(endpoint) for endpoint in infos}
        locations = {e: liveness.moved_location(e, candidates[e]) for e in infos}
        relocated = registry.move(locations)
        for endpoint in relocated:
            self._settle(endpoint, former_uris[endpoint], infos[endpoint])
        await self.registrar.resettle(relocated)
        await self.resubscriber.announce(relocated)  # the URIs are unchanged, connections are lost
        for endpoint in set(infos) - set(relocated):
            # The node has already registered from its new address, and holds another port there.
            slave = HostPort(locations[endpoint].address, endpoint.node.port)
            successor = registry.by_slave.get(slave)
            self._close(endpoint)
            await self.registrar.clean_up(endpoint)
            if successor is not None:
                await self.registrar.register_missing(successor, infos[endpoint])
        return sum(len(endpoint.caller_ids) for endpoint in relocated)

    async def _inspect(self, endpoint: Endpoint, address: str) -> NodeInfo | None:
        """What the node of an endpoint says at another address, if the same node answers there."""
        registrations = list(endpoint.registrations.values())
        slave = HostPort(address, endpoint.node.port)
        ports = list(endpoint.service_ports)
        info, is_confirmed = await Verifier(self.context.nodes).ask(slave, registrations, ports)
        known_pid = endpoint.health.pid
        if info is None or not liveness.is_same_process(known_pid, info.pid, is_confirmed):
            return None
        return info

    def _settle(self, endpoint: Endpoint, former_uri: str, info: NodeInfo) -> None:
        """Serve a node at its new address. The master still has the former URI."""
        endpoint.note_moved(former_uri, self.context.addressing.advertised_uri(endpoint))
        endpoint.mark_alive(info.pid, info.topic_ports, self.context.now())
        self._cut(endpoint)
        self.context.problems.solved_at(endpoint.port)
        self.leases.open(endpoint)
        address = endpoint.location.address
        fields = endpoint.log_fields
        log.info("%s moved to %s", endpoint.label, address, extra=fields)

    async def _unregister(self, endpoints: Iterable[Endpoint]) -> int:
        """Unregister nodes; return the number of node names."""
        registered = [endpoint for endpoint in endpoints if endpoint.registrations]
        await asyncio.gather(*map(self.registrar.clean_up, registered))
        return sum(len(endpoint.caller_ids) for endpoint in registered)

    def _close(self, endpoint: Endpoint) -> None:
        """Make the port of an ended node refuse connections, and cut the open connections."""
        endpoint.health.end(self.context.now())
        if self.context.registry.by_port.get(endpoint.port) is not endpoint:
            return  # during the probe, a live node got the port of this dead node
        self.leases.close(endpoint)
        self._cut(endpoint)
        self.context.problems.solved_at(endpoint.port)

    def _cut(self, endpoint: Endpoint) -> None:
        """End the connections to a node, also connections that the kernel forwards."""
        self.tcpros.cut(endpoint.port)
        self.plane.cut(endpoint)
