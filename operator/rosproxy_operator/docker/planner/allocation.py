"""Choose the port range of each proxy on a Docker host, and decide when a proxy leaves a range."""

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

from rosproxy.shared.ports import PortRange
from rosproxy_operator.common.port_ranges import (
    REFUSED_RANGE_KEPT_S,
    FormerRange,
    Move,
    PortsExhausted,
    RangeRequest,
    advice_after_move,
    assign_ranges,
    is_moved,
    kept_ranges,
    new_moves,
    overlap,
)
from rosproxy_operator.common.problem import (
    CONFLICT,
    EXHAUSTED,
    Fault,
    Problem,
)
from rosproxy_operator.docker.planner.model import SERVING, STARTED, Container, Desired, HostState
from rosproxy_operator.docker.planner.specs import proxy_name, reserved_ports
from rosproxy_operator.docker.planner.state import DockerMemory
from rosproxy_operator.docker.planner.zenoh_redirect import FIRST_PORT
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.proxy_spec.place import ZENOH, Domain, Place


def after_refusals(
    observed: HostState, live: Collection[Place], memory: DockerMemory, now: float
) -> DockerMemory:
    """Return the memory after the engine's refusals to start sandboxes.

    A range that has never served is given up at once: the refused ports become ``taken``. A range
    that has served is given up after `REFUSED_RANGE_KEPT_S` seconds, since the engine may be slow
    to free the ports. ``live`` are the places of wanted proxies, ``now`` is in monotonic seconds.
    """
    refusals = dict(memory.refusals)
    taken = dict(memory.taken)
    moved = dict(memory.moved)
    for sandbox in observed.sandboxes:
        refusal = refusals.get(sandbox.container.name)
        if refusal is None or sandbox.place not in live:
            continue
        served = memory.served.get(sandbox.place)
        port = refusal.port
        suspects = {port} if port and port in sandbox.range else {*sandbox.range.ports()}
        # In a range that was made longer, only the added ports count as taken. The proxy has
        # served on the former ports, so the engine may only be slow to free these ports.
        unserved = {port for port in suspects if served is None or port not in served}
        if served is not None and not unserved:
            if now - refusal.since < REFUSED_RANGE_KEPT_S:
                continue
            moved[sandbox.place] = Move(served, now)
        del refusals[sandbox.container.name]
        taken |= dict.fromkeys(unserved or suspects, now)
    return replace(memory, refusals=refusals, taken=taken, moved=moved)


@dataclass(frozen=True, slots=True)
class _Host:
    """The ports of a host. ``live`` has the wanted proxies, ``serving`` the proxies that serve."""

    observed: HostState
    memory: DockerMemory
    live: Mapping[Place, Desired]
    serving: frozenset[Place]

    def published(self, containers: Collection[Container], place: Place) -> frozenset[int]:
        """Return refused ports, and ports that containers publish by the protocols of a proxy."""
        tcp = frozenset(port for c in containers for port in c.host_ports)
        udp = frozenset(port for c in containers for port in c.udp_ports)
        return self._matching(place, tcp, udp) | self.memory.taken.keys()

    def request(self, place: Place, settings: PlanSettings) -> RangeRequest:
        """Return the ports that a proxy wants, and the ports that the proxy can't have."""
        observed = self.observed
        claimed = self.published(observed.containers, place) | reserved_ports(place)
        blocked = claimed | self._matching(place, observed.listening, observed.listening_udp)
        # The host does not publish the ports of the proxy for rmw_zenoh.
        others = [s for s in observed.sandboxes if s.place not in (place, ZENOH)]
        ranges = [s.range for s in others]
        former: list[FormerRange] = []
        if served := self.memory.served.get(place):
            # Listening programs do not count: the engine may still hold ports for this proxy.
            started = [c for c in observed.containers if c.state in STARTED]
            held = (s for s in others if s.place not in self.live or s.place in self.serving)
            taken = self.published(started, place)
            former.append(FormerRange(served, taken, [s.range for s in held]))
        created = [s.range for s in observed.sandboxes_of(place)]
        if planned := self.memory.planned.get(place) or next(iter(created), None):
            # On the ports of a created sandbox, the engine itself may listen to start the sandbox.
            taken = claimed if planned in created else blocked
            former.append(FormerRange(planned, taken, [observed.ephemeral, *ranges]))
        return RangeRequest(
            self.live[place].ports,
            settings.port_window,
            blocked,
            [observed.ephemeral],
            held=served if place in self.serving else None,
            former=tuple(former),
            growing=ranges,
            room=2,
        )

    def _matching(self, place: Place, tcp: frozenset[int], udp: frozenset[int]) -> frozenset[int]:
        """Return the ports of the protocols that a proxy publishes."""
        if isinstance(place.graph, Domain):
            return udp
        return tcp | udp if self.live[place].spec.udp else tcp


def allocate(
    observed: HostState,
    settings: PlanSettings,
    desired: Iterable[Desired],
    memory: DockerMemory,
    now: float,
    frozen: bool = False,
) -> tuple[DockerMemory, list[Problem]]:
    """Plan a range for each live proxy: the present or a former range, else the first free range.

    Return the memory and the problems. ``planned`` in the memory has the ranges. A proxy that
    serves never moves. A proxy that has served moves only if the engine has refused ports of the
    range, or if other containers or proxies hold such ports. With ``frozen`` no range gets longer,
    since no container can be created.
    """
    live = {d.place: d for d in desired if d.live}
    routers = live.pop(ZENOH, None)
    serving = frozenset(s.place for s in observed.sandboxes if s.container.state in SERVING)
    host = _Host(observed, memory, live, serving)
    # Proxies that serve come first, then proxies that have served, then planned, then new proxies.
    groups = (serving, memory.served, memory.planned, live)
    order = sorted(live, key=lambda p: ([p in group for group in groups].index(True), p))
    requests = {place: host.request(place, settings) for place in order}
    kept = kept_ranges(requests)
    if frozen:
        requests |= {p: replace(requests[p], count=len(ports)) for p, ports in kept.items()}
    ranges, exhausted = assign_ranges(requests, kept)
    problems = [_no_range(place, error) for place, error in exhausted.items()]
    problems += _too_short(requests, ranges, observed.ephemeral)
    if routers:
        ranges[ZENOH] = _router_ports(routers.ports, memory)
    left = new_moves(memory.served, ranges, now)
    served = {place: ports for place, ports in memory.served.items() if place not in left}
    moved = left | dict(memory.moved)
    for place, ports in sorted(ranges.items()):
        if place in moved and is_moved(moved[place].ports, ports):
            ros = place.graph.ros
            text = (
                f"has left ports {moved[place].ports} for {ports}, since another program or "
                "container has taken the old ports"
            )
            fault = Fault(text, advice_after_move(ros == "1", ros == "2"))
            problems.append(_problem(place, fault, CONFLICT))
    return replace(memory, served=served, planned=ranges, moved=moved), problems


def _no_range(place: Place, error: PortsExhausted) -> Problem:
    fix = (
        f"Lower --ports or the label rosproxy.ports ({error.count}), widen --port-window "
        f"({error.window}), or stop programs that hold ports there"
    )
    return _problem(place, Fault(str(error), fix), EXHAUSTED, fatal=True)


def _too_short(
    requests: Mapping[Place, RangeRequest], ranges: Mapping[Place, PortRange], ephemeral: PortRange
) -> Iterator[Problem]:
    """Yield a problem for each range with fewer ports than the proxy wants, with the fix."""
    for place, ports in ranges.items():
        count = requests[place].count
        if len(ports) >= count:
            continue
        missing = PortRange(ports.last + 1, ports.first + count - 1)
        window = requests[place].window
        others = (other for other in sorted(ranges) if other != place)
        neighbour = next((other for other in others if overlap(ranges[other], missing)), None)
        if missing.last > window.last:
            why = f"ports {missing} are beyond --port-window ({window})"
            fix = "Widen --port-window"
        elif neighbour:
            why = f"proxy {proxy_name(neighbour)} has {ranges[neighbour]}"
            fix = (
                "Stop the containers of that proxy until the operator has removed that proxy "
                "(--grace), then start them again"
            )
        elif overlap(ephemeral, missing):
            why = f"ports {missing} lie in the kernel's range of ephemeral ports ({ephemeral})"
            fix = (
                "Give --port-window more room below that range, or begin that range later: sysctl "
                "net.ipv4.ip_local_port_range"
            )
        else:
            why = f"ports {missing} are not all free"
            fix = "Stop the programs that hold these ports (see ss -ltnup)"
        text = (
            f"has only the {len(ports)} ports {ports}, although --ports or the label "
            f"rosproxy.ports asks for {count}: {why}"
        )
        yield _problem(place, Fault(text, fix), EXHAUSTED)


def _router_ports(count: int, memory: DockerMemory) -> PortRange:
    """Return the ports of the proxy for rmw_zenoh, which the host does not publish.

    The number of these ports never falls.
    """
    former = memory.served.get(ZENOH) or memory.planned.get(ZENOH)
    return PortRange(FIRST_PORT, FIRST_PORT + max(count, len(former) if former else 0) - 1)


def _problem(place: Place, fault: Fault, reason: str, fatal: bool = False) -> Problem:
    return Problem(f"proxy {proxy_name(place)}", *fault, fatal=fatal, reason=reason)
