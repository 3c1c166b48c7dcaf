"""The settings of a domain, its ports (DDSI-RTPS), and the bounds for participants."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import msgspec

from rosproxy.ros2.protocol.relay_proof import Direction, RelayProof
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.domain_ports import first_unicast_port, multicast_port
from rosproxy.shared.policy.rules import RuleKind
from rosproxy.shared.ports import PortMap

PARTICIPANTS_TRIED = 32
"""The number of well-known ports of a peer to which announcements go. Each process binds one port.
If more than 16 participants are known there, announcements go to two ports for each participant, up
to `MOST_TRIED`."""
MOST_TRIED = 120
"""The number of well-known ports of a domain. Further ports belong to the next domain (9.6.2.3)."""
NEXT_PORTS = 2
"""Well-known ports that are used beyond the number of known participants at an address."""

MOST_INSIDE = 384
"""Participants inside that have answered a question."""
MOST_INSIDE_UNPROVEN = 128
"""Participants inside that have not answered a question."""
MOST_AT_PEERS = 1024
"""Participants outside at the addresses of peers."""
MOST_OUTSIDE = 512
"""Participants outside at other proven addresses."""
MOST_OUTSIDE_UNPROVEN = 256
"""Participants outside at unproven addresses."""
MOST_WAITING = 512
"""Participants inside that wait after a start for the answer about their former ports."""
MOST_PER_ADDRESS = 64
"""Participants at an address inside."""
MOST_PER_HOST = 256
"""Participants at the address of a peer, or at another proven address outside. There may be another
proxy at the address."""
MOST_PER_UNPROVEN = 16
"""Participants at an unproven address outside."""
MOST_ANNOUNCED_UNPROVEN = 64
"""Participants outside at unproven addresses up to which the proxy announces such participants
inside. Also participants inside that have not answered, up to which the proxy serves further such
participants."""
MOST_MAPPINGS = 16
"""Ports of the range for a participant. Fast DDS announces three locators for an address."""
MOST_DATAGRAMS_PER_PART = 512
"""Datagrams after which a part of the regular work of a domain ends: some milliseconds. What goes
to all peers may exceed this number: with four peers, 129 datagrams for each participant."""

Judge = Callable[[RuleKind, str, str], bool]
"""Returns whether the policy allows a name. The arguments are the kind of rule, the name, and the
address of the participant inside."""
Note = Callable[[str, str, str], None]
"""Called for each refusal with the reason in one word, the source, and a text."""
Settled = Callable[[str], None]
"""Called with the address of each new participant."""


@dataclass(slots=True)
class Refused:
    """Counts and reports what the proxy refuses."""

    note: Note
    count: int = 0

    def __call__(self, reason: str, source: str, text: str) -> None:
        """Report a refusal, with the reason in one word, the source, and a text."""
        self.count += 1
        self.note(reason, source, text)


class Outgoing(msgspec.Struct, frozen=True):
    """A datagram to send."""

    target: HostPort
    datagram: bytes


def sent_to(target: HostPort | None, datagrams: Iterable[bytes]) -> list[Outgoing]:
    """Datagrams for a target; empty without a target."""
    return [Outgoing(target, datagram) for datagram in datagrams] if target else []


@dataclass(frozen=True, slots=True)
class LanRelayLink:
    """The address of the LAN relay of a domain, and the proof that it shares with the proxy."""

    address: HostPort
    proof: RelayProof


@dataclass(slots=True)
class DomainSettings:
    """The settings of a domain. ``hosts``, ``peers`` and ``gateways`` may change.

    ``hosts`` are the IP addresses at which outside reaches the range: a single address, or one of
    each family. A participant gets the address of its own family, if there is one. ``peers`` are
    the hosts outside that get the announcements of participants inside; the port 0 means their
    well-known ports. ``relay`` is the LAN relay, if any. ``proxy_address_for`` returns the proxy's
    address for an address inside. ``is_inside`` tells whether an address is in an inside network.
    ``participants_at`` returns the number of known participants at an address outside. ``gateways``
    are those of the proxy's default routes. ``settled`` is called with the address of each new
    participant. ``both_ways`` means that inside reaches the locators outside only through the
    proxy. ``port_store_key`` proves the ports of participants (`ports.store.port_store_key`).
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
    _peer_hosts: frozenset[str] = frozenset()
    _peer_hosts_of: tuple[HostPort, ...] = ()

    @property
    def host(self) -> str:
        """The first address of the advertised host."""
        return self.hosts[0]

    def host_for(self, address: str) -> str:
        """The address of the advertised host for a participant at an address.

        The family is that of the participant, if possible.
        """
        same_family = (host for host in self.hosts if (":" in host) == (":" in address))
        return next(same_family, self.host)

    @property
    def multicast_port(self) -> int:
        """The port for announcements to the multicast group."""
        return multicast_port(self.number)

    @property
    def unicast_port(self) -> int:
        """The first well-known port, which the first participant of a machine binds."""
        return first_unicast_port(self.number)

    @property
    def discovery_port(self) -> int:
        """The first port of the range, at which outside announces itself to the proxy."""
        return self.ports.listen.first

    def to_outside(self, datagram: bytes) -> list[Outgoing]:
        """A datagram for the LAN relay and all peers."""
        sent = self.to_lan(datagram)
        for peer in self.peers:
            targets = [peer] if peer.port else self.well_known_of_peer(peer.host)
            sent += [Outgoing(target, datagram) for target in targets]
        return sent

    def to_lan(self, datagram: bytes) -> list[Outgoing]:
        """A datagram for the LAN relay, with a proof; empty without a LAN relay."""
        if self.relay is None:
            return []
        return [Outgoing(self.relay.address, self.relay.proof.sealed(Direction.TO_LAN, datagram))]

    def well_known(self, host: str, count: int = PARTICIPANTS_TRIED) -> list[HostPort]:
        """The first ``count`` well-known ports of a host (9.6.2.3)."""
        ports = range(self.unicast_port, self.unicast_port + 2 * count, 2)
        return [HostPort(host, port) for port in ports]

    def well_known_of_peer(self, host: str) -> list[HostPort]:
        """The well-known ports of a peer to which announcements go."""
        count = min(2 * self.participants_at(host), MOST_TRIED)
        return self.well_known(host, max(PARTICIPANTS_TRIED, count))

    def is_peer(self, address: str) -> bool:
        """Whether an address is that of a peer."""
        if self._peer_hosts_of is not self.peers:
            self._peer_hosts_of = self.peers
            self._peer_hosts = frozenset(peer.host for peer in self.peers)
        return address in self._peer_hosts
