"""From what is seen on a Docker host to what is to be done there."""

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

from rosproxy_operator.common.problem import Problem
from rosproxy_operator.docker.planner.actions import (
    Action,
    Connect,
    Create,
    CreateNetwork,
    CreateSandbox,
    Remove,
)
from rosproxy_operator.docker.planner.aliases import Aliases, assign
from rosproxy_operator.docker.planner.allocation import GivenRanges, allocate, refused
from rosproxy_operator.docker.planner.context import PlanContext
from rosproxy_operator.docker.planner.desired import desire
from rosproxy_operator.docker.planner.labels.masters import unresolved
from rosproxy_operator.docker.planner.labels.members import LabelReading, find_members
from rosproxy_operator.docker.planner.model import (
    Desired,
    HostState,
    Key,
    Member,
    PlanSettings,
    Proxy,
    Sandbox,
)
from rosproxy_operator.docker.planner.process import process_steps, retired
from rosproxy_operator.docker.planner.sandbox import leave, sandbox_steps
from rosproxy_operator.docker.planner.specs import master
from rosproxy_operator.docker.planner.state import DockerMemory, looked, noticed

SOON = 1.0
"""Seconds until a look at something that is about to end: a removal, a port that is let go."""


@dataclass(frozen=True, slots=True)
class Group:
    """Actions to be carried out one after the other, for one key (or for the uplink: no key).

    When one fails, the rest is left out, so that a proxy is only removed when the one that takes
    over was created; but a failed Connect or Disconnect keeps nothing else from being done.
    """

    key: Key | None
    actions: tuple[Action, ...]


@dataclass(frozen=True, slots=True)
class DockerPlan:
    """What to do, group after group, and what to remember.

    ``deferred`` are groups that have to wait until the address of their master is known: without
    it a proxy would find itself by its master's name. ``again_in`` is in how many seconds to look
    again even if nothing happens; None: no need.
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
    members, unplaced = find_members(labels, observed)
    memory = noticed(memory, members, now)
    desired, bad_networks = desire(observed, settings, members, memory, now)
    memory = looked(memory, observed, desired, settings.grace, now)
    aliases, missed = assign(desired, observed)
    live = [one.key for one in desired if one.live]
    memory = refused(observed, live, memory, now)
    obstacle = _obstacle(observed, settings) if live else None
    ranges = allocate(observed, settings, desired, memory, now, frozen=obstacle is not None)
    view = _View(observed, settings, aliases, ranges, obstacle is None, now)
    planned = {one.key: _main(view, one) for one in desired}
    problems = [*labels.problems, *unplaced, *bad_networks, *missed, *ranges.problems]
    problems += [*_restarting(view, live), *unresolved(observed.unresolved)]
    if obstacle:
        problems.append(replace(obstacle, fatal=None in planned.values()))
    groups = [g for g in _groups(view, desired, planned) if g.key not in observed.busy_keys]
    return DockerPlan(
        groups=tuple(group for group in groups if not _waits(group, observed)),
        deferred=tuple(group for group in groups if _waits(group, observed)),
        memory=ranges.memory,
        problems=tuple(dict.fromkeys(problems)),
        members=members,
        desired=desired,
        again_in=min(_ends(view, desired, members), default=None),
    )


@dataclass(frozen=True, slots=True)
class _View:
    """What the plans of all keys are made from."""

    observed: HostState
    settings: PlanSettings
    aliases: Aliases
    ranges: GivenRanges
    creatable: bool
    now: float

    @property
    def memory(self) -> DockerMemory:
        """What is going to be remembered."""
        return self.ranges.memory

    def sandboxes(self, key: Key) -> tuple[Sandbox, ...]:
        """The sandboxes of a key but those that are being removed."""
        own = self.observed.sandboxes_of(key)
        return tuple(one for one in own if one.container.state != "removing")

    def proxies(self, key: Key) -> tuple[Proxy, ...]:
        """The proxies of a key but those that are being removed."""
        own = self.observed.proxies_of(key)
        return tuple(one for one in own if one.container.state != "removing")

    def waiting(self, key: Key) -> bool:
        """Whether a container of the key is being removed."""
        own = self.observed.own
        return any(one.key == key and one.container.state == "removing" for one in own)

    def left(self, since: float) -> float:
        """The seconds until the grace ends of what began then."""
        return self.settings.grace - (self.now - since)


def _obstacle(observed: HostState, settings: PlanSettings) -> Problem | None:
    """What keeps proxies from being created."""
    if not observed.image_id:
        return Problem(
            f"proxy image {settings.image}",
            f"not on this host: docker pull {settings.image}, or in rosproxy's sources: "
            f"docker build --target proxy -t {settings.image} .",
        )
    for network in observed.networks:
        if network.name == settings.uplink and (network.internal or network.driver != "bridge"):
            return Problem(
                f"network {network.name}",
                "can't be the proxies' uplink: it must be an ordinary bridge, not internal: remove "
                "it (the operator creates it anew) or name another one with --uplink",
            )
    return None


def _main(view: _View, desired: Desired) -> tuple[Action, ...] | None:
    """What is to be done for a key besides leaving networks; None if it can't be done."""
    key = desired.key
    if not desired.live:
        ended = view.left(view.memory.absent.get(key, view.now)) <= 0
        return tuple(retired(view.sandboxes(key), view.proxies(key))) if ended else ()
    ports = view.ranges.given.get(key)
    if ports is None:
        return ()  # its problem is told already
    context = PlanContext(
        view.observed, view.settings, desired, ports, view.aliases, view.creatable
    )
    first = sandbox_steps(context)
    if first.stuck or first.home is None:
        return None if first.stuck else first.actions
    gone = {action.name for action in first.actions if isinstance(action, Remove)}
    then = process_steps(context, first.home, gone)
    return None if then is None else first.actions + then


def _groups(
    view: _View,
    desired: Iterable[Desired],
    planned: Mapping[Key, tuple[Action, ...] | None],
) -> Iterator[Group]:
    """First what makes names free, then the uplink, then one key after the other."""
    uplink = view.settings.uplink
    for one in desired:
        main = planned[one.key] or ()
        removed = {action.name for action in main if isinstance(action, Remove)}
        staying = tuple(
            sandbox.container
            for sandbox in view.sandboxes(one.key)
            if sandbox.container.name not in removed
        )
        for action in leave(view.observed, one, staying, uplink):
            if action not in main:
                yield Group(one.key, (action,))
    if uplink not in {network.name for network in view.observed.networks} and any(
        _needs(action, uplink) for actions in planned.values() for action in actions or ()
    ):
        yield Group(None, (CreateNetwork(uplink),))
    for key, actions in planned.items():
        if actions:
            yield Group(key, actions)


def _waits(group: Group, observed: HostState) -> bool:
    """Whether a group makes a proxy whose master has no known address."""
    return any(
        isinstance(action, Create) and master(action.proxy.key).host in observed.unresolved
        for action in group.actions
    )


def _needs(action: Action, uplink: str) -> bool:
    return isinstance(action, CreateSandbox) or (
        isinstance(action, Connect) and action.network == uplink
    )


def _restarting(view: _View, live: Collection[Key]) -> Iterator[Problem]:
    for one in view.observed.own:
        name = one.container.name
        if one.key in live and one.container.state == "restarting":
            yield Problem(f"proxy {name}", f"ends and is restarted: see docker logs {name}")


def _ends(view: _View, desired: Iterable[Desired], members: Iterable[Member]) -> Iterator[float]:
    """In how many seconds something comes to its end that no event tells."""
    memory = view.memory
    for one in desired:
        sandboxes = view.sandboxes(one.key)
        tried = any(sandbox.container.name in memory.refusals for sandbox in sandboxes)
        if one.live and (view.waiting(one.key) or tried):
            yield SOON
        there = sandboxes or view.proxies(one.key)
        if not one.live and there and view.left(memory.absent[one.key]) > 0:
            yield view.left(memory.absent[one.key])
    for member in members:
        left = 0.0 if member.alive else view.left(memory.exited[member.id])
        joined = any(s.container.networks & member.networks for s in view.sandboxes(member.key))
        if left > 0 and (joined or member.data_plane):
            yield left
