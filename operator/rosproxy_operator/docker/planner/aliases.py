"""Under which names a proxy is found on each network.

An engine answers with all containers that have a name, in any order. So no name is taken that
another one holds: nodes would reach now this, now that.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

from rosproxy.net.addresses import is_address
from rosproxy.telemetry.text import listed
from rosproxy_operator.common.problem import Problem
from rosproxy_operator.docker.planner.labels.masters import ALIAS
from rosproxy_operator.docker.planner.model import Container, Desired, HostState, Key, Sandbox
from rosproxy_operator.docker.planner.specs import master, proxy_name

Aliases = Mapping[tuple[Key, str], tuple[str, ...]]
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


def assign(desired: Iterable[Desired], observed: HostState) -> tuple[Aliases, tuple[Problem, ...]]:
    """The names of the proxies that are wanted, and the containers that won't find theirs."""
    claims = [*_claims(sorted(desired, key=lambda one: one.key), observed)]
    given: dict[tuple[Key, str], tuple[str, ...]] = {}
    for claim in claims:
        if claim.owner is not None:
            place = claim.owner, claim.network
            given[place] = (*given.get(place, ()), claim.alias)
    return given, tuple(problem for claim in claims for problem in _problems(claim))


def needed_by(desired: Desired, network: str, alias: str) -> tuple[str, ...]:
    """The containers of a proxy on a network that look for it by this name."""
    return tuple(
        member.container
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


def _claims(desired: list[Desired], observed: HostState) -> Iterator[_Claim]:
    live = [one for one in desired if one.live]
    for network in sorted({name for one in live for name in one.networks}):
        there = [one for one in desired if network in one.networks]
        for alias in sorted({name for one in there if one.live for name in _names(one.key)}):
            yield _claim(network, alias, there, observed)


def _claim(network: str, alias: str, there: list[Desired], observed: HostState) -> _Claim:
    others = [
        container.name
        for container in observed.containers
        if container.state not in _GONE and holds(container, network, alias)
    ]
    having = [s for s in observed.sandboxes if holds(s.container, network, alias)]
    staying = [one.key for one in there if one.key in {s.key for s in having}]
    return _Claim(
        network,
        alias,
        claimants=tuple(one for one in there if one.live and alias in _names(one.key)),
        others=tuple(sorted(others)),
        holders=tuple(dict.fromkeys([*staying, *_stuck(having)])),
    )


def _stuck(sandboxes: Iterable[Sandbox]) -> list[Key]:
    """Whose sandboxes can't leave a network: it answers there again as soon as it is restarted."""
    return sorted(one.key for one in sandboxes if one.container.state == "restarting")


def _problems(claim: _Claim) -> Iterator[Problem]:
    for one in claim.claimants:
        if one.key != claim.owner or claim.others or len(claim.holders) > 1:
            for container in needed_by(one, claim.network, claim.alias):
                yield Problem(f"container {container}", _misled_text(claim, one.key), fatal=False)


def _misled_text(claim: _Claim, key: Key) -> str:
    """What a container is told that looks for its proxy by a name that others have."""
    proxies = {*claim.holders, claim.owner or key} - {key}
    others = [f"container {name}" for name in claim.others]
    others += sorted(f"proxy {proxy_name(other)}" for other in proxies)
    host = proxy_name(key) if claim.alias == ALIAS else ALIAS
    return (
        f"looks for its proxy by the name {claim.alias}, but on network {claim.network} "
        f"{listed(others)} answers to it, so its nodes go around their proxy: "
        f"set ROS_MASTER_URI=http://{host}:{master(key).port}"
    )
