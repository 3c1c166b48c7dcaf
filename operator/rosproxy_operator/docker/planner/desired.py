"""Decide which proxies have to exist, and merge the options of each proxy."""

from collections.abc import Collection, Iterable, Iterator

from rosproxy.shared.settings import MOST_ZENOH_PORTS
from rosproxy_operator.common.problem import (
    OPTION_IGNORED,
    Problem,
)
from rosproxy_operator.common.ros2 import LEAST_PORTS
from rosproxy_operator.docker.planner.labels.readers import BUILT_IN_NETWORKS
from rosproxy_operator.docker.planner.model import THIS_HOST, Desired, HostState, Member
from rosproxy_operator.docker.planner.state import DockerMemory
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.proxy_spec.place import ZENOH, Domain, Place
from rosproxy_operator.proxy_spec.spec import OWN_SPEC, ProxySpec, merged, options

ROUTERS_STEP = 32
"""The routers of a proxy for rmw_zenoh come in groups of this size. A router takes 0.5 MB."""


def desire(
    observed: HostState,
    settings: PlanSettings,
    members: Collection[Member],
    memory: DockerMemory,
    now: float,
) -> tuple[tuple[Desired, ...], tuple[Problem, ...]]:
    """Return a Desired for each place that has a proxy or that a container asks for, by place.

    Return problems, too. A living member without a usable network is ignored. The labels of an
    exited container count for ``grace`` seconds: the proxy keeps options and peers, and stays on
    joined networks, but joins no other for that container. ``now`` is in monotonic seconds.
    """
    before = _names_before_uplink(observed, settings.uplink)
    refused = {name for name in before if name.encode() < settings.uplink.encode()}
    usable = {network.name for network in observed.networks} - BUILT_IN_NETWORKS - refused
    alive = [member for member in members if member.container.alive]
    recent = [
        member
        for member in members
        if not member.container.alive
        and now - memory.exited.get(member.container.id, now) < settings.grace
    ]
    desired: list[Desired] = []
    for place in sorted({member.place for member in members} | observed.places):
        own = tuple(
            member for member in alive if member.place == place and member.networks & usable
        )
        exited = [member for member in recent if member.place == place]
        joined = {name for s in observed.sandboxes_of(place) for name in s.container.networks}
        networks = _networks(own) | (_networks(exited) & joined)
        considered = [*own, *exited]
        desired.append(
            Desired(
                place,
                bool(own),
                _ports(place, own, settings),
                networks & usable,
                own,
                proxy_spec(place, considered, settings),
                _peers(place, considered, observed, settings),
                _links(place, considered, settings),
            )
        )
    problems = [
        (_refused_network if name in refused else _preferred_network)(name, settings.uplink)
        for name in sorted(before & _networks(alive))
    ]
    return tuple(desired), (*problems, *_option_warnings(desired))


def proxy_spec(place: Place, members: Iterable[Member], settings: PlanSettings) -> ProxySpec:
    """Return the options of a proxy with these containers."""
    # The log level has no default in the settings: the operator's --log-level is for its own log.
    names = (name for name in options(OWN_SPEC, place.graph.ros) if hasattr(settings, name))
    defaults = ProxySpec(**{name: getattr(settings, name) for name in names})
    return merged([member.wishes for member in members], defaults)


def _ports(place: Place, members: Collection[Member], settings: PlanSettings) -> int:
    """Return the least number of ports of a proxy with these containers."""
    # A change of the number recreates the proxy, and all nodes connect again: so in steps.
    if place == ZENOH:
        steps = max(-(-len(members) // ROUTERS_STEP), 1)
        return min(steps * ROUTERS_STEP, MOST_ZENOH_PORTS)
    ports = max([settings.ports, *(member.ports for member in members)])
    return max(ports, LEAST_PORTS) if isinstance(place.graph, Domain) else ports


def _peers(
    place: Place, members: Iterable[Member], observed: HostState, settings: PlanSettings
) -> tuple[str, ...]:
    """Return the peers from the labels, and for DDS the peers of the operator; empty for ROS 1."""
    peers = {peer for member in members for peer in member.peers}
    if place == ZENOH:
        gateway = observed.gateway(settings.uplink) or THIS_HOST
        return tuple(sorted(peer.replace(THIS_HOST, gateway) for peer in peers))
    return tuple(sorted({*settings.ros2_peer, *peers})) if isinstance(place.graph, Domain) else ()


def _links(place: Place, members: Iterable[Member], settings: PlanSettings) -> tuple[str, ...]:
    """Return the links to other sites from the labels and of the operator."""
    links = {link for member in members for link in member.links}
    return tuple(sorted({*settings.zenoh_link, *links})) if place == ZENOH else ()


def _networks(members: Iterable[Member]) -> frozenset[str]:
    return frozenset(name for member in members for name in member.networks)


def _names_before_uplink(observed: HostState, uplink: str) -> set[str]:
    """Return the names of networks that would take ports and default route from the uplink.

    The engine gives published ports and default route to one network that is not internal. Networks
    with IPv4 and IPv6 come first, then the name that sorts first. A move cuts all connections.
    """
    # moby sorts by Endpoint.Less (libnetwork/sandbox.go): networks that are not internal first,
    # then networks with gateways for IPv4 and IPv6, then by name. Go compares names by bytes. A
    # gateway priority does not help: the first such network always gets the ports
    # (libnetwork/default_gateway.go, selectGatewayEndpoint).
    has_both = any(n.dual_stack for n in observed.networks if n.name == uplink)
    return {
        network.name
        for network in observed.networks
        if network.name != uplink and not network.internal
        if (not network.dual_stack, network.name.encode()) < (not has_both, uplink.encode())
    }


def _refused_network(name: str, uplink: str) -> Problem:
    return Problem(
        f"network {name}",
        f"proxies can't join this network: its name sorts before the name of the uplink network "
        f"{uplink}, so the engine would move the published ports of the proxies there",
        "Create the network under another name, or start the operator with an --uplink that sorts "
        "first",
        reason="NetworkUnusable",
    )


def _preferred_network(name: str, uplink: str) -> Problem:
    """Return a warning. The proxies join, since they work there between two moves."""
    return Problem(
        f"network {name}",
        f"the network has IPv6, and the uplink network {uplink} does not. So the engine moves the "
        "published ports of a proxy when the proxy joins or leaves this network, which cuts all "
        "connections",
        "Create the network without IPv6, or start the operator with --uplink and the name of a "
        "bridge that has IPv6 and sorts first",
        fatal=False,
        reason="NetworkUnusable",
    )


def _option_warnings(desired: Iterable[Desired]) -> Iterator[Problem]:
    """Yield warnings for containers that ask for another option than the proxy has."""
    for wanted in desired:
        plane = wanted.spec.data_plane
        winners = [m.container.name for m in wanted.members if m.wishes.get("data_plane") == plane]
        rival = f"container {winners[0]}" if winners else "an exited container"
        for member in wanted.members:
            subject = f"container {member.container.name}"
            if member.wishes.get("udp") and wanted.spec.direction == "out":
                yield Problem(
                    subject,
                    "label rosproxy.udp=true is ignored: datagrams from outside need both "
                    "directions",
                    "Add the label rosproxy.direction=both, or remove the label rosproxy.udp",
                    fatal=False,
                    reason=OPTION_IGNORED,
                )
            if (asked := member.wishes.get("data_plane", plane)) != plane:
                yield Problem(
                    subject,
                    f"label rosproxy.data-plane={asked} is ignored: the proxy also serves {rival}, "
                    f"whose label asks for {plane}",
                    "Give both containers the same value",
                    fatal=False,
                    reason=OPTION_IGNORED,
                )
