"""The memory of the operator from look to look. A loss of the memory costs only time."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

from rosproxy.shared.ports import PortRange
from rosproxy_operator.common.port_ranges import (
    MOVE_REPORTED_S,
    REFUSED_PORT_AVOIDED_S,
    Move,
    within,
)
from rosproxy_operator.docker.planner.model import SERVING, Desired, HostState, Member
from rosproxy_operator.docker.planner.taken_names import (
    FormerNames,
    present_names,
    remember_names,
)
from rosproxy_operator.proxy_spec.place import Place

# A container in the state created has published no port yet: the range may still be taken.
_SERVED_STATES = SERVING | {"exited", "dead", "removing"}


@dataclass(frozen=True, slots=True)
class PortRefusal:
    """The engine has refused to start a sandbox because a port is taken.

    ``since`` is the time of the first refusal. ``port`` is the port in the engine's last error;
    None if the error names no port.
    """

    since: float
    port: int | None


@dataclass(frozen=True, slots=True)
class DockerMemory:
    """The memory of the operator. Times are in seconds of the operator's monotonic clock.

    Attributes:
        exited: Since when a member's container does not run, by the id of the container.
        absent: Since when no running container needs a proxy.
        served: The last range on which a proxy has served.
        planned: The range that the operator has chosen for a wanted proxy.
        refusals: The refusals of the engine, by the name of the sandbox.
        taken: Since when the operator avoids a port that the engine has refused.
        moved: The range that a proxy had to leave, and when.
        names: The names that containers have or had (`remember_names`).
        engine_returned: Whether the operator has connected to the engine since the last look, and
            so may have missed events.
        outdated_flushes: The flushes from before that connection, by id, each with the time of the
            last run as the engine writes times.
    """

    exited: Mapping[str, float] = field(default_factory=dict)
    absent: Mapping[Place, float] = field(default_factory=dict)
    served: Mapping[Place, PortRange] = field(default_factory=dict)
    planned: Mapping[Place, PortRange] = field(default_factory=dict)
    refusals: Mapping[str, PortRefusal] = field(default_factory=dict)
    taken: Mapping[int, float] = field(default_factory=dict)
    moved: Mapping[Place, Move] = field(default_factory=dict)
    names: FormerNames = field(default_factory=dict)
    engine_returned: bool = False
    outdated_flushes: Mapping[str, str] = field(default_factory=dict)

    def with_refusal(self, name: str, port: int | None, now: float) -> "DockerMemory":
        """Return the memory after the engine could not start the sandbox ``name``.

        ``port`` is the taken port; None if unknown.
        """
        previous = self.refusals.get(name)
        refusal = PortRefusal(previous.since if previous else now, port)
        return replace(self, refusals={**self.refusals, name: refusal})


def with_exited(memory: DockerMemory, members: Iterable[Member], now: float) -> DockerMemory:
    """Return the memory with the members that do not run, and since when."""
    gone = (member.container.id for member in members if not member.container.alive)
    return replace(memory, exited={c: memory.exited.get(c, now) for c in gone})


def after_look(
    memory: DockerMemory, observed: HostState, desired: Iterable[Desired], grace: float, now: float
) -> DockerMemory:
    """Return the memory after a look at the host, before the operator chooses names and ranges.

    ``grace`` is in seconds.
    """
    live = {d.place for d in desired if d.live}
    idle = {s.container.name for s in observed.sandboxes if s.container.state not in SERVING}
    places = (observed.places | set(memory.served)) - live
    absent = {place: memory.absent.get(place, now) for place in sorted(places)}
    flushes = {r.container.id: r.container.started_at for r in observed.flushes}
    wanted = live | {place for place, since in absent.items() if now - since < grace}
    return DockerMemory(
        exited=memory.exited,
        absent={p: since for p, since in absent.items() if p in wanted | observed.places},
        served={
            place: ports for place, ports in _served(memory, observed).items() if place in wanted
        },
        planned={place: ports for place, ports in memory.planned.items() if place in live},
        refusals={name: refusal for name, refusal in memory.refusals.items() if name in idle},
        taken={port: at for port, at in memory.taken.items() if now - at < REFUSED_PORT_AVOIDED_S},
        moved={
            place: move for place, move in memory.moved.items() if now - move.at < MOVE_REPORTED_S
        },
        names=remember_names(memory.names, present_names(observed), observed.containers),
        outdated_flushes=flushes if memory.engine_returned else memory.outdated_flushes,
    )


def _served(memory: DockerMemory, observed: HostState) -> dict[Place, PortRange]:
    """Return the range on which each proxy has served.

    The range of a running sandbox counts first, then the remembered range. A stopped container may
    be older than the memory. So the container's range counts only if the range has all remembered
    ports, or without a remembered range.
    """
    served = dict(memory.served)
    for own in (*observed.sandboxes, *observed.proxies):
        previous = served.get(own.place)
        if own.container.state in _SERVED_STATES and (not previous or within(previous, own.range)):
            served[own.place] = own.range
    for sandbox in reversed(observed.sandboxes):
        if sandbox.container.state in SERVING:
            served[sandbox.place] = sandbox.range
    return served
