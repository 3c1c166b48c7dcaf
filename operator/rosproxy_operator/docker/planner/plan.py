"""Make the plan for a Docker host from the state of the host."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace

from rosproxy_operator.common.problem import (
    LAN_RELAY_STUCK,
    MASTER_UNKNOWN,
    STUCK,
    Problem,
    ends_again,
)
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
from rosproxy_operator.docker.planner.label_peers import with_bounded_links, with_bounded_peers
from rosproxy_operator.docker.planner.label_policy import with_bounded_rules
from rosproxy_operator.docker.planner.labels.members import LabelReading, find_members
from rosproxy_operator.docker.planner.labels.zenoh import with_bounded_containers
from rosproxy_operator.docker.planner.lan_relay import missing_lan_relay, with_lan_relay
from rosproxy_operator.docker.planner.model import (
    THIS_HOST,
    Desired,
    HostState,
    LanRelayContainer,
    Member,
    Proxy,
)
from rosproxy_operator.docker.planner.redirect import redirect_steps
from rosproxy_operator.docker.planner.specs import proxy_name, unresolved_master
from rosproxy_operator.docker.planner.state import DockerMemory, after_look, with_exited
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.proxy_spec.place import Domain, Master, Place

UNWANTED_REASON = "no running container needs the proxy"
ENGINE_BUSY_RECHECK_S = 1.0
"""Seconds until the next look while the engine removes a container, or still holds a port."""


@dataclass(frozen=True, slots=True)
class Group:
    """Actions for a proxy, in order. If ``place`` is None, the actions are for networks (uplink).

    Every group waits for the uplink's group. Groups with the same place and ``subject`` run in
    order. Redirects and flushes have a ``subject``, so other work for the proxy does not wait for
    these.

    If an action fails, the executor skips the rest of the group. Create comes before Remove in a
    group, so the operator removes a proxy only after the operator has created the successor. A
    failed Connect or Disconnect is an exception: the group goes on. ``fix`` says what users can do
    if an action keeps failing; empty if users can do nothing. ``fatal``: whether a failure is a
    fatal `Problem`.
    """

    place: Place | None
    actions: tuple[Action, ...]
    subject: str = ""
    fix: str = ""
    fatal: bool = True


@dataclass(frozen=True, slots=True)
class DockerPlan:
    """The groups of actions that the operator carries out, and the memory for the next look.

    ``deferred`` are groups that create a proxy and wait for an address. A proxy for ROS 1 waits
    only while the address of the master is unknown. The proxy can't resolve the master's host name:
    on the proxy's networks this name is an alias of the proxy itself. Other proxies wait until the
    uplink network exists. These proxies get the address of the uplink's gateway as an option: at
    that address, LAN relays and zenoh routers of this host listen.

    ``again_in`` is in seconds: the next look is then, or at an event. None: only at an event.
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
        """All actions that the operator can carry out now, in order."""
        return tuple(action for group in self.groups for action in group.actions)


def plan(
    observed: HostState,
    labels: LabelReading,
    settings: PlanSettings,
    memory: DockerMemory,
    now: float,
) -> DockerPlan:
    """Return the plan for a host. The plan has no actions if nothing is left to do.

    If a container of a proxy is busy (`HostState.busy`), the plan has no actions for the containers
    and networks of this proxy. The plan may still set or remove redirects to the proxy. ``labels``
    are the labels in ``observed``. ``memory`` is the memory of the previous plan, empty for the
    first plan. ``now`` is in seconds of a monotonic clock, the same for all plans.
    """
    members, member_problems = find_members(labels, observed, settings)
    members, bound_problems = _within_bounds(members, settings)
    memory = with_exited(memory, members, now)
    desired, network_problems = desire(observed, settings, members, memory, now)
    memory = after_look(memory, observed, desired, settings.grace, now)
    naming = assign_aliases(desired, observed, settings, memory.names)
    live = {d.place for d in desired if d.live}
    memory = after_refusals(observed, live, memory, now)
    obstacle = _obstacle(observed, settings) if live else None
    creatable = obstacle is None
    memory, port_problems = allocate(observed, settings, desired, memory, now, frozen=not creatable)
    expired = {place for place, since in memory.absent.items() if now - since >= settings.grace}
    actions_by_place: dict[Place, list[Action] | None] = {
        place: [*removal_steps(observed, place, UNWANTED_REASON)] for place in expired
    }
    for wanted in desired:
        if ports := memory.planned.get(wanted.place):  # else the reason is in port_problems
            context = PlanContext(observed, settings, wanted, ports, naming, creatable)
            steps = wanted_steps(context)
            with_relay = steps if steps is None else with_lan_relay(context, steps)
            actions_by_place[wanted.place] = with_relay
    problems = [*labels.problems, *member_problems, *bound_problems, *network_problems]
    problems += [*naming.problems, *port_problems, *_container_problems(observed, live)]
    problems += _missing_lan_relays(observed, settings, live)
    if obstacle:  # fatal only if a proxy lacks a container, and the operator can't create it
        problems.append(replace(obstacle, fatal=None in actions_by_place.values()))
    groups = [*_possible_groups(observed, settings, desired, actions_by_place, naming, memory)]
    deferred = tuple(group for group in groups if _is_deferred(group, observed, settings.uplink))
    docker_plan = DockerPlan(
        groups=tuple(group for group in groups if group not in deferred),
        deferred=deferred,
        memory=memory,
        problems=tuple(dict.fromkeys(problems)),
        members=members,
        desired=desired,
    )
    waits = [*_seconds_to_changes(observed, settings, docker_plan, now)]
    return replace(docker_plan, again_in=min((wait for wait in waits if wait > 0), default=None))


def _within_bounds(
    members: Collection[Member], settings: PlanSettings
) -> tuple[tuple[Member, ...], list[Problem]]:
    """Return the members that the proxies can serve, and the problems of the limits.

    A member with too many peers or links stays, without these. A living member that loses its
    peers, its links or its proxy gets a problem.
    """
    members, rule_problems = with_bounded_rules(members, settings)
    members, peer_problems = with_bounded_peers(members, settings)
    members, link_problems = with_bounded_links(members, settings)
    members, zenoh_problems = with_bounded_containers(members)
    return members, [*rule_problems, *peer_problems, *link_problems, *zenoh_problems]


def _obstacle(observed: HostState, settings: PlanSettings) -> Problem | None:
    """The problem of the image or the uplink that prevents new proxies; None without a problem."""
    if not observed.image_id:
        return Problem(
            f"proxy image {settings.proxy_image}",
            "not on this host",
            f"Run docker pull {settings.proxy_image}, or in rosproxy's sources docker build "
            f"--target proxy -t {settings.proxy_image} .",
            reason=STUCK,
        )
    for network in observed.networks:
        if network.name == settings.uplink and (network.internal or network.driver != "bridge"):
            return Problem(
                f"network {network.name}",
                "can't be the uplink of the proxies: the uplink must be a bridge, and not internal",
                "Remove the network (the operator creates a new one), or name another network with "
                "--uplink",
                reason="NetworkUnusable",
            )
    return None


def _possible_groups(
    observed: HostState,
    settings: PlanSettings,
    desired: Collection[Desired],
    actions_by_place: Mapping[Place, list[Action] | None],
    naming: Naming,
    memory: DockerMemory,
) -> Iterator[Group]:
    """The groups of places without busy containers, and all groups of redirects and flushes."""
    busy = {own.place for own in observed.own if own.container.name in observed.busy}
    groups = _groups(observed, settings.uplink, desired, actions_by_place, naming)
    yield from (group for group in groups if group.place not in busy)
    for steps in redirect_steps(observed, settings, desired):
        yield Group(steps.place, steps.actions, f"container {steps.container}", steps.fix)
    yield from flush_groups(observed, settings, desired, memory.outdated_flushes)


def flush_groups(
    observed: HostState,
    settings: PlanSettings,
    desired: Collection[Desired],
    outdated: Mapping[str, str],
) -> Iterator[Group]:
    """The groups that delete conntrack entries. No other group waits for these groups."""
    for flush in flush_steps(observed, settings, desired, outdated):
        if flush.actions:
            subject = f"conntrack entries for {proxy_name(flush.place)}"
            yield Group(flush.place, flush.actions, subject, flush.fix, fatal=False)


def _groups(
    observed: HostState,
    uplink: str,
    desired: Collection[Desired],
    actions_by_place: Mapping[Place, list[Action] | None],
    naming: Naming,
) -> Iterator[Group]:
    """The groups of proxies and the uplink.

    The executor carries out the uplink's group first, and the groups of a proxy in this order: the
    groups that leave networks, then all other actions. Proxies do not wait for each other.
    """
    for wanted in desired:
        others = actions_by_place.get(wanted.place)
        for action in disconnect_steps(observed, wanted, others, uplink, naming):
            yield Group(wanted.place, (action,))
    all_actions = [action for actions in actions_by_place.values() for action in actions or ()]
    joins = (isinstance(a, Connect) and a.network == uplink for a in all_actions)
    # By the uplink's gateway, the operator finds the address of this host.
    is_needed = observed.masters.get(THIS_HOST) == "" or any(
        (*joins, *(isinstance(action, CreateSandbox) for action in all_actions))
    )
    if is_needed and uplink not in {network.name for network in observed.networks}:
        yield Group(None, (CreateNetwork(uplink),))
    for wanted in desired:
        if actions := actions_by_place.get(wanted.place):
            yield Group(wanted.place, tuple(actions))


def _is_deferred(group: Group, observed: HostState, uplink: str) -> bool:
    """Whether a group creates a proxy without a known address of the master, or of the uplink."""
    return any(
        isinstance(action, Create) and _lacks_address(action.place, observed, uplink)
        for action in group.actions
    )


def _lacks_address(place: Place, observed: HostState, uplink: str) -> bool:
    if not isinstance(place.graph, Master):
        # LAN relays, and zenoh routers of this host, are at the uplink's gateway.
        return uplink not in {network.name for network in observed.networks}
    return observed.masters.get(place.master.host) == ""


def _missing_lan_relays(
    observed: HostState, settings: PlanSettings, live: Collection[Place]
) -> Iterator[Problem]:
    """Warnings for proxies for ROS 2 without a LAN relay."""
    places = (place for place in sorted(live) if isinstance(place.graph, Domain))
    problems = (missing_lan_relay(place, observed, settings) for place in places)
    yield from filter(None, problems)


def _container_problems(observed: HostState, live: Collection[Place]) -> Iterator[Problem]:
    """Problems of own containers that the engine restarts, and of masters without an address."""
    for own in observed.own:
        name = own.container.name
        if own.place in live and own.container.state == "restarting":
            kind = "proxy" if isinstance(own, Proxy) else "container"  # a sandbox, or a LAN relay
            reason = LAN_RELAY_STUCK if isinstance(own, LanRelayContainer) else STUCK
            fault = ends_again("the engine restarts it", f"docker logs {name}")
            yield Problem(f"{kind} {name}", *fault, fatal=reason is STUCK, reason=reason)
    for host in sorted(host for host, address in observed.masters.items() if not address):
        fault = unresolved_master(host, observed)
        yield Problem(f"master {host}", *fault, reason=MASTER_UNKNOWN)


def _seconds_to_changes(
    observed: HostState, settings: PlanSettings, docker_plan: DockerPlan, now: float
) -> Iterator[float]:
    """The seconds until the plan may change without an event.

    These are the times until a grace ends. During a removal and after a refused port, the time is
    `ENGINE_BUSY_RECHECK_S`. A time may be negative.
    """
    memory = docker_plan.memory
    for wanted in docker_plan.desired:
        present = [own.container for own in observed.own if own.place == wanted.place]
        if not wanted.live and any(c.state != "removing" for c in present):
            yield settings.grace - (now - memory.absent[wanted.place])
        if wanted.live and any(c.state == "removing" or c.name in memory.refusals for c in present):
            yield ENGINE_BUSY_RECHECK_S
    helpers = (*observed.redirects, *observed.flushes)
    if any(helper.container.state == "removing" for helper in helpers):
        yield ENGINE_BUSY_RECHECK_S
    for member in docker_plan.members:
        sandboxes = [s.container for s in observed.sandboxes_of(member.place)]
        joined = any(c.networks & member.networks for c in sandboxes if c.state != "removing")
        if not member.container.alive and (joined or member.wishes or member.peers or member.links):
            yield settings.grace - (now - memory.exited[member.container.id])
