"""The LAN relay: passes announcements of participants between a LAN's multicast and the proxy.

Multicast ends at the bridge of a container network. The LAN relay runs in the host's network, and
receives the announcements of participants to the group (SPDP). The relay sends these to the proxy,
with their source addresses. The announcements of the proxy go to the group on the LAN. The relay
passes on nothing else: neither the discovery of readers and writers nor user data.

The relay needs no other right than to be in the host's network. The relay keeps no state, so it may
be killed and started at any time. Each datagram between relay and proxy has a proof
(`rosproxy.ros2.protocol.relay_proof`), because other programs may use the addresses of both.
"""

import asyncio
import contextlib
import errno
import logging
import socket
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial

from rosproxy.forwarding import datagrams
from rosproxy.forwarding.datagrams import DATAGRAMS_PER_TURN, LARGEST_DATAGRAM
from rosproxy.ros2.domain_settings import Outgoing
from rosproxy.ros2.lan_relay.sources import SOURCE_BURST_UNITS, SOURCE_UNITS_PER_SECOND, LanSources
from rosproxy.ros2.protocol.relay_envelope import LIST_MAGIC, listed_addresses, wrapped
from rosproxy.ros2.protocol.relay_proof import Direction, ProofError, RelayProof
from rosproxy.ros2.protocol.rtps import RtpsError, by_source, by_source_if_sound
from rosproxy.ros2.rewriting.discovery import read_discovery
from rosproxy.ros2.servers.discovery_scheduler import DiscoveryScheduler
from rosproxy.ros2.servers.groups import GroupSockets, family_of, groups_of, send_through
from rosproxy.ros2.sources.rates import DiscoveryRates
from rosproxy.shared.addresses import HostPort, plain_address
from rosproxy.shared.domain_ports import multicast_port

log = logging.getLogger(__name__)

PROOF_WARNING_INTERVAL_S = 60.0
"""Seconds until the relay logs a refused proof again."""


@dataclass(frozen=True, slots=True)
class LanRelaySettings:
    """The settings of a LAN relay.

    ``lan`` is this host's address on the LAN. ``bind`` is the address and port for the proxy's
    announcements. ``proxy`` is the address and port of the proxy for announcements of the LAN.
    ``secret`` is known to both.
    """

    domain: int
    lan: str
    bind: HostPort
    proxy: HostPort
    secret: str = field(repr=False)


class LanRelay:
    """Passes announcements on, from `start` to `close`. Needs a running event loop.

    ``from_lan`` and ``to_lan`` count announcements, and ``dropped`` counts datagrams. If a datagram
    has messages of several participants, each message counts as a datagram.
    """

    def __init__(self, settings: LanRelaySettings) -> None:
        self._settings = settings
        self._loop = asyncio.get_running_loop()
        self._proof = RelayProof(settings.secret, time.time)
        self._sockets: list[socket.socket] = []
        self._port = multicast_port(settings.domain)
        self._groups = GroupSockets(self._port, self._begin, self._end)
        self._sources = LanSources()
        # A machine on the LAN may forge the proxy's address, but not its proof.
        self._proxy_rates = DiscoveryRates(SOURCE_UNITS_PER_SECOND, SOURCE_BURST_UNITS)
        # An attacker that reads a list can repeat it. The lists have an allowance of their own,
        # because the announcements of hundreds of participants use up the other.
        self._list_rates = DiscoveryRates(SOURCE_UNITS_PER_SECOND, SOURCE_BURST_UNITS)
        self._scheduler = DiscoveryScheduler()
        self._warned_at = -PROOF_WARNING_INTERVAL_S
        self.from_lan = self.to_lan = self.dropped = 0

    def start(self) -> None:
        """Bind all sockets. Raises OSError."""
        settings = self._settings
        self._proxy_socket = datagrams.bind(settings.bind.host, settings.bind.port)
        self._sockets.append(self._proxy_socket)
        self._lan_socket = datagrams.bind(settings.lan, 0)
        self._sockets.append(self._lan_socket)
        send_through(self._lan_socket, settings.lan, loop=True)  # also to participants on this host
        self._groups.open([family_of(settings.lan)])
        if not self._groups.join([settings.lan]):
            text = f"can't join the multicast group on the network of the address {settings.lan}"
            raise OSError(errno.EADDRNOTAVAIL, text)
        self._loop.add_reader(self._proxy_socket, self._hear_proxy)

    def close(self) -> None:
        """Close all sockets."""
        self._scheduler.close()
        self._groups.close()
        for sock in self._sockets:
            self._end(sock)

    def _begin(self, sock: socket.socket) -> None:
        self._loop.add_reader(sock, self._hear_lan, sock)

    def _end(self, sock: socket.socket) -> None:
        self._loop.remove_reader(sock)
        sock.close()

    def _hear_lan(self, sock: socket.socket) -> None:
        """Receive announcements of the LAN, and queue these in an order fair to the sources."""
        now = self._loop.time()
        with contextlib.suppress(BlockingIOError):
            for _ in range(DATAGRAMS_PER_TURN):
                datagram, sender = sock.recvfrom(LARGEST_DATAGRAM)
                source = plain_address(sender[0])
                standing = self._sources.standing(source, now)
                for message in self._taken(datagram, source, now):
                    tell = partial(self._tell_proxy, message, source)
                    is_queued = self._scheduler.put(source, standing, len(message), tell)
                    self.dropped += not is_queued

    def _taken(self, datagram: bytes, source: str, now: float) -> Iterator[bytes]:
        """Yield the message of each participant in a datagram, within the source's allowance.

        The relay splits a datagram only after a charge: in a flood, most datagrams end before that.
        The charge includes the first message.
        """
        if not self._sources.take(source, len(datagram), now):
            self.dropped += 1
            return
        for index, message in enumerate(by_source_if_sound(datagram)):
            if index == 0 or self._sources.take(source, len(message), now):
                yield message
            else:
                self.dropped += 1

    def _tell_proxy(self, datagram: bytes, source: str) -> list[Outgoing]:
        """Send the announcements of a source on the LAN to the proxy. Return the sent datagrams."""
        # By the loop option, datagrams of `_tell_lan` come back here. The proxy ignores these.
        announcements = self._announcements(datagram)
        self.from_lan += len(announcements)
        carried = [wrapped(source, announcement) for announcement in announcements]
        sealed = [self._proof.sealed(Direction.TO_PROXY, content) for content in carried]
        sent = [Outgoing(self._settings.proxy, proven) for proven in sealed]
        for out in sent:
            # The proxy accepts a proof only from the address of this socket.
            self._send(self._proxy_socket, out)
        return sent

    def _hear_proxy(self) -> None:
        """Receive the datagrams of the proxy: announcements, and lists of proven addresses."""
        with contextlib.suppress(BlockingIOError):
            for _ in range(DATAGRAMS_PER_TURN):
                try:
                    datagram, sender = self._proxy_socket.recvfrom(LARGEST_DATAGRAM)
                except ConnectionRefusedError:  # the proxy does not run
                    continue
                source = plain_address(sender[0])
                content = self._proven(datagram, source)
                self.dropped += content is None or not self._take(content, source)

    def _take(self, content: bytes, source: str) -> bool:
        """Carry out a datagram of the proxy. False if its allowance is used up."""
        now = self._loop.time()
        rates = self._list_rates if content.startswith(LIST_MAGIC) else self._proxy_rates
        if not rates.take(source, len(content), now):
            return False
        if (addresses := listed_addresses(content)) is not None:
            self._sources.note_proven(addresses, now)
        else:
            self._tell_lan(content)
        return True

    def _tell_lan(self, content: bytes) -> None:
        """Send announcements of the proxy to the groups on the LAN."""
        for announcement in self._announcements(content):
            self.to_lan += 1
            for group in groups_of(self._settings.lan):
                self._send(self._lan_socket, Outgoing(HostPort(group, self._port), announcement))

    def _proven(self, datagram: bytes, source: str) -> bytes | None:
        """The content of a datagram of the proxy; None for a datagram of another program."""
        if source != self._settings.proxy.host:
            return None
        try:
            return self._proof.opened(Direction.TO_LAN, datagram)
        except ProofError as error:
            now = self._loop.time()
            if now - self._warned_at >= PROOF_WARNING_INTERVAL_S:
                self._warned_at = now
                log.warning("refused: from %s, the proxy's address: %s", source, error)
            return None

    def _announcements(self, datagram: bytes) -> list[bytes]:
        """The announcements of participants in a datagram.

        Several participants of a process may share a datagram. A datagram without an announcement
        counts as dropped.
        """
        announcements = list[bytes]()
        with contextlib.suppress(RtpsError):
            messages = map(read_discovery, by_source(datagram))
            announcements = [m.datagram for m in messages if m.of_participant is not None]
        self.dropped += not announcements
        return announcements

    def _send(self, sock: socket.socket, out: Outgoing) -> None:
        try:
            sock.sendto(out.datagram, (out.target.host, out.target.port))
        except OSError as error:
            log.debug("can't send an announcement to %s: %s", out.target, error)
