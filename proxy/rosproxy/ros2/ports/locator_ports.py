"""Which port stands for a locator: found anew after a restart, with nothing kept on disk.

The order in which ports are tried follows from the participant's GUID prefix and from the locator.
So a proxy that has lost all memory gives the same ports again, unless two participants want the
same port first. Then the evidence of the time before the start decides, best first:

- the kernel's table, which the former process left there, leads the port to that very locator;
- the participant *keeps* the port: a number that the former process has signed, or the operator's
  record, says so (`rosproxy.ros2.ports.store`);
- the participant *says* that it had the port, without a proof;
- outside goes on sending to the port and names the participant (INFO_DST). A peer's word counts
  more than that of an address that has proved to receive, and that more than any other, since
  every sender may forge its source.

No port is given in the first second, in which outside may name participants. A word without a proof
is void where outside names other participants alone. Two participants that claim one port with
equal evidence both get other ports: one of the two lies, and the proxy can't tell which. A
participant that comes later with a proof gets its port back from one without.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from functools import partial
from hashlib import blake2b
from itertools import chain

from rosproxy.leases.ports import PortPool, PortRange
from rosproxy.net.addresses import HostPort
from rosproxy.ros2.protocol.addressing import destination, of_built_in_writer
from rosproxy.ros2.registry.participants import TrafficKind

MOST_NAMED = 8
"""Participants that may be named at one port; more tell nothing. One that is named for both kinds
counts twice."""
SETTLING = 1.0
"""Seconds from the start in which no port is given, to hear first what outside means by each."""
REMEMBERED = 30.0
"""Seconds from the start in which a port is rather given to the participant that had it before."""


def order_for(key: str, ports: PortRange) -> Iterator[int]:
    """All ports of a range, in the order in which they are tried for a key."""
    start = int.from_bytes(blake2b(key.encode(), digest_size=8).digest(), "big")
    for number in range(len(ports)):
        yield ports.first + (start + number) % len(ports)


_User = tuple[bytes, TrafficKind]
"""A participant's prefix, and what arrives at its port."""


class NamedBy(IntEnum):
    """What names a participant at a port, from outside; the greatest counts."""

    OTHERS = 0
    """An address whose datagrams may be forged."""
    PROVEN = 1
    """An address that has proved to receive."""
    PEER = 2


class _Claim(IntEnum):
    """Whose a port was, as it seems to a participant that wants a port; the least goes first."""

    FORWARDED = 0
    """Its own: the kernel led there."""
    KEPT_AND_NAMED = 1
    KEPT = 2
    """Its own, as a former process has signed, or the operator has recorded."""
    SAID_AND_NAMED = 3
    SAID = 4
    """Its own, as it says itself; outside names no other participant there."""
    NAMED = 5
    """Its own, as outside says; perhaps that of another of its locators."""
    NOBODYS = 6
    ANOTHERS = 7
    """Another participant has better evidence, or may still come back."""
    DISPUTED = 8
    """Several participants have claimed the port, with equal evidence."""


_SAID_BY_ITSELF = range(_Claim.KEPT_AND_NAMED, _Claim.NAMED)
"""Claims of a participant that says itself that it had the port."""


@dataclass(slots=True)
class _FormerUsers:
    """The participants that were named at a port, and for what, by what named them."""

    users_by: dict[NamedBy, set[_User]] = field(default_factory=dict)

    def note(self, user: _User, by: NamedBy) -> None:
        """Note a participant that was named, up to one more than `MOST_NAMED`."""
        users = self.users_by.setdefault(by, set())
        if len(users) <= MOST_NAMED:
            users.add(user)

    @property
    def best(self) -> NamedBy:
        """The best of those that have named a participant."""
        return max(self.users_by, default=NamedBy.OTHERS)

    @property
    def users(self) -> Collection[_User]:
        """Those to believe in: none where so many were named that it tells nothing."""
        users = self.users_by.get(self.best, set())
        return users if len(users) <= MOST_NAMED else ()

    @property
    def prefixes(self) -> set[bytes]:
        """The participants to believe in."""
        return {prefix for prefix, _ in self.users}


_NO_USERS = _FormerUsers()


class LocatorPorts:
    """Lends the ports of the range to locators; ``started`` is when the proxy did, in seconds."""

    def __init__(self, pool: PortPool, started: float) -> None:
        self.pool = pool
        self._started = started
        self._former_users: dict[int, _FormerUsers] = {}
        self._forwarded: dict[int, HostPort] = {}
        self._claims: dict[int, dict[bytes, bool]] = {}
        """Which participants claim each port, and whether each has a proof."""
        self._ports_claimed: dict[bytes, Sequence[int]] = {}
        self._lent: dict[int, tuple[bytes, _Claim]] = {}
        """Which participant has each port since the start, and by which claim."""
        self._disputed: dict[int, _Claim] = {}
        """Ports that several have claimed, with which evidence."""

    def may_give_ports(self, now: float) -> bool:
        """Whether ports may be given."""
        return now - self._started >= SETTLING

    def is_restoring(self, now: float) -> bool:
        """Whether there may still be participants that had ports before the start."""
        return now - self._started < REMEMBERED

    def note_use(self, port: int, datagram: bytes, by: NamedBy, now: float) -> None:
        """Note the addressee of a datagram from outside at a port without a mapping. RtpsError."""
        prefix = destination(datagram)
        is_built_in = of_built_in_writer(datagram)
        if prefix is not None and is_built_in is not None:
            kind = TrafficKind.METATRAFFIC if is_built_in else TrafficKind.USER_DATA
            self.note_former_user(port, prefix, kind, by, now)

    def note_former_user(
        self, port: int, prefix: bytes, kind: TrafficKind, by: NamedBy, now: float
    ) -> None:
        """Note that a participant was named at a port."""
        if self.is_restoring(now) and port in self.pool.range:
            self._former_users.setdefault(port, _FormerUsers()).note((prefix, kind), by)

    def note_forwarded(self, forwards: Mapping[int, HostPort]) -> None:
        """Note what the kernel was told to forward before the start, by port."""
        self._forwarded = {p: locator for p, locator in forwards.items() if p in self.pool.range}

    def note_claims(self, prefix: bytes, ports: Sequence[int], proven_count: int) -> None:
        """Note which ports a participant had: the first ones by a proof, all others by its word."""
        self.forget_claims(prefix)
        self._ports_claimed[prefix] = ports
        for index, port in enumerate(ports):
            self._claims.setdefault(port, {})[prefix] = index < proven_count

    def forget_claims(self, prefix: bytes) -> None:
        """Forget what a participant claims that has gone."""
        for port in self._ports_claimed.pop(prefix, ()):
            claimants = self._claims.get(port, {})
            claimants.pop(prefix, None)
            if not claimants:
                self._claims.pop(port, None)

    def is_named(self, prefix: bytes) -> bool:
        """Whether a peer, or an address that has proved to receive, names a participant."""
        return any(
            prefix in users.prefixes
            for users in self._former_users.values()
            if users.best > NamedBy.OTHERS
        )

    def displaced_by(self, prefix: bytes, now: float) -> set[bytes]:
        """Return the participants that have to give back a port that another one claims.

        That one has a proof and they have none; or the evidence is equal: then neither gets it.
        """
        if not self.is_restoring(now):
            return set()
        displaced = set[bytes]()
        for port in self._ports_claimed.get(prefix, ()):
            holder, held_by = self._lent.get(port, (prefix, _Claim.NOBODYS))
            claim = self._said(port, prefix)
            if holder == prefix or claim not in _SAID_BY_ITSELF:
                continue
            if claim == held_by:
                self._disputed[port] = claim
                displaced.add(holder)
            elif claim <= _Claim.KEPT and claim < held_by:
                displaced.add(holder)
        return displaced

    def take(
        self,
        prefix: bytes,
        locator: HostPort,
        kind: TrafficKind,
        now: float,
        had: int | None = None,
    ) -> int | None:
        """A port for a locator of a participant; None if all are taken.

        ``had`` is the port that the participant had, by a proof or its own word (`note_claims`).
        """
        if not self.is_restoring(now):
            self._forget_former()
        if not self.pool.free:
            return None  # looking takes long, and one datagram may name a thousand locators
        claims = self._seen_by((prefix, kind), locator, had)
        order = partial(order_for, f"{prefix.hex()} {locator}", self.pool.range)
        nobodys = (port for port in order() if claims.get(port) in (None, _Claim.NOBODYS))
        others = (port for port in order() if claims.get(port) is _Claim.ANOTHERS)
        disputed = (port for port in order() if claims.get(port) is _Claim.DISPUTED)
        first = next(order())
        length = len(self.pool.range)
        own = [port for port, claim in claims.items() if claim < _Claim.NOBODYS]
        own.sort(key=lambda port: (claims[port], (port - first) % length))
        port = next(filter(self.pool.claim, chain(own, nobodys, others, disputed)), None)
        if port is not None:
            self._former_users.pop(port, None)
            self._forwarded.pop(port, None)
            self._lent[port] = prefix, claims.get(port, _Claim.NOBODYS)
        return port

    def _forget_former(self) -> None:
        """Forget the time before the start, since no participant of then comes back any more."""
        self._former_users.clear()
        self._forwarded.clear()
        self._claims.clear()
        self._ports_claimed.clear()
        self._lent.clear()
        self._disputed.clear()

    def _seen_by(self, user: _User, locator: HostPort, had: int | None) -> dict[int, _Claim]:
        """Whose the ports were of which anything is known, as it seems to a participant."""
        told_of = {*self._former_users, *self._forwarded, *self._claims, *self._disputed}
        told_of |= {had} if had else set()
        return {port: self._claim(port, user, locator, had) for port in told_of}

    def _claim(self, port: int, user: _User, locator: HostPort, had: int | None) -> _Claim:
        """Whose a port was, as it seems to a participant that wants one for a locator."""
        prefix, kind = user
        if (former_locator := self._forwarded.get(port)) is not None:
            is_own = former_locator == locator and kind is TrafficKind.USER_DATA
            return _Claim.FORWARDED if is_own else _Claim.ANOTHERS
        if port == had:
            return self._judged(port, prefix)
        if port in self._disputed:
            return _Claim.DISPUTED
        named = self._former_users.get(port, _NO_USERS)
        claims = self._claims.get(port, {})
        rivals = claims.keys() - {prefix}
        if any(claims[rival] for rival in rivals):
            return _Claim.ANOTHERS
        if user in named.users:
            # Every sender may forge its source: such a name is worth no more than a rival's word.
            is_doubtful = rivals and named.best is NamedBy.OTHERS
            return _Claim.ANOTHERS if is_doubtful else _Claim.NAMED
        # Of its own for the other kind: Cyclone DDS has one locator for both, Fast DDS has not.
        return _Claim.ANOTHERS if rivals or named.prefixes - {prefix} else _Claim.NOBODYS

    def _judged(self, port: int, prefix: bytes) -> _Claim:
        """A participant's claim for a port, beside those of others for the same port."""
        claim = self._said(port, prefix)
        rivals = self._claims.get(port, {}).keys() - {prefix}
        best_rival = min((self._said(port, rival) for rival in rivals), default=_Claim.NOBODYS)
        if claim is _Claim.ANOTHERS:
            return claim
        if claim == best_rival:
            self._disputed[port] = claim
        if claim >= self._disputed.get(port, _Claim.DISPUTED):
            return _Claim.DISPUTED
        named_prefixes = self._former_users.get(port, _NO_USERS).prefixes
        is_void = claim is _Claim.SAID and named_prefixes and prefix not in named_prefixes
        return _Claim.ANOTHERS if is_void or claim > best_rival else claim

    def _said(self, port: int, prefix: bytes) -> _Claim:
        """What a participant's claim for a port is worth beside those of others.

        Names that may be forged count for none and against none.
        """
        named = self._former_users.get(port, _NO_USERS)
        prefixes = named.prefixes if named.best > NamedBy.OTHERS else set[bytes]()
        if self._claims.get(port, {}).get(prefix):
            return _Claim.KEPT_AND_NAMED if prefix in prefixes else _Claim.KEPT
        if prefix in prefixes:
            return _Claim.SAID_AND_NAMED
        return _Claim.ANOTHERS if prefixes else _Claim.SAID

    def give_back(self, port: int) -> None:
        """Take a port back."""
        self._lent.pop(port, None)
        self.pool.give_back(port)
