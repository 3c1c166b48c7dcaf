"""The policies in containers' labels: layers of rules for the nodes at their addresses alone.

A proxy holds a bounded number of rules. Where those of its containers are too many together, the
containers with the most are left out: who has many takes nothing from who has few.
"""

from collections import Counter
from collections.abc import Collection, Iterable, Mapping

from msgspec import structs

from rosproxy.access.layers import LONGEST_LAYER_NAME, MOST_LAYERS, PolicyLayer
from rosproxy.access.rules import MOST_RULES, format_rules
from rosproxy_operator.common.problem import Problem, bounded
from rosproxy_operator.docker.planner.labels.readers import POLICY
from rosproxy_operator.docker.planner.model import Container, Key, Member
from rosproxy_operator.docker.settings import PlanSettings

OUTLIVES = 10.0
"""Seconds for which an address keeps its layers after its container has gone.

What its nodes have registered is removed a moment later, and must not become visible before.
"""


def with_bounded_rules(
    members: Collection[Member], settings: PlanSettings
) -> tuple[tuple[Member, ...], tuple[Problem, ...]]:
    """The members whose rules their proxies can hold, and problems of the others."""
    common = sum(len(layer.rules) for layer in settings.policy)
    rules: Counter[Key] = Counter()
    layers: Counter[Key] = Counter()
    crowded: list[Member] = []
    asking = [member for member in members if member.policy and member.container.alive]
    for member in sorted(asking, key=lambda m: (len(m.policy), m.container.name)):
        key = member.key
        is_crowded = common + rules[key] + len(member.policy) > MOST_RULES
        if is_crowded or layers[key] + len(settings.policy) >= MOST_LAYERS:
            crowded.append(member)
            continue
        rules[key] += len(member.policy)
        layers[key] += 1
    text = (
        f"label {POLICY}: the container gets no proxy, since the containers of one proxy have too "
        f"many rules together (at most {MOST_RULES} rules in {MOST_LAYERS} policies). Join rules "
        "by globs, in this label or in the labels of the other containers"
    )
    return (
        tuple(member for member in members if member not in crowded),
        tuple(Problem(f"container {member.container.name}", text) for member in crowded),
    )


def label_layers(
    members: Iterable[Member], by_id: Mapping[str, Container], networks: Collection[str]
) -> tuple[PolicyLayer, ...]:
    """The layers of a proxy's containers, for their addresses on these networks."""
    layers: list[PolicyLayer] = []
    for member in members:
        owner = network_owner(member.container, by_id)
        attachments = (a for a in owner.attachments if a.network in networks)
        addresses = frozenset(a.address for a in attachments if a.address)
        if member.policy and member.container.alive and addresses:
            name = bounded(f"label of container {member.container.name}", LONGEST_LAYER_NAME)
            layers.append(PolicyLayer(name, member.policy, addresses=addresses))
    return tuple(layers)


def network_owner(container: Container, by_id: Mapping[str, Container]) -> Container:
    """The container in whose network namespace another one is: itself, if it has its own."""
    return by_id.get(container.network_container or container.id, container)


class RecentLayers:
    """The layers of containers' labels, and for some seconds those of containers that are gone."""

    def __init__(self) -> None:
        self._last_seen: dict[tuple[PolicyLayer, str], float] = {}

    def look(
        self, layers: Iterable[PolicyLayer], taken: Collection[str], now: float
    ) -> tuple[PolicyLayer, ...]:
        """All layers that a proxy is to have, the ``layers`` of this look included.

        ``taken`` are the addresses of all containers: layers of earlier looks keep none of them.
        """
        current = {
            (structs.replace(layer, addresses=None), address): now
            for layer in layers
            for address in layer.addresses or ()
        }
        recent = {
            pair: since
            for pair, since in self._last_seen.items()
            if now < since + OUTLIVES and pair[1] not in taken
        }
        self._last_seen = recent | current
        # What is remembered is the first to give way: the proxy refuses a policy that is too large.
        joined = _joined(self._last_seen)
        fits = sum(len(layer.rules) for layer in joined) <= MOST_RULES and len(joined) < MOST_LAYERS
        return joined if fits else _joined(current)


def _joined(pairs: Mapping[tuple[PolicyLayer, str], float]) -> tuple[PolicyLayer, ...]:
    """Layers with all their addresses, in a steady order."""
    addresses: dict[PolicyLayer, set[str]] = {}
    for layer, address in pairs:
        addresses.setdefault(layer, set()).add(address)
    joined = (structs.replace(layer, addresses=frozenset(a)) for layer, a in addresses.items())
    return tuple(sorted(joined, key=lambda layer: (layer.name, format_rules(layer.rules))))
