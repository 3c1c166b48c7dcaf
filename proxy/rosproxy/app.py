"""A running proxy: its parts put together, started and stopped."""

import asyncio
import logging
import socket
from typing import Any

from rosproxy.admin.range_probe import probe_range
from rosproxy.admin.requests import read_master_address
from rosproxy.admin.server import AdminServer
from rosproxy.admin.status import describe
from rosproxy.admin.status_document import to_json
from rosproxy.forwarding.kernel.plane import KernelPlane
from rosproxy.net import limits, listeners
from rosproxy.net.acceptor import Acceptor, first_bytes
from rosproxy.net.addresses import HostPort
from rosproxy.net.http_server import Service, XmlRpcServer
from rosproxy.ros1.alias.alias import TIDY_INTERVAL, Alias
from rosproxy.ros1.clients.node import NodeClient
from rosproxy.ros1.context import make_context
from rosproxy.ros1.protocol.tcpros import speaks_http
from rosproxy.ros1.registry.endpoint import Endpoint
from rosproxy.ros1.registry.leases import Leases
from rosproxy.ros1.servers.master import MasterApi, PublishedMaster
from rosproxy.ros1.servers.slave import SlaveApi
from rosproxy.ros1.servers.tcpros import RATE_INTERVAL, TcprosServer
from rosproxy.ros1.upkeep.adoption.adopter import Adopter
from rosproxy.ros1.upkeep.containers.events import ContainerEvents
from rosproxy.ros1.upkeep.master_monitor import MasterMonitor
from rosproxy.ros1.upkeep.prober.prober import PROBE_TICK, Prober
from rosproxy.ros1.upkeep.publisher_updates import PublisherUpdates
from rosproxy.ros1.upkeep.recovery.recovery import Recovery
from rosproxy.ros1.upkeep.registration.registrar import Registrar
from rosproxy.ros1.upkeep.resubscription.resubscriber import RESUBSCRIBE_TICK, Resubscriber
from rosproxy.settings import SettingError, Settings
from rosproxy.telemetry.metrics import StateCollector

log = logging.getLogger(__name__)

RETRY_BLOCKED = 30.0
"""Seconds between looks whether ports that other programs held have become free."""


class App:
    """One proxy. `start` it in a running event loop, `stop` it in the same."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.context = context = make_context(settings)
        nodes = NodeClient(context.upstream, settings.probe_timeout)
        self._tcpros = TcprosServer(context, nodes)
        self._plane = KernelPlane(context)
        self.alias = Alias(context)
        updates = PublisherUpdates(context, self.alias)
        self.registrar = registrar = Registrar(context, nodes, updates)
        self._resubscriber = Resubscriber(context, registrar, updates, self._tcpros, self._plane)
        self._leases = Leases(
            context,
            nodes,
            self._plane,
            self._connection,
            self._close_port,
            lambda endpoint: self._resubscriber.watch([endpoint]),
        )
        self._recovery = Recovery(
            context, self._leases, nodes, registrar, self._resubscriber, self._plane
        )
        self.prober = Prober(
            context, self._leases, nodes, registrar, self._resubscriber, self._recovery
        )
        self.master_monitor = MasterMonitor(context, self._recovery, registrar)
        self._adopter = Adopter(context, self._leases, nodes, registrar)
        self._slaves = XmlRpcServer(
            SlaveApi(context, self._leases, self.alias, self._adopter),
            "rosproxy: slave API of a ROS node behind it\n",
        )
        self._servers = [self._slaves]
        self._acceptors: list[Acceptor] = []
        self._admin = self._make_admin(nodes)

    async def start(self) -> None:
        """Bind all ports and begin. Raises SettingError if a port is taken."""
        self._check_bind()
        self._reserve_range()
        await self._plane.start()
        settings = self.settings
        master = MasterApi(self.context, self._leases, self.alias, self._recovery, self._adopter)
        self._listen("--master-port", settings.master_port, master, "ROS master API, proxied")
        if settings.publish_master is not None:
            where = HostPort(settings.advertise_host, settings.publish_master)
            published = PublishedMaster(self.context, str(where))
            self._listen("--publish-master", where.port, published, "ROS master API")
        self.context.metrics.registry.register(self._state_metrics())
        await self._start_admin()
        repeat = self.context.tasks.repeat
        repeat(self.master_monitor.look, settings.master_interval, "watching the master")
        repeat(self.prober.look, PROBE_TICK, "looking after nodes")
        repeat(self._leases.retry_blocked, RETRY_BLOCKED, "retrying blocked ports")
        repeat(self._resubscriber.look, RESUBSCRIBE_TICK, "looking after subscribers")
        repeat(self.alias.tidy, TIDY_INTERVAL, "looking after the alias's ports")
        repeat(self._tcpros.sample_rates, RATE_INTERVAL, "sampling rates")
        self._log_start()

    async def stop(self) -> None:
        """End everything; registrations stay at the master, for the next start to find."""
        for acceptor in self._acceptors:
            acceptor.stop()
            acceptor.sock.close()
        for endpoint in self.context.registry:
            self._leases.close(endpoint)
        self.context.bank.close_all()
        self.alias.close()
        await self.context.tasks.cancel()
        await self._plane.stop()
        servers = (server.close() for server in self._servers)
        await asyncio.gather(self._admin.stop(), self._tcpros.stop(), self.alias.stop(), *servers)
        await self.context.upstream.close()

    def status(self) -> dict[str, Any]:
        """The state as JSON."""
        return to_json(
            describe(self.context, self.master_monitor, self._tcpros, self.alias, self._plane)
        )

    def _make_admin(self, nodes: NodeClient) -> AdminServer:
        containers = ContainerEvents(
            self.context,
            self._leases,
            nodes,
            self.registrar,
            self._adopter,
            self._recovery,
            self._tcpros,
            self._plane,
        )
        actions = {
            "/probe": self._probe,
            "/containers": containers.handle,
            "/master-address": self._set_master_address,
            "/retire": containers.retire,
        }
        return AdminServer(
            self.context.metrics.registry,
            self.status,
            self._unready,
            actions,
            self.settings.admin_token,
        )

    def _unready(self) -> str | None:
        if self.context.retired:
            return "retired: nothing is registered any more"
        if self.master_monitor.up:
            return None
        return self.master_monitor.error or f"master {self.settings.master_uri} was not asked yet"

    async def _probe(self, body: Any) -> dict[str, Any]:
        return to_json(await probe_range(self.context, self._leases))

    async def _set_master_address(self, body: Any) -> dict[str, Any]:
        """``POST /master-address``: where the master is looked for from now on."""
        address, upstream = read_master_address(body), self.context.upstream
        if address != upstream.master_address:
            log.info("master %s is looked for at %s", self.settings.master_uri, address)
            upstream.master_address = address
            self.context.tasks.spawn(self.master_monitor.look(), "looking for the master")
        return {"address": address}

    async def _connection(self, endpoint: Endpoint, conn: socket.socket, peer: str) -> None:
        """Serve a connection to a lease: XML-RPC or TCPROS, by its first bytes."""
        first = await first_bytes(conn)
        if len(first) < 4:
            conn.close()
        elif speaks_http(first):
            await self._slaves.serve(conn)
        else:
            await self._tcpros.serve(endpoint, conn, peer)

    def _close_port(self, port: int) -> None:
        self._slaves.close_port(port)

    def _check_bind(self) -> None:
        try:
            listeners.bind(self.settings.bind, 0).close()
        except OSError as error:
            text = f"{self.settings.bind} can't be bound: {error.strerror}"
            raise SettingError("--bind", text) from None

    def _reserve_range(self) -> None:
        ports = self.settings.ports.listen
        if not limits.files_for(len(ports)):
            text = f"{ports} are more ports than this process may have open files (ulimit -Hn)"
            raise SettingError("--port-range", text)
        taken = self.context.bank.reserve(ports.ports())
        for port in taken:
            self.context.registry.pool.block(port)
        if len(taken) == len(ports):
            raise SettingError("--port-range", f"no port of {ports} can be bound; all are taken")
        if taken:
            text = f"ports of --port-range {ports} held by other programs: {taken}"
            log.warning("%s", text)
            self.context.problems.add("--port-range", text)

    def _listen(self, option: str, port: int, service: Service, what: str) -> None:
        try:
            sock = listeners.listen(self.settings.bind, port)
        except OSError as error:
            raise SettingError(option, f"port {port} can't be bound: {error.strerror}") from None
        server = XmlRpcServer(service, f"rosproxy: {what}; nodes use it by ROS_MASTER_URI\n")
        self._servers.append(server)
        self._acceptors.append(
            Acceptor(self.context.tasks, sock, lambda conn, peer: _serve_speaker(server, conn))
        )

    async def _start_admin(self) -> None:
        try:
            await self._admin.start(self.settings.admin)
        except OSError as error:
            raise SettingError(
                "--admin-bind", f"{self.settings.admin} can't be bound: {error.strerror}"
            ) from None

    def _state_metrics(self) -> StateCollector:
        return StateCollector(
            self.context.registry,
            self._tcpros.traffic,
            lambda: len(self._tcpros.relays),
            lambda: len(self.alias),
            lambda: bool(self.master_monitor.up),
            self._plane.tally,
        )

    def _log_start(self) -> None:
        settings = self.settings
        log.info(
            "ready: nodes use http://<this host>:%d as ROS_MASTER_URI; master %s; outside sees "
            "%s:%s",
            settings.master_port,
            settings.master_uri,
            settings.advertise_host,
            settings.ports.advertise,
        )


async def _serve_speaker(server: XmlRpcServer, conn: socket.socket) -> None:
    """Serve a connection once its client has said something; silent ones time out."""
    if await first_bytes(conn):
        await server.serve(conn)
    else:
        conn.close()


async def serve(settings: Settings, stopped: asyncio.Event) -> None:
    """Run a proxy until ``stopped`` is set. Raises SettingError if a port is taken."""
    limits.raise_file_limit()
    app = App(settings)
    try:
        await app.start()
        await stopped.wait()
    finally:
        await app.stop()
