"""rmw_zenoh in a running proxy: the routers, their links, and what is wrong with them."""

import asyncio
import logging
from collections.abc import Mapping
from importlib import metadata

from msgspec.structs import replace

from rosproxy.admin.admin_server import Action
from rosproxy.admin.doctor_finding import DoctorFinding
from rosproxy.admin.requests import EnforcementCounts, PortProbe
from rosproxy.admin.status_document import ProxyStatus
from rosproxy.binding import setting_error_if_taken
from rosproxy.net import sockets
from rosproxy.net.resolver import resolve
from rosproxy.runtime import Runtime
from rosproxy.setting_kinds import SettingError
from rosproxy.settings import Settings
from rosproxy.telemetry.text import listed
from rosproxy.zenoh import findings
from rosproxy.zenoh.link_probe import try_link
from rosproxy.zenoh.links import Link
from rosproxy.zenoh.protocol.report import Report
from rosproxy.zenoh.router_configs import router_configs
from rosproxy.zenoh.router_keeper import RouterKeeper, RoutersFailed
from rosproxy.zenoh.status import ZenohState

log = logging.getLogger(__name__)

LINK_INTERVAL_S = 5.0
"""Time between looks at the addresses of peers, and between tries of links that are not up."""
FAULT_INTERVAL_S = 1.0
_OPTION = "--ros zenoh"


class Zenoh:
    """The part for rmw_zenoh. `start` it in a running event loop, `stop` it in the same."""

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._settings = runtime.settings
        self._faults: dict[str, DoctorFinding] = {}
        settings = runtime.settings
        configs = router_configs(
            settings.bind, settings.zenoh_ports, settings.zenoh_listen, settings.zenoh_peer
        )
        self.keeper = RouterKeeper(runtime.tasks, configs, self._take_report)
        self.state = ZenohState(settings, self.keeper, runtime.now)

    async def start(self) -> None:
        """Start the routers and begin. Raises SettingError."""
        _check_package()
        _check_ports(self._settings)
        try:
            await self.keeper.start()
        except RoutersFailed as error:
            raise SettingError(_OPTION, f"the routers do not run: {error}") from None
        self._runtime.metrics.registry.register(self.state)
        tasks = self._runtime.tasks
        tasks.repeat(self._look_at_links, LINK_INTERVAL_S, "looking at zenoh links")
        tasks.repeat(self._look_for_faults, FAULT_INTERVAL_S, "looking for faults of zenoh")

    async def stop(self) -> None:
        """End everything, and the routers."""
        await self._runtime.tasks.cancel()

    @property
    def greeting(self) -> str:
        """How nodes use it, for the log."""
        settings = self._settings
        outside = [f"peers {listed(map(str, settings.zenoh_peer))}"] if settings.zenoh_peer else []
        if settings.zenoh_listen is not None:
            outside.append(f"port {settings.zenoh_listen} for outside")
        ports = f"rmw_zenoh nodes connect to ports {settings.zenoh_ports}"
        return ", ".join([ports, *outside])

    actions: Mapping[str, Action] = {}
    """No post of an operator concerns rmw_zenoh."""
    retired = False
    """The routers register nothing."""

    async def settle(self) -> None:
        """No port of it is probed."""

    async def probe(self, or_fast: bool) -> tuple[PortProbe, ...]:
        """None: it has no ports of the range."""
        return ()

    async def try_ports(self) -> tuple[PortProbe, ...]:
        """Instead of a start: take its ports, and let go. Raises SettingError."""
        _check_package()
        _check_ports(self._settings)
        return ()

    async def apply_policy(self) -> EnforcementCounts:
        """No policy holds for it; `Settings` refuses rules."""
        return EnforcementCounts()

    def unready(self) -> str | None:
        """Why nodes can't use it now; None if they can."""
        failure = self.keeper.failure
        return f"{findings.ROUTERS}: do not run: {failure}" if failure else None

    def add_to(self, status: ProxyStatus) -> ProxyStatus:
        """The status of the proxy, with the routers."""
        return replace(status, zenoh=self.state.status())

    def _take_report(self, report: Report) -> None:
        self.state.take(report)
        for link in self.state.links:
            if self.state.is_up(link) and link.note(None, self._runtime.now()):
                log.info("zenoh link up: %s", link.peer)

    async def _look_at_links(self) -> None:
        await asyncio.gather(*(self._look_at(link) for link in self.state.links))

    async def _look_at(self, link: Link) -> None:
        """Find the addresses of a peer, and why the link to it is not up."""
        # A name server that is away takes no address away.
        link.addresses = tuple(await resolve(link.peer.host)) or link.addresses
        fault = None
        if not self.state.is_up(link):
            fault = await try_link(link.addresses, link.peer.port)
        if self.keeper.failure:  # no router dials
            return
        # The link may have come up during the try, which takes some seconds.
        fault = None if self.state.is_up(link) else fault
        if link.note(fault, self._runtime.now()):
            state = f"down, {fault.value}" if fault else "up"
            log.info("zenoh link %s: %s", state, link.peer)

    async def _look_for_faults(self) -> None:
        """Report each fault once in the log, and as a problem for as long as the fault lasts."""
        current = {fault.subject: fault for fault in findings.faults(self.state.status())}
        if self.keeper.failure:  # of all else nothing is known
            current = self._faults | current
        for subject in self._faults.keys() | current.keys():
            fault = current.get(subject)
            if fault == self._faults.get(subject):
                continue
            self._runtime.problems.solved(subject)
            if fault is None:
                log.info("%s: nothing is wrong any more", subject)
            else:
                text = f"{fault.text}. Fix: {fault.fix}"
                self._runtime.problems.add(subject, text, holds=True)
                log.warning("%s: %s", subject, text)
        self._faults = current


def _check_package() -> None:
    """Raises SettingError without the library of the routers."""
    try:
        metadata.distribution("eclipse-zenoh")
    except metadata.PackageNotFoundError:
        text = "needs the package eclipse-zenoh. Install rosproxy[zenoh]"
        raise SettingError(_OPTION, text) from None


def _check_ports(settings: Settings) -> None:
    """Raises SettingError if another program has one of the ports."""
    for option, port in settings.zenoh_listeners():
        with setting_error_if_taken(option, f"port {port}"):
            sockets.listen(settings.bind, port).close()
