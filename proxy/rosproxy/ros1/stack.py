"""ROS 1 in a running proxy: makes, connects, starts and stops the parts.

Each part gets the parts that it needs, directly or as a `Protocol`, so the stack makes the parts
from the bottom up. There is one exception: a lease gives its connections to the servers, and the
servers may close the lease (``leases.server``).
"""

import asyncio
import logging
import resource
from collections.abc import Mapping
from typing import Any

from rosproxy.admin.admin_server import Action
from rosproxy.binding import RANGE_OPTION, report_taken_ports, setting_error_if_taken
from rosproxy.forwarding.fast_ports import BothSides
from rosproxy.forwarding.kernel.connection_table import ConnectionTable
from rosproxy.forwarding.kernel.plane import KernelPlane
from rosproxy.forwarding.kernel.table import TrackedTable
from rosproxy.forwarding.kernel.tools import Tools
from rosproxy.ros1.api.master import MasterApi, PublishedMaster
from rosproxy.ros1.api.slave import SlaveApi
from rosproxy.ros1.context import Context
from rosproxy.ros1.leases import Leases
from rosproxy.ros1.protocol.master_methods import KNOWN_METHODS
from rosproxy.ros1.range_probe import probe_range
from rosproxy.ros1.servers.admission import NodeAdmission
from rosproxy.ros1.servers.callers import Callers
from rosproxy.ros1.servers.tcpros_server import RATE_INTERVAL_S, TcprosServer
from rosproxy.ros1.servers.xmlrpc_server import Guard, XmlRpcServer
from rosproxy.ros1.stand_ins.stand_in_ports import TIDY_INTERVAL_S, StandInPorts
from rosproxy.ros1.status import Ros1State
from rosproxy.ros1.upkeep.adopter import Adopter
from rosproxy.ros1.upkeep.containers import ContainerEvents
from rosproxy.ros1.upkeep.lease_memory import LeaseMemory
from rosproxy.ros1.upkeep.master_monitor import MasterMonitor
from rosproxy.ros1.upkeep.message_counter import COUNT_INTERVAL_S, MessageCounter
from rosproxy.ros1.upkeep.policy_enforcer import ENFORCE_INTERVAL_S, PolicyEnforcer
from rosproxy.ros1.upkeep.prober import PROBE_CHECK_INTERVAL_S, Prober
from rosproxy.ros1.upkeep.publisher_updates import PublisherUpdates
from rosproxy.ros1.upkeep.recovery import Recovery
from rosproxy.ros1.upkeep.registrar import Registrar
from rosproxy.ros1.upkeep.resubscriber import RESUBSCRIBE_INTERVAL_S, Resubscriber
from rosproxy.runtime import Runtime
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.connections import sockets
from rosproxy.shared.connections.sockets import Acceptor
from rosproxy.shared.documents.requests import (
    ContainerUpdate,
    EmptyBody,
    EnforcementCounts,
    MasterAddress,
    PortProbe,
    read_body,
)
from rosproxy.shared.documents.status_document import ProxyStatus
from rosproxy.shared.setting_kinds import SettingError

log = logging.getLogger(__name__)

SPARE_FILES = 64
"""Open files that the proxy needs besides its ports and connections."""
RETRY_BLOCKED_S = 30.0
"""Seconds between two attempts to reserve ports that other programs held."""


class Ros1:
    """The part of the proxy for ROS 1. Call `start` and `stop` in the same event loop."""

    def __init__(self, runtime: Runtime) -> None:
        self.settings = settings = runtime.settings
        # Callers may invent method names without end, so all unknown names share one label.
        runtime.metrics.known_methods = KNOWN_METHODS
        self.context = context = Context(runtime)
        self.tcpros = TcprosServer(context)
        holders = BothSides(context.registry, context.stand_ins.by_port)
        table = TrackedTable(ConnectionTable(settings.master_port, settings.ports.listen), Tools())
        networks = context.client_networks
        self.plane = plane = KernelPlane(
            settings, holders, context.tasks, context.problems, context.now, table, networks
        )
        self._callers = Callers(context)
        self.stand_ins = StandInPorts(context, self._callers, self.tcpros, plane)
        self._publisher_updates = publisher_updates = PublisherUpdates(context, self.stand_ins)
        self._memory = LeaseMemory(context)
        self.registrar = registrar = Registrar(context, publisher_updates, self._memory)
        self._resubscriber = Resubscriber(
            context, registrar, publisher_updates, self.tcpros, plane, self.stand_ins
        )
        self.leases = leases = Leases(context, plane.syncer, self._resubscriber.watch)
        self._recovery = Recovery(
            context, leases, registrar, self._resubscriber, plane, self._memory
        )
        self._enforcer = PolicyEnforcer(
            context, leases, registrar, self._recovery, self.tcpros, plane, self.stand_ins
        )
        self._admission = NodeAdmission(context, leases, registrar, self._recovery)
        self.prober = Prober(context, leases, registrar, self._resubscriber, self._recovery)
        self.master_monitor = monitor = MasterMonitor(
            context, self._recovery, registrar, self._memory
        )
        self._messages = messages = MessageCounter(context)
        self._state = Ros1State(context, monitor, self.tcpros, self.stand_ins, plane, messages)
        self._adopter = Adopter(context, leases, self._admission, registrar)
        leases.server = slave = SlaveApi(
            context, leases, self.stand_ins, self._adopter, self.tcpros
        )
        self._servers = [slave.server, self.stand_ins.server]
        self._acceptors: list[Acceptor] = []
        self._containers = self._make_containers()

    def _make_containers(self) -> ContainerEvents:
        return ContainerEvents(
            self.context,
            self.leases,
            self.registrar,
            self._adopter,
            self._recovery,
            self._resubscriber,
            self.tcpros,
            self.plane,
        )

    def _make_master_api(self) -> MasterApi:
        return MasterApi(
            self.context,
            self._admission,
            self._adopter,
            self._recovery,
            self.stand_ins,
            self._publisher_updates,
            self._memory,
        )

    async def start(self) -> None:
        """Bind all ports and begin. Raises SettingError if a necessary port is taken."""
        settings = self.settings
        context = self.context
        self.reserve_range()
        # Before any port listens, because the kernel has to see connections from the beginning.
        await self.plane.start()
        master = self._make_master_api()
        context.tasks.spawn(self._callers.await_operator(), "waiting for an operator")
        guard = self._callers.refusal
        title = "ROS master API, proxied"
        self._listen("--master-port", settings.master_port, master, title, guard)
        if settings.publish_master is not None:
            advertised = HostPort(settings.advertise_host, settings.publish_master)
            published = PublishedMaster(context, str(advertised))
            self._listen("--publish-master", advertised.port, published, "ROS master API")
        context.metrics.registry.register(self._state)
        repeat = context.tasks.repeat
        repeat(self.master_monitor.look, settings.master_interval, "watching the master")
        repeat(self.prober.look, PROBE_CHECK_INTERVAL_S, "probing nodes")
        repeat(self.leases.retry_blocked, RETRY_BLOCKED_S, "retrying blocked ports")
        repeat(self._resubscriber.look, RESUBSCRIBE_INTERVAL_S, "checking subscribers")
        repeat(self.stand_ins.tidy, TIDY_INTERVAL_S, "checking stand-ins for nodes outside")
        repeat(self._messages.ask_due_nodes, COUNT_INTERVAL_S, "counting messages")
        repeat(self.tcpros.sample_rates, RATE_INTERVAL_S, "sampling rates")
        repeat(self._enforcer.enforce_if_changed, ENFORCE_INTERVAL_S, "enforcing the policy")

    @property
    def actions(self) -> Mapping[str, Action]:
        """The actions of posts to the admin endpoint, by path."""
        return {
            "/containers": self._handle_update,
            "/master-address": self._set_master_address,
            "/retire": self._retire,
        }

    @property
    def greeting(self) -> str:
        """How nodes use the proxy, for the log."""
        settings = self.settings
        return (
            f"nodes use http://<this host>:{settings.master_port} as ROS_MASTER_URI; master "
            f"{settings.master_uri}; outside sees {settings.advertise_host}:"
            f"{settings.ports.advertise}"
        )

    async def stop(self) -> None:
        """Stop all parts. Registrations stay at the master for the next start."""
        for acceptor in self._acceptors:
            acceptor.close()
        self.leases.close_all()
        self.stand_ins.close()
        await self.context.tasks.cancel()
        self.prober.kept_connections.close_all()
        # After the tasks: a task would repair the kernel's table.
        await self.plane.stop()
        servers = (server.close() for server in self._servers)
        await asyncio.gather(self.tcpros.relays.stop(), *servers)
        await self.context.close()

    @property
    def retired(self) -> bool:
        """Whether all nodes were unregistered for good."""
        return self.context.retired

    async def settle(self) -> None:
        """Wait until the master has answered, because `probe` has the master call the ports."""
        await self.master_monitor.answered.wait()

    async def probe(self, or_fast: bool) -> tuple[PortProbe, ...]:
        """Try whether outside reaches some ports of the range; see `probe_range`."""
        return await probe_range(self.context, self.leases, or_fast)

    async def try_ports(self) -> tuple[PortProbe, ...]:
        """Reserve, try and release the range, without a start. Raises SettingError."""
        try:
            self.reserve_range()
            return await self.probe(or_fast=True)
        finally:
            self.leases.close_all()
            await self.context.close()

    async def apply_policy(self) -> EnforcementCounts:
        """Enforce the policy now. Raises Unreachable, MasterError."""
        return await self._enforcer.enforce()

    def extended_status(self, status: ProxyStatus) -> ProxyStatus:
        """The status of the proxy, with the part for ROS 1."""
        return self._state.extended_status(status)

    def unready(self) -> str | None:
        """Why nodes cannot use the proxy now; None if nodes can."""
        if self.retired:
            return "the proxy is retired and accepts no registrations"
        if self.master_monitor.up:
            return None
        return (
            self.master_monitor.error
            or f"the proxy has not asked master {self.settings.master_uri} yet"
        )

    async def _handle_update(self, body: Any) -> dict[str, Any]:
        """``POST /containers``: return how many nodes were unregistered, moved and adopted.

        The selected addresses apply at once: nodes wait for the selection, which needs no master.
        """
        update = read_body(body, ContainerUpdate)
        if update.selected is not None:
            self._callers.select(update.selected)
        if not update.has_events:
            return {"moved": 0, "unregistered": 0, "adopted": 0}
        arrived = [(container.address, container.names) for container in update.arrived]
        return {**await self._containers.handle(update.gone, update.moved, arrived)}

    async def _retire(self, body: Any) -> dict[str, Any]:
        """``POST /retire``: return how many nodes were unregistered."""
        read_body(body, EmptyBody)
        count = await self._containers.retire()
        await self._memory.write()
        return {"unregistered": count}

    async def _set_master_address(self, body: Any) -> dict[str, Any]:
        """``POST /master-address``: set the address where the proxy looks for the master."""
        address = read_body(body, MasterAddress).address
        upstream = self.context.upstream
        if address != upstream.master_address:
            log.info(
                "master %s: the proxy connects to %s from now on", self.settings.master_uri, address
            )
            upstream.master_address = address
            self.context.outside_changed.set()
            self.context.tasks.spawn(self.master_monitor.look(), "looking for the master")
        return {"address": address}

    def reserve_range(self) -> None:
        """Reserve the ports of the range.

        Raises SettingError if no port is free, or if the process may open too few files.
        """
        ports = self.settings.ports.listen
        files, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
        if files != resource.RLIM_INFINITY and files < len(ports) + SPARE_FILES:
            needed = len(ports) + SPARE_FILES
            text = f"{ports} needs {needed} open files, and this process may have {files}"
            raise SettingError(RANGE_OPTION, f"{text}. Raise the limit (ulimit -Hn)")
        # Kept connections, up to one for each node, get at most half of the rest. Clients get all
        # other files.
        spare = max(files, 0) - len(ports) - SPARE_FILES
        self.prober.kept_connections.most = max(0, min(len(ports), spare // 2))
        self.context.gate.bound(spare - self.prober.kept_connections.most)
        taken = self.leases.reserve_range()
        report_taken_ports("1", self.settings, taken, self.context.problems)

    def _listen(
        self,
        option: str,
        port: int,
        service: MasterApi | PublishedMaster,
        title: str,
        guard: Guard | None = None,
    ) -> None:
        with setting_error_if_taken(option, f"port {port}"):
            sock = sockets.listen(self.settings.bind, port)
        context = self.context
        greeting = f"rosproxy: {title}; nodes use this address as ROS_MASTER_URI\n"
        server = XmlRpcServer(context, service, greeting, context.master_call, service, guard)
        self._servers.append(server)
        self._acceptors.append(Acceptor(context.tasks, sock, server.dispatch, context.gate))
