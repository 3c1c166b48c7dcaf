"""From members to the proxies that there ought to be."""

from collections.abc import Collection, Iterable, Iterator

from rosproxy.setting_kinds import DataPlane, Direction, SlaveControl
from rosproxy_operator.common.problem import Problem
from rosproxy_operator.common.ros2 import LEAST_PORTS
from rosproxy_operator.docker.planner.labels.readers import (
    BUILT_IN,
    DATA_PLANE,
    DIRECTION,
    UDP,
)
from rosproxy_operator.docker.planner.model import (
    Desired,
    HostState,
    Member,
)
from rosproxy_operator.docker.planner.state import DockerMemory
from rosproxy_operator.docker.settings import PlanSettings

_PLANES: tuple[DataPlane, ...] = ("kernel", "splice", "copy", "auto")
"""In order of precedence: first what the proxy can't do by itself."""


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
        ports = max([settings.ports, *(member.ports for member in own)])
        considered = [*own, *exited]
        desired.append(
            Desired(
                key,
                bool(own),
                max(ports, LEAST_PORTS) if key.is_ros2 else ports,
                networks & usable,
                own,
                chosen_plane(considered, settings.data_plane),
                "any" if key.is_ros2 else chosen_control(considered, settings.slave_control),
                chosen_direction(considered, settings.direction),
                not key.is_ros2 and chosen_udp(considered, settings),
                _peers(considered, settings) if key.is_ros2 else (),
            )
        )
    bad_networks = [_bad_network(name, settings.uplink) for name in sorted(bad & _networks(alive))]
    return tuple(desired), (*bad_networks, *_outvoted(desired))


def chosen_plane(members: Iterable[Member], default: DataPlane) -> DataPlane:
    """The data plane of a proxy with these containers; ``default`` if none asks for one."""
    planes = {member.data_plane for member in members}
    return next((plane for plane in _PLANES if plane in planes), default)


def chosen_control(members: Iterable[Member], default: SlaveControl) -> SlaveControl:
    """Who may control the nodes of a proxy with these containers: the narrowest that one asks for.

    A node is not to be open to all because of a neighbour; who asks for more only gets less.
    """
    controls = {default, *(member.slave_control for member in members)}
    return "master" if "master" in controls else "any"


def chosen_direction(members: Iterable[Member], default: Direction) -> Direction:
    """The direction of a proxy with these containers: both ways if one of them needs that.

    Who has a route outwards loses nothing by going through the proxy.
    """
    directions = {member.direction or default for member in members} or {default}
    return "both" if "both" in directions else "out"


def chosen_udp(members: Collection[Member], settings: PlanSettings) -> bool:
    """Whether a proxy with these containers has its ports for UDP, too: if one of them asks for it.

    That is of no use without the other direction: datagrams outwards need no port.
    """
    is_both_ways = chosen_direction(members, settings.direction) == "both"
    return is_both_ways and any(settings.udp if m.udp is None else m.udp for m in members)


def _peers(members: Iterable[Member], settings: PlanSettings) -> tuple[str, ...]:
    """The peers a proxy for ROS 2 tells of participants: the operator's and its containers'."""
    return tuple(sorted({*settings.ros2_peer, *(peer for m in members for peer in m.peers)}))


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
        winners = [m.container.name for m in wanted.members if m.data_plane == wanted.data_plane]
        rival = f"container {winners[0]}" if winners else "an exited container"
        for member in wanted.members:
            if member.udp and wanted.direction == "out":
                yield Problem(
                    f"container {member.container.name}",
                    f"label {UDP}=true is ignored: datagrams from outside need both directions. "
                    f"Add the label {DIRECTION}=both, or remove the label {UDP}",
                    fatal=False,
                )
            if member.data_plane not in (None, wanted.data_plane):
                yield Problem(
                    f"container {member.container.name}",
                    f"label {DATA_PLANE}={member.data_plane} is ignored: the proxy also serves "
                    f"{rival}, whose label asks for {wanted.data_plane}. Give both containers the "
                    "same value",
                    fatal=False,
                )
