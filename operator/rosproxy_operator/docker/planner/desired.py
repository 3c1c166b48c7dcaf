"""From members to the proxies that there ought to be."""

from collections.abc import Collection, Iterable, Iterator
from dataclasses import replace

from rosproxy.settings import DataPlane
from rosproxy_operator.common.problem import Problem
from rosproxy_operator.docker.planner.labels.networks import BUILT_IN
from rosproxy_operator.docker.planner.labels.values import DATA_PLANE
from rosproxy_operator.docker.planner.model import (
    Desired,
    HostState,
    Key,
    Member,
    Network,
    PlanSettings,
)
from rosproxy_operator.docker.planner.state import DockerMemory

_PLANES: tuple[DataPlane, ...] = ("kernel", "splice", "copy", "auto")
"""Who asks for what the proxy can't do by itself goes first."""


def desire(
    observed: HostState,
    settings: PlanSettings,
    members: Iterable[Member],
    memory: DockerMemory,
    now: float,
) -> tuple[tuple[Desired, ...], tuple[Problem, ...]]:
    """One Desired for each key that a container asks for or that has a proxy, sorted by key.

    A member for networks that are not there (any more) is dropped. Containers that have exited
    keep networks joined that a proxy is on, and its data plane, for the settings' grace, but join
    none.
    """
    every = tuple(members)
    bad = _before_uplink(observed.networks, settings.uplink)
    usable = {network.name for network in observed.networks} - BUILT_IN - bad
    keys = {member.key for member in every} | observed.keys
    recent = [
        member
        for member in every
        if not member.alive and now - memory.exited.get(member.id, now) < settings.grace
    ]
    live = [member for member in every if member.alive and member.networks & usable]
    desired = tuple(
        replace(
            _one(key, settings.ports, live, _kept(key, recent, observed), usable),
            data_plane=_data_plane(key, [*live, *recent], settings),
        )
        for key in sorted(keys)
    )
    wanted = {name for member in every if member.alive for name in member.networks}
    bad_networks = (_bad_network(name, settings.uplink) for name in sorted(bad & wanted))
    return desired, (*bad_networks, *_outvoted(desired))


def _one(
    key: Key, ports: int, live: Iterable[Member], kept: frozenset[str], usable: Collection[str]
) -> Desired:
    own = tuple(member for member in live if member.key == key)
    joined = {name for member in own for name in member.networks} | kept
    return Desired(
        key=key,
        live=bool(own),
        ports=max([ports, *(member.ports for member in own)]),
        networks=frozenset(joined.intersection(usable)),
        members=own,
    )


def _data_plane(key: Key, members: Iterable[Member], settings: PlanSettings) -> DataPlane:
    return chosen_plane((member for member in members if member.key == key), settings.data_plane)


def _kept(key: Key, recent: Iterable[Member], observed: HostState) -> frozenset[str]:
    """The networks that a key's sandboxes are on and that its exited containers are, too."""
    there = {n for s in observed.sandboxes if s.key == key for n in s.container.networks}
    left = {name for member in recent if member.key == key for name in member.networks}
    return frozenset(there & left)


def _before_uplink(networks: Iterable[Network], uplink: str) -> set[str]:
    """Networks that would take the published ports and the default route over from the uplink.

    The engine gives both to the network whose name sorts first, internal ones aside, and moving
    them cuts all connections.
    """
    return {
        network.name
        for network in networks
        if not network.internal and network.name.encode() < uplink.encode()
    }


def _bad_network(name: str, uplink: str) -> Problem:
    return Problem(
        f"network {name}",
        f"can't be joined: its name sorts before that of the uplink network {uplink}, so the "
        "engine would move the proxy's published ports to it: give it another name, or start the "
        "operator with an --uplink that sorts first",
    )


def chosen_plane(members: Iterable[Member], default: DataPlane) -> DataPlane:
    """The data plane of a proxy with these containers; ``default`` if none asks for one."""
    asked = {member.data_plane for member in members}
    return next((plane for plane in _PLANES if plane in asked), default)


def _outvoted(desired: Iterable[Desired]) -> Iterator[Problem]:
    """Tell the containers that share a proxy with one that asks for something else."""
    for one in desired:
        for member in one.members:
            if member.data_plane not in (None, one.data_plane):
                yield Problem(
                    f"container {member.container}", _outvoted_text(member, one), fatal=False
                )


def _outvoted_text(member: Member, one: Desired) -> str:
    other = next(
        (w.container for w in one.members if w.data_plane == one.data_plane), "another one"
    )
    return (
        f"label {DATA_PLANE}={member.data_plane} is ignored: its proxy also serves {other}, which "
        f"asks for {one.data_plane}; give both the same"
    )
