"""Which range of ports each proxy of a Docker host gets, and when it must leave it."""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import replace

from rosproxy.leases.ports import PortRange
from rosproxy_operator.common.allocation import (
    RETRY_FOR,
    Move,
    PortsExhausted,
    after_move,
    extended,
    is_free,
    negotiate,
    within,
)
from rosproxy_operator.common.problem import Problem
from rosproxy_operator.docker.planner.model import (
    SERVING,
    STARTED,
    Container,
    Desired,
    HostState,
    Key,
    PlanSettings,
    Sandbox,
)
from rosproxy_operator.docker.planner.specs import proxy_name, reserved_ports
from rosproxy_operator.docker.planner.state import DockerMemory, PortRefusal


def refused(
    observed: HostState, live: Collection[Key], memory: DockerMemory, now: float
) -> DockerMemory:
    """Draw the conclusions from the engine's refusals to start sandboxes.

    A range that has never served is given up at once: its refused ports become ``taken``. One that
    has served is given up after `RETRY_FOR` seconds, since its ports may only be slow to be let go.
    """
    for sandbox in observed.sandboxes:
        refusal = memory.refusals.get(sandbox.container.name)
        if refusal is not None and sandbox.key in live:
            memory = _concluded(memory, sandbox, refusal, now)
    return memory


def _concluded(
    memory: DockerMemory, sandbox: Sandbox, refusal: PortRefusal, now: float
) -> DockerMemory:
    served, moved = memory.served.get(sandbox.key), dict(memory.moved)
    port = refusal.port
    hit = {port} if port and port in sandbox.range else set(sandbox.range.ports())
    fresh = {port for port in hit if served is None or port not in served}
    if served is not None and not fresh:
        if now - refusal.since < RETRY_FOR:
            return memory
        moved[sandbox.key] = Move(served, now)
    name = sandbox.container.name
    return replace(
        memory,
        refusals={other: said for other, said in memory.refusals.items() if other != name},
        taken={**memory.taken, **dict.fromkeys(fresh or hit, now)},
        moved=moved,
    )


class _Allocation:
    """Ranges being given out, one key after the other."""

    def __init__(
        self,
        observed: HostState,
        settings: PlanSettings,
        memory: DockerMemory,
        live: Mapping[Key, Desired],
    ) -> None:
        self.observed = observed
        self.settings = settings
        self.memory = memory
        self.live = live
        self.given: dict[Key, PortRange] = {}
        self.problems: list[Problem] = []
        self.serving = {s.key for s in observed.sandboxes if s.container.state in SERVING}
        """The keys that have ports on which a proxy serves."""

    def claimed(self, key: Key) -> frozenset[int]:
        """The ports that other containers publish, by a key's protocols, and those refused."""
        return self._published(self.observed.containers, key) | self.memory.taken.keys()

    def blocked(self, key: Key) -> frozenset[int]:
        """These, and on which something listens."""
        seen = self.observed
        return self.claimed(key) | self._for(key, seen.listening, seen.listening_udp)

    def order(self, key: Key) -> tuple[int, Key]:
        """Who has ports comes before who had some, and that one before who wants some."""
        ranks = [key in found for found in (self.serving, self.memory.served, self.memory.planned)]
        return [*ranks, True].index(True), key

    def held(self, key: Key) -> list[PortRange]:
        """The ranges that a key can't have: other proxies', and the kernel's."""
        others = [sandbox.range for sandbox in self.observed.sandboxes if sandbox.key != key]
        return [self.observed.ephemeral, *others, *self.given_to_others(key)]

    def given_to_others(self, key: Key) -> list[PortRange]:
        """What other keys have got already."""
        return [ports for other, ports in self.given.items() if other != key]

    def may_stay(self, key: Key, ports: PortRange) -> bool:
        """Whether nobody else is seen to have ports on which this key's proxy has served.

        What listens there does not count: it may be what is left of that very proxy.
        """
        others = [
            one.range
            for one in self.observed.sandboxes
            if one.key != key and (one.key not in self.live or one.key in self.serving)
        ]
        started = [one for one in self.observed.containers if one.state in STARTED]
        taken = self._published(started, key) | self.memory.taken.keys()
        return is_free(ports, taken, [*others, *self.given_to_others(key)])

    def _for(self, key: Key, tcp: frozenset[int], udp: frozenset[int]) -> frozenset[int]:
        """Those of some TCP ports and UDP ports that a key's proxy publishes as well."""
        if key.is_ros2:
            return udp
        return tcp | udp if self.live[key].udp else tcp

    def _published(self, containers: Collection[Container], key: Key) -> frozenset[int]:
        """The ports that containers publish by the protocols of a key's proxy."""
        tcp = frozenset(port for one in containers for port in one.host_ports)
        return self._for(key, tcp, frozenset(port for one in containers for port in one.udp_ports))

    def keep(self, key: Key) -> None:
        """Give a key the range where its proxy serves, has served, or is being made."""
        ports = self.memory.served.get(key)
        if ports is not None and (key in self.serving or self.may_stay(key, ports)):
            self.given[key] = ports
            return
        created = [one.range for one in self.observed.sandboxes_of(key)]
        ports = self.memory.planned.get(key) or (created[0] if created else None)
        # What listens on ports of a sandbox that is there may be the engine, which is starting it.
        blocked = self.claimed(key) if ports in created else self.blocked(key)
        if ports and is_free(ports, blocked | reserved_ports(key), self.held(key)):
            self.given[key] = ports

    def fill(self, desired: Desired, frozen: bool) -> None:
        """Give a key more ports if it has too few, or a range if it has none."""
        key, count, window = desired.key, desired.ports, self.settings.port_window
        blocked, held = self.blocked(key) | reserved_ports(key), self.held(key)
        kept = self.given.get(key)
        if kept is None:
            try:
                self.given[key] = negotiate(count, window, blocked, held)
            except PortsExhausted as error:
                text = (
                    f"{error}: lower --ports or the label rosproxy.ports ({count}), widen "
                    f"--port-window ({window}), or stop what holds ports there"
                )
                self.problems.append(_problem(key, text, fatal=True))
        elif not frozen:
            self.given[key] = extended(kept, count, window, blocked, held) or kept
            if len(self.given[key]) < count:
                more = PortRange(kept.last + 1, kept.first + count - 1)
                text = (
                    f"{count} ports are wanted (--ports or the label rosproxy.ports), but it keeps "
                    f"its {len(kept)} at {kept}, since {more} are not free or beyond "
                    "--port-window: stop what holds them"
                )
                self.problems.append(_problem(key, text))


def allocate(
    observed: HostState,
    settings: PlanSettings,
    desired: Iterable[Desired],
    memory: DockerMemory,
    now: float,
    frozen: bool = False,
) -> tuple[DockerMemory, list[Problem]]:
    """Plan a range for each live proxy: the one that it has or had, else the first that is free.

    The memory's ``planned`` has those of all that can have one. A proxy that serves is never moved.
    One that has served and does not is only moved if others are seen on its ports. With ``frozen``
    no range gets longer: nothing can be created.
    """
    live = {one.key: one for one in desired if one.live}
    allocation = _Allocation(observed, settings, memory, live)
    order = sorted(live, key=allocation.order)
    for key in order:
        allocation.keep(key)
    for key in order:
        allocation.fill(live[key], frozen)
    given, served = allocation.given, dict(memory.served)
    left = [key for key in given if key in served and not within(served[key], given[key])]
    moved = {key: Move(served.pop(key), now) for key in left} | dict(memory.moved)
    for key, ports in sorted(given.items(), key=lambda item: item[0]):
        if key in moved and not within(moved[key].ports, ports):
            text = (
                f"HAS LEFT ITS PORTS {moved[key].ports} for {ports}, since something else has "
                f"taken them: {after_move(not key.is_ros2, key.is_ros2)}"
            )
            allocation.problems.append(_problem(key, text))
    memory = replace(memory, served=served, planned=given, moved=moved)
    return memory, allocation.problems


def _problem(key: Key, text: str, fatal: bool = False) -> Problem:
    return Problem(f"proxy {proxy_name(key)}", text, fatal)
