"""rmw_zenoh in a running proxy: the routers, the links, and the faults of both."""

import asyncio
import contextlib
import logging
import resource
import ssl
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace as replace_plan
from importlib import metadata

from msgspec.structs import replace

from rosproxy.admin.admin_server import Action
from rosproxy.admin.common_status import with_hidden
from rosproxy.binding import setting_error_if_taken
from rosproxy.runtime import Runtime
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.connections import sockets
from rosproxy.shared.documents.doctor_finding import DoctorFinding
from rosproxy.shared.documents.requests import EnforcementCounts, PortProbe
from rosproxy.shared.documents.status_document import ProxyStatus, ZenohCertificateStatus
from rosproxy.shared.machine.interfaces import is_own
from rosproxy.shared.machine.resolver import resolve
from rosproxy.shared.output.text import listed
from rosproxy.shared.policy.layers import PolicyLayer
from rosproxy.shared.setting_kinds import SettingError
from rosproxy.shared.settings import Settings
from rosproxy.shared.zenoh_rules.name_sets import check_layers
from rosproxy.zenoh import findings
from rosproxy.zenoh.access_control import access_control
from rosproxy.zenoh.certificates import CLIENTS, SERVERS, Checked, Unusable, check_credentials
from rosproxy.zenoh.link_probe import accepts, try_link
from rosproxy.zenoh.links import Link, LinkFault, own_peers
from rosproxy.zenoh.protocol.liveliness import graph_of
from rosproxy.zenoh.protocol.report import Report
from rosproxy.zenoh.redialing import Redialing
from rosproxy.zenoh.router_configs import RouterConfig, RouterPlan
from rosproxy.zenoh.router_policy import RouterPolicy
from rosproxy.zenoh.router_supervisor import RoutersFailed, RouterSupervisor
from rosproxy.zenoh.site_links import CHECK_INTERVAL_S, SiteLinks
from rosproxy.zenoh.socket_directory import (
    LINKS_NEED_DIRECTORY,
    NO_DIRECTORY,
    make_socket_directory,
    remove_socket_directory,
)
from rosproxy.zenoh.status import Reading, ZenohState

log = logging.getLogger(__name__)

LINK_INTERVAL_S = 5.0
"""Seconds between look-ups of the peers' addresses, and between tries of links that are down."""
FAULT_INTERVAL_S = 1.0
"""Seconds between two searches for faults."""
MOST_LOOKS = 32
"""Links that the proxy looks at, at a time: the proxy may look up 64 host names at a time."""
TOKEN_SHARE = 0.1
"""Largest share of the time for reading tokens. 8,192 tokens take up to 0.8 s."""
POLICY_INTERVAL_S = 0.5
"""Seconds between checks of the policy, and of the sessions at the ports for containers."""
_ROS_OPTION = "--ros zenoh"
HUB_CERTIFICATE = "--zenoh-hub-certificate"


class Zenoh:
    """The part of the proxy for rmw_zenoh. Call `start` and `stop` in the same event loop."""

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._settings = runtime.settings
        self._faults: dict[str, DoctorFinding] = {}
        self._mismatches: dict[str, DoctorFinding] = {}
        self._applying = asyncio.Lock()
        settings = runtime.settings
        self._plan = RouterPlan(
            settings.bind,
            settings.zenoh_ports,
            settings.zenoh_listen,
            settings.zenoh_peer,
            hub_listen=settings.zenoh_hub_listen,
            hubs=settings.zenoh_hub,
            certificate=settings.zenoh_hub_certificate,
        )
        self._of_hub: Checked | None = None
        runtime.policy.checks.append(self._check_layers)
        self._policy = RouterPolicy(runtime.policy, settings.zenoh_ports, settings.zenoh_listen)
        self._access: dict[int, object] = {}
        self._sites = SiteLinks(settings)
        self._awaiting = bool(settings.await_policy)
        self._tokens: Sequence[str] | None = None
        self._tokens_due = 0.0
        self._redialing = Redialing()
        self._own_peers = frozenset[HostPort]()
        self.supervisor = RouterSupervisor(runtime.tasks, self._take_report, self._refuse)
        self.state = ZenohState(settings, self.supervisor, runtime.now, self._certificates)

    async def start(self) -> None:
        """Start the routers and the periodic checks. Raises SettingError.

        If the proxy waits for a policy, the routers start later.
        """
        _check_package()
        _check_ports(self._settings)
        self._of_hub = _hub_certificate(self._settings)
        files, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
        self._plan = replace_plan(self._plan, directory=make_socket_directory(), files=files)
        self._check_policy()
        self._sites.check()
        if self._settings.has_site_links and not self._plan.directory:
            raise SettingError("--zenoh-link", LINKS_NEED_DIRECTORY)
        self._check_files()
        tasks = self._runtime.tasks
        if self._awaiting:
            tasks.spawn(self._start_with_policy(), "waiting for an operator's policy")
        else:
            try:
                await self._start_routers()
            except RoutersFailed as error:
                raise SettingError(_ROS_OPTION, f"the routers do not run: {error}") from None
        self._runtime.metrics.registry.register(self.state)
        tasks.repeat(self._look_at_links, LINK_INTERVAL_S, "looking at zenoh links")
        tasks.repeat(self._look_for_faults, FAULT_INTERVAL_S, "looking for faults of zenoh")
        tasks.repeat(self._look_at_policy, POLICY_INTERVAL_S, "applying the policy to zenoh")
        if self._settings.has_site_links:
            tasks.repeat(self._look_at_files, CHECK_INTERVAL_S, "checking the files of links")

    async def _start_with_policy(self) -> None:
        """Start the routers when the operator has sent the policy, or when the time is up."""
        await self._runtime.policy.wait_for_operator(self._settings.await_policy)
        with contextlib.suppress(RoutersFailed):  # the supervisor logs this, and retries
            await self._start_routers()

    async def _start_routers(self) -> None:
        """Start the routers with the present policy. Raises RoutersFailed."""
        self._access = self._policy.access()
        self._awaiting = False
        for link in self.state.links:
            if self._may_be_own(link):
                link.addresses = tuple(await resolve(link.peer.host))
                self._note_own(link)
        await self.supervisor.start(self._configs(self._access))

    async def stop(self) -> None:
        """Cancel all tasks. This also stops the routers."""
        await self._runtime.tasks.cancel()
        remove_socket_directory(self._plan.directory)

    @property
    def greeting(self) -> str:
        """The text for the log: the ports for nodes inside, and the ways to outside."""
        settings = self._settings
        outside = [f"peers {listed(map(str, settings.zenoh_peer))}"] if settings.zenoh_peer else []
        outside += [f"hubs {listed(map(str, settings.zenoh_hub))}"] if settings.zenoh_hub else []
        sites = [*settings.zenoh_link]
        outside += [f"other sites {listed(map(str, sites))}"] if sites else []
        if settings.zenoh_hub_listen is not None:
            outside.append(f"port {settings.zenoh_hub_listen} for hubs")
        if settings.zenoh_listen is not None:
            outside.append(f"port {settings.zenoh_listen} for outside")
        if settings.zenoh_link_listen is not None:
            outside.append(f"port {settings.zenoh_link_listen} for other sites")
        ports = f"rmw_zenoh nodes connect to ports {settings.zenoh_ports}"
        return ", ".join([ports, *outside])

    actions: Mapping[str, Action] = {}
    """Empty: no POST request of an operator concerns rmw_zenoh."""
    retired = False
    """Always False: the routers have no registrations that the proxy could take back."""

    async def settle(self) -> None:
        """Return at once: the proxy probes no port for rmw_zenoh."""

    async def probe(self, or_fast: bool) -> tuple[PortProbe, ...]:
        """No results: rmw_zenoh has no ports of the range."""
        return ()

    async def try_ports(self) -> tuple[PortProbe, ...]:
        """Bind the ports and close them again, without a start. Return no results.

        Raises SettingError if a port is taken, eclipse-zenoh is missing, a rule is impossible, or a
        file of links can't be used.
        """
        _check_package()
        _check_ports(self._settings)
        _hub_certificate(self._settings)
        self._check_policy()
        self._sites.check()
        return ()

    async def apply_policy(self) -> EnforcementCounts:
        """Restart the routers whose access control has changed.

        Returns when no router runs with former access control. Returns no counts, because the
        routers have no registrations. Raises ValueError as `RouterPolicy.access` does.
        """
        if self._awaiting:  # the routers start with the policy
            return EnforcementCounts()
        async with self._applying:
            access = self._policy.access()
            if access is not self._access and access != self._access:
                await self.supervisor.use(self._configs(access))
                ports = access.keys() | self._access.keys()
                changed = sorted(p for p in ports if access.get(p) != self._access.get(p))
                log.info("zenoh policy changed: ports %s", listed(map(str, changed)))
            self._access = access  # after the change, so that a failure is repeated
        return EnforcementCounts()

    def unready(self) -> str | None:
        """Why nodes can't use the routers now; None if the routers run."""
        failure = self.supervisor.failure
        return f"{findings.ROUTERS}: do not run: {failure}" if failure else None

    def extended_status(self, status: ProxyStatus) -> ProxyStatus:
        """The status of the proxy, with the routers."""
        policy = with_hidden(status.policy, *self._policy.hidden())
        waiting = self._policy.not_judged(self.state.inside_names())
        return replace(status, zenoh=self.state.status(waiting), policy=policy)

    async def _take_report(self, report: Report) -> None:
        # In a thread, because many tokens would hold up all other traffic of the proxy.
        self.state.show(await asyncio.to_thread(self._read, report))
        for link in self.state.links:
            if self.state.is_up(link) and link.note(None, self._runtime.now()):
                log.info("zenoh link up: %s", link)
        # Without the directory, the hub dials its routers by TCP, and there are no rules.
        if self._plan.directory:
            to_routers = [link for link in self.state.links if link.is_to_router]
            self._leave_out(own_peers(to_routers, report.routers))

    def _read(self, report: Report) -> Reading:
        """A reading of a report. After many tokens, the next tokens wait.

        So a container that changes a token each second takes `TOKEN_SHARE` of a processor.
        """
        if report.tokens is not None:
            self._tokens = report.tokens
        began = self._runtime.now()
        if self._tokens is None or began < self._tokens_due:
            return self.state.read(report, None)
        reading = self.state.read(report, graph_of(self._tokens))
        self._tokens = None
        ended = self._runtime.now()
        self._tokens_due = ended + (ended - began) * (1 / TOKEN_SHARE - 1)
        return reading

    def _refuse(self, reason: str) -> None:
        """Report that the routers have refused the certificate of another site, or of a hub."""
        settings = self._settings
        at_hub = settings.zenoh_hub_listen if settings.zenoh_hub_certificate else None
        ports = " or ".join(
            str(port) for port in (settings.zenoh_link_listen, at_hub) if port is not None
        )
        text = f"the certificate {reason}. If the proxy is known, look at rosproxy doctor there"
        self._runtime.refusals.note("link_certificate", f"a connection to {ports}", text)

    async def _look_at_policy(self) -> None:
        """Apply changes of the policy and of the containers at ports. Report denied names."""
        self._policy.note(self.state.container_sessions)
        await self.apply_policy()
        self._policy.look(self.state.inside_names())

    async def _look_at_files(self) -> None:
        """Restart the router of the links to other sites after a change of its files."""
        if self._sites.look() and not self._awaiting:
            await self._use_again()

    def _certificates(self) -> tuple[ZenohCertificateStatus, ...]:
        """The state of the certificate for hubs, and of each certificate for links."""
        files = self._sites.certificates()
        if self._of_hub is None:
            return files
        life = self._of_hub.certificate
        ca = self._of_hub.ca
        now = time.time()
        begin = max(life.begin, ca.begin)
        return (
            ZenohCertificateStatus(
                file=HUB_CERTIFICATE,
                starts_in=max(begin - now, 0.0),
                ends_in=min(life.end, ca.end) - now,
                hub=True,
            ),
            *files,
        )

    def _configs(self, access: Mapping[int, object]) -> list[RouterConfig]:
        """The configurations of all routers. Raises ValueError as `RouterPlan.configs` does."""
        peers = [peer for peer in self._plan.peers if peer not in self._own_peers]
        plan = replace_plan(self._plan, peers=peers)
        return plan.configs(access, self._sites.config(plan.hub_socket))

    def _may_be_own(self, link: Link) -> bool:
        """Whether a peer has a port of the routers that hold the rules for containers."""
        return link.is_to_router and link.peer.port in self._plan.all_ports

    def _note_own(self, link: Link) -> bool:
        """Note a peer with an address of this machine. Return whether the peer is new."""
        is_new = link.peer not in self._own_peers
        if is_new and self._may_be_own(link) and any(map(is_own, link.addresses)):
            self._own_peers |= {link.peer}
            return True
        return False

    def _leave_out(self, peers: set[HostPort]) -> None:
        """Let the hub dial these peers no more, because they lead to the proxy itself."""
        if peers - self._own_peers:
            self._own_peers |= peers
            log.error("zenoh peers lead to the proxy itself: %s", listed(map(str, peers)))
            # In a task, because the change waits for the next report.
            self._runtime.tasks.spawn(self._use_again(), "leaving out zenoh peers")

    async def _use_again(self) -> None:
        async with self._applying:
            await self.supervisor.use(self._configs(self._access))

    def _check_policy(self) -> None:
        """Raise SettingError for rules that the routers cannot enforce."""
        try:
            self._check_layers(self._runtime.policy.layers)
        except ValueError as error:
            raise SettingError("--policy", str(error)) from None

    def _check_files(self) -> None:
        """Raise SettingError if the routers need more open files than the process may have."""
        try:
            self._configs({})
        except ValueError as error:
            text = f"{self._settings.zenoh_ports} {error}. Raise the limit (ulimit -Hn)"
            raise SettingError("--zenoh-ports", text) from None

    def _check_layers(self, layers: Sequence[PolicyLayer]) -> None:
        """Raise ValueError for rules that the routers cannot enforce."""
        check_layers(layers)
        if not self._plan.directory and access_control(layers):
            raise ValueError(NO_DIRECTORY)

    async def _look_at_links(self) -> None:
        room = asyncio.Semaphore(MOST_LOOKS)

        async def look_at(link: Link) -> None:
            async with room:
                await self._look_at(link)

        await asyncio.gather(*map(look_at, self.state.links))
        await self._dial_again()

    async def _look_at(self, link: Link) -> None:
        """Look up the addresses of a peer, and record why the link to the peer is down."""
        link.note_addresses(tuple(await resolve(link.peer.host)))
        if link.is_to_site and self._sites.files is None:
            return  # the status has the fault of the file
        if self._note_own(link):
            await self._use_again()
        fault = None
        if link.is_to_router and link.peer in self._own_peers:
            fault = LinkFault.ITSELF
        elif not self.state.is_up(link):
            fault = await try_link(link, self._client_for(link))
            if fault is LinkFault.NO_SESSION and link.former:
                fault = LinkFault.MOVED
                await self._end_former(link)
        if self.supervisor.failure:  # the routers do not run, so the fault of the link is unknown
            return
        # The link may have come up during the try, which takes some seconds.
        fault = None if self.state.is_up(link) else fault
        if link.note(fault, self._runtime.now()):
            state = f"down, {fault.value}" if fault else "up"
            log.info("zenoh link %s: %s", state, link)

    async def _dial_again(self) -> None:
        """Open the hub anew if it dials a lost router no more."""
        if self.supervisor.failure:
            return
        down = {self._endpoint(link): link.since for link in self.state.links if link.is_lost}
        down |= {self._plan.dialed_at(port): at for port, at in self.state.unlinked.items()}
        lost = self._redialing.due(down, self.supervisor.connected, self._runtime.now())
        if lost:
            log.error("zenoh does not dial %s again; opening the hub anew", listed(lost))
            self._plan = replace_plan(self._plan, opening=self._plan.opening + 1)
            await self._use_again()

    def _endpoint(self, link: Link) -> str:
        """The endpoint of the peer of a link, as in the configurations."""
        return self._plan.hub_endpoint(link.peer) if link.is_hub else f"{link.protocol}/{link.peer}"

    async def _end_former(self, link: Link) -> None:
        """End the sessions with former addresses of a peer, where no router answers any more.

        The hub would wait for the lease of the peer, which is 60 s for rmw_zenohd.
        """
        former = [end for end in self.state.left_behind(link) if not await accepts(end)]
        if former:
            log.info("zenoh link %s: no router at %s any more", link, listed(map(str, former)))
            self.supervisor.end_connections(former)

    def _client_for(self, link: Link) -> ssl.SSLContext | None:
        """What proves the proxy to the peer of a link; None for a link without TLS."""
        if link.is_hub:
            return self._of_hub.client if self._of_hub else None
        return self._sites.files.client if link.protocol == "tls" and self._sites.files else None

    async def _look_for_faults(self) -> None:
        """Log each fault once, and report the fault as a problem while the fault lasts.

        A mismatch has to last for two looks, because nodes that start have not told all yet.
        """
        if self._awaiting:
            return
        zenoh = self.state.status()
        current = {fault.subject: fault for fault in findings.faults(zenoh)}
        mismatches = findings.first_mismatches(zenoh)
        lasting = mismatches.items() & self._mismatches.items()
        self._mismatches = mismatches
        current |= dict(lasting)
        if self.supervisor.failure:  # other faults are unknown meanwhile, and stay
            current = self._faults | current
        for subject in self._faults.keys() | current.keys():
            fault = current.get(subject)
            if fault == self._faults.get(subject):
                continue
            self._runtime.problems.solved(subject)
            if fault is None:
                log.info("%s: the fault is over", subject)
            else:
                text = f"{fault.text}. Fix: {fault.fix}"
                self._runtime.problems.add(subject, text, holds=True)
                log.warning("%s: %s", subject, text)
        self._faults = current


def _check_package() -> None:
    """Raise SettingError if eclipse-zenoh, the library of the routers, is not installed."""
    try:
        metadata.distribution("eclipse-zenoh")
    except metadata.PackageNotFoundError:
        text = "needs the package eclipse-zenoh. Install rosproxy[zenoh]"
        raise SettingError(_ROS_OPTION, text) from None


def _hub_certificate(settings: Settings) -> Checked | None:
    """The certificate that proves the proxy to other hubs; None without a certificate.

    Raises SettingError for a bad certificate.
    """
    if settings.zenoh_hub_certificate is None:
        return None
    try:
        return check_credentials(settings.zenoh_hub_certificate, (CLIENTS, SERVERS))
    except Unusable as error:
        raise SettingError(HUB_CERTIFICATE, str(error)) from None


def _check_ports(settings: Settings) -> None:
    """Raise SettingError if another program has one of the ports."""
    link = settings.zenoh_link_listen
    udp_port = link.port if link and link.protocol == "quic" else None
    for option, port in settings.zenoh_listeners():
        if port == udp_port:  # zenoh itself reports a port that is taken
            continue
        with setting_error_if_taken(option, f"port {port}"):
            sockets.listen(settings.bind, port).close()
