"""The sockets of a domain: pass received datagrams to `Domain`, and send the resulting datagrams.

User data passes at once. Discovery takes long to read, and waits in a queue
(`DiscoveryScheduler`).

    the groups       at the domain's multicast port, on all inside networks
    well-known port  participants inside with the proxy as a peer announce themselves there
    the range        all ports, from the start: a datagram at a port without a mapping may name the
                     participant that had the port
    stand-ins        for the locators of participants outside

One socket of each family sends all datagrams: participants of RTPS answer to locators, not to the
source of a datagram.
"""

import asyncio
import contextlib
import errno
import logging
import os
import socket
import time
from collections.abc import (
    Awaitable,
    Callable,
    Collection,
    Hashable,
    Iterable,
    Iterator,
    Mapping,
    Sequence,
)
from functools import partial

from rosproxy.forwarding import datagrams
from rosproxy.forwarding.buffer_sizes import UDP_RECEIVE_BUFFER_BYTES
from rosproxy.forwarding.datagrams import LARGEST_DATAGRAM
from rosproxy.ros2.discovery.domain import Domain
from rosproxy.ros2.domain_settings import (
    NEXT_PORTS,
    PARTICIPANTS_TRIED,
    DomainSettings,
    Outgoing,
)
from rosproxy.ros2.protocol.addressing import heartbeat_stream, only_acknowledges
from rosproxy.ros2.protocol.locators import pack_locator
from rosproxy.ros2.protocol.relay_envelope import address_lists
from rosproxy.ros2.protocol.rtps import PREFIX_BYTES, RtpsError, by_source_if_sound
from rosproxy.ros2.rewriting.discovery import read_messages
from rosproxy.ros2.servers.discovery_scheduler import DiscoveryScheduler
from rosproxy.ros2.servers.groups import GroupSockets, family_of, groups_of, send_through
from rosproxy.ros2.servers.receive_buffers import ReceiveBuffers
from rosproxy.ros2.sources.selected import SelectedAddresses
from rosproxy.shared.addresses import HostPort, plain_address
from rosproxy.shared.ports import PortPool
from rosproxy.shared.tasks import in_turns

log = logging.getLogger(__name__)

EXPIRY_INTERVAL_S = 0.5
"""Seconds between calls of `DomainServer.expire`."""
ADMISSION_TIMEOUT_S = 5.0
"""Seconds after which a waiting participant is queued again, unless already served."""
DATAGRAMS_PER_TURN = 16
"""Datagrams that a socket passes on before other sockets follow."""
QUEUED_PER_PASSED = 8
"""Datagrams that a socket may queue in the time in which it passes on one datagram.

If sockets queued fewer, the kernel would drop datagrams, without fairness to the sources."""

SENT_PER_TURN = 64
"""Own announcements that the proxy sends before the event loop does other work: some
milliseconds."""

Take = Callable[[bytes, str, float, int], list[Outgoing]]
"""Handles a datagram with its source, the time, and the number of received bytes. Returns the
datagrams to send."""
MustQueue = Callable[[bytes, str], bool]
"""Whether a datagram from a source is discovery that has to wait in the queue."""


class DomainServer:
    """Serves a domain.

    ``now`` is the clock in seconds, and ``is_inside`` tells the side of an address. ``changed`` is
    called after each change of the port mappings. Before the first selection of an operator, no
    participant is served for ``selection_timeout`` seconds. After that, all are served.
    """

    def __init__(
        self,
        settings: DomainSettings,
        bind: str,
        now: Callable[[], float],
        is_inside: Callable[[str], bool],
        changed: Callable[[], None],
        selection_timeout: float = 0.0,
    ) -> None:
        self._bind = bind
        self._now = now
        self._is_inside = is_inside
        self._changed = changed
        self._reported_changes = 0
        pool = PortPool(settings.ports.listen)
        # A new prefix for each process: participants announce themselves at once only to an
        # unknown discovery participant, and repeat all announcements for this participant.
        self.domain = Domain(
            settings, pool, os.urandom(PREFIX_BYTES), os.urandom(32), now(), time.time()
        )
        self._selected = SelectedAddresses(now() + selection_timeout)
        self._loop = asyncio.get_running_loop()
        self.buffers = ReceiveBuffers()
        self._sockets: list[socket.socket] = []
        self._stand_ins: dict[int, socket.socket] = {}
        self._synced_changes = 0
        self._groups = GroupSockets(settings.multicast_port, self._read_group, self._stop_reading)
        self._secret = b""
        self._heard = asyncio.Event()
        self._scheduler = DiscoveryScheduler()
        self._next_part: asyncio.Handle | None = None
        self._admitting: dict[bytes, float] = {}
        """Participants that no longer wait for former ports, with the time of queueing."""
        self._out = {f: _sending_socket(f) for f in (socket.AF_INET, socket.AF_INET6)}
        self.lost = 0
        """Datagrams that the kernel refused to send."""

    def start(self) -> list[int]:
        """Open all sockets except stand-ins. Return the ports of the range that are not available.

        Raises OSError if the multicast port or the well-known port is not available.
        """
        settings = self.domain.settings
        domain = self.domain
        self._groups.open(_families(self._bind))
        well_known = datagrams.bind(self._bind, settings.unicast_port)
        self._read(well_known, self._heard_at_well_known, self._must_queue_inside)
        taken_ports = []
        for port in settings.ports.listen.ports():
            try:
                sock = datagrams.bind(self._bind, port)
            except OSError as error:
                log.debug("port %d of the range can't be bound: %s", port, error)
                self.domain.ports.pool.block(port)
                taken_ports.append(port)
                continue
            if port == settings.discovery_port:
                self._read(sock, self._at_discovery, self._must_queue_discovery)
            else:
                self._read(
                    sock,
                    partial(domain.at_range_port, port),
                    partial(domain.must_queue_at_range_port, port),
                )
        return taken_ports

    async def try_discovery_port(
        self, secret: bytes, trial: Callable[[asyncio.Event], Awaitable[str]]
    ) -> str:
        """Return the outcome of a trial of the discovery port.

        The event that ``trial`` gets is set when ``secret`` arrives at the discovery port.
        """
        self._secret = secret
        self._heard = asyncio.Event()
        return await trial(self._heard)

    def join(self, addresses: Iterable[str]) -> None:
        """Join the groups on the inside networks of these addresses, and leave all others.

        These are addresses of the proxy. If the proxy leaves a network and returns, the proxy has
        to join again. The discovery participant announces itself on each new network.
        """
        for address in self._groups.join(addresses):
            self._announce_on(address)

    def note_gateways(self, gateways: frozenset[str]) -> None:
        """Note the gateways of the proxy's default routes."""
        self.domain.settings.gateways = gateways

    def set_peers(self, peers: tuple[HostPort, ...]) -> None:
        """Replace the peers. After a change, announce the discovery participant outside."""
        if peers != self.domain.settings.peers:
            self.domain.settings.peers = peers
            self._send(self.domain.proxy_participants.announced_outside())

    def move_to(self, hosts: tuple[str, ...]) -> None:
        """Announce the range at these addresses of the advertised host from now on."""
        self._send_and_go_on(self.domain.move_to(hosts, self._now()))
        self._send(self.domain.proxy_participants.announced_outside())

    def apply_policy(self) -> None:
        """Start the rediscovery of the participants for which a verdict has changed."""
        self._send_and_go_on(self.domain.apply_policy(self._now()))

    def select(self, addresses: Iterable[str]) -> None:
        """Serve only participants at these addresses from now on."""
        before = self._selected.selected or frozenset()
        self._selected.select(addresses)
        self._release()
        self._announce_to((self._selected.selected or frozenset()) - before)

    @property
    def unselected(self) -> Collection[str]:
        """The addresses inside that have announced participants, but are not selected."""
        return self._selected.held_announcements.keys()

    def note_former(self, former: Mapping[bytes, Sequence[int]]) -> None:
        """Note the ports that participants had at a proxy with another address."""
        self.domain.former_ports.note_recorded(former, self.domain.inside.by_prefix)

    def end(self, addresses: Collection[str]) -> int:
        """End the participants at addresses that are gone. Return the number of participants."""
        count = sum(p.address in addresses for p in self.domain.inside.by_prefix.values())
        self._send_and_go_on(self.domain.end_participants_at(addresses))
        return count

    def retire(self) -> int:
        """End all participants inside, because no proxy takes over.

        Return the number of participants.
        """
        count = len(self.domain.inside.by_prefix)
        self._send_and_go_on(self.domain.retire(self._now()))
        return count

    async def finish(self) -> None:
        """Wait until all datagrams that follow from a change are sent."""
        while self.domain.is_busy:  # noqa: ASYNC110 - each round of the event loop does a part
            await asyncio.sleep(0)

    async def expire(self) -> None:
        """Serve participants that have waited, and end participants that have gone.

        Continue rediscoveries, too.
        """
        self._release()
        self._admit_waiting()
        self._send_and_go_on(self.domain.continue_pending(self._now()))
        # An end goes to all ports of the peers. So the proxy forwards in between.
        while ended := self.domain.expire(self._now()):
            self._send(ended)
            await asyncio.sleep(0)
        self._sync_stand_ins()
        self._report_changes()

    async def announce(self) -> None:
        """Announce the discovery participant to all, and send reminders of ports.

        Hundreds of participants inside take 0.1 s. So the proxy forwards in between.
        """
        for address in self._groups.joined:
            self._announce_on(address)
        await self._send_in_turns(self._announcements_to_inside())
        await self._send_in_turns(self._announcements_at(self._selected.selected or ()))
        await self._send_in_turns(self.domain.proxy_participants.announced_outside())
        await self._send_in_turns(self.domain.proxy_participants.port_reminders(self._now()))
        await self._tell_relay()

    def _announcements_to_inside(self) -> Iterator[Outgoing]:
        """Yield the announcements of the discovery participant to the participants inside."""
        settings = self.domain.settings
        for participant in list(self.domain.inside.by_prefix.values()):
            if participant.metatraffic:
                near = settings.proxy_address_for(participant.address)
                announced = self.domain.proxy_participants.announced_inside(near)
                yield Outgoing(participant.metatraffic, announced)

    async def _send_in_turns(self, outgoing: Iterable[Outgoing]) -> None:
        async for out in in_turns(outgoing, SENT_PER_TURN):
            self._send([out])

    def close(self) -> None:
        """Close all sockets."""
        self._scheduler.close()
        if self._next_part:
            self._next_part.cancel()
        # Only for the discovery participant: the port store has to stay known, because
        # participants use the port store to keep ports.
        dispose_message = self.domain.proxy_participants.discovery_participant.dispose_message()
        for address in self._groups.joined:
            self._multicast(address, dispose_message)
        self._send(self.domain.settings.to_outside(dispose_message))
        self._groups.close()
        for sock in [*self._sockets, *self._stand_ins.values()]:
            self._stop_reading(sock)
        for sock in self._out.values():
            sock.close()

    async def _tell_relay(self) -> None:
        """Send the proven addresses outside to the LAN relay.

        4,096 addresses take 0.1 s. So the proxy forwards after each list.
        """
        if self.domain.settings.relay is None:
            return
        proven = self.domain.proofs.addresses
        outside = (address for address in proven if not self._is_inside(address))
        for listed in address_lists(outside):
            self._send(self.domain.settings.to_lan(listed))
            await asyncio.sleep(0)

    def _admit_waiting(self) -> None:
        """Queue the participants that may get ports now. After a start there are many at once."""
        now = self._now()
        # `FairQueue` may drop the last items of a source without notice: queue them again later.
        admitting = {p: t for p, t in self._admitting.items() if now - t < ADMISSION_TIMEOUT_S}
        self._admitting = admitting
        former_ports = self.domain.former_ports
        for prefix in former_ports.ready(now):
            if prefix in admitting:
                continue
            source, datagram, *_ = former_ports.waiting[prefix]
            standing = self.domain.standing(source)
            admit = partial(self._admit, prefix)
            if self._scheduler.put(source, standing, len(datagram), admit):
                admitting[prefix] = now

    def _admit(self, prefix: bytes) -> list[Outgoing]:
        self._admitting.pop(prefix, None)
        outgoing = self.domain.admit(prefix, self._now())
        self._report_changes()
        self._open_and_send(outgoing)
        return outgoing

    def _release(self) -> None:
        """Read the held announcements of addresses that are admitted now."""
        for source, datagram in self._selected.released(self._now()):
            self._read_in_turn(self._heard_at_well_known, datagram, source, None)

    def _announce_to(self, addresses: Iterable[str]) -> None:
        self._send(self._announcements_at(addresses))

    def _announcements_at(self, addresses: Iterable[str]) -> Iterator[Outgoing]:
        """Yield unicast announcements to addresses that may not get multicast.

        Docker's internal networks pass no multicast if the host filters bridged packets
        (br_netfilter).
        """
        settings = self.domain.settings
        counts = self.domain.inside.count_by_address
        for address in addresses:
            announcement = self.domain.proxy_participants.announced_inside(
                settings.proxy_address_for(address)
            )
            count = counts.get(address, 0)
            # Participants of a machine bind the well-known ports in order (9.6.2.3). So
            # unknown participants are at the next ports.
            targets = settings.well_known(
                address, count + NEXT_PORTS if count else PARTICIPANTS_TRIED
            )
            for target in targets:
                yield Outgoing(target, announcement)

    def _announce_on(self, near: str) -> None:
        self._multicast(near, self.domain.proxy_participants.announced_inside(near))

    def _multicast(self, near: str, datagram: bytes) -> None:
        """Send a datagram to the groups on the network of an address of the proxy."""
        try:
            # The network is a setting of the socket, and the same socket sends to all networks.
            send_through(self._out[family_of(near)], near, loop=False)
        except OSError as error:
            log.debug("can't send multicast from %s, its network may have gone: %s", near, error)
            return
        port = self.domain.settings.multicast_port
        self._send(Outgoing(HostPort(group, port), datagram) for group in groups_of(near))

    def _read_group(self, sock: socket.socket) -> None:
        self._begin_reading(sock, self._heard_in_group, self._must_queue_inside)

    def _begin_reading(self, sock: socket.socket, take: Take, must_queue: MustQueue) -> None:
        self.buffers.sockets.add(sock)
        self._loop.add_reader(sock, self._take_in, sock, take, must_queue)

    def _stop_reading(self, sock: socket.socket) -> None:
        self._loop.remove_reader(sock)
        self.buffers.remove(sock)
        sock.close()

    def _read(self, sock: socket.socket, take: Take, must_queue: MustQueue) -> None:
        self._sockets.append(sock)
        self._begin_reading(sock, take, must_queue)

    def _must_queue_inside(self, datagram: bytes, source: str) -> bool:
        if self._is_at_relay(source):
            return False
        return self._is_inside(source) and self.domain.must_queue_inside(datagram, source)

    def _must_queue_discovery(self, datagram: bytes, source: str) -> bool:
        is_own = self._secret and datagram == self._secret
        return not is_own and self.domain.must_queue_discovery(datagram, source)

    def _heard_at_well_known(
        self, datagram: bytes, source: str, now: float, _: int
    ) -> list[Outgoing]:
        if not self._is_let_in(datagram, source, now):
            return []
        return self.domain.heard_inside(datagram, source, now)

    def _heard_in_group(self, datagram: bytes, source: str, now: float, _: int) -> list[Outgoing]:
        if not self._is_let_in(datagram, source, now):
            return []
        sent = self.domain.heard_inside(datagram, source, now)
        # After `heard_inside`, which adds new participants to the table.
        self.domain.inside.note_in_group(datagram, source)
        return sent

    def _is_let_in(self, datagram: bytes, source: str, now: float) -> bool:
        """Return whether the proxy handles discovery from a source now; False for outside.

        If an address inside is not selected, hold announcements from there, because the operator
        may select the address soon.
        """
        if not self._is_inside(source) or self._is_at_relay(source):
            return False
        if self._selected.admits(source, now):
            return True
        standing = self.domain.standing(source)
        if self.domain.rates.take(source, len(datagram), now, standing):
            with contextlib.suppress(RtpsError):
                for message in read_messages(datagram):
                    if message.of_participant is not None:
                        self._selected.hold(source, message.datagram)
        return False

    def _is_at_relay(self, source: str) -> bool:
        """Whether an address is that of the LAN relay, whose machine is outside.

        A participant there announces itself on all networks of its machine: also on the inside
        network, and often there first. As a participant inside, it would get no data from inside.
        """
        relay = self.domain.settings.relay
        return relay is not None and source == relay.address.host

    def _at_discovery(
        self, datagram: bytes, source: str, now: float, received: int
    ) -> list[Outgoing]:
        if self._secret and datagram == self._secret:
            self._heard.set()
            return []
        return self.domain.heard_outside(datagram, source, now, received)

    def _at_stand_in(
        self, port: int, datagram: bytes, source: str, now: float, _: int
    ) -> list[Outgoing]:
        return self.domain.at_stand_in(port, datagram, source, now)

    def _take_in(self, sock: socket.socket, take: Take, must_queue: MustQueue) -> None:
        """Receive the datagrams at a socket: queue discovery, and pass all others at once.

        A turn ends after `DATAGRAMS_PER_TURN`, or after half the bytes of the longest datagram.
        Then other sockets follow. A queued datagram counts less (`QUEUED_PER_PASSED`). A datagram
        that leads to many counts as many: an answer that proves an address lets the proxy announce
        16 participants to all of inside.
        """
        spent_bytes = spent = 0.0
        with contextlib.suppress(BlockingIOError):
            while spent < DATAGRAMS_PER_TURN and spent_bytes < LARGEST_DATAGRAM // 2:
                try:
                    datagram, sender = sock.recvfrom(LARGEST_DATAGRAM)
                except ConnectionRefusedError:
                    spent += 1
                    continue
                source = plain_address(sender[0])
                key = self._replaceable_as(take, datagram, source)
                if self._replaces(key, take, datagram, source):
                    weight = 1 / QUEUED_PER_PASSED
                elif must_queue(datagram, source):
                    weight = 1 / QUEUED_PER_PASSED
                    self._read_in_turn(take, datagram, source, key)
                else:
                    sent = self._carry_out(take, datagram, source, len(datagram))
                    weight = max(len(sent), 1.0)
                spent += weight
                spent_bytes += weight * len(datagram)

    def _replaceable_as(self, take: Take, datagram: bytes, source: str) -> Hashable:
        """The key of a datagram in the queue, if a later datagram may replace it; else None.

        Fast DDS repeats a heartbeat 25 times a second until the reader has answered. If the proxy
        is slow, repeated heartbeats would leave no room for the announced samples. So only the last
        heartbeat of a stream waits.
        """
        stream = heartbeat_stream(datagram) if self._scheduler.is_behind else None
        return (take, source, stream) if stream else None

    def _replaces(self, key: Hashable, take: Take, datagram: bytes, source: str) -> bool:
        """Replace the waiting datagram with a key by a later one. Return False if none waits."""
        if key is None:
            return False
        read = partial(self._carry_out, take, datagram, source, len(datagram))
        return self._scheduler.replace(key, read)

    def _read_in_turn(self, take: Take, datagram: bytes, source: str, key: Hashable) -> None:
        """Queue a datagram of discovery, or handle the datagram at once if no datagram waits."""
        heard_at = self.domain.source_of(datagram, source)
        standing = self.domain.standing(heard_at)
        left = len(datagram)
        for message in _parts(datagram):
            received = min(len(message), left)  # together, the messages may be longer
            left -= received
            read = partial(self._carry_out, take, message, source, received)
            if not self._scheduler.read(heard_at, standing, len(message), read, key):
                text = "the queue of discovery that the proxy has not read yet is full"
                self.domain.refused("rate", heard_at, text)

    def _carry_out(self, take: Take, datagram: bytes, source: str, received: int) -> list[Outgoing]:
        """Handle a datagram. Send and return the resulting datagrams."""
        outgoing = take(datagram, source, self._now(), received)
        self._report_changes()
        self._open_and_send(outgoing)
        return outgoing

    def _open_and_send(self, outgoing: Iterable[Outgoing]) -> None:
        """Open new stand-ins, and then send datagrams that may name the new stand-ins.

        Datagrams that name a stand-in that can't be opened are not sent, because inside would keep
        a wrong locator for good. The announcement from outside will come again.
        """
        closed = self._sync_stand_ins()
        self._send(out for out in outgoing if not (closed and self._names_any(closed, out)))

    def _send_and_go_on(self, outgoing: Iterable[Outgoing]) -> None:
        """Send the first datagrams that follow from a change, and the rest in later rounds."""
        self._open_and_send(outgoing)
        if self.domain.is_busy and self._next_part is None:
            self._next_part = self._loop.call_soon(self._go_on)

    def _go_on(self) -> None:
        self._next_part = None
        self._send_and_go_on(self.domain.go_on(self._now()))

    def _names_any(self, ports: Iterable[int], out: Outgoing) -> bool:
        """Whether a datagram has a locator with any of these ports of the proxy."""
        near = self.domain.settings.proxy_address_for(out.target.host)
        locators = (pack_locator(HostPort(near, p), order) for p in ports for order in "<>")
        return any(locator in out.datagram for locator in locators)

    def _send(self, outgoing: Iterable[Outgoing]) -> None:
        for out in outgoing:
            try:
                self._out[family_of(out.target.host)].sendto(
                    out.datagram, (out.target.host, out.target.port)
                )
            except OSError as error:
                self.lost += 1
                log.debug("can't send a datagram to %s: %s", out.target, error)

    def _report_changes(self) -> None:
        """Call ``changed`` if the port mappings have changed."""
        changes = self.domain.mappings.changes
        if changes != self._reported_changes:
            self._reported_changes = changes
            self._changed()

    def _sync_stand_ins(self) -> list[int]:
        """Open and close the sockets of stand-ins. Return the ports that can't be opened."""
        stand_ins = self.domain.stand_ins
        closed = list[int]()
        if stand_ins.changes == self._synced_changes:
            return closed
        self._synced_changes = stand_ins.changes
        wanted = stand_ins.by_port
        for port in self._stand_ins.keys() - wanted.keys():
            self._stop_reading(self._stand_ins.pop(port))
        for port in wanted.keys() - self._stand_ins.keys():
            try:
                sock = datagrams.bind(self._bind, port)
            except OSError as error:
                log.debug("port %d can't be opened as a stand-in: %s", port, error)
                stand_ins.block(port, error.errno == errno.EADDRINUSE)
                closed.append(port)
                continue
            self._stand_ins[port] = sock
            take = partial(self._at_stand_in, port)
            must_queue = partial(self.domain.must_queue_at_stand_in, port)
            self._begin_reading(sock, take, must_queue)
        return closed


def _parts(datagram: bytes) -> list[bytes]:
    """The parts of a datagram that wait one by one.

    These are the messages of each participant, since each announcement may go to hundreds of
    participants. An acknowledgement or a heartbeat goes to one. So a datagram with nothing else
    waits as a whole: apart, 50 participants of Cyclone DDS in a process would fill the queue.
    """
    parts = by_source_if_sound(datagram)
    return [datagram] if len(parts) > 1 and only_acknowledges(datagram) else parts


def _families(bind: str) -> list[socket.AddressFamily]:
    """The families of the datagrams that arrive at a socket bound to an address."""
    return [socket.AF_INET, socket.AF_INET6] if bind == "::" else [family_of(bind)]


def _sending_socket(family: socket.AddressFamily) -> socket.socket:
    sock = socket.socket(family, socket.SOCK_DGRAM)
    sock.setblocking(False)
    with contextlib.suppress(OSError):
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, UDP_RECEIVE_BUFFER_BYTES)
    return sock
