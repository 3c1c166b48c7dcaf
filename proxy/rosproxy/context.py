"""What the parts of a running proxy share."""

import time
import uuid
from collections.abc import Sequence
from dataclasses import dataclass, field

from rosproxy.core.addressing import Addressing, Asker, Network
from rosproxy.core.registry import Endpoint, Registry
from rosproxy.core.settings import Settings
from rosproxy.listeners import PortBank
from rosproxy.metrics import Metrics
from rosproxy.network import address_towards, interface_networks
from rosproxy.problems import Problems
from rosproxy.tasks import Tasks
from rosproxy.upstream import Upstream

NETWORKS_TTL = 5.0
"""Seconds for which the list of the machine's own networks is taken as current."""


@dataclass(slots=True)
class Context:
    """The state and the tools of one running proxy."""

    settings: Settings
    registry: Registry
    addressing: Addressing
    bank: PortBank
    upstream: Upstream
    metrics: Metrics
    tasks: Tasks
    instance: str
    problems: Problems = field(default_factory=Problems)
    _networks: tuple[float, Sequence[Network]] = (0.0, ())

    def now(self) -> float:
        """Seconds of the monotonic clock."""
        return time.monotonic()

    def refresh_networks(self) -> None:
        """Take in the networks that the proxy's interfaces are in now."""
        if self.settings.inside_networks:
            self.addressing.networks = self.settings.inside_networks
            return
        read, _ = self._networks
        if self.now() - read > NETWORKS_TTL:
            self._networks = (self.now(), interface_networks())
            self.addressing.networks = self._networks[1]

    def node_asker(self, endpoint: Endpoint) -> Asker:
        """The node of an endpoint as somebody who is given addresses."""
        address = endpoint.place.address
        return Asker(
            address, address_towards(address), next(iter(endpoint.caller_ids), ""), "", endpoint
        )


def make_context(settings: Settings) -> Context:
    """A context for a proxy that is about to start; needs a running event loop."""
    registry, metrics, instance = Registry(settings.ports.listen), Metrics(), uuid.uuid4().hex
    context = Context(
        settings=settings,
        registry=registry,
        addressing=Addressing(registry, settings.advertise_host, settings.ports),
        bank=PortBank(settings.bind),
        upstream=Upstream(settings.master_uri, instance, metrics),
        metrics=metrics,
        tasks=Tasks(),
        instance=instance,
    )
    context.refresh_networks()
    return context
