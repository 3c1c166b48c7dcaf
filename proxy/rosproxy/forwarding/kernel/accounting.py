"""What the kernel has forwarded and forwards, by endpoint: bytes, and open connections."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

from rosproxy.forwarding.kernel.conntrack import OpenConnections
from rosproxy.forwarding.kernel.nft import Counters, Counts
from rosproxy.leases.fast_ports import LeaseHolder, LeaseHolders

SILENCE_WINDOW = 2.0
"""Seconds at least that a port is watched to see whether anything goes back through it."""


@dataclass(slots=True)
class Account:
    """Bytes of IP packets of one node's connections: sent outside, and received from there.

    ``packets`` are those that came to its port; ``rates`` are both in bytes per second, as of the
    last count.
    """

    sent: int = 0
    received: int = 0
    packets: int = 0
    rates: tuple[float, float] = (0.0, 0.0)


class CounterDeltas:
    """What was counted by port, from counters that begin anew when their table is made again."""

    def __init__(self) -> None:
        self._last_counters: Counters = {}

    def take(self, counters: Counters) -> dict[int, Counts]:
        """What has been counted since the last time, by port; ports without anything left out."""
        deltas = {}
        for port, current in counters.items():
            previous = self._last_counters.get(port, Counts())
            if any(c < p for c, p in zip(current, previous, strict=True)):
                previous = Counts()
            deltas[port] = Counts(*(c - p for c, p in zip(current, previous, strict=True)))
        self._last_counters = counters
        return {port: delta for port, delta in deltas.items() if any(delta)}


class UnansweredPorts:
    """Ports through which something comes in and nothing goes back.

    Connections that are dropped on the way never show up as such; their bytes do. A first packet
    is sent again after one and after three seconds: two windows in a row see it.
    """

    def __init__(self) -> None:
        self._window_start = 0.0
        self._bytes: dict[int, tuple[int, int]] = {}
        self._silent_before: set[int] = set()

    def look(self, deltas: Counters, now: float) -> list[int]:
        """The ports silent in two windows in a row; ``deltas`` were counted since the last look."""
        for port, (sent, received, _) in deltas.items():
            total_sent, total_received = self._bytes.get(port, (0, 0))
            self._bytes[port] = total_sent + sent, total_received + received
        if now - self._window_start < SILENCE_WINDOW:
            return []
        silent = {port for port, (sent, received) in self._bytes.items() if received and not sent}
        unanswered = silent & self._silent_before
        self._silent_before = silent
        self._window_start = now
        self._bytes = {}
        return sorted(unanswered)


class KernelAccounts:
    """Whose the connections through the fast ports are, and what went through them.

    A port that was given back stays its last holder's until somebody else holds it, or the holder
    ends: the connections through it go on meanwhile. ``unanswered`` are ports behind which nobody
    answered of late.
    """

    def __init__(self) -> None:
        self.owners: Mapping[int, LeaseHolder] = {}
        self._accounts: dict[LeaseHolder, Account] = {}
        self._deltas = CounterDeltas()
        self._silence = UnansweredPorts()
        self.unanswered: list[int] = []
        self._counted_at = 0.0

    def note_owners(self, endpoints: LeaseHolders[LeaseHolder]) -> None:
        """Take in who holds which fast port now."""
        remaining = {p: e for p, e in self.owners.items() if endpoints.by_port.get(e.port) is e}
        self.owners = remaining | {e.fast_port: e for e in endpoints if e.fast_port is not None}
        holders = set(self.owners.values())
        self._accounts = {e: account for e, account in self._accounts.items() if e in holders}

    def owns(self, endpoint: LeaseHolder) -> bool:
        """Whether an endpoint had a fast port when that was last looked at."""
        return any(owner is endpoint for owner in self.owners.values())

    def count(self, counters: Counters, now: float) -> list[tuple[str, Counts]]:
        """Take in counters; what was sent and received since the last time, by node name."""
        elapsed = now - self._counted_at
        self._counted_at = now
        for account in self._accounts.values():
            account.rates = 0.0, 0.0
        by_name = []
        by_port = self._deltas.take(counters)
        self.unanswered = self._silence.look(by_port, now)
        for port, (from_node, to_node, packets) in by_port.items():
            endpoint = self.owners.get(port)
            # Where the node is outside, what it sends is what inside receives.
            outwards = endpoint is not None and not endpoint.inside
            delta = Counts(*((to_node, from_node) if outwards else (from_node, to_node)), packets)
            if endpoint is not None:
                self._add(endpoint, delta, elapsed)
            names = endpoint.caller_ids if endpoint else []
            by_name.append((names[0] if names else "unnamed", delta))
        return by_name

    def note_peers(self, connections: OpenConnections) -> None:
        """Take in all open connections that the kernel tracks now.

        Those to a node that is down don't count: if its host vanished without a word, the kernel
        takes them for open for days.
        """
        by_owner: dict[LeaseHolder, Counter[str]] = {e: Counter() for e in self.owners.values()}
        for (port, node), counts in connections.items():
            owner = self.owners.get(port)
            if owner is not None and not owner.is_down and owner.address in ("", node):
                by_owner[owner].update(counts)
        for endpoint, counts in by_owner.items():
            endpoint.fast_peers = dict(counts)

    def account(self, endpoint: LeaseHolder) -> Account:
        """What went through an endpoint's fast ports so far."""
        return self._accounts.get(endpoint, Account())

    def ports_of(self, endpoint: LeaseHolder) -> list[int]:
        """The fast ports that connections to an endpoint may go through."""
        return [port for port, owner in self.owners.items() if owner is endpoint]

    def _add(self, endpoint: LeaseHolder, delta: Counts, elapsed: float) -> None:
        account = self._accounts.setdefault(endpoint, Account())
        account.sent += delta.sent
        account.received += delta.received
        account.packets += delta.packets
        sent, received = account.rates
        if elapsed > 0:
            account.rates = sent + delta.sent / elapsed, received + delta.received / elapsed
