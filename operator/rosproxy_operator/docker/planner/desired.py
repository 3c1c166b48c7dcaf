"""From wishes to the proxies that there ought to be."""

from collections.abc import Collection, Iterable
from dataclasses import replace

from rosproxy.settings import DataPlane
from rosproxy_operator.common.problem import Problem
from rosproxy_operator.docker.planner.data_planes import chosen, outvoted
from rosproxy_operator.docker.planner.membership import BUILT_IN
from rosproxy_operator.docker.planner.model import Desired, Key, Network, Observed, Wish
from rosproxy_operator.docker.planner.settings import PlanSettings
from rosproxy_operator.docker.planner.state import Memory


def desire(
    observed: Observed,
    settings: PlanSettings,
    wishes: Iterable[Wish],
    memory: Memory,
    now: float,
) -> tuple[tuple[Desired, ...], tuple[Problem, ...]]:
    """One Desired for each key that is wished for or has a proxy, sorted by key.

    A wish for networks that are not there (any more) is dropped. Containers that have exited
    keep networks joined that a proxy is on, and its data plane, for the settings' grace, but join
    none.
    """
    every = tuple(wishes)
    bad = _before_uplink(observed.networks, settings.uplink)
    usable = {network.name for network in observed.networks} - BUILT_IN - bad
    keys = {wish.key for wish in every} | observed.keys
    recent = [
        wish
        for wish in every
        if not wish.alive and now - memory.exited.get(wish.id, now) < settings.grace
    ]
    live = [wish for wish in every if wish.alive and wish.networks & usable]
    desired = tuple(
        replace(
            _one(key, settings.ports, live, _kept(key, recent, observed), usable),
            data_plane=_data_plane(key, [*live, *recent], settings),
        )
        for key in sorted(keys)
    )
    wanted = {name for wish in every if wish.alive for name in wish.networks}
    bad_networks = (_bad_network(name, settings.uplink) for name in sorted(bad & wanted))
    return desired, (*bad_networks, *outvoted(desired))


def _one(
    key: Key, ports: int, live: Iterable[Wish], kept: frozenset[str], usable: Collection[str]
) -> Desired:
    own = tuple(wish for wish in live if wish.key == key)
    joined = {name for wish in own for name in wish.networks} | kept
    return Desired(
        key=key,
        live=bool(own),
        ports=max([ports, *(wish.ports for wish in own)]),
        networks=frozenset(joined.intersection(usable)),
        wishes=own,
    )


def _data_plane(key: Key, wishes: Iterable[Wish], settings: PlanSettings) -> DataPlane:
    return chosen((wish for wish in wishes if wish.key == key), settings.data_plane)


def _kept(key: Key, recent: Iterable[Wish], observed: Observed) -> frozenset[str]:
    """The networks that a key's sandboxes are on and that its exited containers are, too."""
    there = {n for s in observed.sandboxes if s.key == key for n in s.container.networks}
    left = {name for wish in recent if wish.key == key for name in wish.networks}
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
        "controller with an --uplink that sorts first",
    )
