"""A running proxy: its parts put together, started and stopped.

Each part is given those that it needs, as they are or as a `Protocol`. They are made from the
bottom up. One thing goes the other way: a leased port hands its connections to the servers, which
in turn may close the port (``leases.server``).
"""

import asyncio
import contextlib
import logging
import resource
import signal
from collections.abc import Callable, Iterator
from typing import Any

from rosproxy.access.layers import read_layer
from rosproxy.access.policy_file import LOOK_INTERVAL, OPTION, PolicyFile
from rosproxy.admin.range_probe import probe_range
from rosproxy.admin.requests import (
    BodyError,
    ContainerNews,
    MasterAddress,
    Nothing,
    PolicyNews,
    read_body,
)
from rosproxy.admin.server import AdminServer
from rosproxy.admin.status import ProxyState
from rosproxy.admin.status_document import to_json
from rosproxy.forwarding.kernel.plane import KernelPlane
from rosproxy.leases.leases import RANGE_OPTION, Leases
from rosproxy.net import sockets
from rosproxy.net.addresses import HostPort
from rosproxy.net.sockets import Acceptor
from rosproxy.ros1.api.master import MasterApi, PublishedMaster
from rosproxy.ros1.api.slave import SlaveApi
from rosproxy.ros1.context import Context
from rosproxy.ros1.servers.admission import NodeAdmission
from rosproxy.ros1.servers.callers import Callers
from rosproxy.ros1.servers.judge import PolicyJudge
from rosproxy.ros1.servers.tcpros import RATE_INTERVAL, TcprosServer
from rosproxy.ros1.servers.xmlrpc_server import Guard, XmlRpcServer
from rosproxy.ros1.standins.ports import TIDY_INTERVAL, StandInPorts
from rosproxy.ros1.upkeep.adopter import Adopter
from rosproxy.ros1.upkeep.containers import ContainerEvents
from rosproxy.ros1.upkeep.master_monitor import MasterMonitor
from rosproxy.ros1.upkeep.matchmaker import Matchmaker
from rosproxy.ros1.upkeep.policy_enforcer import ENFORCE_TICK, PolicyEnforcer
from rosproxy.ros1.upkeep.prober import PROBE_TICK, Prober
from rosproxy.ros1.upkeep.recovery import Recovery
from rosproxy.ros1.upkeep.registrar import Registrar
from rosproxy.ros1.upkeep.resubscriber import RESUBSCRIBE_TICK, Resubscriber
from rosproxy.ros1.upkeep.service_finder import ServiceFinder
from rosproxy.settings import SettingError, Settings

log = logging.getLogger(__name__)

new_event_loop: Callable[[], asyncio.AbstractEventLoop] = asyncio.new_event_loop
with contextlib.suppress(ImportError):
    from uvloop import new_event_loop

SPARE_FILES = 64
"""Open files that the proxy needs besides its ports and connections."""
RETRY_BLOCKED = 30.0
"""Seconds between looks whether ports that other programs held have become free."""


class App:
    """One proxy. `start` it in a running event loop, `stop` it in the same."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.context = context = Context(settings)
        self._judge = judge = PolicyJudge(
            context.policy, context.registry, context.addressing, context.upstream
        )
        self.tcpros = TcprosServer(context)
        self.plane = plane = KernelPlane(
            settings, context.registry, context.tasks, context.problems, context.now
        )
        self._callers, self._probing = Callers(context), asyncio.Lock()
        self.stand_ins = StandInPorts(context, self._callers, self.tcpros, judge)
        self._matchmaker = matchmaker = Matchmaker(context, self.stand_ins)
        self.registrar = registrar = Registrar(context, matchmaker)
        udpros = self.stand_ins.udpros
        self._resubscriber = Resubscriber(
            context, registrar, matchmaker, self.tcpros, plane, udpros
        )
        self.leases = leases = Leases(
            context.registry,
            settings.bind,
            plane.syncer,
            self._resubscriber.watch,
            context.tasks,
            context.problems,
            context.gate,
        )
        self._recovery = Recovery(context, leases, registrar, self._resubscriber, plane, judge)
        self._enforcer = PolicyEnforcer(
            context, leases, registrar, self._recovery, self.tcpros, plane, judge, udpros
        )
        self._admission = NodeAdmission(context, leases, registrar, self._recovery)
        self.prober = Prober(context, leases, registrar, self._resubscriber, self._recovery)
        self.master_monitor = monitor = MasterMonitor(context, self._recovery, registrar)
        self._state = ProxyState(context, monitor, self.tcpros, self.stand_ins, plane)
        self._adopter = Adopter(context, leases, self._admission, registrar)
        leases.server = slave = SlaveApi(
            context, leases, self.stand_ins, self._adopter, self.tcpros, judge
        )
        self._servers = [slave.server, self.stand_ins.server]
        self._acceptors: list[Acceptor] = []
        self._containers = ContainerEvents(
            context, leases, registrar, self._adopter, self._recovery, self.tcpros, plane
        )
        self._admin = self._make_admin()

    def _make_master_api(self) -> MasterApi:
        return MasterApi(
            self.context,
            self._admission,
            self.stand_ins,
            self._recovery,
            self._adopter,
            self._judge,
            self._matchmaker,
            self._enforcer,
            ServiceFinder(self.context),
        )

    def _make_admin(self) -> AdminServer:
        actions = {
            "/probe": self._probe,
            "/containers": self._handle_news,
            "/master-address": self._set_master_address,
            "/retire": self._retire,
            "/policy": self._set_policy,
        }
        metrics, token_hash = self.context.metrics.registry, self.settings.token_hash
        return AdminServer(metrics, self.status, self._unready, actions, token_hash)

    async def start(self) -> None:
        """Bind all ports and begin. Raises SettingError if a port is taken."""
        settings, context = self.settings, self.context
        with _binding("--bind", settings.bind):
            sockets.bind(settings.bind, 0).close()
        policy_file = self._read_policy_file()
        self._reserve_range()
        await self.plane.start()
        master = self._make_master_api()
        context.tasks.spawn(self._callers.hold(), "waiting for an operator")
        guard, what = self._callers.refusal, "ROS master API, proxied"
        self._listen("--master-port", settings.master_port, master, what, guard)
        if settings.publish_master is not None:
            where = HostPort(settings.advertise_host, settings.publish_master)
            published = PublishedMaster(context, str(where))
            self._listen("--publish-master", where.port, published, "ROS master API")
        context.metrics.registry.register(self._state)
        with _binding("--admin-bind", settings.admin):
            await self._admin.start(settings.admin)
        repeat = context.tasks.repeat
        repeat(self.master_monitor.look, settings.master_interval, "watching the master")
        repeat(self.prober.look, PROBE_TICK, "looking after nodes")
        repeat(self.leases.retry_blocked, RETRY_BLOCKED, "retrying blocked ports")
        repeat(self._resubscriber.look, RESUBSCRIBE_TICK, "looking after subscribers")
        repeat(self.stand_ins.tidy, TIDY_INTERVAL, "looking after nodes outside")
        repeat(self.tcpros.sample_rates, RATE_INTERVAL, "sampling rates")
        repeat(self._enforcer.look, ENFORCE_TICK, "enforcing the policy")
        if policy_file is not None:
            repeat(policy_file.look, LOOK_INTERVAL, "looking at the policy's file")
        log.info(
            "ready: nodes use http://<this host>:%d as ROS_MASTER_URI; master %s; outside sees "
            "%s:%s",
            settings.master_port,
            settings.master_uri,
            settings.advertise_host,
            settings.ports.advertise,
        )

    async def stop(self) -> None:
        """End everything; registrations stay at the master, for the next start to find."""
        for acceptor in self._acceptors:
            acceptor.close()
        self.leases.close_all()
        self.stand_ins.close()
        await self.context.tasks.cancel()
        await self.plane.stop()
        servers = (server.close() for server in self._servers)
        await asyncio.gather(self._admin.stop(), self.tcpros.relays.stop(), *servers)
        await self.context.upstream.close()

    def status(self) -> dict[str, Any]:
        """The state as JSON."""
        return to_json(self._state.status())

    def _unready(self) -> str | None:
        if self.context.retired:
            return "retired: nothing is registered any more"
        if self.master_monitor.up:
            return None
        return self.master_monitor.error or f"master {self.settings.master_uri} was not asked yet"

    async def _probe(self, body: Any) -> dict[str, Any]:
        async with self._probing:
            return to_json(await probe_range(self.context, self.leases))

    async def _handle_news(self, body: Any) -> dict[str, Any]:
        """``POST /containers``: how many nodes were unregistered, moved and adopted.

        Who is selected is taken in at once: nodes wait for that, and it needs no master.
        """
        news = read_body(body, ContainerNews)
        if news.selected is not None:
            self._callers.select(news.selected)
        if not news.tells_events:
            return {"moved": 0, "unregistered": 0, "adopted": 0}
        arrived = [(one.address, one.names) for one in news.arrived]
        return {**await self._containers.handle(news.gone, news.moved, arrived)}

    async def _retire(self, body: Any) -> dict[str, Any]:
        """``POST /retire``: how many nodes were unregistered."""
        read_body(body, Nothing)
        return {"unregistered": await self._containers.retire()}

    async def _set_master_address(self, body: Any) -> dict[str, Any]:
        """``POST /master-address``: where the master is looked for from now on."""
        address, upstream = read_body(body, MasterAddress).address, self.context.upstream
        if address != upstream.master_address:
            log.info("master %s is looked for at %s", self.settings.master_uri, address)
            upstream.master_address = address
            self.context.tasks.spawn(self.master_monitor.look(), "looking for the master")
        return {"address": address}

    async def _set_policy(self, body: Any) -> dict[str, Any]:
        """``POST /policy``: how many registrations are hidden and shown now, and what was cut."""
        written = read_body(body, PolicyNews).layers
        try:
            self.context.policy.use_told([read_layer(one) for one in written])
        except ValueError as error:
            raise BodyError(f"layers: {error}") from None
        return to_json(await self._enforcer.enforce())

    def _read_policy_file(self) -> PolicyFile | None:
        settings, context = self.settings, self.context
        if not settings.policy_file:
            return None
        file = PolicyFile(
            settings.policy_file, settings.policy_mode, context.policy, context.problems
        )
        try:
            file.read()
        except ValueError as error:
            raise SettingError(OPTION, str(error)) from None
        return file

    def _reserve_range(self) -> None:
        ports = self.settings.ports.listen
        files, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
        if files != resource.RLIM_INFINITY and files < len(ports) + SPARE_FILES:
            text = f"{ports} are more ports than this process may have open files (ulimit -Hn)"
            raise SettingError(RANGE_OPTION, text)
        self.context.gate.bound(max(files, 0) - len(ports) - SPARE_FILES)
        taken = self.leases.reserve_range()
        if len(taken) == len(ports):
            raise SettingError(RANGE_OPTION, f"no port of {ports} can be bound; all are taken")
        if taken:
            text = f"ports of --port-range {ports} held by other programs: {taken}"
            log.warning("%s", text)
            self.context.problems.add(RANGE_OPTION, text)

    def _listen(
        self,
        option: str,
        port: int,
        service: MasterApi | PublishedMaster,
        what: str,
        guard: Guard | None = None,
    ) -> None:
        with _binding(option, f"port {port}"):
            sock = sockets.listen(self.settings.bind, port)
        context, greeting = self.context, f"rosproxy: {what}; nodes use it by ROS_MASTER_URI\n"
        server = XmlRpcServer(context, service, greeting, context.master_call, service, guard)
        self._servers.append(server)
        self._acceptors.append(Acceptor(context.tasks, sock, server.dispatch, context.gate))


@contextlib.contextmanager
def _binding(option: str, what: object) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise SettingError(option, f"{what} can't be bound: {error.strerror}") from None


def run(settings: Settings) -> None:
    """Run a proxy until a signal ends it. Raises SettingError if a port is taken."""
    with asyncio.Runner(loop_factory=new_event_loop) as runner:
        runner.run(_run_until_signal(settings))


async def _run_until_signal(settings: Settings) -> None:
    stopped = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stopped.set)
    _raise_file_limit()
    app = App(settings)
    try:
        await app.start()
        await stopped.wait()
    finally:
        await app.stop()


def _raise_file_limit() -> None:
    """Have as many open files as the system lets this process have at most (``ulimit -Hn``).

    Each relayed connection takes up to six: two sockets and two pipes.
    """
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
