"""From members to the proxies that there ought to be."""

from collections.abc import Collection, Iterable, Iterator

from rosproxy.settings import DataPlane
from rosproxy_operator.common.problem import Problem
from rosproxy_operator.docker.planner.labels.values import BUILT_IN, DATA_PLANE
from rosproxy_operator.docker.planner.model import Desired, HostState, Member, PlanSettings
from rosproxy_operator.docker.planner.state import DockerMemory

_PLANES: tuple[DataPlane, ...] = ("kernel", "splice", "copy", "auto")
"""Who asks for what the proxy can't do by itself goes first."""


def desire(
    observed: HostState,
    settings: PlanSettings,
    members: Collection[Member],
    memory: DockerMemory,
    now: float,
) -> tuple[tuple[Desired, ...], tuple[Problem, ...]]:
    """One Desired for each key that a container asks for or that has a proxy, sorted by key.

    A member for networks that are not there (any more) is dropped. Containers that have exited
    keep networks joined that a proxy is on, and its data plane, for the settings' grace, but join
    none.
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
        left = [member for member in recent if member.key == key]
        there = {name for box in observed.sandboxes_of(key) for name in box.container.networks}
        networks = _networks(own) | (_networks(left) & there)
        plane = chosen_plane([*own, *left], settings.data_plane)
        ports = max([settings.ports, *(member.ports for member in own)])
        desired.append(Desired(key, bool(own), ports, networks & usable, own, plane))
    told = [_bad_network(name, settings.uplink) for name in sorted(bad & _networks(alive))]
    return tuple(desired), (*told, *_outvoted(desired))


def chosen_plane(members: Iterable[Member], default: DataPlane) -> DataPlane:
    """The data plane of a proxy with these containers; ``default`` if none asks for one."""
    asked = {member.data_plane for member in members}
    return next((plane for plane in _PLANES if plane in asked), default)


def _networks(members: Iterable[Member]) -> frozenset[str]:
    return frozenset(name for member in members for name in member.networks)


def _before_uplink(observed: HostState, uplink: str) -> set[str]:
    """Networks that would take the published ports and the default route over from the uplink.

    The engine gives both to the network whose name sorts first, internal ones aside, and moving
    them cuts all connections.
    """
    return {
        network.name
        for network in observed.networks
        if not network.internal and network.name.encode() < uplink.encode()
    }


def _bad_network(name: str, uplink: str) -> Problem:
    return Problem(
        f"network {name}",
        f"can't be joined: its name sorts before that of the uplink network {uplink}, so the "
        "engine would move the proxy's published ports to it: give it another name, or start the "
        "operator with an --uplink that sorts first",
    )


def _outvoted(desired: Iterable[Desired]) -> Iterator[Problem]:
    """Tell the containers that share a proxy with one that asks for something else."""
    for one in desired:
        winners = [m.container.name for m in one.members if m.data_plane == one.data_plane]
        for member in one.members:
            if member.data_plane not in (None, one.data_plane):
                yield Problem(
                    f"container {member.container.name}",
                    f"label {DATA_PLANE}={member.data_plane} is ignored: its proxy also serves "
                    f"{next(iter(winners), 'another one')}, which asks for {one.data_plane}; give "
                    "both the same",
                    fatal=False,
                )
