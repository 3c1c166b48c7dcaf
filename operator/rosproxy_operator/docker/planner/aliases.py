"""The names under which the nodes of containers find their proxies, by network.

An engine answers with all containers that have a name, in any order. So no name is taken that
another one holds: nodes would reach now one, now the other.
"""

from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass

from rosproxy.net.addresses import is_address
from rosproxy.telemetry.text import listed
from rosproxy_operator.common.problem import Problem
from rosproxy_operator.docker.planner.labels.readers import ALIAS, MASTER_URI
from rosproxy_operator.docker.planner.model import (
    Container,
    Desired,
    HostState,
    Key,
    Member,
    Sandbox,
)
from rosproxy_operator.docker.planner.specs import master, proxy_name

Aliases = Mapping[Key, Mapping[str, tuple[str, ...]]]
"""For a key and a network, the names of the key's proxy there."""
_GONE = frozenset({"dead", "removing"})


@dataclass(frozen=True, slots=True)
class _Claim:
    """A name on a network, the proxies that want it, and the containers and proxies with it."""

    network: str
    alias: str
    claimants: tuple[Desired, ...]
    containers: tuple[str, ...]
    holders: tuple[Key, ...]

    @property
    def owner(self) -> Key | None:
        """The proxy that gets the name; None if another container on the network has it.

        A proxy that already has the name keeps it, so that no connection is cut. Otherwise it goes
        to the first one whose containers look for it, else to the first that would have it. One
        that shares its name with another container loses it when it joins the network anew.
        """
        if self.containers:
            return None
        if self.holders:
            return self.holders[0]
        needed = [d.key for d in self.claimants if needed_by(d, self.network, self.alias)]
        return (needed or [d.key for d in self.claimants])[0]


def assign_aliases(
    desired: Collection[Desired], observed: HostState
) -> tuple[Aliases, list[Problem]]:
    """The names of the proxies that are wanted, and the containers that won't find theirs.

    ``desired`` is sorted by key.
    """
    aliases: dict[Key, dict[str, tuple[str, ...]]] = {}
    problems: list[Problem] = []
    neighbours: dict[str, list[Container]] = defaultdict(list)
    for container in observed.containers:
        for network in container.networks:
            neighbours[network].append(container)
    for network in sorted({name for d in desired if d.live for name in d.networks}):
        proxies = [d for d in desired if network in d.networks]
        claims = [
            _claim(network, alias, proxies, neighbours[network], observed.sandboxes)
            for alias in sorted({name for d in proxies if d.live for name in _names(d.key)})
        ]
        for claim in claims:
            if claim.owner is not None:
                names = aliases.setdefault(claim.owner, {})
                names[network] = (*names.get(network, ()), claim.alias)
        common = next((claim for claim in claims if claim.alias == ALIAS), None)
        problems += [problem for claim in claims for problem in _problems(claim, common)]
    return aliases, problems


def needed_by(desired: Desired, network: str, alias: str) -> tuple[str, ...]:
    """The containers of a proxy on a network that look for it by this name."""
    return tuple(member.container.name for member in _seekers(desired, network, alias))


def _seekers(desired: Desired, network: str, alias: str) -> Iterator[Member]:
    return (m for m in desired.members if network in m.networks and m.wanted_alias == alias)


def answers_to(container: Container, network: str, alias: str) -> bool:
    """Whether a container answers to a name on a network; case does not matter to engines."""
    return any(
        alias.lower() in map(str.lower, attachment.names)
        for attachment in container.attachments
        if attachment.network == network
    )


def _names(key: Key) -> tuple[str, ...]:
    """The names that a proxy is to have: its container's own, too, which has no endpoint itself."""
    if key.is_ros2:  # found by multicast, or as a peer
        return (proxy_name(key),)
    host = master(key).host
    return (ALIAS, proxy_name(key), *(() if is_address(host) else (host,)))


def _claim(
    network: str,
    alias: str,
    proxies: Iterable[Desired],
    neighbours: Iterable[Container],
    sandboxes: Iterable[Sandbox],
) -> _Claim:
    containers = [
        container.name
        for container in neighbours
        if container.state not in _GONE and answers_to(container, network, alias)
    ]
    holding = [s for s in sandboxes if answers_to(s.container, network, alias)]
    staying = [d.key for d in proxies if d.key in {s.key for s in holding}]
    # One that is restarting can't leave the network: it answers there again in a moment.
    stuck = sorted(s.key for s in holding if s.container.state == "restarting")
    return _Claim(
        network,
        alias,
        claimants=tuple(d for d in proxies if d.live and alias in _names(d.key)),
        containers=tuple(sorted(containers)),
        holders=tuple(dict.fromkeys([*staying, *stuck])),
    )


def _problems(claim: _Claim, common: _Claim | None) -> Iterator[Problem]:
    """Warnings for containers that look for their proxy by a name that others have.

    ``common`` is the claim to the name that all proxies would have.
    """
    for claimant in claim.claimants:
        if _has_name(claim, claimant.key):
            continue
        holders = [f"container {name}" for name in claim.containers]
        rivals = {*claim.holders, claim.owner or claimant.key} - {claimant.key}
        holders += [_holder(claim, key) for key in sorted(rivals)]
        key = claimant.key
        host = ALIAS if common and _has_name(common, key) else proxy_name(key)
        for member in _seekers(claimant, claim.network, claim.alias):
            fix = f"set ROS_MASTER_URI=http://{host}:{master(key).port}"
            if MASTER_URI not in member.container.labels:
                # Without it a variable that names a proxy leaves open which master is meant.
                fix += f" and the label {MASTER_URI}={key.master_uri}"
            yield Problem(
                f"container {member.container.name}",
                f"looks for its proxy by the name {claim.alias}, but on network {claim.network} "
                f"{listed(holders)} answers to it, so its nodes go around their proxy: {fix}",
                fatal=False,
            )


def _has_name(claim: _Claim, key: Key) -> bool:
    """Whether a proxy, and nobody else, answers to the name, or will."""
    return key == claim.owner and not claim.containers and len(claim.holders) <= 1


def _holder(claim: _Claim, key: Key) -> str:
    """A proxy that has the name, and the containers for which it is there: they may be wrong."""
    containers = [
        member.container.name
        for claimant in claim.claimants
        if claimant.key == key
        for member in claimant.members
    ]
    served = f" (for the master {key.master_uri} of {listed(containers)})" if containers else ""
    return f"proxy {proxy_name(key)}{served}"
