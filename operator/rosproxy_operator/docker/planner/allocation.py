"""Which range of ports each proxy of a Docker host gets, and when it must leave it."""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import replace

from rosproxy.leases.ports import PortRange
from rosproxy_operator.common.port_negotiation import (
    RETRY_FOR,
    Move,
    PortsExhausted,
    after_move,
    extended,
    is_free,
    negotiate_with_room,
    overlap,
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
    Sandbox,
)
from rosproxy_operator.docker.planner.specs import proxy_name, reserved_ports
from rosproxy_operator.docker.planner.state import DockerMemory, PortRefusal
from rosproxy_operator.docker.settings import PlanSettings


def after_refusals(
    observed: HostState, live: Collection[Key], memory: DockerMemory, now: float
) -> DockerMemory:
    """The memory after the engine's refusals to start sandboxes.

    A range that has never served is given up at once: its refused ports become ``taken``. One that
    has served is given up after `RETRY_FOR` seconds, since its ports may only be slow to be let go.
    """
    for sandbox in observed.sandboxes:
        refusal = memory.refusals.get(sandbox.container.name)
        if refusal is not None and sandbox.key in live:
            memory = _after_refusal(memory, sandbox, refusal, now)
    return memory


def _after_refusal(
    memory: DockerMemory, sandbox: Sandbox, refusal: PortRefusal, now: float
) -> DockerMemory:
    served = memory.served.get(sandbox.key)
    moved = dict(memory.moved)
    port = refusal.port
    suspects = {port} if port and port in sandbox.range else set(sandbox.range.ports())
    # Of a range that was made longer only the added ports can be another's: on the others its proxy
    # has served, and the engine may only be slow to let go of them.
    unserved = {port for port in suspects if served is None or port not in served}
    if served is not None and not unserved:
        if now - refusal.since < RETRY_FOR:
            return memory
        moved[sandbox.key] = Move(served, now)
    name = sandbox.container.name
    return replace(
        memory,
        refusals={n: r for n, r in memory.refusals.items() if n != name},
        taken={**memory.taken, **dict.fromkeys(unserved or suspects, now)},
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
        self.allocated: dict[Key, PortRange] = {}
        self.problems: list[Problem] = []
        self.serving = {s.key for s in observed.sandboxes if s.container.state in SERVING}
        """The keys that have ports on which a proxy serves."""

    def claimed(self, key: Key) -> frozenset[int]:
        """The ports that other containers publish, by a key's protocols, and those refused."""
        return self._published(self.observed.containers, key) | self.memory.taken.keys()

    def blocked(self, key: Key) -> frozenset[int]:
        """The claimed ports, and those on which something listens."""
        observed = self.observed
        return self.claimed(key) | self._matching(key, observed.listening, observed.listening_udp)

    def order(self, key: Key) -> tuple[int, Key]:
        """Keys with ports come first, then those that had some, then those that want some."""
        ranks = [key in group for group in (self.serving, self.memory.served, self.memory.planned)]
        return [*ranks, True].index(True), key

    def blocked_ranges(self, key: Key) -> list[PortRange]:
        """The ranges that a key can't have: other proxies', and the kernel's."""
        return [self.observed.ephemeral, *self.ranges_of_proxies(key)]

    def ranges_of_proxies(self, key: Key) -> list[PortRange]:
        """The ranges that other proxies have, and those that other keys have been given."""
        occupied = [sandbox.range for sandbox in self.observed.sandboxes if sandbox.key != key]
        return [*occupied, *self.ranges_of_others(key)]

    def ranges_of_others(self, key: Key) -> list[PortRange]:
        """The ranges that other keys have been given."""
        return [ports for owner, ports in self.allocated.items() if owner != key]

    def may_stay(self, key: Key, ports: PortRange) -> bool:
        """Whether no other container has ports on which this key's proxy has served.

        What listens there does not count: it may be what is left of that very proxy.
        """
        occupied = [
            s.range
            for s in self.observed.sandboxes
            if s.key != key and (s.key not in self.live or s.key in self.serving)
        ]
        started = [c for c in self.observed.containers if c.state in STARTED]
        taken = self._published(started, key) | self.memory.taken.keys()
        return is_free(ports, taken, [*occupied, *self.ranges_of_others(key)])

    def _matching(self, key: Key, tcp: frozenset[int], udp: frozenset[int]) -> frozenset[int]:
        """Those of these ports whose protocol a key's proxy publishes."""
        if key.is_ros2:
            return udp
        return tcp | udp if self.live[key].spec.udp else tcp

    def _published(self, containers: Collection[Container], key: Key) -> frozenset[int]:
        """The ports that containers publish by the protocols of a key's proxy."""
        tcp = frozenset(port for c in containers for port in c.host_ports)
        return self._matching(key, tcp, frozenset(port for c in containers for port in c.udp_ports))

    def keep(self, key: Key) -> None:
        """Give a key the range where its proxy serves, has served, or is being made."""
        ports = self.memory.served.get(key)
        if ports is not None and (key in self.serving or self.may_stay(key, ports)):
            self.allocated[key] = ports
            return
        created = [sandbox.range for sandbox in self.observed.sandboxes_of(key)]
        ports = self.memory.planned.get(key) or (created[0] if created else None)
        # What listens on ports of a sandbox that is there may be the engine, which is starting it.
        blocked = self.claimed(key) if ports in created else self.blocked(key)
        if ports and is_free(ports, blocked | reserved_ports(key), self.blocked_ranges(key)):
            self.allocated[key] = ports

    def fill(self, desired: Desired, frozen: bool) -> None:
        """Give a key more ports if it has too few, or a range if it has none."""
        key = desired.key
        count = desired.ports
        window = self.settings.port_window
        blocked = self.blocked(key) | reserved_ports(key)
        kept = self.allocated.get(key)
        if kept is None:
            others = self.ranges_of_proxies(key)
            try:
                self.allocated[key] = negotiate_with_room(
                    count, window, blocked, others, [self.observed.ephemeral]
                )
            except PortsExhausted as error:
                text = (
                    f"{error}. Lower --ports or the label rosproxy.ports ({count}), widen "
                    f"--port-window ({window}), or stop programs that hold ports there"
                )
                self.problems.append(_problem(key, text, fatal=True))
        elif not frozen:
            ranges = self.blocked_ranges(key)
            self.allocated[key] = extended(kept, count, window, blocked, ranges) or kept
            if len(self.allocated[key]) < count:
                missing = PortRange(kept.last + 1, kept.first + count - 1)
                text = (
                    f"has only the {len(kept)} ports {kept}, although --ports or the label "
                    f"rosproxy.ports asks for {count}: {self._why_not_longer(key, missing)}"
                )
                self.problems.append(_problem(key, text))

    def _why_not_longer(self, key: Key, missing: PortRange) -> str:
        """What keeps a key's range from getting these ports, and what to do."""
        window = self.settings.port_window
        if missing.last > window.last:
            return f"ports {missing} are beyond --port-window ({window}). Widen --port-window"
        for neighbour, ports in sorted(self.allocated.items()):
            if neighbour != key and overlap(ports, missing):
                return (
                    f"proxy {proxy_name(neighbour)} has {ports}. Stop the containers of that proxy "
                    "until the operator has removed that proxy (--grace), then start them again"
                )
        ephemeral = self.observed.ephemeral
        if overlap(ephemeral, missing):
            return (
                f"ports {missing} lie in the kernel's range of ephemeral ports ({ephemeral}). Give "
                "--port-window more room below that range, or begin that range later: sysctl "
                "net.ipv4.ip_local_port_range"
            )
        return f"ports {missing} are not all free. Stop the programs that hold them (see ss -ltnup)"


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
    live = {d.key: d for d in desired if d.live}
    allocation = _Allocation(observed, settings, memory, live)
    order = sorted(live, key=allocation.order)
    for key in order:
        allocation.keep(key)
    for key in order:
        allocation.fill(live[key], frozen)
    ranges = allocation.allocated
    served = dict(memory.served)
    leaving = [key for key in ranges if key in served and not within(served[key], ranges[key])]
    moved = {key: Move(served.pop(key), now) for key in leaving} | dict(memory.moved)
    for key, ports in sorted(ranges.items(), key=lambda item: item[0]):
        if key in moved and not within(moved[key].ports, ports):
            text = (
                f"has left ports {moved[key].ports} for {ports}, since another program or "
                f"container has taken the old ports. {after_move(not key.is_ros2, key.is_ros2)}"
            )
            allocation.problems.append(_problem(key, text))
    memory = replace(memory, served=served, planned=ranges, moved=moved)
    return memory, allocation.problems


def _problem(key: Key, text: str, fatal: bool = False) -> Problem:
    return Problem(f"proxy {proxy_name(key)}", text, fatal)
