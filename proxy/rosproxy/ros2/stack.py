"""ROS 2 in a running proxy: a server for each domain. The domains share the range."""

import asyncio
import logging
import secrets
import time
from collections.abc import Collection, Mapping, Sequence
from itertools import chain
from typing import Any

from msgspec.structs import replace

from rosproxy.admin.admin_server import Action
from rosproxy.admin.common_status import with_hidden
from rosproxy.binding import report_taken_ports, setting_error_if_taken
from rosproxy.forwarding.kernel.datagram_table import DatagramTable
from rosproxy.forwarding.kernel.plane import KernelPlane
from rosproxy.forwarding.kernel.table import KernelTable
from rosproxy.forwarding.kernel.tools import Tools
from rosproxy.net import proxy_signs
from rosproxy.ros2.discovery.discovery_participant import ANNOUNCE_INTERVAL_S
from rosproxy.ros2.domain_plane import DomainPlane
from rosproxy.ros2.domain_settings import DomainSettings, LanRelayLink
from rosproxy.ros2.domain_watch import DomainWatch
from rosproxy.ros2.ports.kernel_ports import KernelPorts
from rosproxy.ros2.ports.locator_ports import EVIDENCE_PERIOD_S
from rosproxy.ros2.ports.store import port_store_key
from rosproxy.ros2.protocol.relay_proof import RelayProof
from rosproxy.ros2.servers.domain_server import EXPIRY_INTERVAL_S, DomainServer
from rosproxy.ros2.sources.selected import FIRST_SELECTION_TIMEOUT_S
from rosproxy.ros2.status import Ros2State
from rosproxy.ros2.udp_probe import try_ports, try_udp
from rosproxy.runtime import Runtime
from rosproxy.shared import addresses
from rosproxy.shared.addresses import HostPort, Network
from rosproxy.shared.documents.requests import (
    ContainerUpdate,
    EmptyBody,
    EnforcementCounts,
    PortProbe,
    read_body,
)
from rosproxy.shared.documents.status_document import PortsStatus, ProxyStatus
from rosproxy.shared.machine.interfaces import (
    address_into,
    address_towards,
    default_gateways,
    interface_networks,
)
from rosproxy.shared.machine.resolver import resolve
from rosproxy.shared.output.text import listed
from rosproxy.shared.policy.rules import RuleKind
from rosproxy.shared.ports import PortMap, PortPool, PortRange
from rosproxy.shared.setting_kinds import SettingError
from rosproxy.shared.settings import Settings

log = logging.getLogger(__name__)

REFRESH_INTERVAL_S = 5.0
"""Seconds between checks of the networks, the addresses of peers, and the domain problems."""
POLICY_INTERVAL_S = 0.5
"""Seconds between checks of the policy for changes."""
RATE_INTERVAL_S = 2.0
"""Seconds between updates of the rates."""
MOST_ROUTES = 4096
"""Addresses for which the proxy remembers its own address on the way there."""


class Ros2:
    """The part of the proxy for ROS 2. `start` and `stop` it in the same event loop."""

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._settings = runtime.settings
        self.servers: list[DomainServer] = []
        self._hosts: tuple[str, ...] = ()
        self._routes: dict[str, str] = {}
        ports = runtime.settings.ports.listen
        self._kernel_ports = kernel_ports = KernelPorts(PortPool(ports))
        table = KernelTable(DatagramTable(ports), Tools())
        self.plane = plane = KernelPlane(
            runtime.settings, kernel_ports, runtime.tasks, runtime.problems, runtime.now, table
        )
        self._domain_plane = DomainPlane(plane, kernel_ports)
        self.state = Ros2State(self.servers, self._domain_plane)
        self._applied = runtime.policy.version
        self._awaiting = bool(self._settings.await_policy)
        self.networks: tuple[Network, ...] = ()
        self._peers = self._settings.ros2_peer
        self._addresses_of_peers: dict[HostPort, tuple[HostPort, ...]] = {}
        self._peer_addresses = frozenset[str]()
        self._watch = DomainWatch(
            Ros2State(
                self.servers,
                self._domain_plane,
                with_names=False,
                comparisons=self.state.comparisons,
            ),
            runtime.problems,
        )

    async def start(self) -> None:
        """Bind all ports and begin. Raises SettingError if a necessary port is not available."""
        tasks = self._runtime.tasks
        self._hosts = await self._first_hosts()
        # Before opening any port: the table of a former process has the locator of each port.
        await self.plane.start()
        self._kernel_ports.note_former(self.plane.forwards)
        self._start_servers()
        self._runtime.metrics.registry.register(self.state)
        self._runtime.metrics.registry.register(self._domain_plane)
        # Unlike in ROS 1 there is no registry to rebuild: `note_former` has noted all forwards.
        self.plane.recovered([])
        tasks.spawn(self._forget_former(), "waiting for participants from before the start")
        await self._refresh()
        if self._awaiting:
            tasks.spawn(self._await_policy(), "waiting for an operator's policy")
        tasks.repeat(self._look_at_policy, POLICY_INTERVAL_S, "applying the policy")
        for server in self.servers:
            tasks.repeat(server.expire, EXPIRY_INTERVAL_S, "ending participants")
            tasks.repeat(server.announce, ANNOUNCE_INTERVAL_S, "announcing the proxy")
        tasks.repeat(self._refresh, REFRESH_INTERVAL_S, "checking networks and peers")
        tasks.repeat(
            self._look_at_domains, REFRESH_INTERVAL_S, "checking connections of participants"
        )
        tasks.repeat(self._sample_rates, RATE_INTERVAL_S, "sampling rates")

    async def _look_at_domains(self) -> None:
        for server in self.servers:
            server.buffers.sample(self._runtime.now())
        await self.state.comparisons.renew([server.domain for server in self.servers])
        await self._watch.look()

    def _start_servers(self) -> None:
        """Start a server for each domain. Raises SettingError."""
        settings = self._settings
        taken = list[int]()
        # Each process of the proxy gets the same secret, which containers do not know.
        key = port_store_key(settings.token_hash or settings.ros2_lan_relay_secret)
        for number, ports in zip(settings.domains, self._domain_ports(), strict=True):
            domain_settings = DomainSettings(
                number=number,
                hosts=self._hosts,
                ports=ports,
                proxy_address_for=self._address_towards,
                note=self._runtime.refusals.note,
                settled=self._runtime.refusals.settle,
                judge=self._is_allowed,
                is_inside=self._is_inside,
                both_ways=settings.direction == "both",
                relay=_relay(settings),
                port_store_key=key,
            )
            server = DomainServer(
                domain_settings,
                settings.bind,
                self._runtime.now,
                self._is_inside,
                self.plane.syncer.note_change,
                # With a token an operator is expected, which selects addresses.
                FIRST_SELECTION_TIMEOUT_S if settings.admin_token_hash else 0.0,
            )
            server.domain.ports.note_forwarded(self.plane.forwards)
            self.servers.append(server)
            self._kernel_ports.domains.append(server.domain.mappings)
            # Any proxy for ROS 2 may have these ports, which follow from the domain.
            other_proxies = proxy_signs.overlapping_proxies("2", 1, 65535)
            with setting_error_if_taken(
                "--ros2-domain", f"a port of domain {number}", other_proxies
            ):
                taken += server.start()
        report_taken_ports("2", settings, taken, self._runtime.problems)

    async def settle(self) -> None:
        """Return at once: ROS 2 needs no preparation before a probe."""

    async def probe(self, or_fast: bool) -> tuple[PortProbe, ...]:
        """Whether UDP to the advertised host reaches the discovery port of each domain."""
        return tuple([await self._probe(server) for server in self.servers])

    async def _probe(self, server: DomainServer) -> PortProbe:
        settings = server.domain.settings
        secret = secrets.token_bytes(16)
        port = settings.ports.advertised(settings.discovery_port)
        target = HostPort(self._hosts[0], port)
        outcome = await server.try_discovery_port(
            secret, lambda heard: try_udp(target, secret, heard)
        )
        advertised = str(HostPort(self._settings.advertise_host, port))
        return PortProbe(settings.discovery_port, advertised, outcome, "unknown", "udp")

    async def try_ports(self) -> tuple[PortProbe, ...]:
        """Bind the range, probe the discovery port, and release the range. Raises SettingError.

        A caller uses this instead of `start`.
        """
        return await try_ports(self._runtime)

    async def stop(self) -> None:
        """Stop all tasks, the kernel plane and the servers."""
        await self._runtime.tasks.cancel()
        await self.plane.stop()
        for server in self.servers:
            server.close()

    @property
    def actions(self) -> Mapping[str, Action]:
        """The handlers of POST requests at the admin endpoint, by path."""
        return {"/containers": self._handle_update, "/retire": self._retire}

    async def _handle_update(self, body: Any) -> dict[str, Any]:
        """Handle ``POST /containers``. Return the number of participants that have ended.

        The participants at the former address of a moved container end, too. At the new address
        they announce themselves again.
        """
        update = read_body(body, ContainerUpdate)
        self._look_at_networks()  # the proxy may have just joined the network of new containers
        # Before the selection, after which waiting participants get their ports at once.
        for server in self.servers:
            server.note_former(update.former_ports)
        if update.selected is not None:
            for server in self.servers:
                server.select(update.selected)
        if (peers := update.ros2_peers) is not None and peers != self._peers:
            self._peers = peers
            await self._find_peers()
        former_addresses = {*update.gone, *update.moved}
        return {"unregistered": sum(server.end(former_addresses) for server in self.servers)}

    async def _retire(self, body: Any) -> dict[str, Any]:
        """Handle ``POST /retire``. Return the number of participants that have ended."""
        read_body(body, EmptyBody)
        ended = 0
        for server in self.servers:
            # Before the end of the participants: their next announcement must not be accepted.
            server.select(())
            ended += server.retire()
            await server.finish()
        return {"unregistered": ended}

    @property
    def greeting(self) -> str:
        """How nodes use the proxy, for the log."""
        domains = ", ".join(map(str, self._settings.domains))
        host = self._settings.advertise_host
        ports = self._settings.ports.advertise
        return (
            f"ROS 2 nodes of domain {domains} are found by multicast; outside sees {host}:{ports}"
        )

    async def _forget_former(self) -> None:
        """End former forwards of the kernel that no participant has claimed since the start."""
        await asyncio.sleep(EVIDENCE_PERIOD_S)
        self._kernel_ports.note_former({})
        self.plane.syncer.note_change()

    def _domain_ports(self) -> list[PortMap]:
        """The part of the range for each domain."""
        ports = self._settings.ports
        count = len(self._settings.domains)
        size = len(ports.listen) // count

        def share(whole: PortRange, index: int) -> PortRange:
            first = whole.first + index * size
            return PortRange(first, first + size - 1)

        return [
            PortMap(share(ports.listen, index), share(ports.advertise, index))
            for index in range(count)
        ]

    def _address_towards(self, address: str) -> str:
        """The proxy's own address on the way to an address, as of the last look at the networks.

        A lookup takes 20 us, and an announcement goes to hundreds of participants inside.
        """
        own_address = self._routes.get(address)
        if own_address is None:
            own_address = address_towards(address)
            # Without a route, look again: the proxy may join the network at any time, and Fast DDS
            # accepts no new locators of a known participant.
            if len(self._routes) < MOST_ROUTES and not addresses.is_loopback(own_address):
                self._routes[address] = own_address
        return own_address

    def _is_inside(self, address: str) -> bool:
        is_peer = address in self._peer_addresses
        return not is_peer and addresses.is_inside(address, self.networks)

    def _is_allowed(self, kind: RuleKind, name: str, address: str) -> bool:
        """Whether the policy allows a name to the participant inside at an address.

        Nothing is allowed while the proxy waits for the policy of an operator. The policy gets no
        node names, because a participant is not a node.
        """
        return not self._awaiting and self._runtime.policy.ask(kind, name, (), address).allowed

    async def apply_policy(self) -> EnforcementCounts:
        """Let participants inside with a changed verdict rediscover the participants outside."""
        version = self._runtime.policy.version
        for server in self.servers:
            server.apply_policy()
        self._applied = version  # after the calls, so that a failure is repeated
        for server in self.servers:
            await server.finish()
        return EnforcementCounts()

    retired = False
    """Always False: after `/retire` the operator may select addresses again."""

    def unready(self) -> str | None:
        """Return None: ROS 2 needs no master, and is ready after `start`."""
        return None

    def extended_status(self, status: ProxyStatus) -> ProxyStatus:
        """Add the domains of ROS 2 to the status of the proxy.

        If the proxy also serves ROS 1, networks, ports and data plane in the status are those of
        ROS 1.
        """
        domains = self.state.status()
        policy = with_hidden(status.policy, *self.state.hidden(self._runtime.policy))
        status = replace(status, domains=domains, policy=policy)
        if self._settings.for_ros1:
            return status
        return replace(
            status,
            settings=replace(status.settings, inside_networks=tuple(map(str, self.networks))),
            ports=PortsStatus(
                status.ports.listen,
                status.ports.advertise,
                sum(domain.ports_used for domain in domains),
                sum(domain.ports_free for domain in domains),
            ),
            data_plane=domains[0].data_plane if domains else None,
        )

    async def _look_at_policy(self) -> None:
        if self._applied != self._runtime.policy.version:
            await self.apply_policy()

    async def _await_policy(self) -> None:
        await self._runtime.policy.wait_for_operator(self._settings.await_policy)
        self._awaiting = False
        await self.apply_policy()

    async def _first_hosts(self) -> tuple[str, ...]:
        """The addresses of the advertised host at the start. Raises SettingError."""
        host = self._settings.advertise_host
        hosts = advertised_hosts(await resolve(host), self._settings.bind, ())
        if not hosts:
            text = (
                f"host name {host} can't be resolved. Set the IP address: ROS 2 needs the address"
            )
            raise SettingError("--advertise-host", text)
        return hosts

    async def _refresh(self) -> None:
        """Check the networks, and the addresses of the advertised host and the peers."""
        self._look_at_networks()
        await self._find_hosts()
        await self._find_peers()

    async def _find_hosts(self) -> None:
        resolved = await resolve(self._settings.advertise_host)
        hosts = advertised_hosts(resolved, self._settings.bind, self._hosts)
        if hosts == self._hosts:
            return
        former = self._hosts
        self._hosts = hosts
        name = self._settings.advertise_host
        log.info("advertised host %s moved: from %s to %s", name, listed(former), listed(hosts))
        for server in self.servers:
            server.move_to(hosts)

    async def _find_peers(self) -> None:
        peers = self._peers
        found = await asyncio.gather(*(self._resolve_peer(peer) for peer in peers))
        # If the name server does not answer, the known addresses of a peer stay.
        known = {peer: self._addresses_of_peers.get(peer, ()) for peer in peers}
        self._addresses_of_peers = {
            peer: tuple(addresses) or known[peer]
            for peer, addresses in zip(peers, found, strict=True)
        }
        addresses_of_all = tuple(chain.from_iterable(self._addresses_of_peers.values()))
        hosts = (peer.host for peer in addresses_of_all)
        # In a trial on a single machine, both sides may have the same loopback address.
        self._peer_addresses = frozenset(host for host in hosts if not addresses.is_loopback(host))
        for server in self.servers:
            server.set_peers(addresses_of_all)

    def _look_at_networks(self) -> None:
        self._routes.clear()
        own_networks = {network: address_into(network) for network in interface_networks()}
        self.networks = self._settings.inside_networks or networks_inside(own_networks, self._hosts)
        own_addresses = {address_into(network) for network in self.networks}
        gateways = default_gateways()
        for server in self.servers:
            # If the proxy is not on an inside network, the route there begins at another address.
            server.join(address for address in own_addresses if self._is_inside(address))
            server.note_gateways(gateways)

    async def _sample_rates(self) -> None:
        now = self._runtime.now()
        for server in self.servers:
            for _, mapping in server.domain.mappings.by_port.values():
                mapping.update_rates(now)

    async def _resolve_peer(self, peer: HostPort) -> list[HostPort]:
        subject = f"peer {peer.host}"
        resolved = await resolve(peer.host)
        self._runtime.problems.solved(subject)
        if not resolved:
            text = (
                "the host name can't be resolved, so the proxy does not announce participants to "
                "this peer. Set the address of the peer"
            )
            self._runtime.problems.add(subject, text)
        return [HostPort(address, peer.port) for address in resolved]


def advertised_hosts(
    resolved: Sequence[str], bind: str, present: tuple[str, ...]
) -> tuple[str, ...]:
    """The addresses of the advertised host to announce: a single one, or one of each family.

    Locators have no host names. ``resolved`` are the addresses of the name now, and ``present`` the
    announced addresses. The present addresses stay while the name has all of them, because a name
    server may return several addresses in any order. They also stay if the name can't be resolved.
    An address of a family that ``bind`` does not cover counts only if there is no other.
    """
    if not resolved or (present and all(address in resolved for address in present)):
        return present
    served = [a for a in resolved if bind == "::" or (":" in a) == (":" in bind)]
    # Reversed, so that the first address of each family is the last one written, and stays.
    by_family = {":" in a: a for a in reversed(served or resolved)}
    return tuple(sorted(by_family.values(), key=resolved.index))


def networks_inside(
    own_networks: Mapping[Network, str], hosts: Collection[str]
) -> tuple[Network, ...]:
    """The inside networks without an option: the networks of the proxy's interfaces.

    ``own_networks`` are these networks, each with the proxy's address there. If this is an address
    of the advertised host (``hosts``), the network counts as outside, unless there are no others.
    """
    inside = tuple(network for network, own in own_networks.items() if own not in hosts)
    return inside or tuple(own_networks)


def _relay(settings: Settings) -> LanRelayLink | None:
    """The LAN relay in the settings; None without a relay or without a secret."""
    if settings.ros2_lan_relay is None or settings.ros2_lan_relay_secret is None:
        return None
    return LanRelayLink(
        settings.ros2_lan_relay, RelayProof(settings.ros2_lan_relay_secret, time.time)
    )
