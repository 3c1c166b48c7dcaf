"""What the kernel has forwarded and forwards, by endpoint: bytes, and open connections."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from rosproxy.forwarding.kernel import conntrack
from rosproxy.forwarding.kernel.conntrack import Flow
from rosproxy.forwarding.kernel.nft import Counters, Counts
from rosproxy.leases.fast_ports import LeaseHolder, LeaseHolders

SILENCE_WINDOW = 2.0
"""Seconds at least over which it is told whether anything goes back through a port."""


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
        self._last: Counters = {}

    def take(self, counters: Counters) -> dict[int, Counts]:
        """What has been counted since the last time, by port; ports without anything left out."""
        grown = {}
        for port, now in counters.items():
            before = self._last.get(port, Counts())
            if any(one < former for one, former in zip(now, before, strict=True)):
                before = Counts()
            grown[port] = Counts(*(one - b for one, b in zip(now, before, strict=True)))
        self._last = counters
        return {port: more for port, more in grown.items() if any(more)}


class UnansweredPorts:
    """Ports through which something comes in and nothing goes back.

    Connections that are dropped on the way never show up as such; their bytes do. A first packet
    is sent again after one and after three seconds: two windows in a row see it.
    """

    def __init__(self) -> None:
        self._began = 0.0
        self._bytes: dict[int, tuple[int, int]] = {}
        self._before: set[int] = set()

    def look(self, grown: Counters, now: float) -> list[int]:
        """The ports that were silent in two windows in a row, by what was counted of late."""
        for port, (sent, received, _) in grown.items():
            out, into = self._bytes.get(port, (0, 0))
            self._bytes[port] = out + sent, into + received
        if now - self._began < SILENCE_WINDOW:
            return []
        silent = {port for port, (sent, received) in self._bytes.items() if received and not sent}
        found, self._before = silent & self._before, silent
        self._began, self._bytes = now, {}
        return sorted(found)


class KernelAccounts:
    """Whose the connections through the fast ports are, and what went through them.

    A port that was given back stays its last holder's until somebody else holds it, or the holder
    ends: the connections through it go on meanwhile. ``unanswered`` are ports behind which nobody
    answered of late.
    """

    def __init__(self) -> None:
        self.owners: Mapping[int, LeaseHolder] = {}
        self._accounts: dict[LeaseHolder, Account] = {}
        self._deltas, self._silence = CounterDeltas(), UnansweredPorts()
        self.unanswered: list[int] = []
        self._counted_at = 0.0

    def note_owners(self, endpoints: LeaseHolders[LeaseHolder]) -> None:
        """Take in who holds which fast port now."""
        there = {p: e for p, e in self.owners.items() if endpoints.by_port.get(e.port) is e}
        self.owners = there | {e.fast_port: e for e in endpoints if e.fast_port is not None}
        known = set(self.owners.values())
        self._accounts = {e: account for e, account in self._accounts.items() if e in known}

    def owns(self, endpoint: LeaseHolder) -> bool:
        """Whether an endpoint had a fast port when that was last looked at."""
        return any(owner is endpoint for owner in self.owners.values())

    def count(self, counters: Counters, now: float) -> list[tuple[str, Counts]]:
        """Take in counters; what was sent and received since the last time, by node name."""
        passed, self._counted_at = now - self._counted_at, now
        for account in self._accounts.values():
            account.rates = 0.0, 0.0
        grown, by_port = [], self._deltas.take(counters)
        self.unanswered = self._silence.look(by_port, now)
        for port, (back, there, packets) in by_port.items():
            endpoint = self.owners.get(port)
            outwards = endpoint is not None and not endpoint.inside
            more = Counts(*((there, back) if outwards else (back, there)), packets)
            if endpoint is not None:
                self._add(endpoint, more, passed)
            names = endpoint.caller_ids if endpoint else []
            grown.append((names[0] if names else "unnamed", more))
        return grown

    def note_peers(self, flows: Sequence[Flow]) -> None:
        """Take in all connections that the kernel tracks now.

        Those to a node that is down don't count: if its host vanished without a word, the kernel
        takes them for open for days.
        """
        found: dict[LeaseHolder, list[Flow]] = {endpoint: [] for endpoint in self.owners.values()}
        for flow in flows:
            owner = self.owners.get(flow.port)
            if owner is not None and not owner.is_down:
                found[owner].append(flow)
        for endpoint, mine in found.items():
            endpoint.fast_peers = conntrack.peers(mine, endpoint.address)

    def account(self, endpoint: LeaseHolder) -> Account:
        """What went through an endpoint's fast ports so far."""
        return self._accounts.get(endpoint, Account())

    def ports_of(self, endpoint: LeaseHolder) -> list[int]:
        """The fast ports that connections to an endpoint may go through."""
        return [port for port, owner in self.owners.items() if owner is endpoint]

    def _add(self, endpoint: LeaseHolder, more: Counts, passed: float) -> None:
        account = self._accounts.setdefault(endpoint, Account())
        account.sent += more.sent
        account.received += more.received
        account.packets += more.packets
        out, into = account.rates
        if passed > 0:
            account.rates = out + more.sent / passed, into + more.received / passed
