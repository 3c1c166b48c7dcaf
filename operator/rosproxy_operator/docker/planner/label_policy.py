"""The policies in containers' labels: layers of rules for the nodes at a container's addresses.

A proxy holds a bounded number of rules. If the containers of a proxy have too many rules together,
the containers with the most rules get no proxy. So a container with many rules takes nothing from
other containers.
"""

from collections import Counter
from collections.abc import Collection, Iterable, Mapping

from msgspec import structs

from rosproxy.shared.policy.layers import LONGEST_LAYER_NAME, MOST_LAYERS, PolicyLayer
from rosproxy.shared.policy.rules import MOST_RULES, format_rules
from rosproxy.shared.ports import PortRange
from rosproxy_operator.common.problem import (
    TOO_MANY,
    Problem,
    bounded,
)
from rosproxy_operator.docker.planner.labels.readers import POLICY
from rosproxy_operator.docker.planner.model import Container, HostState, Member
from rosproxy_operator.docker.planner.network_owner import by_reference, network_owner
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.proxy_spec.place import ZENOH, Place

LAYERS_KEPT_S = 10.0
"""Seconds for which an address keeps the layers of a container that has gone.

The proxy unregisters the nodes of that container a moment later. Until then the layers have to hide
the denied names.
"""


def with_bounded_rules(
    members: Collection[Member], settings: PlanSettings
) -> tuple[tuple[Member, ...], tuple[Problem, ...]]:
    """Return the members whose rules the proxies can hold, and a problem for each other member."""
    common = sum(len(layer.rules) for layer in settings.policy)
    rules: Counter[Place] = Counter()
    layers: Counter[Place] = Counter()
    refused: list[Member] = []
    asking = [member for member in members if member.policy and member.container.alive]
    for member in sorted(asking, key=lambda m: (len(m.policy), m.container.name)):
        place = member.place
        is_full = common + rules[place] + len(member.policy) > MOST_RULES
        if is_full or layers[place] + len(settings.policy) >= MOST_LAYERS:
            refused.append(member)
            continue
        rules[place] += len(member.policy)
        layers[place] += 1
    text = (
        f"label {POLICY}: the container gets no proxy, since the containers of one proxy have too "
        f"many rules together (at most {MOST_RULES} rules in {MOST_LAYERS} policies)"
    )
    fix = "Join rules by globs, in this label or in the labels of the other containers"
    return (
        tuple(member for member in members if member not in refused),
        tuple(
            Problem(f"container {member.container.name}", text, fix, reason=TOO_MANY)
            for member in refused
        ),
    )


def label_layers(
    members: Iterable[Member],
    observed: HostState,
    networks: Collection[str],
    routers: PortRange | None = None,
) -> tuple[PolicyLayer, ...]:
    """Return the layers of living members, each for the container's addresses on ``networks``.

    ``routers`` are the ports of the proxy for rmw_zenoh, whose layers need ports; None for other
    proxies.
    """
    containers = by_reference(observed.containers)
    layers: list[PolicyLayer] = []
    for member in members:
        owner = network_owner(member.container, containers)
        attachments = (a for a in owner.attachments if a.network in networks)
        addresses = frozenset(a.address for a in attachments if a.address)
        if member.policy and member.container.alive and addresses:
            name = bounded(f"label of container {member.container.name}", LONGEST_LAYER_NAME)
            ports = _ports_at(owner, routers, observed) if routers else None
            layers.append(PolicyLayer(name, member.policy, addresses=addresses, ports=ports))
    return tuple(layers)


def _ports_at(owner: Container, routers: PortRange, observed: HostState) -> frozenset[int]:
    """Return the ports of the proxy for rmw_zenoh at which the rules of a container apply.

    These are the port of the container's redirect, and all ports that no container has. A container
    gets one of the free ports before the proxy learns which.
    """
    alive = {container.id for container in observed.containers if container.alive}
    owner_by_port: dict[int, set[str]] = {}
    for record in observed.redirects:
        target = record.container.network_container
        if record.place == ZENOH and target in alive:
            owner_by_port.setdefault(record.range.first, set()).add(target)
    return frozenset(p for p in routers.ports() if owner.id in owner_by_port.get(p, {owner.id}))


class RecentLayers:
    """The layers of labels, also those of containers that have gone in the last `LAYERS_KEPT_S`."""

    def __init__(self) -> None:
        self._last_seen: dict[tuple[PolicyLayer, str], float] = {}

    def record(
        self, layers: Iterable[PolicyLayer], taken: Collection[str], now: float
    ) -> tuple[PolicyLayer, ...]:
        """Return the ``layers`` of this look, and the remembered layers of earlier looks.

        ``taken`` has the addresses of all containers. At these addresses only the layers of this
        look count. ``now`` is in monotonic seconds.
        """
        current = {
            (structs.replace(layer, addresses=None), address): now
            for layer in layers
            for address in layer.addresses or ()
        }
        recent = {
            pair: since
            for pair, since in self._last_seen.items()
            if now < since + LAYERS_KEPT_S and pair[1] not in taken
        }
        self._last_seen = recent | current
        # The proxy refuses a policy that is too large. So remembered layers are left out first.
        joined = _joined(self._last_seen)
        fits = sum(len(layer.rules) for layer in joined) <= MOST_RULES and len(joined) < MOST_LAYERS
        return joined if fits else _joined(current)


def _joined(pairs: Mapping[tuple[PolicyLayer, str], float]) -> tuple[PolicyLayer, ...]:
    """Return each layer once, with all addresses. The order is always the same."""
    addresses: dict[PolicyLayer, set[str]] = {}
    for layer, address in pairs:
        addresses.setdefault(layer, set()).add(address)
    joined = (structs.replace(layer, addresses=frozenset(a)) for layer, a in addresses.items())
    return tuple(sorted(joined, key=lambda layer: (layer.name, format_rules(layer.rules))))
