"""What the parts of a running proxy share: its state, and the tools to act on it.

Made once, before the parts; none of them keeps a copy of what is in it.
"""

import asyncio
import time
import uuid

from rosproxy.access.access_policy import AccessPolicy
from rosproxy.net.addresses import is_inside
from rosproxy.net.budget import Budget
from rosproxy.net.gate import Gate
from rosproxy.net.interfaces import address_towards, interface_networks
from rosproxy.net.tasks import Tasks
from rosproxy.ros1.clients.master import MasterClient
from rosproxy.ros1.clients.node import NodeClient
from rosproxy.ros1.protocol.master_methods import KNOWN_METHODS
from rosproxy.ros1.protocol.xmlrpc import limits
from rosproxy.ros1.registry.endpoint import Endpoint
from rosproxy.ros1.registry.registry import Registry
from rosproxy.ros1.registry.selection import Standing, standing
from rosproxy.ros1.registry.stand_ins import StandIns
from rosproxy.ros1.rewriting.addressing import Addressing, Asker
from rosproxy.settings import MEBIBYTE, Settings
from rosproxy.telemetry.metrics import Metrics
from rosproxy.telemetry.problems import Problems
from rosproxy.telemetry.refusals import Refusals

REGISTRATION_GRACE = 0.5
"""Seconds that a publisherUpdate waits at most for a registration of the same node."""
NETWORKS_TTL = 5.0
"""Seconds for which the list of the machine's own networks is taken as current."""
MANY_VALUES = 100
"""Values from which on a document is large; registrations have six."""
MOST_PASSING = 256
"""Calls and replies that pass unread at once; each takes a thread of the master's."""
PASSING_SHARE = 64
"""Those of them from one source."""


class Context:
    """The state and the tools of one proxy that is about to start; needs a running event loop.

    ``retired``: nothing is registered any more, neither for nodes nor by the proxy itself.
    ``selected``: the addresses that may use the proxy as their master; None: no operator has told.
    ``lease_call`` and ``master_call`` bound what is read of a call from outside and from inside.
    ``gate`` counts connections, ``buffered`` the bytes of requests and replies in memory,
    ``passing`` the calls that pass unread; ``refusals`` tells what is over these and other bounds.
    ``policy``: what outside may see and do.
    """

    def __init__(self, settings: Settings) -> None:
        self.settings, self.instance = settings, uuid.uuid4().hex
        self.metrics, self.tasks, self.problems = Metrics(KNOWN_METHODS), Tasks(), Problems()
        self.refusals = Refusals(self.metrics, self.problems, self.now)
        self.policy = AccessPolicy(
            settings.policy, settings.policy_layers, self.metrics, self.refusals
        )
        self.gate = Gate(
            settings.max_connections_per_source,
            settings.max_connections_per_lease,
            self.refusals.note,
        )
        self.lease_call = limits.lease_call(settings.max_lease_call)
        self.master_call = limits.master_call(settings.max_master_call)
        held = settings.max_buffered * MEBIBYTE
        self.buffered = Budget(held, held // 2, "bytes of requests and replies")
        self._turn = asyncio.Lock()
        self.passing = Budget(MOST_PASSING, PASSING_SHARE, "long requests and replies")
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
        self.retired = False
        self.selected: frozenset[str] | None = None
        self._towards: dict[str, str] = {}
        self.read_networks()

    def now(self) -> float:
        """Seconds of the monotonic clock."""
        return time.monotonic()

    async def take_turn(self) -> None:
        """Wait for one's turn to read or rewrite a document of more than MANY_VALUES.

        All connections are looked at in between. Else many large documents that come together
        would hold everybody up.
        """
        async with self._turn:
            await asyncio.sleep(0)

    def standing(self, address: str) -> Standing:
        """Whether an address may use the proxy as its master, as far as is known now."""
        return standing(address, self.addressing.networks, self.selected)

    async def after_registration(self, endpoint: Endpoint) -> None:
        """Let the reply to a registration that is under way reach a node first.

        A node that applies an older list of publishers after a newer one loses a publisher; the
        way through the proxy must not make that race of ROS more likely.
        """
        deadline = self.now() + REGISTRATION_GRACE
        while endpoint.pending and self.now() < deadline:  # noqa: ASYNC110 - rare, short
            await asyncio.sleep(0.002)

    def refresh_networks(self, source: str = "") -> None:
        """Take in the networks that the proxy's interfaces are in now.

        They are read every few seconds, and at once where a call comes from a ``source`` in none
        of them: containers join networks while they run.
        """
        unknown = source and not is_inside(source, self.addressing.networks)
        if unknown or self.now() - self._networks_read > NETWORKS_TTL:
            self.read_networks()

    def read_networks(self) -> None:
        """The same at once."""
        self._towards.clear()
        self._networks_read = self.now()
        given, both = self.settings.inside_networks, self.stand_ins.both
        self.addressing.networks = given or interface_networks(without_uplink=both)

    def node_asker(self, endpoint: Endpoint) -> Asker:
        """The node of an endpoint as somebody who is given addresses.

        The proxy's own address that it sees is looked up as often as the networks are.
        """
        address, name = endpoint.place.address, min(endpoint.callers, default="")
        if address not in self._towards:
            self._towards[address] = address_towards(address)
        return Asker(address, self._towards[address], name, "", endpoint)
