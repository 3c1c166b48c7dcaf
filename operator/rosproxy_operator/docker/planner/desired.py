"""From members to the proxies that there ought to be."""

from collections.abc import Collection, Iterable, Iterator

from rosproxy.settings import MOST_ZENOH_PORTS
from rosproxy_operator.common.problem import Problem
from rosproxy_operator.common.ros2 import LEAST_PORTS
from rosproxy_operator.docker.planner.labels.readers import BUILT_IN
from rosproxy_operator.docker.planner.model import THIS_HOST, ZENOH, Desired, HostState, Key, Member
from rosproxy_operator.docker.planner.state import DockerMemory
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.proxy_spec.spec import OWN_SPEC, WISHES, ProxySpec, merged

ROUTERS_STEP = 32
"""The routers of a proxy for rmw_zenoh are a multiple of this, of half a megabyte each."""


def desire(
    observed: HostState,
    settings: PlanSettings,
    members: Collection[Member],
    memory: DockerMemory,
    now: float,
) -> tuple[tuple[Desired, ...], tuple[Problem, ...]]:
    """One Desired for each key that a container asks for or that has a proxy, sorted by key.

    A member for networks that are not there (any more) is dropped. Containers that have exited
    keep networks joined that a proxy is on, and what else their labels made it, for the settings'
    grace, but join none.
    """
    bad = _before_uplink(observed, settings.uplink)
    usable = {network.name for network in observed.networks} - BUILT_IN - bad
    alive = [member for member in members if member.container.alive]
    recent = [
        member
        for member in members
        if not member.container.alive
        and now - memory.exited.get(member.container.id, now) < settings.grace
    ]
    desired: list[Desired] = []
    for key in sorted({member.key for member in members} | observed.keys):
        own = tuple(member for member in alive if member.key == key and member.networks & usable)
        exited = [member for member in recent if member.key == key]
        joined = {name for s in observed.sandboxes_of(key) for name in s.container.networks}
        networks = _networks(own) | (_networks(exited) & joined)
        considered = [*own, *exited]
        desired.append(
            Desired(
                key,
                bool(own),
                _ports(key, own, settings),
                networks & usable,
                own,
                proxy_spec(key, considered, settings),
                _peers(key, considered, observed, settings),
            )
        )
    bad_networks = [_bad_network(name, settings.uplink) for name in sorted(bad & _networks(alive))]
    return tuple(desired), (*bad_networks, *_outvoted(desired))


def proxy_spec(key: Key, members: Iterable[Member], settings: PlanSettings) -> ProxySpec:
    """The options of a proxy with these containers."""
    if key == ZENOH:  # none is for its routers
        return OWN_SPEC
    names = (name for name, wish in WISHES.items() if wish.ros in ("", key.ros))
    defaults = ProxySpec(**{name: getattr(settings, name) for name in names})
    return merged([member.wishes for member in members], defaults)


def _ports(key: Key, members: Collection[Member], settings: PlanSettings) -> int:
    """The least number of ports of a proxy with these containers."""
    if key == ZENOH:  # in steps: with each change of the number its nodes have to connect again
        steps = max(-(-len(members) // ROUTERS_STEP), 1)
        return min(steps * ROUTERS_STEP, MOST_ZENOH_PORTS)
    ports = max([settings.ports, *(member.ports for member in members)])
    return max(ports, LEAST_PORTS) if key.is_ros2 else ports


def _peers(
    key: Key, members: Iterable[Member], observed: HostState, settings: PlanSettings
) -> tuple[str, ...]:
    """The peers of a proxy for ROS 2: its containers', and for DDS the operator's."""
    peers = {peer for member in members for peer in member.peers}
    if key == ZENOH:
        gateway = observed.gateway(settings.uplink) or THIS_HOST
        return tuple(sorted(peer.replace(THIS_HOST, gateway) for peer in peers))
    return tuple(sorted({*settings.ros2_peer, *peers})) if key.is_ros2 else ()


def _networks(members: Iterable[Member]) -> frozenset[str]:
    return frozenset(name for member in members for name in member.networks)


def _before_uplink(observed: HostState, uplink: str) -> set[str]:
    """Networks that would take the published ports and the default route over from the uplink.

    The engine gives both to the network whose name sorts first, internal ones aside, and moving
    them cuts all connections.
    """
    # The order is that of moby's Endpoint.Less (libnetwork/sandbox.go): not internal, then with
    # gateways for both IPv4 and IPv6, then by name, which Go compares by bytes.
    return {
        network.name
        for network in observed.networks
        if not network.internal and network.name.encode() < uplink.encode()
    }


def _bad_network(name: str, uplink: str) -> Problem:
    return Problem(
        f"network {name}",
        f"proxies can't join this network: its name sorts before the name of the uplink network "
        f"{uplink}, so the engine would move the published ports of the proxies there. Create the "
        "network under another name, or start the operator with an --uplink that sorts first",
    )


def _outvoted(desired: Iterable[Desired]) -> Iterator[Problem]:
    """Warn the containers whose proxy is not as their labels ask."""
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
                    "directions. Add the label rosproxy.direction=both, or remove the label "
                    "rosproxy.udp",
                    fatal=False,
                )
            if (asked := member.wishes.get("data_plane", plane)) != plane:
                yield Problem(
                    subject,
                    f"label rosproxy.data-plane={asked} is ignored: the proxy also serves {rival}, "
                    f"whose label asks for {plane}. Give both containers the same value",
                    fatal=False,
                )
