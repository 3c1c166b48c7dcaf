"""The settings of a domain, and which ports DDS gives it."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import msgspec

from rosproxy.access.rules import RuleKind
from rosproxy.leases.ports import PortMap
from rosproxy.net.addresses import HostPort
from rosproxy.ros2.protocol.relay_proof import Direction, RelayProof

PORTS_PER_DOMAIN = 250
SPDP_MULTICAST = 7400
SPDP_UNICAST = 7410
"""DDSI-RTPS 2.5, 9.6.2.3: domain d has the ports from 7400 + 250 d on."""
PARTICIPANTS_TRIED = 32
"""How many well-known ports of a peer are told of participants inside: each program has one. Where
many participants are known, twice as many ports are told, up to `MOST_TRIED`."""
MOST_TRIED = 120
"""The well-known ports of a domain; the next ones belong to the next domain (9.6.2.3)."""
NEXT_PORTS = 2
"""How many more well-known ports are used than participants are known at an address."""

MOST_INSIDE = 384
MOST_INSIDE_UNPROVEN = 128
"""Participants inside: at addresses that have proved to receive, and at all others."""
MOST_AT_PEERS = 1024
MOST_OUTSIDE = 512
MOST_OUTSIDE_UNPROVEN = 256
"""Participants outside: at peers' addresses, at others that have proved to receive, at the rest."""
MOST_WAITING = 512
"""Participants inside that wait after a start until it is known which ports they had."""
MOST_PER_ADDRESS = 64
MOST_PER_HOST = 256
"""Participants at one address inside, and outside, where another proxy may be."""
MOST_PER_UNPROVEN = 16
"""Participants at one address outside that has not proved to receive."""
MOST_ANNOUNCED_UNPROVEN = 64
"""While so many participants outside are at unproven addresses, inside is told of these, too."""
MOST_MAPPINGS = 16
"""Ports of the range for one participant; Fast DDS takes three for one address."""

Judge = Callable[[RuleKind, str, str], bool]
"""Whether a kind of rule allows a name to the participant inside at an address."""
Note = Callable[[str, str, str], None]
"""Called with each refusal: its reason in one word, the source, and a text."""
Settled = Callable[[str], None]
"""Called with the address of each participant that is met."""


@dataclass(slots=True)
class Refused:
    """Counts the datagrams that go nowhere, and tells of them."""

    note: Note
    count: int = 0

    def __call__(self, reason: str, source: str, text: str) -> None:
        """Tell why a datagram from a source goes nowhere."""
        self.count += 1
        self.note(reason, source, text)


class Outgoing(msgspec.Struct, frozen=True):
    """A datagram to send."""

    target: HostPort
    datagram: bytes


def sent_to(target: HostPort | None, datagrams: Iterable[bytes]) -> list[Outgoing]:
    """Datagrams for one target; none if it is not known."""
    return [Outgoing(target, datagram) for datagram in datagrams] if target else []


@dataclass(frozen=True, slots=True)
class LanRelayLink:
    """The LAN relay of a domain: where it listens, and the proof that it shares with the proxy."""

    address: HostPort
    proof: RelayProof


@dataclass(slots=True)
class DomainSettings:
    """The settings of a domain; ``hosts``, ``peers`` and ``gateways`` may change.

    ``hosts`` are the IP addresses at which outside reaches the ports of the range, one or one of
    each family; a participant is led to that of its own family, if there is one. ``peers`` are
    those outside that are told of participants inside, with port 0 at their well-known ports;
    ``relay`` is the program that passes announcements on to the LAN.
    ``proxy_address_for`` gives the proxy's own address that an address inside reaches.
    ``is_inside`` tells whether an address lies in an inside network. ``participants_at`` counts the
    participants outside that are known at an address. ``gateways`` are those of the proxy's
    default routes. ``settled`` is called with the address of each participant that is met.
    ``both_ways``: inside reaches the locators of those outside through the proxy alone.
    ``port_store_key`` proves which ports participants had (`ports.store.port_store_key`).
    """

    number: int
    hosts: tuple[str, ...]
    ports: PortMap
    proxy_address_for: Callable[[str], str]
    note: Note
    judge: Judge
    is_inside: Callable[[str], bool]
    both_ways: bool = False
    peers: tuple[HostPort, ...] = ()
    relay: LanRelayLink | None = None
    port_store_key: bytes = field(default=b"", repr=False)
    participants_at: Callable[[str], int] = lambda _: 0
    gateways: frozenset[str] = frozenset()
    settled: Settled = lambda _: None

    @property
    def host(self) -> str:
        """The address by which the proxy is known."""
        return self.hosts[0]

    def host_for(self, address: str) -> str:
        """The address of the proxy's by which outside reaches a participant at an address."""
        same_family = (host for host in self.hosts if (":" in host) == (":" in address))
        return next(same_family, self.host)

    @property
    def multicast_port(self) -> int:
        """Where participants announce themselves to the group."""
        return SPDP_MULTICAST + PORTS_PER_DOMAIN * self.number

    @property
    def unicast_port(self) -> int:
        """Where the first participant of a machine is told of others."""
        return SPDP_UNICAST + PORTS_PER_DOMAIN * self.number

    @property
    def discovery_port(self) -> int:
        """The port of the range, its first, at which outside announces itself to the proxy."""
        return self.ports.listen.first

    def to_outside(self, datagram: bytes) -> list[Outgoing]:
        """A datagram for the LAN and all peers, at which participants inside are announced."""
        sent = self.to_lan(datagram)
        for peer in self.peers:
            targets = [peer] if peer.port else self.well_known_of_peer(peer.host)
            sent += [Outgoing(target, datagram) for target in targets]
        return sent

    def to_lan(self, datagram: bytes) -> list[Outgoing]:
        """A datagram for the LAN; nothing without a LAN relay."""
        if self.relay is None:
            return []
        return [Outgoing(self.relay.address, self.relay.proof.sealed(Direction.TO_LAN, datagram))]

    def well_known(self, host: str, count: int = PARTICIPANTS_TRIED) -> list[HostPort]:
        """Where the first participants of a host are told of others (9.6.2.3)."""
        ports = range(self.unicast_port, self.unicast_port + 2 * count, 2)
        return [HostPort(host, port) for port in ports]

    def well_known_of_peer(self, host: str) -> list[HostPort]:
        """Where the participants of a peer are told of others."""
        count = min(2 * self.participants_at(host), MOST_TRIED)
        return self.well_known(host, max(PARTICIPANTS_TRIED, count))

    def is_peer(self, address: str) -> bool:
        """Whether an address is a peer's."""
        return any(peer.host == address for peer in self.peers)
