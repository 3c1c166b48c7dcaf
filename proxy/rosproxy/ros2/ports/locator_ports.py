"""Which port stands for a locator. After a restart the proxy finds the same port, without a file.

The order in which ports are tried follows from the GUID prefix of the participant and from the
locator. So a proxy without any memory gives the same ports again, unless two participants have the
same first port. Then the evidence from before the start decides, best first:

- the kernel's table, which the former process left, leads the port to this very locator;
- the participant *keeps* the port: this is shown by a number that the former process has signed, or
  by the record of the operator (`rosproxy.ros2.ports.store`);
- the participant *states* without a proof that this was its port;
- outside still sends to the port, and names the participant (INFO_DST). A peer outweighs a proven
  address, and a proven address outweighs all others, because every sender may forge a source.

The proxy gives no port in the first second, so that outside has time to name participants. A
statement without a proof is void if outside names only other participants. If two participants
claim a port with equal evidence, both get other ports: one of the two lies, and the proxy can't
tell which. If a participant with a proof comes later, it gets its port back from a participant
without a proof.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from functools import partial
from hashlib import blake2b
from itertools import chain

from rosproxy.ros2.protocol.addressing import destination, of_built_in_writer
from rosproxy.ros2.registry.participants import TrafficKind
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.ports import PortPool, PortRange

MOST_NAMED = 8
"""Participants that may be named at one port. If more are named, the names count for nothing. A
participant that is named for metatraffic and for user data counts twice."""
SETTLING_PERIOD_S = 1.0
"""Seconds from the start in which the proxy gives no port, and waits for datagrams from outside."""
EVIDENCE_PERIOD_S = 30.0
"""Seconds from the start in which the proxy considers evidence from before the start."""


def order_for(key: str, ports: PortRange) -> Iterator[int]:
    """Yield all ports of a range, in the order in which they are tried for a key."""
    start = int.from_bytes(blake2b(key.encode(), digest_size=8).digest(), "big")
    for number in range(len(ports)):
        yield ports.first + (start + number) % len(ports)


_User = tuple[bytes, TrafficKind]
"""The GUID prefix of a participant, and the kind of traffic at its port."""


class NamedBy(IntEnum):
    """The kind of source that names a participant at a port. The greatest counts."""

    OTHERS = 0
    """Any other address. Its datagrams may be forged."""
    PROVEN = 1
    """A proven address outside."""
    PEER = 2
    """The address of a peer."""


class _Claim(IntEnum):
    """The evidence with which a participant claims a port. The least value wins."""

    FORWARDED = 0
    """The kernel forwarded the port to the locator of the participant."""
    KEPT_AND_NAMED = 1
    KEPT = 2
    """The participant had the port, as a former process has signed, or the operator has
    recorded."""
    STATED_AND_NAMED = 3
    STATED = 4
    """The participant states that this was its port. No reliable source names another
    participant."""
    NAMED = 5
    """Outside names the participant. The port may belong to another locator of the participant."""
    UNCLAIMED = 6
    """There is no evidence for any participant."""
    OF_ANOTHER = 7
    """Another participant has better evidence, or may still come back."""
    DISPUTED = 8
    """Several participants have claimed the port with equal evidence."""


_KEPT_OR_STATED = range(_Claim.KEPT_AND_NAMED, _Claim.NAMED)
"""The claims from `LocatorPorts.note_claims`."""


@dataclass(slots=True)
class _FormerUsers:
    """The participants that are named at a port, by the kind of source.

    ``users`` are those that the best kind of source names; empty if these are more than
    `MOST_NAMED`. ``prefixes`` are the GUID prefixes of ``users``.
    """

    users_by: dict[NamedBy, set[_User]] = field(default_factory=dict)
    users: set[_User] = field(default_factory=set)
    prefixes: set[bytes] = field(default_factory=set)

    def note(self, user: _User, by: NamedBy) -> None:
        """Note a named participant, up to `MOST_NAMED` and one more."""
        users = self.users_by.setdefault(by, set())
        if len(users) <= MOST_NAMED and user not in users:
            users.add(user)
            best_users = self.users_by[self.best]
            self.users = best_users if len(best_users) <= MOST_NAMED else set()
            self.prefixes = {prefix for prefix, _ in self.users}

    @property
    def best(self) -> NamedBy:
        """The best kind of source that has named a participant."""
        return max(self.users_by, default=NamedBy.OTHERS)


_NO_USERS = _FormerUsers()


class LocatorPorts:
    """Chooses ports of the range for locators. ``started`` is the start of the proxy in seconds."""

    def __init__(self, pool: PortPool, started: float) -> None:
        self.pool = pool
        self._started = started
        self._former_users: dict[int, _FormerUsers] = {}
        self._forwarded: dict[int, HostPort] = {}
        self._forwarded_to: dict[HostPort, list[int]] = {}
        self._claims: dict[int, dict[bytes, bool]] = {}
        """The participants that claim each port, and whether each has a proof."""
        self._ports_claimed: dict[bytes, Sequence[int]] = {}
        self._lent: dict[int, tuple[bytes, _Claim]] = {}
        """By port: the participant that got the port since the start, and its claim then."""
        self._disputed: dict[int, _Claim] = {}
        """Ports that several participants claim, and the evidence of these claims."""

    def may_give_ports(self, now: float) -> bool:
        """Whether the proxy may give ports: `SETTLING_PERIOD_S` is over."""
        return now - self._started >= SETTLING_PERIOD_S

    def is_restoring(self, now: float) -> bool:
        """Whether `EVIDENCE_PERIOD_S` is not over, so that former evidence counts."""
        return now - self._started < EVIDENCE_PERIOD_S

    def note_use(self, port: int, datagram: bytes, by: NamedBy, now: float) -> None:
        """Note the destination of a datagram from outside at a port without a mapping.

        Raises RtpsError.
        """
        prefix = destination(datagram)
        is_built_in = of_built_in_writer(datagram)
        if prefix is not None and is_built_in is not None:
            kind = TrafficKind.METATRAFFIC if is_built_in else TrafficKind.USER_DATA
            self.note_former_user(port, prefix, kind, by, now)

    def note_former_user(
        self, port: int, prefix: bytes, kind: TrafficKind, by: NamedBy, now: float
    ) -> None:
        """Note that a source has named a participant at a port."""
        if self.is_restoring(now) and port in self.pool.range:
            self._former_users.setdefault(port, _FormerUsers()).note((prefix, kind), by)

    def note_forwarded(self, forwards: Mapping[int, HostPort]) -> None:
        """Note the ports that the kernel forwarded before the start, and their locators."""
        self._forwarded = {p: locator for p, locator in forwards.items() if p in self.pool.range}
        self._forwarded_to = {}
        for port, locator in self._forwarded.items():
            self._forwarded_to.setdefault(locator, []).append(port)

    def note_claims(self, prefix: bytes, ports: Sequence[int], proven_count: int) -> None:
        """Note the ports that a participant claims; the first ``proven_count`` have a proof."""
        self.forget_claims(prefix)
        self._ports_claimed[prefix] = ports
        for index, port in enumerate(ports):
            self._claims.setdefault(port, {})[prefix] = index < proven_count

    def forget_claims(self, prefix: bytes) -> None:
        """Forget the claims of a participant that has gone."""
        for port in self._ports_claimed.pop(prefix, ()):
            claimants = self._claims.get(port, {})
            claimants.pop(prefix, None)
            if not claimants:
                self._claims.pop(port, None)

    def is_named(self, prefix: bytes) -> bool:
        """Whether a peer or a proven address names a participant."""
        return any(
            prefix in users.prefixes
            for users in self._former_users.values()
            if users.best > NamedBy.OTHERS
        )

    def displaced_by(self, prefix: bytes, now: float) -> set[bytes]:
        """Return the participants that have to give back a port that a new participant claims.

        There are two cases. The new participant has a proof and better evidence. Or the evidence is
        equal: then neither participant gets the port.
        """
        if not self.is_restoring(now):
            return set()
        displaced = set[bytes]()
        for port in self._ports_claimed.get(prefix, ()):
            holder, held_by = self._lent.get(port, (prefix, _Claim.UNCLAIMED))
            claim = self._evidence(port, prefix)
            if holder == prefix or claim not in _KEPT_OR_STATED:
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
        former_port: int | None = None,
    ) -> int | None:
        """Choose a port for a locator of a participant; None if all ports are taken.

        ``former_port`` is the port that the participant claims for this locator (`note_claims`).
        """
        if not self.is_restoring(now):
            self._forget_former()
        if not self.pool.free:
            return None  # the search takes long, and a datagram may name a thousand locators
        own, others, disputed = self._ports_by_claim((prefix, kind), locator, former_port)
        order = partial(order_for, f"{prefix.hex()} {locator}", self.pool.range)
        unclaimed = (port for port in order() if port not in others and port not in disputed)
        first = next(order())
        length = len(self.pool.range)
        best = sorted(own, key=lambda port: (own[port], (port - first) % length))
        worse = (port for ports in (others, disputed) for port in order() if port in ports)
        port = next(filter(self.pool.claim, chain(best, unclaimed, worse)), None)
        if port is not None:
            self._former_users.pop(port, None)
            self._forwarded.pop(port, None)
            if port in others:
                claim = _Claim.OF_ANOTHER
            else:
                claim = _Claim.DISPUTED if port in disputed else _Claim.UNCLAIMED
            self._lent[port] = prefix, own.get(port, claim)
        return port

    def _forget_former(self) -> None:
        """Forget the evidence from before the start, because `EVIDENCE_PERIOD_S` is over."""
        self._former_users.clear()
        self._forwarded.clear()
        self._forwarded_to.clear()
        self._claims.clear()
        self._ports_claimed.clear()
        self._lent.clear()
        self._disputed.clear()

    def _ports_by_claim(
        self, user: _User, locator: HostPort, former_port: int | None
    ) -> tuple[dict[int, _Claim], set[int], set[int]]:
        """The ports with any evidence, by the claim of a participant.

        Three values: the ports that the participant claims, with its claims; the ports of another
        participant; the disputed ports. Outside may name participants at all ports. So the method
        looks closely only at the ports with evidence for this participant.
        """
        prefix, _ = user
        named = self._former_users
        concerned = {port for port, users in named.items() if prefix in users.prefixes}
        concerned |= {*self._ports_claimed.get(prefix, ()), *self._forwarded_to.get(locator, ())}
        concerned |= {former_port} if former_port else set()
        claims = {port: self._claim(port, user, locator, former_port) for port in concerned}
        rest = {port for port, users in named.items() if users.prefixes}
        rest.update(self._claims, self._disputed, self._forwarded)
        rest -= concerned
        disputed = rest & self._disputed.keys() - self._forwarded.keys()
        others = rest - disputed
        others |= {port for port, claim in claims.items() if claim is _Claim.OF_ANOTHER}
        disputed |= {port for port, claim in claims.items() if claim is _Claim.DISPUTED}
        own = {port: claim for port, claim in claims.items() if claim < _Claim.UNCLAIMED}
        return own, others, disputed

    def _claim(self, port: int, user: _User, locator: HostPort, former_port: int | None) -> _Claim:
        """The claim of a participant to a port, for a locator."""
        prefix, kind = user
        if (former_locator := self._forwarded.get(port)) is not None:
            is_own = former_locator == locator and kind is TrafficKind.USER_DATA
            return _Claim.FORWARDED if is_own else _Claim.OF_ANOTHER
        if port == former_port:
            return self._judged(port, prefix)
        if port in self._disputed:
            return _Claim.DISPUTED
        named = self._former_users.get(port, _NO_USERS)
        claims = self._claims.get(port, {})
        rivals = claims.keys() - {prefix}
        if any(claims[rival] for rival in rivals):
            return _Claim.OF_ANOTHER
        if user in named.users:
            # Every sender may forge a source. So a name from an unproven address is worth no more
            # than the word of a rival.
            is_doubtful = rivals and named.best is NamedBy.OTHERS
            return _Claim.OF_ANOTHER if is_doubtful else _Claim.NAMED
        # The participant may be named for the other kind of traffic: Cyclone DDS has one locator
        # for both kinds, Fast DDS has two.
        return _Claim.OF_ANOTHER if rivals or named.prefixes - {prefix} else _Claim.UNCLAIMED

    def _judged(self, port: int, prefix: bytes) -> _Claim:
        """The claim of a participant to a port that it states or has proved, against its rivals."""
        claim = self._evidence(port, prefix)
        rivals = self._claims.get(port, {}).keys() - {prefix}
        best_rival = min(
            (self._evidence(port, rival) for rival in rivals), default=_Claim.UNCLAIMED
        )
        if claim is _Claim.OF_ANOTHER:
            return claim
        if claim == best_rival:
            self._disputed[port] = claim
        if claim >= self._disputed.get(port, _Claim.DISPUTED):
            return _Claim.DISPUTED
        named_prefixes = self._former_users.get(port, _NO_USERS).prefixes
        is_void = claim is _Claim.STATED and named_prefixes and prefix not in named_prefixes
        return _Claim.OF_ANOTHER if is_void or claim > best_rival else claim

    def _evidence(self, port: int, prefix: bytes) -> _Claim:
        """The claim that a participant's own statement or proof gives, without regard to rivals.

        Names from unproven addresses count neither for nor against the participant.
        """
        named = self._former_users.get(port, _NO_USERS)
        prefixes = named.prefixes if named.best > NamedBy.OTHERS else set[bytes]()
        if self._claims.get(port, {}).get(prefix):
            return _Claim.KEPT_AND_NAMED if prefix in prefixes else _Claim.KEPT
        if prefix in prefixes:
            return _Claim.STATED_AND_NAMED
        return _Claim.OF_ANOTHER if prefixes else _Claim.STATED

    def give_back(self, port: int) -> None:
        """Make a port available again."""
        self._lent.pop(port, None)
        self.pool.give_back(port)
