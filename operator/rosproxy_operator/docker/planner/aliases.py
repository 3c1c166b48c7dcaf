"""The names under which the nodes of containers find their proxies, by network.

An engine answers with all containers that have a name, in any order. So a proxy gets no name that
a container has: nodes would reach now one, now the other. A proxy that has such a name loses it.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass

from rosproxy.net.addresses import is_address
from rosproxy.telemetry.text import listed
from rosproxy_operator.common.problem import Problem
from rosproxy_operator.docker.planner.labels.alias_bounds import (
    alias_refusal,
    is_allowed_by_administrator,
)
from rosproxy_operator.docker.planner.labels.readers import ALIAS, MASTER_URI
from rosproxy_operator.docker.planner.model import Container, Desired, HostState, Key, Member
from rosproxy_operator.docker.planner.specs import is_proxy_name, master, proxy_name
from rosproxy_operator.docker.planner.taken_names import (
    FormerNames,
    NamesByNetwork,
    places_of,
    present_names,
)
from rosproxy_operator.docker.settings import PlanSettings

Aliases = Mapping[Key, Mapping[str, tuple[str, ...]]]
"""For a key and a network, the names of the key's proxy there."""


@dataclass(frozen=True, slots=True)
class Naming:
    """The names of the proxies, by key and network, and problems of containers without theirs.

    ``withdrawn`` are names, by network, that no proxy there may have or keep.
    """

    aliases: Aliases
    withdrawn: Mapping[str, frozenset[str]]
    problems: tuple[Problem, ...]

    def is_misnamed(self, sandbox: Container, network: str) -> bool:
        """Whether a sandbox has a name on a network that no proxy may have there.

        The engine takes no single name away: to lose one, the sandbox has to join the network anew.
        """
        # The engine gives these names by itself, so that joining anew would change nothing.
        lasting = {sandbox.name.lower(), sandbox.id[:12]}
        withdrawn = self.withdrawn.get(network, frozenset()) - lasting
        return any(answers_to(sandbox, network, name) for name in withdrawn)


@dataclass(frozen=True, slots=True)
class _Claim:
    """A name on a network, the proxies that want it, and the containers and proxies with it.

    ``refusal`` says why a label may not give the name; it is empty if a label may.
    """

    network: str
    alias: str
    claimants: tuple[Desired, ...]
    containers: tuple[str, ...]
    holders: tuple[Key, ...]
    refusal: str = ""

    @property
    def withdrawn(self) -> bool:
        """Whether no proxy may have the name."""
        return bool(self.containers or self.refusal)

    @property
    def owner(self) -> Key | None:
        """The proxy that gets the name; None if no proxy may have the name, or wants it.

        A proxy that already has the name keeps it, so that no connection is cut. Otherwise the
        first proxy gets it whose containers look for it, else the first that wants it.
        """
        if self.withdrawn or not self.claimants:
            return None
        if self.holders:
            return self.holders[0]
        needed = [d.key for d in self.claimants if needed_by(d, self.network, self.alias)]
        return (needed or [d.key for d in self.claimants])[0]


@dataclass(frozen=True, slots=True)
class _NameFacts:
    """What decides on a name: the host, the names of its containers, and the settings."""

    observed: HostState
    settings: PlanSettings
    present: NamesByNetwork
    former: FormerNames


def assign_aliases(
    desired: Collection[Desired], observed: HostState, settings: PlanSettings, former: FormerNames
) -> Naming:
    """The names of the proxies, and the containers that won't find theirs.

    ``desired`` is sorted by key. ``former`` are the names that containers have or had.
    """
    aliases: dict[Key, dict[str, tuple[str, ...]]] = {}
    withdrawn: dict[str, frozenset[str]] = {}
    problems: list[Problem] = []
    facts = _NameFacts(observed, settings, present_names(observed), former)
    for network in sorted({name for d in desired for name in d.networks}):
        proxies = [d for d in desired if network in d.networks]
        claims = [
            _claim(network, alias, proxies, facts)
            for alias in sorted({name for d in proxies for name in _names(d.key)})
        ]
        for claim in claims:
            if claim.owner is not None:
                names = aliases.setdefault(claim.owner, {})
                names[network] = (*names.get(network, ()), claim.alias)
        withdrawn[network] = frozenset(claim.alias for claim in claims if claim.withdrawn)
        common = next((claim for claim in claims if claim.alias == ALIAS), None)
        problems += [problem for claim in claims for problem in _problems(claim, common)]
    return Naming(aliases, withdrawn, tuple(problems))


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
    if key.ros != "1":  # found by multicast, as a peer, or by a redirect
        return (proxy_name(key),)
    host = master(key).host
    return (ALIAS, proxy_name(key), *(() if is_address(host) else (host,)))


def _claim(network: str, alias: str, proxies: Collection[Desired], facts: _NameFacts) -> _Claim:
    observed = facts.observed
    places = [*places_of(alias, network, (n.name for n in observed.networks))]
    containers = {
        holder
        for where, name in places
        for holder in facts.present.get(where, {}).get(name, frozenset())
    }
    holding = [s for s in observed.sandboxes if answers_to(s.container, network, alias)]
    staying = [d.key for d in proxies if d.key in {s.key for s in holding}]
    # One that is restarting can't leave the network: it answers there again in a moment.
    stuck = sorted(s.key for s in holding if s.container.state == "restarting")
    return _Claim(
        network,
        alias,
        claimants=tuple(d for d in proxies if d.live and alias in _names(d.key)),
        containers=tuple(sorted(containers)),
        holders=tuple(dict.fromkeys([*staying, *stuck])),
        refusal="" if alias == ALIAS or is_proxy_name(alias) else _refusal(alias, places, facts),
    )


def _refusal(alias: str, places: Iterable[tuple[str, str]], facts: _NameFacts) -> str:
    """Why the name of a master's host is not for a proxy, though no container has the name now."""
    if refusal := alias_refusal(alias, facts.settings):
        return refusal
    former = next((facts.former[place] for place in places if place in facts.former), "")
    if not former or is_allowed_by_administrator(alias, facts.settings):
        return ""
    return f"container {former} had the name, and may return"


def _problems(claim: _Claim, common: _Claim | None) -> Iterator[Problem]:
    """Warnings for containers that look for their proxy by a name that the proxy has not.

    ``common`` is the claim to the name that all proxies would have.
    """
    for claimant in claim.claimants:
        key = claimant.key
        if _has_name(claim, key):
            continue
        host = ALIAS if common and _has_name(common, key) else proxy_name(key)
        for member in _seekers(claimant, claim.network, claim.alias):
            fix = f"ROS_MASTER_URI=http://{host}:{master(key).port}"
            if MASTER_URI not in member.container.labels:
                # Without it a variable that names a proxy leaves open which master is meant.
                fix += f" and the label {MASTER_URI}={key.master_uri}"
            text = (
                f"the nodes look for the proxy by the name {claim.alias}, but "
                f"{_obstacle(claim, key, fix)}"
            )
            yield Problem(f"container {member.container.name}", text, fatal=False)


def _obstacle(claim: _Claim, key: Key, fix: str) -> str:
    """What keeps a proxy from a name, and what the user or the administrator can do.

    ``fix`` is the variable to set, and perhaps a label.
    """
    if claim.refusal and not claim.containers:
        return (
            f"labels may not give a proxy that name on network {claim.network}: {claim.refusal}. "
            "So the nodes bypass the proxy. Start the operator with --allow-alias "
            f"{claim.alias}, or set {fix}"
        )
    holders = [f"container {name}" for name in claim.containers]
    rivals = {*claim.holders, claim.owner or key} - {key}
    holders += [_holder(claim, rival) for rival in sorted(rivals)]
    return (
        f"on network {claim.network} that name belongs to {listed(holders)}. So the nodes bypass "
        f"the proxy. Set {fix}"
    )


def _has_name(claim: _Claim, key: Key) -> bool:
    """Whether the proxy answers to the name, or will, and no other proxy does."""
    return key == claim.owner and len(claim.holders) <= 1


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
