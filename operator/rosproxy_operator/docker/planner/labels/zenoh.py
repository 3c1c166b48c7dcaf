"""Read what a container with rmw_zenoh asks for: routers and links for the proxy, and the redirect.

The label ``rosproxy.peers`` and the variable ZENOH_CONFIG_OVERRIDE of the container name routers.
The proxy connects to these routers. If the container itself runs a router, the proxy connects to
that router, too. The router goes on serving its own clients.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

from rosproxy.shared.addresses import HostPort, is_address, is_loopback
from rosproxy.shared.output.text import listed
from rosproxy.shared.policy.layers import PolicyLayer, PolicyMode
from rosproxy.shared.policy.rules import Rule
from rosproxy.shared.setting_kinds import read_zenoh_peer
from rosproxy.shared.settings import MOST_ZENOH_PORTS
from rosproxy.shared.zenoh_rules.name_sets import check_layers
from rosproxy_operator.common.problem import (
    TOO_MANY,
    Fault,
    Problem,
)
from rosproxy_operator.common.zenoh import (
    OVERRIDE,
    SESSION_FILE,
    connect_endpoints,
    is_client,
    listens_beyond_loopback,
    router_port,
)
from rosproxy_operator.docker.planner.labels import readers
from rosproxy_operator.docker.planner.labels.bounds import is_allowed_link, is_allowed_router
from rosproxy_operator.docker.planner.labels.readers import (
    ALIAS,
    LINK,
    PEERS,
    POLICY,
    REDIRECT,
    Labels,
    UnusableLabel,
    quoted,
)
from rosproxy_operator.docker.planner.model import Container, HostState, Member
from rosproxy_operator.docker.planner.network_owner import by_reference, network_owner
from rosproxy_operator.docker.planner.specs import proxy_name
from rosproxy_operator.docker.planner.zenoh_redirect import LOCAL_ROUTER, as_client
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.proxy_spec.place import ZENOH

_PROXIES = (ALIAS, proxy_name(ZENOH))
"""The names of the proxy on the networks of containers."""
_NEEDS_REDIRECT = Fault(
    f"label {POLICY} has no effect without the redirect, since the container then has no port of "
    "its own",
    "Remove --no-redirect of the operator and the label rosproxy.redirect, or remove the rules",
)


_RouterPort = tuple[str, int]
"""A router in a container: the id of the container with the network namespace, and the port."""


@dataclass(frozen=True, slots=True)
class _Router:
    """A router that a container names.

    ``named_by`` is the label or variable with the name, for messages. ``neighbour`` is the
    container in which the router runs; None for a router outside.
    """

    address: HostPort
    named_by: str
    neighbour: Container | None = None

    @property
    def peer(self) -> str:
        """The router as ``host:port``, for an option of the proxy.

        For a router in a container, the host is the container's name: each start may change the
        address.
        """
        host = self.neighbour.name if self.neighbour else self.address.host
        return str(HostPort(host, self.address.port))


def zenoh_member(
    container: Container, observed: HostState, settings: PlanSettings
) -> tuple[Member, list[Fault]]:
    """Return what a container with rmw_zenoh asks for, and warnings. Raises UnusableLabel."""
    labels = container.labels
    rules = _rules(labels, settings)
    networks = readers.networks(container, observed, settings.uplink)
    member = Member(
        container,
        ZENOH,
        policy=rules,
        networks=networks,
        wishes=readers.wishes(labels, "zenoh", networks, observed.networks),
        redirect=readers.redirect(labels),
    )
    owner = readers.network_owner(container, observed)
    if rules or any(layer.mode is PolicyMode.ENFORCE for layer in settings.policy):
        _refuse_detours(container, bool(rules), _has_router(owner, observed))
    own = [*_routers_of_variable(member, observed)]
    allowed = [r for r in (*_routers_of_label(labels), *own) if _is_allowed(r, settings)]
    refused = [r for r in (*_routers_of_label(labels), *own) if r not in allowed]
    peers = {router.peer for router in allowed}
    links = readers.links(labels)
    allowed_links = frozenset(link for link in links if is_allowed_link(link, settings))
    member = replace(member, links=allowed_links)
    refused_links = [link for link in links if link not in allowed_links]
    if container.is_zenoh_router:
        port = router_port(container.variables.get(OVERRIDE, ""))
        peers.add(str(HostPort(owner.name, port)))
    member = replace(member, peers=frozenset(peers))
    warnings = [*_refusal_warnings(refused), *_link_warnings(refused_links, settings)]
    warnings += _protocol_warnings(container)
    if _has_router(owner, observed):
        return member, warnings
    outside = [router for router in own if router in allowed and not router.neighbour]
    redirected = [router for router in outside if _is_redirectable(router, owner, observed)]
    warnings += _bypass_warnings(router for router in outside if router not in redirected)
    if not settings.redirect or member.redirect is False:
        if rules:
            raise UnusableLabel(*_NEEDS_REDIRECT)
        return member, [*warnings, _redirect_warning()]
    addresses = (LOCAL_ROUTER, *(router.address for router in redirected))
    return replace(member, redirected=tuple(dict.fromkeys(addresses))), warnings


def peers_of_one_router(
    members: Iterable[Member], observed: HostState
) -> Iterator[tuple[Container, Fault]]:
    """Yield a warning for each container whose nodes are peers of the router of other containers.

    A router of rmw_zenohd passes no data between two of its peers, in any version of zenoh.
    Peers could connect to each other, but nodes of rmw_zenoh listen on loopback only.
    """
    containers = by_reference(observed.containers)
    owners = {c.id: network_owner(c, containers).id for c in observed.containers}
    peers_by_router: dict[_RouterPort, list[Member]] = {}
    for member in members:
        for router in _routers_of_peer(member, observed, owners):
            peers_by_router.setdefault(router, []).append(member)
    for (owner, port), peers in peers_by_router.items():
        router_name = str(HostPort(containers[owner].name, port))
        for member in peers:
            own = owners[member.container.id]
            far = [p.container.name for p in peers if owners[p.container.id] != own]
            if far:
                yield member.container, _shared_router_warning(member, router_name, far)


def _routers_of_peer(
    member: Member, observed: HostState, owners: Mapping[str, str]
) -> set[_RouterPort]:
    """Return the routers in containers to which the nodes of a member connect as peers.

    ``owners`` has the owner of the network namespace of each container, by id. A container with a
    session file has no routers here, since the file may make the nodes clients.
    """
    container = member.container
    override = container.variables.get(OVERRIDE, "")
    is_peer = not is_client(override) and not container.variables.get(SESSION_FILE)
    if not is_peer or listens_beyond_loopback(override):
        return set()
    if member.place != ZENOH or container.is_zenoh_router or not container.alive:
        return set()
    own = owners[container.id]
    has_router = any(
        owners[c.id] == own and c.is_zenoh_router and c.alive for c in observed.containers
    )
    endpoints = [address for _, address in connect_endpoints(override)] or [LOCAL_ROUTER]
    near = {(own, a.port) for a in endpoints if has_router and is_loopback(a.host)}
    named = _routers_of_variable(member, observed)
    return near | {(owners[r.neighbour.id], r.address.port) for r in named if r.neighbour}


def _shared_router_warning(member: Member, router: str, others: Collection[str]) -> Fault:
    fix = f'Add mode="client" to the variable {OVERRIDE} of these containers'
    if member.redirected:
        fix += (
            ". Or remove connect/endpoints from the variables, and add the label "
            f"{PEERS}={router}: a router of the proxy then serves each of these containers"
        )
    return Fault(
        f"the nodes are peers of the same router ({quoted(router)}) as the nodes of container "
        f"{listed(others)}. Messages between these containers do not pass: rmw_zenohd passes none "
        "between its peers, and neither does zenohd from 1.9 on",
        fix,
    )


def _is_allowed(router: _Router, settings: PlanSettings) -> bool:
    """Return whether the proxy may connect to a router."""
    return router.neighbour is not None or is_allowed_router(router.address, settings)


def with_bounded_containers(
    members: Iterable[Member],
) -> tuple[tuple[Member, ...], tuple[Problem, ...]]:
    """Return the members without the excess members of the proxy for rmw_zenoh, and the problems.

    This proxy has a router for each of its first `MOST_ZENOH_PORTS` members. Each living member
    beyond that limit gets a problem. All members of other proxies stay.
    """
    every = tuple(members)
    excess = [member for member in every if member.place == ZENOH][MOST_ZENOH_PORTS:]
    text = f"a proxy for rmw_zenoh serves at most {MOST_ZENOH_PORTS} containers"
    fix = f"Remove labels {readers.ENABLE} of other containers"
    problems = (
        Problem(f"container {m.container.name}", text, fix, reason=TOO_MANY)
        for m in excess
        if m.container.alive
    )
    return tuple(member for member in every if member not in excess), tuple(problems)


def _rules(labels: Labels, settings: PlanSettings) -> tuple[Rule, ...]:
    """Return the rules of the label.

    Raises UnusableLabel for rules, also of --policy, that a router can't enforce.
    """
    rules = readers.policy(labels)
    for source, layers in (
        (f"label {POLICY}", (PolicyLayer(POLICY, rules),)),
        ("the operator's --policy", settings.policy),
    ):
        try:
            check_layers(layers)
        except ValueError as error:
            raise UnusableLabel(f"{source}: {error}") from None
    return rules


def _refuse_detours(container: Container, has_own_rules: bool, has_router: bool) -> None:
    """Raise UnusableLabel if nodes of a container with rules can get past the proxy's router.

    Before the redirect is in place, a node reaches an address outside directly. If the variable
    names a port of the proxy, the administrator's rules apply there, and the label's rules do not.
    """
    policy = "has a policy" if has_own_rules else "has to obey the operator's --policy"
    if has_router:
        raise UnusableLabel(
            f"{policy}, and a router runs in the container or in its network. Nodes at that router "
            "bypass the policy",
            "Remove the router, or the rules",
        )
    proxies = () if has_own_rules else _PROXIES
    for protocol, address in connect_endpoints(container.variables.get(OVERRIDE, "")):
        is_of_proxy = protocol == "tcp" and address.host in proxies
        if not is_loopback(address.host) and not is_of_proxy:
            raise UnusableLabel(
                f"{policy}, and variable {OVERRIDE} connects the nodes to {quoted(str(address))}, "
                "past the policy",
                "Remove connect/endpoints from the variable, and name routers outside in the label "
                f"{PEERS}",
            )


def _routers_of_label(labels: Labels) -> Iterator[_Router]:
    """Yield the routers that the label ``rosproxy.peers`` names. Raises UnusableLabel."""
    for address in readers.peers(labels, lambda name: read_zenoh_peer(name.lower())):
        yield _Router(address, f"label {PEERS}")


def _routers_of_variable(member: Member, observed: HostState) -> Iterator[_Router]:
    """Yield the routers to which ZENOH_CONFIG_OVERRIDE connects the nodes of a container.

    A container that runs a router yields nothing: the variable configures this router.
    """
    container = member.container
    if container.is_zenoh_router:
        return
    endpoints = connect_endpoints(container.variables.get(OVERRIDE, ""))
    neighbours = _neighbours(member, observed) if endpoints else {}
    for protocol, address in endpoints:
        host = address.host
        if protocol == "tcp" and not is_loopback(host) and host not in _PROXIES:
            yield _Router(address, f"variable {OVERRIDE}", neighbours.get(host))


def _neighbours(member: Member, observed: HostState) -> dict[str, Container]:
    """Return the containers on the networks of a member, by name and address; the first counts."""
    neighbours: dict[str, Container] = {}
    for container in observed.containers:
        for attachment in container.attachments:
            if attachment.network in member.networks:
                for name in (attachment.address, *map(str.lower, attachment.names)):
                    neighbours.setdefault(name, container)
    return neighbours


def _has_router(owner: Container, observed: HostState) -> bool:
    """Whether a router runs in the network namespace of a container."""
    containers = by_reference(observed.containers)
    routers = (c for c in observed.containers if c.is_zenoh_router and c.alive)
    return any(network_owner(router, containers).id == owner.id for router in routers)


def _is_redirectable(router: _Router, owner: Container, observed: HostState) -> bool:
    """Whether nftables can redirect the connections for a router outside to the proxy.

    The rules are for IPv4 alone. A container that is only on internal networks has no route to the
    router.
    """
    # Without a route, connect(2) fails before a rule could take effect: the kernel looks for a
    # route before there is a packet (net/ipv4/tcp_ipv4.c, tcp_v4_connect).
    internal = {network.name for network in observed.networks if network.internal}
    host = router.address.host
    return is_address(host) and ":" not in host and not owner.networks <= internal


def _refusal_warnings(refused: Iterable[_Router]) -> Iterator[Fault]:
    for router in refused:
        yield Fault(
            f"{router.named_by} names {quoted(router.peer)}, which the operator does not allow. "
            "The proxy does not connect there",
            f"To allow this router, start the operator with --allow-peer {router.peer}",
        )


def _link_warnings(refused: Iterable[str], settings: PlanSettings) -> Iterator[Fault]:
    has_files = settings.zenoh_link_certificates
    directory = "" if has_files else " --zenoh-link-certificates DIRECTORY"
    for link in refused:
        yield Fault(
            f"label {LINK} names {quoted(link)}, which the operator does not allow. The proxy does "
            "not connect there",
            f"To allow this link, start the operator with --allow-link {link}{directory}",
        )


def _bypass_warnings(routers: Iterable[_Router]) -> Iterator[Fault]:
    """Yield warnings for routers to which the nodes connect directly, not through the proxy."""
    for router in routers:
        yield Fault(
            f"{router.named_by} connects the nodes to {quoted(router.peer)}, and the operator can "
            "redirect only an IPv4 address with a route. So the nodes bypass the proxy",
            f"Remove connect/endpoints from the variable, and add the label {PEERS}={router.peer}",
        )


def _protocol_warnings(container: Container) -> Iterator[Fault]:
    for protocol, address in connect_endpoints(container.variables.get(OVERRIDE, "")):
        if protocol != "tcp":
            yield Fault(
                f"variable {OVERRIDE} connects the nodes by {quoted(protocol)}, and the proxy "
                "connects by tcp only",
                f"Remove connect/endpoints from the variable, and add the label {PEERS}={address}",
            )


def _redirect_warning() -> Fault:
    return Fault(
        "is not redirected to the proxy, as --no-redirect of the operator or the label "
        f"{REDIRECT} says. So the nodes do not find the proxy",
        f"Remove the option or label, or set {as_client(proxy_name(ZENOH))}",
    )
