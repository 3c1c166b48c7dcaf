"""What the operator remembers from look to look. Losing it costs time, never correctness."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

from rosproxy.leases.ports import PortRange
from rosproxy_operator.common.port_negotiation import MOVED_FOR, TAKEN_FOR, Move, within
from rosproxy_operator.docker.planner.model import SERVING, Desired, HostState, Key, Member
from rosproxy_operator.docker.planner.taken_names import (
    FormerNames,
    present_names,
    remember_names,
)

# One that is only created has published no port yet: its range may still turn out to be taken.
_HAS_SERVED = SERVING | {"exited", "dead", "removing"}


@dataclass(frozen=True, slots=True)
class PortRefusal:
    """The engine didn't start a sandbox because of its ports.

    ``since`` is when it first said so. ``port`` is the one that it named; None if it named none.
    """

    since: float
    port: int | None


@dataclass(frozen=True, slots=True)
class DockerMemory:
    """Times are in seconds of the operator's monotonic clock.

    ``exited`` are containers, by id, since when they are seen not to run; ``absent`` proxies since
    when nobody wants them. ``served`` is the range on which a proxy was last seen to serve,
    ``planned`` the one with which one is being created. ``refusals`` are by the name of the
    sandbox. ``taken`` are ports that the engine has refused, and when. ``names`` are those that
    containers have or had (`remember_names`). ``engine_returned``: the engine was not there, or not
    listened to, before the look. ``outdated_flushes`` are flushes that ran before that, by id, with
    the time of their last run.
    """

    exited: Mapping[str, float] = field(default_factory=dict)
    absent: Mapping[Key, float] = field(default_factory=dict)
    served: Mapping[Key, PortRange] = field(default_factory=dict)
    planned: Mapping[Key, PortRange] = field(default_factory=dict)
    refusals: Mapping[str, PortRefusal] = field(default_factory=dict)
    taken: Mapping[int, float] = field(default_factory=dict)
    moved: Mapping[Key, Move] = field(default_factory=dict)
    names: FormerNames = field(default_factory=dict)
    engine_returned: bool = False
    outdated_flushes: Mapping[str, str] = field(default_factory=dict)

    def port_taken(self, name: str, port: int | None, now: float) -> "DockerMemory":
        """Note that the engine could not start the sandbox ``name``: a port of it is taken."""
        previous = self.refusals.get(name)
        refusal = PortRefusal(previous.since if previous else now, port)
        return replace(self, refusals={**self.refusals, name: refusal})


def with_exited(memory: DockerMemory, members: Iterable[Member], now: float) -> DockerMemory:
    """The memory with the containers that have exited, and since when."""
    gone = (member.container.id for member in members if not member.container.alive)
    return replace(memory, exited={c: memory.exited.get(c, now) for c in gone})


def after_look(
    memory: DockerMemory, observed: HostState, desired: Iterable[Desired], grace: float, now: float
) -> DockerMemory:
    """What is remembered after a look at the host, before anything is decided."""
    live = {d.key for d in desired if d.live}
    idle = {s.container.name for s in observed.sandboxes if s.container.state not in SERVING}
    keys = (observed.keys | set(memory.served)) - live
    absent = {key: memory.absent.get(key, now) for key in sorted(keys)}
    flushes = {r.container.id: r.container.started_at for r in observed.flushes}
    wanted = live | {key for key, since in absent.items() if now - since < grace}
    return DockerMemory(
        exited=memory.exited,
        absent={k: since for k, since in absent.items() if k in wanted | observed.keys},
        served={key: ports for key, ports in _served(memory, observed).items() if key in wanted},
        planned={key: ports for key, ports in memory.planned.items() if key in live},
        refusals={name: refusal for name, refusal in memory.refusals.items() if name in idle},
        taken={port: at for port, at in memory.taken.items() if now - at < TAKEN_FOR},
        moved={key: move for key, move in memory.moved.items() if now - move.at < MOVED_FOR},
        names=remember_names(memory.names, present_names(observed), observed.containers),
        outdated_flushes=flushes if memory.engine_returned else memory.outdated_flushes,
    )


def _served(memory: DockerMemory, observed: HostState) -> dict[Key, PortRange]:
    """Where each proxy has served: a sandbox that runs knows best.

    What has stopped may be older than what is remembered, unless it has more ports.
    """
    served = dict(memory.served)
    for own in (*observed.sandboxes, *observed.proxies):
        previous = served.get(own.key)
        if own.container.state in _HAS_SERVED and (not previous or within(previous, own.range)):
            served[own.key] = own.range
    for sandbox in reversed(observed.sandboxes):
        if sandbox.container.state in SERVING:
            served[sandbox.key] = sandbox.range
    return served
