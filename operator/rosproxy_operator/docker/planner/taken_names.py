"""Which names containers have or had on a network, so that no proxy may be given them by a label.

The caller that creates a container chooses its name and aliases; an image does not. The label
``com.docker.compose.service`` is not read. An image can carry this label, and Compose gives each
service its name as an alias anyway.

A container finds the names of all its networks. So a name of another network is taken as well, if a
container is on both networks.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping

from rosproxy_operator.docker.planner.labels.readers import BUILT_IN
from rosproxy_operator.docker.planner.model import Container, HostState

MOST_REMEMBERED = 10_000
"""Names of containers that are remembered; beyond that the ones unseen for longest are forgotten.

A container has two names on a network as a rule, and some 150 bytes are kept of each.
"""
GONE = frozenset({"dead", "removing"})
"""States of a container that answers to its names never again."""

NamesByNetwork = Mapping[str, Mapping[str, frozenset[str]]]
"""By network and name (in lower case): the containers of that name, as texts show them."""
FormerNames = Mapping[tuple[str, str], str]
"""By network and name (in lower case): a container that has or had the name. The latest is last."""


def present_names(observed: HostState) -> NamesByNetwork:
    """The names of all containers, running or not, by each network where the name is taken."""
    own: dict[str, dict[str, set[str]]] = defaultdict(lambda: defaultdict(set))
    neighbours: dict[str, set[str]] = defaultdict(set)
    for container in observed.containers:
        if container.state in GONE:
            continue
        for attachment in container.attachments:
            for name in attachment.names:
                own[attachment.network][name.lower()].add(container.name)
            # No names resolve on built-in networks: a container there finds no names of others.
            neighbours[attachment.network] |= container.networks - BUILT_IN
    taken: dict[str, dict[str, frozenset[str]]] = {}
    for network, others in neighbours.items():
        merged: dict[str, set[str]] = defaultdict(set)
        for other in others | {network}:
            for name, containers in own[other].items():
                place = "" if other == network else f" (network {other})"
                merged[name] |= {f"{container}{place}" for container in containers}
        taken[network] = {name: frozenset(containers) for name, containers in merged.items()}
    return taken


def places_of(name: str, network: str, networks: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Where the engine looks for a name that a container of a network asks for: network, name.

    The engine also answers to ``NAME.NETWORK`` (moby: libnetwork/sandbox.go, ResolveName), and
    looks for the whole name first: a proxy of that alias would stand before the container.
    """
    wanted = name.lower()
    yield network, wanted
    for other in networks:
        if wanted.endswith(f".{other.lower()}"):
            yield other, wanted[: -len(other) - 1]


def remember_names(
    former: FormerNames, present: NamesByNetwork, containers: Iterable[Container]
) -> FormerNames:
    """The names that containers had or have, for the next look."""
    # No later container gets the short id of another one as its name.
    short_ids = {container.id[:12] for container in containers}
    current = {
        (network, name): min(holders)
        for network, names in present.items()
        for name, holders in names.items()
        if name not in short_ids
    }
    known = {place: holder for place, holder in former.items() if place not in current} | current
    return dict(list(known.items())[-MOST_REMEMBERED:])
