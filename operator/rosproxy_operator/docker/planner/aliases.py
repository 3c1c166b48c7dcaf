"""The names under which the nodes of containers find the proxies, by network.

If several containers on a network have the same name, the engine resolves this name to all of
these containers, in any order: nodes would reach the proxy or the container by chance. So a proxy
gets no name that a container has. A proxy loses its name if a container gets the same name.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass

from rosproxy.shared.addresses import is_address
from rosproxy.shared.output.text import listed
from rosproxy_operator.common.problem import Fault, Problem
from rosproxy_operator.docker.planner.labels.alias_bounds import (
    alias_refusal,
    is_allowed_by_administrator,
)
from rosproxy_operator.docker.planner.labels.readers import ALIAS, MASTER_URI
from rosproxy_operator.docker.planner.model import Container, Desired, HostState, Member
from rosproxy_operator.docker.planner.specs import is_proxy_name, proxy_name
from rosproxy_operator.docker.planner.taken_names import (
    FormerNames,
    NamesByNetwork,
    lookups_of,
    present_names,
)
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.proxy_spec.place import Master, Place

Aliases = Mapping[Place, Mapping[str, tuple[str, ...]]]
"""The names of a proxy on a network, by place and network."""


@dataclass(frozen=True, slots=True)
class Naming:
    """The names of all proxies, and the problems of containers that won't find their proxy.

    ``withdrawn`` has, by network, the names that no proxy may have or keep there.
    """

    aliases: Aliases
    withdrawn: Mapping[str, frozenset[str]]
    problems: tuple[Problem, ...]

    def is_misnamed(self, sandbox: Container, network: str) -> bool:
        """Return whether a sandbox has a withdrawn name on a network.

        The engine removes no single name. To lose a name, a sandbox disconnects from the network,
        and connects again without that name.
        """
        # The engine adds these two names at each connection, so connecting again changes nothing.
        lasting = {sandbox.name.lower(), sandbox.id[:12]}
        withdrawn = self.withdrawn.get(network, frozenset()) - lasting
        return any(answers_to(sandbox, network, name) for name in withdrawn)


@dataclass(frozen=True, slots=True)
class _Claim:
    """A name on a network, and the proxies that want this name (``claimants``).

    ``containers`` and ``holders`` are the containers and the proxies that have the name now.
    ``refusal`` is the reason why a label may not give the name, or empty.
    """

    network: str
    alias: str
    claimants: tuple[Desired, ...]
    containers: tuple[str, ...]
    holders: tuple[Place, ...]
    refusal: str = ""

    @property
    def withdrawn(self) -> bool:
        """Whether no proxy may have the name."""
        return bool(self.containers or self.refusal)

    @property
    def owner(self) -> Place | None:
        """The proxy that gets the name; None if no proxy may have or wants the name.

        A proxy that has the name keeps the name, so that no connection is cut. Otherwise the name
        goes to the first claimant whose containers look for the name, else to the first claimant.
        """
        if self.withdrawn or not self.claimants:
            return None
        if self.holders:
            return self.holders[0]
        needed = [
            d.place for d in self.claimants if containers_seeking(d, self.network, self.alias)
        ]
        return (needed or [d.place for d in self.claimants])[0]


@dataclass(frozen=True, slots=True)
class _NameFacts:
    """The facts that decide on a name: host, present and former names, and settings."""

    observed: HostState
    settings: PlanSettings
    present: NamesByNetwork
    former: FormerNames


def assign_aliases(
    desired: Collection[Desired], observed: HostState, settings: PlanSettings, former: FormerNames
) -> Naming:
    """Return the names of the proxies, and the problems of containers that won't find their proxy.

    ``desired`` is sorted by place. ``former`` has the names that containers have or had.
    """
    aliases: dict[Place, dict[str, tuple[str, ...]]] = {}
    withdrawn: dict[str, frozenset[str]] = {}
    problems: list[Problem] = []
    facts = _NameFacts(observed, settings, present_names(observed), former)
    for network in sorted({name for d in desired for name in d.networks}):
        proxies = [d for d in desired if network in d.networks]
        claims = [
            _claim(network, alias, proxies, facts)
            for alias in sorted({name for d in proxies for name in _names(d.place)})
        ]
        for claim in claims:
            if claim.owner is not None:
                names = aliases.setdefault(claim.owner, {})
                names[network] = (*names.get(network, ()), claim.alias)
        withdrawn[network] = frozenset(claim.alias for claim in claims if claim.withdrawn)
        common = next((claim for claim in claims if claim.alias == ALIAS), None)
        problems += [problem for claim in claims for problem in _problems(claim, common)]
    return Naming(aliases, withdrawn, tuple(problems))


def containers_seeking(desired: Desired, network: str, alias: str) -> tuple[str, ...]:
    """Return the names of the containers on a network that look for the proxy by ``alias``."""
    return tuple(member.container.name for member in _seekers(desired, network, alias))


def _seekers(desired: Desired, network: str, alias: str) -> Iterator[Member]:
    return (m for m in desired.members if network in m.networks and m.wanted_alias == alias)


def answers_to(container: Container, network: str, alias: str) -> bool:
    """Return whether a container has a name on a network. Engines ignore the case of names."""
    return any(
        alias.lower() in map(str.lower, attachment.names)
        for attachment in container.attachments
        if attachment.network == network
    )


def _names(place: Place) -> tuple[str, ...]:
    """Return the names that a proxy wants.

    The name of the proxy's container has to be an alias of the sandbox: only the sandbox is on
    networks.
    """
    if not isinstance(place.graph, Master):
        # Nodes find the proxy by multicast, as a peer, or by a redirect.
        return (proxy_name(place),)
    host = place.master.host
    return (ALIAS, proxy_name(place), *(() if is_address(host) else (host,)))


def _claim(network: str, alias: str, proxies: Collection[Desired], facts: _NameFacts) -> _Claim:
    observed = facts.observed
    lookups = [*lookups_of(alias, network, (n.name for n in observed.networks))]
    containers = {
        holder
        for where, name in lookups
        for holder in facts.present.get(where, {}).get(name, frozenset())
    }
    holding = [s for s in observed.sandboxes if answers_to(s.container, network, alias)]
    staying = [d.place for d in proxies if d.place in {s.place for s in holding}]
    # A sandbox that restarts can't leave the network, and has the name again in a moment.
    stuck = sorted(s.place for s in holding if s.container.state == "restarting")
    return _Claim(
        network,
        alias,
        claimants=tuple(d for d in proxies if d.live and alias in _names(d.place)),
        containers=tuple(sorted(containers)),
        holders=tuple(dict.fromkeys([*staying, *stuck])),
        refusal="" if alias == ALIAS or is_proxy_name(alias) else _refusal(alias, lookups, facts),
    )


def _refusal(alias: str, lookups: Iterable[tuple[str, str]], facts: _NameFacts) -> str:
    """Return why no proxy may have a name; empty if a proxy may.

    Names that containers have now are not checked here (`_Claim.containers`).
    """
    if refusal := alias_refusal(alias, facts.settings):
        return refusal
    former = next((facts.former[lookup] for lookup in lookups if lookup in facts.former), "")
    if not former or is_allowed_by_administrator(alias, facts.settings):
        return ""
    return f"container {former} had the name, and may return"


def _problems(claim: _Claim, common: _Claim | None) -> Iterator[Problem]:
    """Yield warnings for containers that look for the proxy by a name that the proxy lacks.

    ``common`` is the claim to ALIAS, the name that all proxies want.
    """
    for claimant in claim.claimants:
        place = claimant.place
        if _has_name(claim, place):
            continue
        host = ALIAS if common and _has_name(common, place) else proxy_name(place)
        for member in _seekers(claimant, claim.network, claim.alias):
            fix = f"ROS_MASTER_URI=http://{host}:{place.master.port}"
            if MASTER_URI not in member.container.labels:
                # A variable that names a proxy does not say which master the container means.
                fix += f" and the label {MASTER_URI}={place.master.uri}"
            obstacle = _obstacle(claim, place, fix)
            text = f"the nodes look for the proxy by the name {claim.alias}, but {obstacle.text}"
            subject = f"container {member.container.name}"
            yield Problem(subject, text, obstacle.fix, fatal=False, reason="NameTaken")


def _obstacle(claim: _Claim, place: Place, fix: str) -> Fault:
    """Return what keeps a proxy from having a name, and the fix.

    ``fix`` has the variable to set, and a label if the container lacks the label.
    """
    if claim.refusal and not claim.containers:
        return Fault(
            f"labels may not give a proxy that name on network {claim.network}: {claim.refusal}. "
            "So the nodes bypass the proxy",
            f"Start the operator with --allow-alias {claim.alias} (and with this option for every "
            f"other name that a proxy may have), or set {fix}",
        )
    holders = [f"container {name}" for name in claim.containers]
    rivals = {*claim.holders, claim.owner or place} - {place}
    holders += [_holder(claim, rival) for rival in sorted(rivals)]
    return Fault(
        f"on network {claim.network} that name belongs to {listed(holders)}. So the nodes bypass "
        "the proxy",
        f"Set {fix}",
    )


def _has_name(claim: _Claim, place: Place) -> bool:
    """Return whether the proxy has or gets the name, and no other proxy has the name."""
    return place == claim.owner and len(claim.holders) <= 1


def _holder(claim: _Claim, place: Place) -> str:
    """Return the text for a proxy that has the name, with its containers: a label may be wrong."""
    containers = [
        member.container.name
        for claimant in claim.claimants
        if claimant.place == place
        for member in claimant.members
    ]
    served = f" (for the {place.graph} of {listed(containers)})" if containers else ""
    return f"proxy {proxy_name(place)}{served}"
