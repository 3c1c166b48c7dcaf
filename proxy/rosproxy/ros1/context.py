"""What the parts of a running proxy share: the state, and the tools to act on the state.

The proxy makes the context once, before the parts. No part keeps a copy of anything in the context.
"""

import asyncio
from collections.abc import Sequence
from ipaddress import IPv4Network, IPv6Network, collapse_addresses, ip_network

from rosproxy.net.network_changes import NetworkChanges
from rosproxy.ros1.clients.master_client import MasterClient
from rosproxy.ros1.clients.node_client import NodeClient
from rosproxy.ros1.policy.checks import Ros1Policy
from rosproxy.ros1.policy.service_finder import ServiceFinder
from rosproxy.ros1.protocol.xmlrpc import limits
from rosproxy.ros1.registry.client_kinds import ClientKind, client_kind
from rosproxy.ros1.registry.endpoint import Endpoint
from rosproxy.ros1.registry.registry import Registry
from rosproxy.ros1.registry.stand_ins import StandIns
from rosproxy.ros1.rewriting.addressing import Addressing, Caller
from rosproxy.runtime import Runtime
from rosproxy.shared.addresses import Network
from rosproxy.shared.connections.budget import Budget
from rosproxy.shared.connections.gate import Gate
from rosproxy.shared.machine.interfaces import address_towards, interface_networks
from rosproxy.shared.settings import MEBIBYTE

REGISTRATION_GRACE_S = 0.5
"""The longest time in seconds that a publisherUpdate waits for a registration of the node."""
MANY_VALUES = 100
"""A document with more values is large. Registrations have six."""
MOST_PASSING = 256
"""Most calls and replies that pass unread at once. Each call takes a thread of the master."""
MOST_CLIENTS = 4096
"""The highest number of addresses whose `ClientKind` is remembered."""
PASSING_PER_SOURCE = 64
"""Most calls and replies of a single source among `MOST_PASSING`."""


class Context:
    """The state and the tools of ROS 1 in a proxy that is about to start.

    - ``now``: the clock of the proxy; see `Runtime`.
    - ``retired``: the proxy makes no more registrations, for nodes or by itself.
    - ``lease_call``, ``master_call``: bounds of a call from outside and from inside.
    - ``gate`` counts connections.
    - ``buffered`` counts the bytes of requests and replies in memory.
    - ``unread_calls`` counts the calls that pass unread.
    - ``refusals`` reports what exceeds these and other bounds.
    - ``policy``: what outside may see and do, and what inside may take from outside.
    """

    def __init__(self, runtime: Runtime) -> None:
        self.settings = settings = runtime.settings
        self.instance = runtime.instance
        self.now = runtime.now
        self.metrics = runtime.metrics
        self.tasks = runtime.tasks
        self.problems = runtime.problems
        self.refusals = runtime.refusals
        self.outside_changed = runtime.outside_changed
        self.gate = Gate(
            settings.max_connections_per_source,
            settings.max_connections_per_lease,
            self.refusals.note,
        )
        self.lease_call = limits.lease_call(settings.max_lease_call)
        self.master_call = limits.master_call(settings.max_master_call)
        capacity = settings.max_buffered * MEBIBYTE
        self.buffered = Budget(capacity, capacity // 2, "bytes of requests and replies")
        self._turn = asyncio.Lock()
        self.unread_calls = Budget(MOST_PASSING, PASSING_PER_SOURCE, "long requests and replies")
        self.registry = Registry(settings.ports.listen)
        self.stand_ins = StandIns(settings)
        self.addressing = Addressing(
            self.registry, settings.advertise_host, settings.ports, self.stand_ins
        )
        self.upstream = MasterClient(
            settings.master_uri,
            self.instance,
            self.metrics,
            settings.master_address,
            settings.max_body * MEBIBYTE,
        )
        self.nodes = NodeClient(self.upstream, settings.probe_timeout)
        finder = ServiceFinder(runtime.policy, self.registry, self.nodes, self.now)
        self.policy = Ros1Policy(
            runtime.policy, self.registry, self.addressing, self.upstream, finder
        )
        self.retired = False
        self._selected: frozenset[str] | None = None
        self._proxy_addresses: dict[str, str] = {}
        self._client_kinds: dict[str, ClientKind] = {}
        """By address; cleared when the networks or the selection change."""
        self._client_networks: list[Network] | None = None
        self._network_changes = NetworkChanges()
        self.read_networks()

    async def close(self) -> None:
        """Close the connections to the master and the nodes, and the socket to the kernel."""
        self._network_changes.close()
        await self.upstream.close()

    async def yield_to_others(self) -> None:
        """Wait for a turn to read or rewrite a document of more than MANY_VALUES.

        The proxy serves all connections between two turns. Otherwise many large documents at the
        same time would hold up all other calls.
        """
        async with self._turn:
            await asyncio.sleep(0)

    @property
    def selected(self) -> frozenset[str] | None:
        """The addresses that may use the proxy as the master; None: no operator has named any."""
        return self._selected

    @selected.setter
    def selected(self, addresses: frozenset[str]) -> None:
        self._selected = addresses
        self._client_kinds.clear()
        self._client_networks = None

    def client_kind(self, address: str) -> ClientKind:
        """The kind of an address: whether the address may use the proxy as the master."""
        kind = self._client_kinds.get(address)
        if kind is None:
            if len(self._client_kinds) >= MOST_CLIENTS:
                self._client_kinds.clear()
            kind = client_kind(address, self.addressing.networks, self.selected)
            self._client_kinds[address] = kind
        return kind

    def client_networks(self) -> Sequence[Network]:
        """The networks that may use the proxy as the master, without overlaps."""
        if self._client_networks is None:
            networks = self.addressing.networks
            if self.selected is not None:
                networks = [ip_network(address) for address in self.selected]
            # nft accepts no overlapping intervals in a set (`near4` of the kernel's table).
            ipv4 = collapse_addresses(n for n in networks if isinstance(n, IPv4Network))
            ipv6 = collapse_addresses(n for n in networks if isinstance(n, IPv6Network))
            self._client_networks = [*ipv4, *ipv6]
        return self._client_networks

    async def wait_for_registration(self, endpoint: Endpoint) -> None:
        """Wait until no registration of a node is pending, for REGISTRATION_GRACE_S at most.

        So the reply to the registration reaches the node before a later update. A node that applies
        an older list of publishers after a newer list loses a publisher. The way through the proxy
        must not make this race of ROS more likely.
        """
        deadline = self.now() + REGISTRATION_GRACE_S
        while endpoint.pending and self.now() < deadline:  # noqa: ASYNC110 - rare, short
            await asyncio.sleep(0.002)

    def refresh_networks(self) -> None:
        """Read the networks of the proxy's interfaces again after a change."""
        if self._network_changes.noticed(self.now()):
            self.read_networks()

    def read_networks(self) -> None:
        """Read the networks of the proxy's interfaces now."""
        self._proxy_addresses.clear()
        self._client_kinds.clear()
        self._client_networks = None
        # With --direction both, the network of the default route leads outside and is not inside.
        configured = self.settings.inside_networks
        both = self.stand_ins.is_bidirectional
        self.addressing.networks = configured or interface_networks(without_uplink=both)

    def caller_at(self, endpoint: Endpoint) -> Caller:
        """The node of an endpoint as a caller that gets addresses.

        The proxy looks up its own address, as the node sees it, again whenever it reads the
        networks.
        """
        address = endpoint.location.address
        name = min(endpoint.callers, default="")
        if address not in self._proxy_addresses:
            self._proxy_addresses[address] = address_towards(address)
        return Caller(address, self._proxy_addresses[address], name, "", endpoint)
