"""Bytes and open connections that the kernel forwards, for each endpoint."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

from rosproxy.forwarding.fast_ports import LeaseHolder, LeaseHolders
from rosproxy.forwarding.kernel.conntrack import OpenConnections
from rosproxy.forwarding.kernel.nft import Counters, Counts

SILENCE_WINDOW_S = 2.0
"""Shortest window, in seconds, in which a node must send bytes (`UnansweredPorts`)."""


@dataclass(slots=True)
class Account:
    """The traffic of an endpoint through the kernel; bytes are of IP packets.

    ``sent`` are bytes from inside to outside, ``received`` bytes from outside to inside.
    ``packets``: the packets that peers sent to the port. ``rates``: sent and received bytes per
    second, as of the last count, ``packet_rate`` packets per second.
    """

    sent: int = 0
    received: int = 0
    packets: int = 0
    rates: tuple[float, float] = (0.0, 0.0)
    packet_rate: float = 0.0


class CounterDeltas:
    """Differences between readings of the counters, which begin at 0 in a new table."""

    def __init__(self) -> None:
        self._last_counters: Counters = {}

    def take(self, counters: Counters) -> dict[int, Counts]:
        """The counts since the last call, by port, without the ports whose counts are all 0."""
        deltas = {}
        for port, current in counters.items():
            previous = self._last_counters.get(port, Counts())
            if any(c < p for c, p in zip(current, previous, strict=True)):
                previous = Counts()
            deltas[port] = Counts(*(c - p for c, p in zip(current, previous, strict=True)))
        self._last_counters = counters
        return {port: delta for port, delta in deltas.items() if any(delta)}


class UnansweredPorts:
    """Ports with packets to the node, but without packets from the node.

    If a filter drops a connection on the way, the kernel lists no connection, but the counters have
    the bytes. TCP repeats a SYN after one and after three seconds, so two windows in a row have
    bytes of the SYN.
    """

    def __init__(self) -> None:
        self._window_start = 0.0
        self._bytes: dict[int, tuple[int, int]] = {}
        self._silent_before: set[int] = set()

    def look(self, deltas: Counters, now: float) -> list[int]:
        """The ports without an answer in two windows in a row; empty within a window.

        ``deltas`` are the counts since the last call, ``now`` is in seconds.
        """
        for port, (sent, received, _) in deltas.items():
            total_sent, total_received = self._bytes.get(port, (0, 0))
            self._bytes[port] = total_sent + sent, total_received + received
        if now - self._window_start < SILENCE_WINDOW_S:
            return []
        silent = {port for port, (sent, received) in self._bytes.items() if received and not sent}
        unanswered = silent & self._silent_before
        self._silent_before = silent
        self._window_start = now
        self._bytes = {}
        return sorted(unanswered)


class KernelAccounts:
    """The owners of the fast ports, and the traffic through these ports.

    A port that an endpoint gave back still belongs to that endpoint until another endpoint gets the
    port, or the endpoint ends: connections through the port continue. ``unanswered`` are the ports
    whose node has lately sent nothing.
    """

    def __init__(self) -> None:
        self.owners: Mapping[int, LeaseHolder] = {}
        self._accounts: dict[LeaseHolder, Account] = {}
        self._deltas = CounterDeltas()
        self._silence = UnansweredPorts()
        self.unanswered: list[int] = []
        self._counted_at = 0.0

    def note_owners(self, endpoints: LeaseHolders[LeaseHolder]) -> None:
        """Update the owners from the fast ports of all endpoints. A former owner has no peers."""
        before = self.owners
        remaining = {p: e for p, e in before.items() if endpoints.by_port.get(e.port) is e}
        self.owners = remaining | {e.fast_port: e for e in endpoints if e.fast_port is not None}
        holders = set(self.owners.values())
        for former in set(before.values()) - holders:
            # A reading of the connections may have ended after the former owner gave its port back.
            former.fast_peers = {}
        by_port = endpoints.by_port
        self._accounts = {e: a for e, a in self._accounts.items() if by_port.get(e.port) is e}

    def forget_lost_ports(self, endpoint: LeaseHolder) -> None:
        """Forget the ports of an endpoint, except its fast port: their connections have ended."""
        lost = set(self.ports_of(endpoint)) - {endpoint.fast_port}
        self.owners = {port: owner for port, owner in self.owners.items() if port not in lost}
        if not self.owns(endpoint):
            endpoint.fast_peers = {}  # no later reading of the connections is about this endpoint

    def owns(self, endpoint: LeaseHolder) -> bool:
        """Whether an endpoint had a fast port at the last call of `note_owners`."""
        return any(owner is endpoint for owner in self.owners.values())

    def count(self, counters: Counters, now: float) -> list[tuple[str, Counts]]:
        """Add a reading of the counters at ``now`` (s); return the counts since the last reading.

        The counts stand by node name. ``sent`` are bytes from inside to outside, for nodes of both
        sides.
        """
        elapsed = now - self._counted_at
        self._counted_at = now
        for account in self._accounts.values():
            account.rates = 0.0, 0.0
            account.packet_rate = 0.0
        by_name = []
        by_port = self._deltas.take(counters)
        self.unanswered = self._silence.look(by_port, now)
        for port, (from_node, to_node, packets) in by_port.items():
            endpoint = self.owners.get(port)
            # Bytes from a node outside are bytes that inside receives.
            outwards = endpoint is not None and not endpoint.inside
            delta = Counts(*((to_node, from_node) if outwards else (from_node, to_node)), packets)
            if endpoint is not None:
                self._add(endpoint, delta, elapsed)
            names = endpoint.caller_ids if endpoint else []
            by_name.append((names[0] if names else "unnamed", delta))
        return by_name

    def note_peers(self, connections: OpenConnections) -> None:
        """Update the peers of all owners from the open connections that the kernel tracks.

        Connections to a node that is down don't count. If the host of the node disappeared without
        a FIN or RST, the kernel lists such connections as open for days.
        """
        by_owner: dict[LeaseHolder, Counter[str]] = {e: Counter() for e in self.owners.values()}
        for (port, node), counts in connections.items():
            owner = self.owners.get(port)
            if owner is not None and not owner.is_down and owner.address in ("", node):
                by_owner[owner].update(counts)
        for endpoint, counts in by_owner.items():
            endpoint.fast_peers = dict(counts)

    def account(self, endpoint: LeaseHolder) -> Account:
        """The traffic through the fast ports of an endpoint so far; zeros without traffic."""
        return self._accounts.get(endpoint, Account())

    def ports_of(self, endpoint: LeaseHolder) -> list[int]:
        """The fast ports of an endpoint, ports that were given back included."""
        return [port for port, owner in self.owners.items() if owner is endpoint]

    def _add(self, endpoint: LeaseHolder, delta: Counts, elapsed: float) -> None:
        account = self._accounts.setdefault(endpoint, Account())
        account.sent += delta.sent
        account.received += delta.received
        account.packets += delta.packets
        sent, received = account.rates
        if elapsed > 0:
            account.rates = sent + delta.sent / elapsed, received + delta.received / elapsed
            account.packet_rate += delta.packets / elapsed
