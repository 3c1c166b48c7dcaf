"""Under which names a proxy is found on each network.

An engine answers with all containers that have a name, in any order. So no name is taken that
another one holds: nodes would reach now this, now that.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass

from rosproxy.net.addresses import is_address
from rosproxy.telemetry.text import listed
from rosproxy_operator.common.problem import Problem
from rosproxy_operator.docker.planner.labels.masters import ALIAS
from rosproxy_operator.docker.planner.model import Container, Desired, HostState, Key
from rosproxy_operator.docker.planner.specs import master, proxy_name

Aliases = Mapping[Key, Mapping[str, tuple[str, ...]]]
"""For a key and a network, the names of the key's proxy there."""
_GONE = frozenset({"dead", "removing"})


@dataclass(frozen=True, slots=True)
class _Claim:
    """A name on a network, who wants it, and who has it already."""

    network: str
    alias: str
    claimants: tuple[Desired, ...]
    others: tuple[str, ...]
    holders: tuple[Key, ...]

    @property
    def owner(self) -> Key | None:
        """The proxy that gets the name; None if another container on the network has it.

        A proxy that already has the name keeps it, so that no connection is cut. Otherwise it goes
        to the first one whose containers look for it, else to the first that would have it. One
        that shares its name with another container loses it when it joins the network anew.
        """
        if self.others:
            return None
        if self.holders:
            return self.holders[0]
        needed = [one.key for one in self.claimants if needed_by(one, self.network, self.alias)]
        return (needed or [one.key for one in self.claimants])[0]


def assign(desired: Iterable[Desired], observed: HostState) -> tuple[Aliases, list[Problem]]:
    """The names of the proxies that are wanted, and the containers that won't find theirs.

    ``desired`` is sorted by key.
    """
    given: dict[Key, dict[str, tuple[str, ...]]] = {}
    problems: list[Problem] = []
    for claim in _claims(tuple(desired), observed):
        if claim.owner is not None:
            names = given.setdefault(claim.owner, {})
            names[claim.network] = (*names.get(claim.network, ()), claim.alias)
        problems += _problems(claim)
    return given, problems


def needed_by(desired: Desired, network: str, alias: str) -> tuple[str, ...]:
    """The containers of a proxy on a network that look for it by this name."""
    return tuple(
        member.container.name
        for member in desired.members
        if network in member.networks and member.needs == alias
    )


def holds(container: Container, network: str, alias: str) -> bool:
    """Whether a container answers to a name on a network; case does not matter to engines."""
    return any(
        alias.lower() in map(str.lower, place.names)
        for place in container.attachments
        if place.network == network
    )


def _names(key: Key) -> tuple[str, ...]:
    """The names that a proxy is to have: its container's own, too, which has no endpoint itself."""
    host = master(key).host
    return (ALIAS, proxy_name(key), *(() if is_address(host) else (host,)))


def _claims(desired: Collection[Desired], observed: HostState) -> Iterator[_Claim]:
    for network in sorted({name for one in desired if one.live for name in one.networks}):
        there = [one for one in desired if network in one.networks]
        for alias in sorted({name for one in there if one.live for name in _names(one.key)}):
            yield _claim(network, alias, there, observed)


def _claim(network: str, alias: str, there: list[Desired], observed: HostState) -> _Claim:
    others = [
        container.name
        for container in observed.containers
        if container.state not in _GONE and holds(container, network, alias)
    ]
    having = [box for box in observed.sandboxes if holds(box.container, network, alias)]
    staying = [one.key for one in there if one.key in {box.key for box in having}]
    # One that is restarting can't leave the network: it answers there again in a moment.
    stuck = sorted(box.key for box in having if box.container.state == "restarting")
    return _Claim(
        network,
        alias,
        claimants=tuple(one for one in there if one.live and alias in _names(one.key)),
        others=tuple(sorted(others)),
        holders=tuple(dict.fromkeys([*staying, *stuck])),
    )


def _problems(claim: _Claim) -> Iterator[Problem]:
    """What containers are told that look for their proxy by a name that others have."""
    containers = [f"container {name}" for name in claim.others]
    for one in claim.claimants:
        if one.key == claim.owner and not claim.others and len(claim.holders) <= 1:
            continue
        proxies = {*claim.holders, claim.owner or one.key} - {one.key}
        others = [*containers, *sorted(f"proxy {proxy_name(other)}" for other in proxies)]
        host = proxy_name(one.key) if claim.alias == ALIAS else ALIAS
        for container in needed_by(one, claim.network, claim.alias):
            yield Problem(
                f"container {container}",
                f"looks for its proxy by the name {claim.alias}, but on network {claim.network} "
                f"{listed(others)} answers to it, so its nodes go around their proxy: "
                f"set ROS_MASTER_URI=http://{host}:{master(one.key).port}",
                fatal=False,
            )
