"""The port store: participants inside remember their ports for the next process of the proxy.

After a restart of the proxy each participant must get its former ports again. Participants outside
go on sending there, and Fast DDS accepts no new locators of a known participant (PDPListener.cpp).
The proxy writes no file: the file would be lost with the container. Instead the participant
remembers the ports, in a number that each reliable reader keeps of a writer: the sequence number of
the sample that the reader expects next (DDSI-RTPS 2.5, 8.3.8.6 and 8.4.9).

**What is written.** The proxy has a participant, the *port store*, with the two writers of SEDP.
These never write a sample. A heartbeat tells the reader that all samples before a number are gone,
so the reader expects that number next. The number holds the ports::

    port store                                            participant inside
      SPDP: participant, writers of SEDP       ------->   remembers the port store
      HEARTBEAT publications, first 98949      ------->   reader: next is 98949
      HEARTBEAT subscriptions, first 1         ------->   reader: next is 1
                                               <-------   ACKNACK: next is 98949; next is 1

    range 11400-11463, ports 11403 11404 11405: 4, 5 and 6 as distances from 11399, of 7 bits each

      98949 - 1  =   0000110   0000101   0000100         lower half, of the writer of publications
                     11405     11404     11403           upper half: 0, as no further port follows

**Where the number is.** The number is in the builtin readers of the participant, while the
participant lives and `LEASE_DURATION_S` is not over. `FormerPorts.reminders` writes the numbers:
when a participant gets a further port, and then with each announcement of the proxy until the
participant confirms the numbers.

**How the next process reads the number.** The GUID prefix of the port store follows from the
advertised host, the range and the domain. So to the participant, the next process has the same port
store::

    port store, next process                              participant inside
      SPDP; HEARTBEAT with first 1             ------->   expects 98949, ignores smaller numbers
                                               <-------   ACKNACK: next is 98949

`FormerPorts.wait` asks before the proxy announces the participant outside,
`FormerPorts.take_answer` handles the answer, and `LocatorPorts.take` gives the ports again.

**Why this is safe.**

- *A number only grows.* A reader ignores smaller numbers (8.4.12.1). The first port has the lowest
  bits, so a further port makes neither half smaller. For a smaller number the participant first has
  to forget the port store, by a dispose message (`reminders`).
- *A lost datagram does no harm.* The proxy repeats each heartbeat until the participant has
  confirmed the number (`keeps`).
- *A former heartbeat does no harm.* A reader ignores a heartbeat unless the count is greater than
  that of the last heartbeat, which another process may have sent. So the count follows from the
  time (`_heartbeat_datagrams`).
- *A longer range keeps the ports.* The first port of the range stays. A port takes the same number
  of bits in the longer range, up to a limit (`_WIDTHS`). So the port store stays the same.
- *A lie is worth less than a proof.* Each participant can compute the number for the ports of
  another participant. So a proxy with a secret has a second such participant, the *port proof*. The
  number of the port proof has the count of the ports, and a keyed hash of the participant's GUID
  prefix and ports. The GUID prefix of the port proof follows from the secret, too: a proxy with
  another secret asks as another port proof. `LocatorPorts` prefers a claim with a proof.
- *No participant hangs.* No half is longer than `HALF_BITS`. Fast DDS before 2.14.6, 3.2.4, 3.3.1
  and 3.4.2 counts up to the number of a writer in steps of 1, under a lock (StatefulReader.cpp,
  NotifyChanges). Up to 2^24 takes some hundredths of a second, up to 2^32 ten seconds, and up to
  2^48 days. Cyclone DDS does not count: a heartbeat makes a single gap there (ddsi_receive.c,
  handle_Heartbeat).
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from hashlib import blake2b, pbkdf2_hmac

from rosproxy.ros2.protocol.announcement import PORT_STORE_ENDPOINTS, announcement, dispose_message
from rosproxy.ros2.protocol.reliable import acknowledged, heartbeat
from rosproxy.ros2.protocol.rtps import HEADER_BYTES, NO_VENDOR, PREFIX_BYTES
from rosproxy.ros2.rewriting.discovery import BuiltinWriter
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.ports import PortRange

COUNTS_EACH_SECOND = 4
"""Heartbeat counts per second of Unix time (`PortStore._heartbeat_datagrams`)."""
LEASE_DURATION_S = 24 * 3600.0
"""Seconds for which participants remember the port store without an announcement."""
WRITERS = (BuiltinWriter.PUBLICATIONS, BuiltinWriter.SUBSCRIPTIONS)
"""The writers of the port store: for the lower half of a number, and for the upper half."""
HALF_BITS = 24
"""Bits of each half. More bits would block Fast DDS (see above)."""
_WIDTHS = (7, 10, 12, 16)
"""Bits of a port, by the length of the range. A number then has 6, 4, 4 or 2 ports."""
_HASH_BITS = 20
"""Bits of the keyed hash in each half of a proof. The number of ports is above these bits."""
_HALF_MASK = (1 << HALF_BITS) - 1
_HASH_MASK = (1 << _HASH_BITS) - 1
_KEY_ROUNDS = 100_000
"""Rounds of the key derivation, which take some 40 ms. A participant can test secrets against its
own proof, and the rounds make each test slow."""


_Writer = tuple[bytes, int]
"""The GUID prefix of a participant of the proxy, and the entity id of its writer."""


def port_store_key(secret: str | None) -> bytes:
    """Return the key of the proofs; empty without a secret. Takes some 40 ms."""
    if not secret:
        return b""
    return pbkdf2_hmac("sha256", secret.encode(), b"rosproxy: ports of participants", _KEY_ROUNDS)


def halves(number: int, bits: int) -> tuple[int, int]:
    """Return the numbers for both writers. ``bits`` is the length of the lower half."""
    upper, lower = divmod(number - 1, 1 << bits)
    return lower + 1, upper + 1


@dataclass(slots=True)
class PortStore:
    """Lets participants keep ports of a range; ``prefix`` is the GUID prefix of the port store.

    ``key`` makes the proofs; without a key there are no proofs. ``unix_offset`` is Unix time minus
    the time ``now`` of the methods, in seconds.
    """

    prefix: bytes
    ports: PortRange
    key: bytes = field(default=b"", repr=False)
    unix_offset: float = 0.0
    _answers: dict[bytes, dict[_Writer, int]] = field(default_factory=dict)
    """The last answers of each participant, by GUID prefix and by writer."""
    _counts: dict[bytes, int] = field(default_factory=dict)
    """The count of the last heartbeat to each participant, by GUID prefix."""

    @classmethod
    def of(
        cls, host: str, ports: PortRange, domain: int, unix_offset: float, key: bytes = b""
    ) -> "PortStore":
        """Return the port store of a host, a range and a domain, the same in each process."""
        identity = f"{host} {ports.first} {_bits_of_port(ports)} {domain}"
        digest = blake2b(identity.encode(), digest_size=PREFIX_BYTES - 2).digest()
        # A GUID prefix begins with the vendor's id (DDSI 2.2; so in Cyclone DDS, ddsi_init.c).
        return cls(NO_VENDOR + digest, ports, key, unix_offset)

    @property
    def proof_prefix(self) -> bytes:
        """The GUID prefix of the port proof; empty without a key."""
        if not self.key:
            return b""
        return NO_VENDOR + blake2b(self.prefix, key=self.key, digest_size=PREFIX_BYTES - 2).digest()

    @property
    def prefixes(self) -> Iterable[bytes]:
        """The GUID prefixes of the participants that have answered."""
        return self._answers.keys()

    def questions(self, prefix: bytes, reached_at: HostPort, now: float) -> list[bytes]:
        """The datagrams that ask a participant for its ports.

        ``reached_at`` is where the participant reaches the port store.
        """
        return self._heartbeat_datagrams(prefix, dict.fromkeys(self._writers, 1), reached_at, now)

    def reminders(
        self, prefix: bytes, ports: Sequence[int], reached_at: HostPort, now: float
    ) -> list[bytes]:
        """The datagrams with which a participant keeps its ports; empty if nothing is missing.

        If a number would have to become smaller, these are `dispose_messages`, and the answers of
        the participant are forgotten.
        ``reached_at`` is where the participant reaches the port store.
        """
        if self.keeps(prefix, ports):
            return []
        wanted = self.numbers(prefix, ports)
        is_missing = {
            self.prefix: not self._has_kept(prefix, ports),
            self.proof_prefix: not self._is_proven(prefix, ports),
        }
        answers = self._answers.get(prefix, {})
        if any(is_missing[w[0]] and n < answers.get(w, 1) for w, n in wanted.items()):
            # A reader ignores smaller numbers (DDSI-RTPS 2.5, 8.4.12.1). So the participant has to
            # forget the port store first, and gets the number with the next reminders.
            return self.dispose_messages(prefix)
        return self._heartbeat_datagrams(prefix, wanted, reached_at, now)

    def dispose_messages(self, prefix: bytes) -> list[bytes]:
        """The datagrams with which a participant forgets the port store and the ports."""
        self.forget(prefix)
        return [dispose_message(own) for own in self._own_prefixes]

    def keeps(self, prefix: bytes, ports: Sequence[int]) -> bool:
        """Whether a participant keeps all these ports, or as many as fit into a number."""
        is_proven = not self.key or not ports or self._is_proven(prefix, ports)
        return prefix in self._answers and is_proven and self._has_kept(prefix, ports)

    def take(self, prefix: bytes, datagram: bytes) -> bool:
        """Note the answers of a participant. Return whether there are any. Raises RtpsError."""
        is_answer = False
        for own, writer in self._writers:
            for number in acknowledged(datagram, own, writer):
                self._answers.setdefault(prefix, {})[own, writer] = number
                is_answer = True
        return is_answer

    def has_answered(self, prefix: bytes) -> bool:
        """Whether a participant has answered all questions."""
        return len(self._answers.get(prefix, ())) == len(self._writers)

    def former_ports(self, prefix: bytes) -> list[int]:
        """The ports that a participant has kept, in the order of its locators.

        Empty if the participant has not answered.
        """
        return list(self._ports(self._answer(prefix, self.prefix, self.lower_half_bits)))

    def proven_count(self, prefix: bytes) -> int:
        """How many of `former_ports` a participant has proved."""
        ports = self.former_ports(prefix)
        proof = self._answer(prefix, self.proof_prefix, HALF_BITS)
        count = (proof - 1 & _HALF_MASK) >> _HASH_BITS
        if not 0 < count <= len(ports):
            return 0
        return count if proof == self.proof(prefix, ports[:count]) else 0

    def forget(self, prefix: bytes) -> None:
        """Forget the answers of a participant."""
        self._answers.pop(prefix, None)
        self._counts.pop(prefix, None)

    def numbers(self, prefix: bytes, ports: Sequence[int]) -> dict[_Writer, int]:
        """The numbers of the port store and the port proof for a participant's ports, by writer."""
        numbers = [*halves(self.number(ports), self.lower_half_bits)]
        if self.key:
            numbers += halves(self.proof(prefix, ports), HALF_BITS)
        return dict(zip(self._writers, numbers, strict=True))

    def number(self, ports: Sequence[int]) -> int:
        """The number that holds these ports, or as many as fit."""
        number = 0
        width = _bits_of_port(self.ports)
        for index, port in enumerate(ports[: _most_ports(self.ports)]):
            # The first port of the range is 1, because 0 means that no port follows (`_ports`).
            number |= (port - self.ports.first + 1) << index * width
        return number + 1

    def proof(self, prefix: bytes, ports: Sequence[int]) -> int:
        """The number that proves the ports of a participant; 1 without ports or without a key."""
        count = min(len(ports), _most_ports(self.ports))
        if not self.key or not count:
            return 1
        # The port store's prefix stands for the proxy, its range and its domain.
        content = self.prefix + prefix + self.number(ports).to_bytes(8, "big")
        digest = int.from_bytes(blake2b(content, key=self.key, digest_size=8).digest(), "big")
        lower = digest & _HASH_MASK
        upper = digest >> _HASH_BITS & _HASH_MASK
        # Both halves have the number of ports, so that both grow with each port.
        return ((count << _HASH_BITS | upper) << HALF_BITS | count << _HASH_BITS | lower) + 1

    @property
    def _own_prefixes(self) -> list[bytes]:
        return [self.prefix, self.proof_prefix] if self.key else [self.prefix]

    @property
    def _writers(self) -> list[_Writer]:
        return [(own, writer) for own in self._own_prefixes for writer in WRITERS]

    @property
    def lower_half_bits(self) -> int:
        """Bits of the lower half of a number that holds ports. Each port lies in one half."""
        return _most_ports(self.ports) // 2 * _bits_of_port(self.ports)

    def _answer(self, prefix: bytes, own: bytes, bits: int) -> int:
        """The last number of a participant for the port store or the port proof; 1 without answers.

        ``own`` is the GUID prefix of port store or port proof, and ``bits`` the length of the lower
        half.
        """
        answers = self._answers.get(prefix, {})
        lower, upper = (answers.get((own, writer), 1) for writer in WRITERS)
        # In the answer to a former version, the lower half may have all ports, in more bits.
        return lower + (upper - 1 << bits)

    def _has_kept(self, prefix: bytes, ports: Sequence[int]) -> bool:
        """Whether the number of a participant begins with these ports, or with as many as fit."""
        fitting = list(ports[: _most_ports(self.ports)])
        return self.former_ports(prefix)[: len(fitting)] == fitting

    def _is_proven(self, prefix: bytes, ports: Sequence[int]) -> bool:
        """Whether a participant has proved as many ports as these, or more."""
        return self.proven_count(prefix) >= min(len(ports), _most_ports(self.ports))

    def _ports(self, number: int) -> Iterator[int]:
        """Yield the ports that a number holds, up to the first that is not in the range."""
        bits = number - 1
        width = _bits_of_port(self.ports)
        while bits > 0:
            port = self.ports.first + (bits & (1 << width) - 1) - 1
            if port not in self.ports:
                return
            yield port
            bits >>= width

    def _heartbeat_datagrams(
        self, prefix: bytes, numbers: Mapping[_Writer, int], reached_at: HostPort, now: float
    ) -> list[bytes]:
        """The datagrams that give a participant the numbers of the writers.

        A reader ignores a heartbeat unless the count is greater than that of the last heartbeat,
        which another process may have sent. So the count follows from the time.
        """
        time_count = int((self.unix_offset + now) * COUNTS_EACH_SECOND)
        count = max(self._counts.get(prefix, 0) + 1, time_count)
        self._counts[prefix] = count
        sent = list[bytes]()
        for own in self._own_prefixes:
            # A count is a signed number of 32 bits.
            beats = [
                heartbeat(own, prefix, writer, numbers[own, writer], count & 0x7FFFFFFF)
                for writer in WRITERS
            ]
            sent.append(announcement(own, [reached_at], LEASE_DURATION_S, PORT_STORE_ENDPOINTS))
            sent.append(beats[0] + b"".join(beat[HEADER_BYTES:] for beat in beats[1:]))
        return sent


def _bits_of_port(ports: PortRange) -> int:
    return next(width for width in _WIDTHS if len(ports) < 1 << width)


def _most_ports(ports: PortRange) -> int:
    """How many ports of a range a number can hold."""
    return 2 * (HALF_BITS // _bits_of_port(ports))
