"""Which ports a participant has, kept where that outlasts the proxy: in the participant itself.

A reliable reader remembers, of each writer, the number of the next sample that it expects, and says
so when it is asked by a heartbeat (DDSI-RTPS 2.5, 8.3.8.6 and 8.4.9). So the proxy has a
participant, the *keeper*, with a writer of SEDP that never writes: it tells each participant inside
by a heartbeat that all samples before a number are gone, and the number holds its ports. The keeper
has the same GUID prefix in each process of the proxy, so that the next one asks, and is told.

The number is 1 for no ports; else it holds each port less the range's first, that of the first port
in the lowest bits, and a port that is added makes it greater, as it has to be. A range that is made
longer keeps its first port, and a port its bits, up to a length: so the keeper stays the same.

Each participant can compute this number for the ports of another one. So a proxy with a secret has
a second such participant, the *witness*, whose number proves that of the keeper: how many ports
there are, and a keyed hash of the participant's GUID prefix and these ports. The witness's own
prefix follows from the secret, too: a proxy with another secret asks as another witness.

Both numbers stay small where they can. Fast DDS 2.14 and 3.2 count up to a number one by one, and
hold a lock meanwhile (StatefulReader.cpp, NotifyChanges): up to 2^24 takes some hundredths of a
second, and up to 2^61 the participant hangs.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from hashlib import blake2b, pbkdf2_hmac

from rosproxy.leases.ports import PortRange
from rosproxy.net.addresses import HostPort
from rosproxy.ros2.protocol.announcement import WRITER_ENDPOINTS, announcement, farewell
from rosproxy.ros2.protocol.reliable import acknowledged, heartbeat
from rosproxy.ros2.protocol.rtps import NO_VENDOR, PREFIX
from rosproxy.ros2.rewriting.discovery import BuiltinWriter

COUNTS_EACH_SECOND = 4
LEASE = 24 * 3600.0
"""Seconds for which participants remember the keeper without hearing it."""
_BITS = 62
"""Bits of a number that are used."""
_WIDTHS = (7, 10, 16)
"""Bits that a port may take, by how long the range is: 8, 6 or 3 ports are kept."""


_PROOF_BITS = 20
"""Bits of the keyed hash; above these stands the number of ports. Few: see Fast DDS above."""
MOST_WRONG = 4
"""Wrong proofs after which no proof of an address counts any more: it may be guessing."""
MOST_WRONG_ADDRESSES = 256
"""Addresses with wrong proofs after which no proof of another address counts any more."""
_KEY_ROUNDS = 100_000
"""Rounds in which the key is made, some 40 ms. A participant can try secrets by its own proof: this
makes each try slow."""


def keeper_key(secret: str | None) -> bytes:
    """Return the key of the proofs; empty without a secret. It takes some 40 ms."""
    if not secret:
        return b""
    return pbkdf2_hmac("sha256", secret.encode(), b"rosproxy: ports of participants", _KEY_ROUNDS)


@dataclass(slots=True)
class Keeper:
    """Keeps ports of a range in participants; ``prefix`` is its own, ``key`` that of the proofs.

    ``witness`` is the prefix of the participant that keeps the proofs, empty without a key.
    ``number_by_prefix`` and ``proof_by_prefix`` are what each participant has answered last, by
    GUID prefix. ``wrong_by_address`` counts the wrong proofs that each address has sent.
    """

    prefix: bytes
    ports: PortRange
    key: bytes = field(default=b"", repr=False)
    number_by_prefix: dict[bytes, int] = field(default_factory=dict)
    proof_by_prefix: dict[bytes, int] = field(default_factory=dict)
    wrong_by_address: Counter[str] = field(default_factory=Counter)
    _first_count: int = 0
    _counts: dict[bytes, int] = field(default_factory=dict)

    @classmethod
    def of(
        cls, host: str, ports: PortRange, domain: int, started: float, key: bytes = b""
    ) -> "Keeper":
        """The keeper of a proxy, from its advertised host, its range's first port and its domain.

        ``started`` is Unix time: heartbeats to a participant are counted up from there, since it
        heeds only those with a greater count than the last, which another process may have sent.
        No process sends a participant more than `COUNTS_EACH_SECOND`.
        """
        identity = f"{host} {ports.first} {_width(ports)} {domain}"
        digest = blake2b(identity.encode(), digest_size=PREFIX - 2).digest()
        first_count = int(started * COUNTS_EACH_SECOND)
        # A GUID prefix begins with the vendor's id (DDSI 2.2; so in Cyclone DDS, ddsi_init.c).
        return cls(NO_VENDOR + digest, ports, key, _first_count=first_count)

    @property
    def witness(self) -> bytes:
        """The GUID prefix of the participant that keeps the proofs; empty without a key."""
        if not self.key:
            return b""
        return NO_VENDOR + blake2b(self.prefix, key=self.key, digest_size=PREFIX - 2).digest()

    def questions(self, prefix: bytes, reached_at: HostPort) -> list[bytes]:
        """What asks a participant for its ports; ``reached_at`` is where it answers."""
        return self._told(prefix, dict.fromkeys(self._prefixes, 1), reached_at)

    def reminders(self, prefix: bytes, ports: Sequence[int], reached_at: HostPort) -> list[bytes]:
        """What makes a participant keep its ports; nothing if it does already."""
        if self.keeps(prefix, ports):
            return []
        number = self.number(ports)
        proof = self.proof(prefix, ports)
        has_others = not self._has_kept(prefix, ports) and number <= self._number(prefix)
        has_other_proof = 1 < proof <= self.proof_by_prefix.get(prefix, 1)
        if has_others or (has_other_proof and not self._is_proven(prefix, ports)):
            # A reader heeds no smaller number (DDSI-RTPS 2.5, 8.4.12.1): it has to forget the
            # keeper first, and is told the number the next time.
            return self.farewells(prefix)
        numbers = dict(zip(self._prefixes, (number, proof), strict=False))
        return self._told(prefix, numbers, reached_at)

    def farewells(self, prefix: bytes) -> list[bytes]:
        """What makes a participant forget the keeper, with what it keeps."""
        self.forget(prefix)
        return [farewell(own) for own in self._prefixes]

    def keeps(self, prefix: bytes, ports: Sequence[int]) -> bool:
        """Whether a participant keeps all these ports, as many of them as fit."""
        is_proven = not self.key or not ports or self._is_proven(prefix, ports)
        return prefix in self.number_by_prefix and is_proven and self._has_kept(prefix, ports)

    def take(self, prefix: bytes, source: str, datagram: bytes) -> bool:
        """Note what a participant at an address answers; whether it is an answer. RtpsError."""
        numbers = acknowledged(datagram, self.prefix, BuiltinWriter.PUBLICATIONS)
        for number in numbers:
            self.number_by_prefix[prefix] = number
        proofs = self._proofs_in(datagram)
        for proof in proofs:
            self.proof_by_prefix[prefix] = proof
        if proofs and self._is_wrong(prefix):
            self._note_wrong(source)
        return bool(numbers or proofs)

    def has_answered(self, prefix: bytes) -> bool:
        """Whether a participant has answered all questions."""
        is_proof_known = not self.key or prefix in self.proof_by_prefix
        return is_proof_known and prefix in self.number_by_prefix

    def former_ports(self, prefix: bytes) -> list[int]:
        """The ports that a participant has kept, in the order of its locators."""
        return list(self._ports(self._number(prefix)))

    def proven_count(self, prefix: bytes, source: str) -> int:
        """How many of these ports a participant at an address has proved that it had."""
        is_trusted = self.wrong_by_address[source] < MOST_WRONG and (
            source in self.wrong_by_address or len(self.wrong_by_address) < MOST_WRONG_ADDRESSES
        )
        ports = self.former_ports(prefix)
        proof = self.proof_by_prefix.get(prefix, 1)
        count = proof >> _PROOF_BITS
        if not is_trusted or not 0 < count <= len(ports):
            return 0
        return count if proof == self.proof(prefix, ports[:count]) else 0

    def forget(self, prefix: bytes) -> None:
        """Forget a participant that has gone."""
        self.number_by_prefix.pop(prefix, None)
        self.proof_by_prefix.pop(prefix, None)
        self._first_count = max(self._first_count, self._counts.pop(prefix, 0))  # it may come again

    def number(self, ports: Sequence[int]) -> int:
        """The number that holds these ports, as many of them as fit."""
        number = 0
        width = _width(self.ports)
        for index, port in enumerate(ports[: _most(self.ports)]):
            # The first port is 1: zero means that no port follows (`_ports`).
            number |= (port - self.ports.first + 1) << index * width
        return number + 1

    def proof(self, prefix: bytes, ports: Sequence[int]) -> int:
        """The number that proves the ports of a participant; 1 for none, and without a key."""
        count = min(len(ports), _most(self.ports))
        if not self.key or not count:
            return 1
        # The keeper's prefix stands for the proxy, its range and its domain.
        content = self.prefix + prefix + self.number(ports).to_bytes(8, "big")
        digest = blake2b(content, key=self.key, digest_size=8).digest()
        return count << _PROOF_BITS | int.from_bytes(digest, "big") & (1 << _PROOF_BITS) - 1

    @property
    def _prefixes(self) -> list[bytes]:
        return [self.prefix, self.witness] if self.key else [self.prefix]

    def _number(self, prefix: bytes) -> int:
        """The number that a participant has answered last."""
        return self.number_by_prefix.get(prefix, 1)

    def _has_kept(self, prefix: bytes, ports: Sequence[int]) -> bool:
        """Whether the number of a participant holds these ports, as many of them as fit."""
        fitting = list(ports[: _most(self.ports)])
        return self.former_ports(prefix)[: len(fitting)] == fitting

    def _is_proven(self, prefix: bytes, ports: Sequence[int]) -> bool:
        """Whether a participant has answered the proof of these ports, or of more."""
        proof = self.proof_by_prefix.get(prefix, 1)
        count = proof >> _PROOF_BITS
        kept = self.former_ports(prefix)[:count]
        is_enough = count >= min(len(ports), _most(self.ports))
        return is_enough and len(kept) == count and proof == self.proof(prefix, kept)

    def _proofs_in(self, datagram: bytes) -> list[int]:
        if not self.key:
            return []
        return acknowledged(datagram, self.witness, BuiltinWriter.PUBLICATIONS)

    def _is_wrong(self, prefix: bytes) -> bool:
        """Whether a participant has answered a proof of its ports that is wrong, not just old."""
        proof = self.proof_by_prefix[prefix]
        count = proof >> _PROOF_BITS
        ports = self.former_ports(prefix)
        return proof > 1 and count <= len(ports) and proof != self.proof(prefix, ports[:count])

    def _note_wrong(self, source: str) -> None:
        """Count a wrong proof of an address."""
        is_known = source in self.wrong_by_address
        if is_known or len(self.wrong_by_address) < MOST_WRONG_ADDRESSES:
            self.wrong_by_address[source] += 1

    def _ports(self, number: int) -> Iterator[int]:
        """The ports that a number holds; none if it can't be one of `number`."""
        bits, width = number - 1, _width(self.ports)
        while bits > 0:
            port = self.ports.first + (bits & (1 << width) - 1) - 1
            if port not in self.ports:
                return
            yield port
            bits >>= width

    def _told(
        self, prefix: bytes, number_by_own: Mapping[bytes, int], reached_at: HostPort
    ) -> list[bytes]:
        """What tells a participant where the samples of the proxy's own participants begin."""
        count = self._counts[prefix] = self._counts.get(prefix, self._first_count) + 1
        sent = list[bytes]()
        for own, number in number_by_own.items():
            sent.append(announcement(own, [reached_at], LEASE, WRITER_ENDPOINTS))
            # A count is a signed number of 32 bits.
            beat_count = count & 0x7FFFFFFF
            sent.append(heartbeat(own, prefix, BuiltinWriter.PUBLICATIONS, number, beat_count))
        return sent


def _width(ports: PortRange) -> int:
    return next(width for width in _WIDTHS if len(ports) < 1 << width)


def _most(ports: PortRange) -> int:
    """How many ports of a range are kept of a participant."""
    return _BITS // _width(ports)
