"""Which port stands for a locator: found anew after a restart, with nothing kept on disk.

The order in which ports are tried follows from the participant's GUID prefix and from the locator.
So a proxy that has lost all memory gives the same ports again, unless two participants want the
same one first: then who came first has it, which a new process can't know. But outside goes on
sending to the ports that it was told, and names the participant that it means (INFO_DST). So no
port is given in the first second. Then a port goes first to the participant that was named there,
next to one that says itself that it had it (`rosproxy.ros2.discovery.port_keeper`), as anybody may.
Several may be named at a port, as anybody outside may name anybody, and a participant at several
ports, as it has more than one locator: there its own word decides, and a peer's word counts more
than a stranger's. What the kernel forwards does not come here; but its table is what a former
process has left there, and tells which port led to which locator.
"""

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from functools import partial
from hashlib import blake2b
from itertools import chain, islice

from rosproxy.leases.ports import PortPool, PortRange
from rosproxy.net.addresses import HostPort
from rosproxy.ros2.protocol.addressing import destination, of_built_in_writer
from rosproxy.ros2.registry.participants import LeaseKind

STAND_INS = PortRange(20_000, 32_767)
"""Where ports for participants outside are chosen from: below those that Linux gives away."""
TRIES = 32
"""How many ports are tried for a locator outside."""
MOST_NAMED = 8
"""Participants that may be named at one port; more tell nothing. One that is named for both kinds
counts twice."""
MOST_SHARING = 3
"""Locators outside that one port may stand for."""
SETTLING = 1.0
"""Seconds from the start in which no port is given, to hear first whom outside means by each."""
REMEMBERED = 30.0
"""Seconds from the start in which a port is rather given to the participant that had it before."""


def order_for(key: str, ports: PortRange) -> Iterator[int]:
    """All ports of a range, in the order in which they are tried for a key."""
    start = int.from_bytes(blake2b(key.encode(), digest_size=8).digest(), "big")
    for number in range(len(ports)):
        yield ports.first + (start + number) % len(ports)


_User = tuple[bytes, LeaseKind]
"""A participant's prefix, and what arrives at its port."""


class _Claim(IntEnum):
    """Whose a port was, as it seems to a participant that wants one; the least goes first."""

    PROVEN = 0
    """Its own: the kernel led there, or outside has named it and it says so itself."""
    SAID = 1
    """Its own, as it says itself; nobody else was named there."""
    NAMED = 2
    """Its own, as outside says; perhaps that of another of its locators."""
    NOBODYS = 3
    ANOTHERS = 4
    """Who was named there may still come back."""


@dataclass(slots=True)
class _FormerUsers:
    """Who was named at a port, and for what: by peers, and by others outside."""

    by_peers: set[_User] = field(default_factory=set)
    by_others: set[_User] = field(default_factory=set)

    def note(self, user: _User, by_peer: bool) -> None:
        """Note one that was named, up to one more than `MOST_NAMED`."""
        users = self.by_peers if by_peer else self.by_others
        if len(users) <= MOST_NAMED:
            users.add(user)

    @property
    def users(self) -> Collection[_User]:
        """Those to believe in: none where so many were named that it tells nothing."""
        users = self.by_peers or self.by_others
        return users if len(users) <= MOST_NAMED else ()


class LocatorPorts:
    """Lends the ports of the range to locators; ``started`` is when the proxy did, in seconds."""

    def __init__(self, pool: PortPool, started: float) -> None:
        self.pool, self._started = pool, started
        self._former_users: dict[int, _FormerUsers] = {}
        self._forwarded: dict[int, HostPort] = {}

    def may_give_ports(self, now: float) -> bool:
        """Whether ports may be given."""
        return now - self._started >= SETTLING

    def may_have_returning(self, now: float) -> bool:
        """Whether there may still be participants that had ports before the start."""
        return now - self._started < REMEMBERED

    def note_use(self, port: int, datagram: bytes, by_peer: bool, now: float) -> None:
        """Note whom a datagram from outside is for, at a port that nobody has. Raises RtpsError."""
        prefix, is_built_in = destination(datagram), of_built_in_writer(datagram)
        if prefix is not None and is_built_in is not None:
            kind = LeaseKind.METATRAFFIC if is_built_in else LeaseKind.DATA
            self.note_former_user(port, prefix, kind, by_peer, now)

    def note_former_user(
        self, port: int, prefix: bytes, kind: LeaseKind, by_peer: bool, now: float
    ) -> None:
        """Note that a participant was named at a port."""
        if self.may_have_returning(now) and port in self.pool.range:
            self._former_users.setdefault(port, _FormerUsers()).note((prefix, kind), by_peer)

    def note_forwarded(self, forwards: Mapping[int, HostPort]) -> None:
        """Note what the kernel was told to forward before the start, by port."""
        self._forwarded = {p: locator for p, locator in forwards.items() if p in self.pool.range}

    def take(
        self, prefix: bytes, locator: HostPort, kind: LeaseKind, now: float, had: int | None = None
    ) -> int | None:
        """A port for a locator of a participant; None if all are taken.

        ``had`` is the port that the participant itself says that it had.
        """
        if not self.may_have_returning(now):
            self._former_users.clear()
            self._forwarded.clear()
        if not self.pool.free:
            return None  # looking takes long, and one datagram may name a thousand locators
        user = prefix, kind
        told_of = {*self._former_users, *self._forwarded, *([had] if had else [])}
        claims = {port: self._claim(port, user, locator, had) for port in told_of}
        order = partial(order_for, f"{prefix.hex()} {locator}", self.pool.range)
        nobodys = (port for port in order() if claims.get(port) in (None, _Claim.NOBODYS))
        others = (port for port in order() if claims.get(port) is _Claim.ANOTHERS)
        first, length = next(order()), len(self.pool.range)
        own = [port for port, claim in claims.items() if claim < _Claim.NOBODYS]
        own.sort(key=lambda port: (claims[port], (port - first) % length))
        port = next(filter(self.pool.claim, chain(own, nobodys, others)), None)
        self._former_users.pop(port or 0, None)
        self._forwarded.pop(port or 0, None)
        return port

    def _claim(self, port: int, user: _User, locator: HostPort, had: int | None) -> _Claim:
        """Whose a port was, as it seems to a participant that wants one for a locator."""
        prefix, kind = user
        if (former_locator := self._forwarded.get(port)) is not None:
            is_own = former_locator == locator and kind is LeaseKind.DATA
            return _Claim.PROVEN if is_own else _Claim.ANOTHERS
        users = self._former_users[port].users if port in self._former_users else ()
        if user in users:
            return _Claim.PROVEN if port == had else _Claim.NAMED
        prefixes = {named for named, _ in users}
        if port == had:
            return _Claim.SAID if not users or prefix in prefixes else _Claim.ANOTHERS
        # Of its own for the other kind: Cyclone DDS has one locator for both, Fast DDS has not.
        return _Claim.ANOTHERS if prefixes - {prefix} else _Claim.NOBODYS

    def give_back(self, port: int) -> None:
        """Take a port back."""
        self.pool.give_back(port)


def stand_in_port(key: str, users: Callable[[int], int], busy: Callable[[int], bool]) -> int | None:
    """A port for a locator outside; None if there are too many of them.

    ``users`` tells how many locators a port stands for already. It may be several: so the port
    follows from the locator alone, and a proxy that starts again chooses the same. Each of these
    gets users' data that is meant for the others as well, and skips it, as with multicast.
    ``busy`` tells which ports can't be had; they don't count as tries, as there may be many.
    """
    order = (port for port in order_for(key, STAND_INS) if not busy(port))
    return next((port for port in islice(order, TRIES) if users(port) < MOST_SHARING), None)
