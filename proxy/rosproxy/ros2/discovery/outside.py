"""The participants outside, and the ports that stand for their locators inside.

Their discovery passes the proxy always: its locators are led to *stand-ins*, ports of the proxy's
that those inside reach. What users send goes there directly, unless the direction is both: then the
locators of user data are led to stand-ins as well, and inside needs no route.
"""

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field
from functools import partial
from math import inf

from rosproxy.net.addresses import HostPort, is_loopback, is_of_link
from rosproxy.ros2.discovery.announced import (
    first_metatraffic,
    lease_duration,
    next_number,
    note_endpoints,
    traits,
)
from rosproxy.ros2.discovery.domain_settings import (
    MOST_LEASES,
    MOST_OUTSIDE,
    MOST_PER_HOST,
    DomainSettings,
    Outgoing,
    Refused,
    sent_to,
)
from rosproxy.ros2.discovery.policing import is_hidden
from rosproxy.ros2.protocol.announcement import farewell
from rosproxy.ros2.protocol.parameters import Pid
from rosproxy.ros2.protocol.rtps import destination, for_all, source_vendor
from rosproxy.ros2.registry.participants import (
    InsideParticipant,
    Lease,
    LeaseKind,
    OutsideParticipant,
    ParticipantTable,
)
from rosproxy.ros2.registry.ports import stand_in_port
from rosproxy.ros2.rewriting.discovery import (
    DiscoveryMessage,
    read_discovery,
    rewritten,
)

PARTED_AGAIN = 2.0
"""Seconds after which one inside that has not met one outside anew is told again to forget it."""


@dataclass(slots=True)
class OutsideParticipants(ParticipantTable[OutsideParticipant]):
    """Those outside; ``stand_ins`` by port, each with whom it leads to.

    ``blocked`` are ports that other programs hold. ``changes`` counts those of ``stand_ins``.
    """

    settings: DomainSettings
    refused: Refused
    stand_ins: dict[int, list[tuple[OutsideParticipant, Lease]]] = field(default_factory=dict)
    blocked: set[int] = field(default_factory=set)
    changes: int = 0

    def meet(self, message: DiscoveryMessage, source: str, now: float) -> OutsideParticipant | None:
        """The participant that announces itself from an address, or its end; None if it is none."""
        prefix, datagram, told = message.prefix, message.datagram, message.of_participant
        known = self.at(prefix, source)
        if told is None or told.ended or (known is None and prefix in self.by_prefix):
            if known is not None:
                known.announcement = for_all(datagram)
            return known
        reached = first_metatraffic(told, datagram, source)
        if reached is None:
            fault = traits(told, datagram, source).locator_fault
            text = f"it names no locator of metatraffic at {source} ({fault})"
            self.refused("no_locator", source, text)
            return None
        known = known or self._add(prefix, datagram, source, now)
        if known is not None:
            known.until = now + lease_duration(told, datagram)
            known.metatraffic, known.announcement = reached, for_all(datagram)
            known.traits = traits(told, datagram, source)
        return known

    def imported(
        self, there: OutsideParticipant, inside: InsideParticipant, message: DiscoveryMessage
    ) -> bytes:
        """A message of discovery as one inside gets it. Raises RtpsError."""
        note_endpoints(self.notes, there, message.datagram, message.announcements)
        return self._as_told(there, inside, message)

    def observed(self, there: OutsideParticipant, message: DiscoveryMessage) -> bytes:
        """Take in what one outside tells the proxy itself: what it has, and where. RtpsError."""
        note_endpoints(self.notes, there, message.datagram, message.announcements)
        return rewritten(message, self._leading_in(there, there.address), lambda _: False)

    def introduced(
        self,
        outside: Iterable[OutsideParticipant],
        inside: Collection[InsideParticipant],
        now: float,
    ) -> list[Outgoing]:
        """The announcements of participants outside for some inside."""
        sent = list[Outgoing]()
        for there in outside:
            message = read_discovery(there.announcement)
            for one in inside:
                if one.metatraffic and not one.is_apart:
                    sent += self.parting(there, one, now)
                    sent.append(Outgoing(one.metatraffic, self._as_told(there, one, message)))
        return sent

    def parting(
        self, there: OutsideParticipant, one: InsideParticipant, now: float
    ) -> list[Outgoing]:
        """What has one inside forget one outside, if it has to and was not told just now."""
        if one.parted is None or now - one.parted.get(there.prefix, -inf) < PARTED_AGAIN:
            return []
        one.parted[there.prefix] = now
        told = farewell(there.prefix, there.vendor, next_number(there.announcement))
        return sent_to(one.metatraffic, [told])

    def is_strange(self, source: str) -> bool:
        """Whether nobody is known at an address, so that nothing from there is read."""
        if source in self.here or self.settings.is_peer(source):
            return False
        self.refused("not_a_peer", source, "it is no peer's address, and nobody was heard there")
        return True

    def may_announce(self, message: DiscoveryMessage, source: str, observer: bytes) -> bool:
        """Whether one outside may announce itself to the proxy directly.

        Who names the ``observer`` has heard it, whose prefix is told to peers and by the ear alone.
        """
        known = self.at(message.prefix, source) is not None
        return known or destination(message.datagram) == observer or self.settings.is_peer(source)

    def asked(self, there: OutsideParticipant, questions: Iterable[bytes]) -> list[Outgoing]:
        """Questions to a participant about its discovery, as many as it may be sent."""
        to = there.metatraffic
        may = [one for one in questions if to and there.may_be_sent(len(one))]
        return [Outgoing(to, one) for one in may] if to else []

    def forget(self, participant: OutsideParticipant) -> None:
        """Forget one that has gone."""
        self.remove(participant)
        for where in list(participant.leases):
            self._close(participant, where)

    def block(self, port: int, for_good: bool = True) -> None:
        """Note that a port can't be had; who had it gets one by the next announcement.

        It is another one if this is ``for_good``, not where the process has no more sockets.
        """
        if for_good:
            self.blocked.add(port)
        for participant, lease in list(self.stand_ins.get(port, ())):
            self._close(participant, lease.where)

    def _add(
        self, prefix: bytes, datagram: bytes, source: str, now: float
    ) -> OutsideParticipant | None:
        if self.here[source] >= MOST_PER_HOST or len(self.by_prefix) >= MOST_OUTSIDE:
            text = f"more than {MOST_PER_HOST} participants there, or {MOST_OUTSIDE} outside in all"
            self.refused("participants", source, text)
            return None
        there = OutsideParticipant(prefix, source, source_vendor(datagram), now)
        there.proven = self.settings.is_peer(source)
        self.add(there)
        return there

    def _as_told(
        self, there: OutsideParticipant, inside: InsideParticipant, message: DiscoveryMessage
    ) -> bytes:
        """A message as one inside gets it, without what the policy denies. Raises RtpsError."""
        judge = self.settings.judge
        return rewritten(
            message,
            self._leading_in(there, inside.address),
            lambda told: is_hidden(judge, inside, told, message.datagram, is_own=False),
        )

    def _leading_in(
        self, there: OutsideParticipant, inside: str
    ) -> Callable[[int, HostPort], HostPort | None]:
        return partial(self._lead_in, there, self.settings.near(inside))

    def _lead_in(
        self, there: OutsideParticipant, near: str, pid: int, where: HostPort
    ) -> HostPort | None:
        """Where inside reaches a locator of a participant outside; None if it does not."""
        if pid == Pid.METATRAFFIC_UNICAST_LOCATOR:
            lease = there.metatraffic and self._lease(
                there, there.metatraffic, LeaseKind.METATRAFFIC
            )
        elif not self.settings.both_ways:
            all_here = is_loopback(near) and is_loopback(there.address)
            elsewhere = is_loopback(where.host) or is_of_link(where.host)
            return where if all_here or not elsewhere else None
        else:
            at_home = where.host == there.address
            lease = self._lease(there, where, LeaseKind.DATA) if at_home else None
        return HostPort(near, lease.port) if lease else None

    def _lease(self, there: OutsideParticipant, where: HostPort, kind: LeaseKind) -> Lease | None:
        """The stand-in for a locator, which is opened if there is none; None if there are too many.

        Where Cyclone DDS has one locator for both, it is one of metatraffic, whoever comes first.
        """
        lease = there.leases.get(where)
        if lease is None and len(there.leases) < MOST_LEASES:
            port = stand_in_port(f"{there.prefix.hex()} {where}", self._users, self._is_held)
            if port is not None:
                lease = there.leases[where] = Lease(port, where, kind)
                self.stand_ins.setdefault(port, []).append((there, lease))
                self.changes += 1
        if lease is None:
            text = f"no port can stand in for {where} of {there.guid_prefix}"
            self.refused("stand_ins", there.address, text)
        elif kind is LeaseKind.METATRAFFIC:
            lease.kind = kind
        return lease

    def _users(self, port: int) -> int:
        return len(self.stand_ins.get(port, ()))

    def _is_held(self, port: int) -> bool:
        return port in self.blocked or port in self.settings.ports.listen

    def _close(self, participant: OutsideParticipant, where: HostPort) -> None:
        lease = participant.leases.pop(where)
        left = [one for one in self.stand_ins.pop(lease.port) if one[1] is not lease]
        if left:
            self.stand_ins[lease.port] = left
        self.changes += 1
