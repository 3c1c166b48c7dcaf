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
from rosproxy_operator.docker.planner.aliases import Naming, assign_aliases
from rosproxy_operator.docker.planner.allocation import after_refusals, allocate
from rosproxy_operator.docker.planner.container_steps import (
    PlanContext,
    disconnect_steps,
    removal_steps,
    wanted_steps,
)
from rosproxy_operator.docker.planner.desired import desire
from rosproxy_operator.docker.planner.flush import flush_steps
from rosproxy_operator.docker.planner.label_peers import with_bounded_peers
from rosproxy_operator.docker.planner.label_policy import with_bounded_rules
from rosproxy_operator.docker.planner.labels.members import LabelReading, find_members
from rosproxy_operator.docker.planner.labels.zenoh import with_bounded_containers
from rosproxy_operator.docker.planner.lan_relay import missing_lan_relay, with_lan_relay
from rosproxy_operator.docker.planner.model import Desired, HostState, Key, Member
from rosproxy_operator.docker.planner.redirect import redirect_steps
from rosproxy_operator.docker.planner.specs import master, proxy_name, unresolved_master
from rosproxy_operator.docker.planner.state import DockerMemory, after_look, with_exited
from rosproxy_operator.docker.settings import PlanSettings

UNWANTED = "no running container needs the proxy"
SOON = 1.0
"""Seconds until a look at something that is about to end: a removal, a port that is let go."""


@dataclass(frozen=True, slots=True)
class Group:
    """Actions to be carried out one after the other, for one key (or for the uplink: no key).

    One ``subject`` a container alone, for a redirect, and the key's other groups do not wait for
    each other. When an action fails, the rest of its group is left out, so that a proxy is only
    removed when its successor was created; but a failed Connect or Disconnect stops nothing else.
    ``fix`` is what users can do where one fails again and again, in words; empty for nothing.
    ``fatal``: a failure keeps an object from what its user wants (`Problem`).
    """

    key: Key | None
    actions: tuple[Action, ...]
    subject: str = ""
    fix: str = ""
    fatal: bool = True


@dataclass(frozen=True, slots=True)
class DockerPlan:
    """What to do, group after group, and what to remember.

    ``deferred`` are groups that have to wait until the address of their master is known: without
    it a proxy would find itself by its master's name; or until the uplink is there, where a LAN
    relay listens. ``again_in`` is in how many seconds to look again even if nothing happens; None:
    no need.
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
    members, crowded = _within_bounds(members, settings)
    memory = with_exited(memory, members, now)
    desired, bad_networks = desire(observed, settings, members, memory, now)
    memory = after_look(memory, observed, desired, settings.grace, now)
    naming = assign_aliases(desired, observed, settings, memory.names)
    live = {d.key for d in desired if d.live}
    memory = after_refusals(observed, live, memory, now)
    obstacle = _obstacle(observed, settings) if live else None
    creatable = obstacle is None
    memory, tight = allocate(observed, settings, desired, memory, now, frozen=not creatable)
    expired = {key for key, since in memory.absent.items() if now - since >= settings.grace}
    planned: dict[Key, list[Action] | None] = {
        key: [*removal_steps(observed, key, UNWANTED)] for key in expired
    }
    for wanted in desired:
        if ports := memory.planned.get(wanted.key):  # else its problem is reported already
            context = PlanContext(observed, settings, wanted, ports, naming, creatable)
            steps = wanted_steps(context)
            planned[wanted.key] = steps if steps is None else with_lan_relay(context, steps)
    problems = [*labels.problems, *unplaced, *crowded, *bad_networks, *naming.problems, *tight]
    problems += _unwell(observed, live)
    problems += _deaf(observed, settings, live)
    if obstacle:
        problems.append(replace(obstacle, fatal=None in planned.values()))
    groups = [*_possible_groups(observed, settings, desired, planned, naming, memory)]
    deferred = tuple(group for group in groups if _waits(group, observed, settings.uplink))
    docker_plan = DockerPlan(
        groups=tuple(group for group in groups if group not in deferred),
        deferred=deferred,
        memory=memory,
        problems=tuple(dict.fromkeys(problems)),
        members=members,
        desired=desired,
    )
    delays = [delay for delay in _delays(observed, settings, docker_plan, now) if delay > 0]
    return replace(docker_plan, again_in=min(delays, default=None))


def _within_bounds(
    members: Collection[Member], settings: PlanSettings
) -> tuple[tuple[Member, ...], list[Problem]]:
    """The members as far as their proxies can hold what all of their labels ask for together."""
    members, crowded = with_bounded_rules(members, settings)
    members, peerless = with_bounded_peers(members, settings)
    members, left_out = with_bounded_containers(members)
    return members, [*crowded, *peerless, *left_out]


def _obstacle(observed: HostState, settings: PlanSettings) -> Problem | None:
    """What keeps proxies from being created."""
    if not observed.image_id:
        return Problem(
            f"proxy image {settings.proxy_image}",
            f"not on this host. Run docker pull {settings.proxy_image}, or in rosproxy's sources "
            f"docker build --target proxy -t {settings.proxy_image} .",
        )
    for network in observed.networks:
        if network.name == settings.uplink and (network.internal or network.driver != "bridge"):
            return Problem(
                f"network {network.name}",
                "can't be the uplink of the proxies: the uplink must be a bridge, and not "
                "internal. Remove the network (the operator creates a new one), or name another "
                "network with --uplink",
            )
    return None


def _possible_groups(
    observed: HostState,
    settings: PlanSettings,
    desired: Collection[Desired],
    planned: Mapping[Key, list[Action] | None],
    naming: Naming,
    memory: DockerMemory,
) -> Iterator[Group]:
    """All groups but those of keys of which a container is busy, and those of helpers."""
    busy = {own.key for own in observed.own if own.container.name in observed.busy}
    groups = _groups(observed, settings.uplink, desired, planned, naming)
    yield from (group for group in groups if group.key not in busy)
    for steps in redirect_steps(observed, settings, desired):
        yield Group(steps.key, steps.actions, f"container {steps.container}", steps.fix)
    yield from flush_groups(observed, settings, desired, memory.outdated_flushes)


def flush_groups(
    observed: HostState,
    settings: PlanSettings,
    desired: Collection[Desired],
    outdated: Mapping[str, str],
) -> Iterator[Group]:
    """The groups that delete conntrack entries; each key's other work does not wait for them."""
    for flush in flush_steps(observed, settings, desired, outdated):
        if flush.actions:
            subject = f"conntrack entries for {proxy_name(flush.key)}"
            yield Group(flush.key, flush.actions, subject, flush.fix, fatal=False)


def _groups(
    observed: HostState,
    uplink: str,
    desired: Collection[Desired],
    planned: Mapping[Key, list[Action] | None],
    naming: Naming,
) -> Iterator[Group]:
    """First what makes names free, then the uplink, then one key after the other."""
    for wanted in desired:
        others = planned.get(wanted.key)
        for action in disconnect_steps(observed, wanted, others, uplink, naming):
            yield Group(wanted.key, (action,))
    all_actions = [action for actions in planned.values() for action in actions or ()]
    joins = (isinstance(a, Connect) and a.network == uplink for a in all_actions)
    is_needed = any(joins) or any(isinstance(action, CreateSandbox) for action in all_actions)
    if is_needed and uplink not in {network.name for network in observed.networks}:
        yield Group(None, (CreateNetwork(uplink),))
    for wanted in desired:
        if actions := planned.get(wanted.key):
            yield Group(wanted.key, tuple(actions))


def _waits(group: Group, observed: HostState, uplink: str) -> bool:
    """Whether a group makes a proxy that lacks an address: its master's, or that of its uplink."""
    return any(
        isinstance(action, Create) and _lacks_address(action.key, observed, uplink)
        for action in group.actions
    )


def _lacks_address(key: Key, observed: HostState, uplink: str) -> bool:
    if key.ros != "1":  # a LAN relay, and a router of this host, are at the uplink's gateway
        return uplink not in {network.name for network in observed.networks}
    return observed.masters.get(master(key).host) == ""


def _deaf(observed: HostState, settings: PlanSettings, live: Collection[Key]) -> Iterator[Problem]:
    """Proxies for ROS 2 that lack a LAN relay."""
    problems = (missing_lan_relay(key, observed, settings) for key in sorted(live) if key.is_ros2)
    yield from filter(None, problems)


def _unwell(observed: HostState, live: Collection[Key]) -> Iterator[Problem]:
    """Proxies that end again and again, and masters that are not found."""
    for own in observed.own:
        name = own.container.name
        if own.key in live and own.container.state == "restarting":
            yield Problem(
                f"proxy {name}", f"the container has ended and restarts. Read docker logs {name}"
            )
    for host in sorted(host for host, address in observed.masters.items() if not address):
        yield Problem(f"master {host}", unresolved_master(host))


def _delays(
    observed: HostState, settings: PlanSettings, docker_plan: DockerPlan, now: float
) -> Iterator[float]:
    """In how many seconds something ends without an event."""
    memory = docker_plan.memory
    for wanted in docker_plan.desired:
        present = [own.container for own in observed.own if own.key == wanted.key]
        if not wanted.live and any(c.state != "removing" for c in present):
            yield settings.grace - (now - memory.absent[wanted.key])
        if wanted.live and any(c.state == "removing" or c.name in memory.refusals for c in present):
            yield SOON
    helpers = (*observed.redirects, *observed.flushes)
    if any(helper.container.state == "removing" for helper in helpers):
        yield SOON
    for member in docker_plan.members:
        sandboxes = [s.container for s in observed.sandboxes_of(member.key)]
        joined = any(c.networks & member.networks for c in sandboxes if c.state != "removing")
        if not member.container.alive and (joined or member.wishes or member.peers):
            yield settings.grace - (now - memory.exited[member.container.id])
