"""From what is seen on a Docker host to what is to be done there."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace

from rosproxy_operator.common.problem import Problem
from rosproxy_operator.docker.planner.actions import (
    Action,
    Connect,
    Create,
    CreateNetwork,
    CreateSandbox,
)
from rosproxy_operator.docker.planner.allocation import allocate, refused
from rosproxy_operator.docker.planner.desired import assign, desire
from rosproxy_operator.docker.planner.ear import missing_ear, with_ear
from rosproxy_operator.docker.planner.label_policy import within_bounds
from rosproxy_operator.docker.planner.labels.members import LabelReading, find_members
from rosproxy_operator.docker.planner.model import Desired, HostState, Key, Member, PlanSettings
from rosproxy_operator.docker.planner.redirect import redirect_steps
from rosproxy_operator.docker.planner.specs import master, unresolved_master
from rosproxy_operator.docker.planner.state import DockerMemory, looked, noticed
from rosproxy_operator.docker.planner.steps import PlanContext, leave, retired, wanted_steps

SOON = 1.0
"""Seconds until a look at something that is about to end: a removal, a port that is let go."""


@dataclass(frozen=True, slots=True)
class Group:
    """Actions to be carried out one after the other, for one key (or for the uplink: no key).

    Those ``about`` a container alone, a redirect, wait for nothing else of the key, nor else for
    them.
    When one fails, the rest is left out, so that a proxy is only removed when the one that takes
    over was created; but a failed Connect or Disconnect keeps nothing else from being done.
    """

    key: Key | None
    actions: tuple[Action, ...]
    about: str = ""


@dataclass(frozen=True, slots=True)
class DockerPlan:
    """What to do, group after group, and what to remember.

    ``deferred`` are groups that have to wait until the address of their master is known: without
    it a proxy would find itself by its master's name; or until the uplink is there, where an ear
    listens. ``again_in`` is in how many seconds to look again even if nothing happens; None: no
    need.
    """

    groups: tuple[Group, ...]
    memory: DockerMemory
    problems: tuple[Problem, ...]
    members: tuple[Member, ...]
    desired: tuple[Desired, ...]
    again_in: float | None = None
    deferred: tuple[Group, ...] = ()

    @property
    def actions(self) -> tuple[Action, ...]:
        """All actions that can be carried out now, in order."""
        return tuple(action for group in self.groups for action in group.actions)


def plan(
    observed: HostState,
    labels: LabelReading,
    settings: PlanSettings,
    memory: DockerMemory,
    now: float,
) -> DockerPlan:
    """The next actions, from everything that is seen; none if all is as it ought to be.

    For a key of which a container is busy nothing is done. ``labels`` are those that were read from
    ``observed``. ``memory`` is that of the plan before, or an empty one. ``now`` is in seconds of a
    monotonic clock that goes on as long as the memory does.
    """
    members, unplaced = find_members(labels, observed, settings)
    members, crowded = within_bounds(members, settings)
    memory = noticed(memory, members, now)
    desired, bad_networks = desire(observed, settings, members, memory, now)
    memory = looked(memory, observed, desired, settings.grace, now)
    aliases, missed = assign(desired, observed)
    live = {one.key for one in desired if one.live}
    memory = refused(observed, live, memory, now)
    obstacle = _obstacle(observed, settings) if live else None
    creatable = obstacle is None
    memory, tight = allocate(observed, settings, desired, memory, now, frozen=not creatable)
    over = {key for key, since in memory.absent.items() if now - since >= settings.grace}
    planned: dict[Key, list[Action] | None] = {key: [*retired(observed, key)] for key in over}
    for one in desired:
        if ports := memory.planned.get(one.key):  # else its problem is told already
            names = aliases.get(one.key, {})
            context = PlanContext(observed, settings, one, ports, names, creatable)
            steps = wanted_steps(context)
            planned[one.key] = steps if steps is None else with_ear(context, steps)
    problems = [*labels.problems, *unplaced, *crowded, *bad_networks, *missed, *tight]
    problems += _unwell(observed, live)
    problems += _deaf(observed, settings, live)
    if obstacle:
        problems.append(replace(obstacle, fatal=None in planned.values()))
    groups = [*_possible(observed, settings, desired, planned)]
    deferred = tuple(group for group in groups if _waits(group, observed, settings.uplink))
    found = DockerPlan(
        groups=tuple(group for group in groups if group not in deferred),
        deferred=deferred,
        memory=memory,
        problems=tuple(dict.fromkeys(problems)),
        members=members,
        desired=desired,
    )
    ends = [end for end in _ends(observed, settings, found, now) if end > 0]
    return replace(found, again_in=min(ends, default=None))


def _obstacle(observed: HostState, settings: PlanSettings) -> Problem | None:
    """What keeps proxies from being created."""
    if not observed.image_id:
        return Problem(
            f"proxy image {settings.proxy_image}",
            f"not on this host: docker pull {settings.proxy_image}, or in rosproxy's sources: "
            f"docker build --target proxy -t {settings.proxy_image} .",
        )
    for network in observed.networks:
        if network.name == settings.uplink and (network.internal or network.driver != "bridge"):
            return Problem(
                f"network {network.name}",
                "can't be the proxies' uplink: it must be an ordinary bridge, not internal: remove "
                "it (the operator creates it anew) or name another one with --uplink",
            )
    return None


def _possible(
    observed: HostState,
    settings: PlanSettings,
    desired: Collection[Desired],
    planned: Mapping[Key, list[Action] | None],
) -> Iterator[Group]:
    """All groups but those of keys of which a container is busy, and the redirects'."""
    busy = {one.key for one in observed.own if one.container.name in observed.busy}
    every = _groups(observed, settings.uplink, desired, planned)
    yield from (group for group in every if group.key not in busy)
    for steps in redirect_steps(observed, settings, desired):
        yield Group(steps.key, steps.actions, f"container {steps.container}")


def _groups(
    observed: HostState,
    uplink: str,
    desired: Collection[Desired],
    planned: Mapping[Key, list[Action] | None],
) -> Iterator[Group]:
    """First what makes names free, then the uplink, then one key after the other."""
    for one in desired:
        for action in leave(observed, one, planned.get(one.key) or [], uplink):
            yield Group(one.key, (action,))
    every = [action for actions in planned.values() for action in actions or ()]
    joins = (isinstance(a, Connect) and a.network == uplink for a in every)
    needed = any(joins) or any(isinstance(action, CreateSandbox) for action in every)
    if needed and uplink not in {network.name for network in observed.networks}:
        yield Group(None, (CreateNetwork(uplink),))
    for one in desired:
        if actions := planned.get(one.key):
            yield Group(one.key, tuple(actions))


def _waits(group: Group, observed: HostState, uplink: str) -> bool:
    """Whether a group makes a proxy that lacks an address: its master's, or that of its uplink."""
    return any(
        isinstance(action, Create) and _lacks(action.key, observed, uplink)
        for action in group.actions
    )


def _lacks(key: Key, observed: HostState, uplink: str) -> bool:
    if key.is_ros2:  # its ear is at the uplink's gateway
        return uplink not in {network.name for network in observed.networks}
    return observed.masters.get(master(key).host) == ""


def _deaf(observed: HostState, settings: PlanSettings, live: Collection[Key]) -> Iterator[Problem]:
    """Proxies for ROS 2 that lack an ear."""
    found = (missing_ear(key, observed, settings) for key in sorted(live) if key.is_ros2)
    yield from filter(None, found)


def _unwell(observed: HostState, live: Collection[Key]) -> Iterator[Problem]:
    """Proxies that end again and again, and masters that are not found."""
    for one in observed.own:
        name = one.container.name
        if one.key in live and one.container.state == "restarting":
            yield Problem(f"proxy {name}", f"ends and is restarted: see docker logs {name}")
    for host in sorted(host for host, address in observed.masters.items() if not address):
        yield Problem(f"master {host}", unresolved_master(host))


def _ends(
    observed: HostState, settings: PlanSettings, found: DockerPlan, now: float
) -> Iterator[float]:
    """In how many seconds something comes to its end that no event tells."""
    memory = found.memory
    for one in found.desired:
        own = [each.container for each in observed.own if each.key == one.key]
        if not one.live and any(each.state != "removing" for each in own):
            yield settings.grace - (now - memory.absent[one.key])
        if one.live and any(e.state == "removing" or e.name in memory.refusals for e in own):
            yield SOON
    if any(one.container.state == "removing" for one in observed.redirects):
        yield SOON
    for member in found.members:
        boxes = [one.container for one in observed.sandboxes_of(member.key)]
        joined = any(b.networks & member.networks for b in boxes if b.state != "removing")
        asks = member.data_plane or member.direction or member.udp or member.peers
        if not member.container.alive and (joined or asks):
            yield settings.grace - (now - memory.exited[member.container.id])
