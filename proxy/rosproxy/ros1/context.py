"""What the parts of a running proxy share: its state, and the tools to act on it.

Made once (`make_context`), before the parts; none of them keeps a copy of what is in it.
"""

import time
import uuid
from collections.abc import Sequence
from dataclasses import dataclass, field

from rosproxy.net.addresses import Network, is_inside
from rosproxy.net.interfaces import address_towards, interface_networks
from rosproxy.net.tasks import Tasks
from rosproxy.ros1.clients.master import MasterClient
from rosproxy.ros1.protocol.master_methods import KNOWN_METHODS
from rosproxy.ros1.registry.endpoint import Endpoint
from rosproxy.ros1.registry.registry import Registry
from rosproxy.ros1.rewriting.addressing import Addressing, Asker
from rosproxy.settings import Settings
from rosproxy.telemetry.metrics import Metrics
from rosproxy.telemetry.problems import Problems

NETWORKS_TTL = 5.0
"""Seconds for which the list of the machine's own networks is taken as current."""


@dataclass(slots=True)
class Context:
    """The state and the tools of one running proxy."""

    settings: Settings
    registry: Registry
    addressing: Addressing
    upstream: MasterClient
    metrics: Metrics
    tasks: Tasks
    instance: str
    problems: Problems = field(default_factory=Problems)
    retired: bool = False
    """Whether nothing is registered any more, neither for nodes nor by the proxy itself."""
    _networks: tuple[float, Sequence[Network]] = (0.0, ())
    _towards: dict[str, str] = field(default_factory=dict)

    def now(self) -> float:
        """Seconds of the monotonic clock."""
        return time.monotonic()

    def refresh_networks(self, source: str = "") -> None:
        """Take in the networks that the proxy's interfaces are in now.

        They are read every few seconds, and at once where a call comes from a ``source`` in none
        of them: containers join networks while they run.
        """
        read, _ = self._networks
        unknown = source and not is_inside(source, self.addressing.networks)
        if unknown or self.now() - read > NETWORKS_TTL:
            self.read_networks()

    def read_networks(self) -> None:
        """The same at once."""
        self._towards.clear()
        self._networks = (self.now(), self.settings.inside_networks or interface_networks())
        self.addressing.networks = self._networks[1]

    def node_asker(self, endpoint: Endpoint) -> Asker:
        """The node of an endpoint as somebody who is given addresses."""
        address, name = endpoint.place.address, min(endpoint.callers, default="")
        return Asker(address, self._address_towards(address), name, "", endpoint)

    def _address_towards(self, address: str) -> str:
        """The proxy's own address that a node sees, looked up as often as the networks are."""
        if address not in self._towards:
            self._towards[address] = address_towards(address)
        return self._towards[address]


def make_context(settings: Settings) -> Context:
    """A context for a proxy that is about to start; needs a running event loop."""
    registry, metrics, instance = (
        Registry(settings.ports.listen),
        Metrics(KNOWN_METHODS),
        uuid.uuid4().hex,
    )
    context = Context(
        settings=settings,
        registry=registry,
        addressing=Addressing(registry, settings.advertise_host, settings.ports),
        upstream=MasterClient(settings.master_uri, instance, metrics, settings.master_address),
        metrics=metrics,
        tasks=Tasks(),
        instance=instance,
    )
    context.refresh_networks()
    return context
