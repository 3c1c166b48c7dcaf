"""Find the names that containers have or had on a network. No label gives a proxy such a name.

The caller that creates a container chooses its name and aliases; an image does not. The label
``com.docker.compose.service`` is not read. An image can carry this label, and Compose gives each
service its name as an alias anyway.

A container finds the names of all its networks. So a name on one network is also taken on a second
network if a container is on both networks.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping

from rosproxy_operator.docker.planner.labels.readers import BUILT_IN_NETWORKS
from rosproxy_operator.docker.planner.model import Container, HostState

MOST_REMEMBERED_NAMES = 10_000
"""Most names that the operator remembers. The names unseen for the longest time are dropped first.

A container usually has two names on a network, and each name takes about 150 bytes.
"""
GONE_STATES = frozenset({"dead", "removing"})
"""States of a container that never answers to its names again."""

NamesByNetwork = Mapping[str, Mapping[str, frozenset[str]]]
"""By network and name (in lower case): the containers of that name, as texts show them."""
FormerNames = Mapping[tuple[str, str], str]
"""By network and name (in lower case): a container that has or had the name. The latest is last."""


def present_names(observed: HostState) -> NamesByNetwork:
    """The names of all containers, running or not, by network where the name is taken."""
    own: dict[str, dict[str, set[str]]] = defaultdict(lambda: defaultdict(set))
    neighbours: dict[str, set[str]] = defaultdict(set)
    for container in observed.containers:
        if container.state in GONE_STATES:
            continue
        for attachment in container.attachments:
            for name in attachment.names:
                own[attachment.network][name.lower()].add(container.name)
            # No names resolve on built-in networks, so names there are not taken on other networks.
            neighbours[attachment.network] |= container.networks - BUILT_IN_NETWORKS
    taken: dict[str, dict[str, frozenset[str]]] = {}
    for network, others in neighbours.items():
        merged: dict[str, set[str]] = defaultdict(set)
        for other in others | {network}:
            for name, containers in own[other].items():
                suffix = "" if other == network else f" (network {other})"
                merged[name] |= {f"{container}{suffix}" for container in containers}
        taken[network] = {name: frozenset(containers) for name, containers in merged.items()}
    return taken


def lookups_of(name: str, network: str, networks: Iterable[str]) -> Iterator[tuple[str, str]]:
    """The pairs of network and name where the engine looks up a name for a container of a network.

    The engine resolves ``NAME.NETWORK`` as well (moby: libnetwork/sandbox.go, ResolveName), but
    looks up the whole text first. So a proxy with the alias ``NAME.NETWORK`` would replace the
    container ``NAME``.
    """
    wanted = name.lower()
    yield network, wanted
    for other in networks:
        if wanted.endswith(f".{other.lower()}"):
            yield other, wanted[: -len(other) - 1]


def remember_names(
    former: FormerNames, present: NamesByNetwork, containers: Iterable[Container]
) -> FormerNames:
    """Return the names that containers have or had, for the next look."""
    # A short id is left out: no later container gets the short id of another container.
    short_ids = {container.id[:12] for container in containers}
    current = {
        (network, name): min(holders)
        for network, names in present.items()
        for name, holders in names.items()
        if name not in short_ids
    }
    known = {pair: holder for pair, holder in former.items() if pair not in current} | current
    return dict(list(known.items())[-MOST_REMEMBERED_NAMES:])
