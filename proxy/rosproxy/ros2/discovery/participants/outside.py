"""The participants outside, and the ports that stand for their locators inside.

Their discovery passes the proxy always: its locators are led to *stand-ins*, ports of the proxy's
that those inside reach. What users send goes there directly, unless the direction is both: then the
locators of user data are led to stand-ins as well, and inside needs no route. Of several addresses
inside gets the one that a participant was heard from. Each machine has others that mean another one
inside: those of its own container networks may be the very gateway of the reader's.
"""

from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from math import inf

from rosproxy.net.addresses import HostPort, is_loopback, is_of_link, subnet
from rosproxy.ros2.discovery.participants.places import fairer_place, oldest_unproven, surplus
from rosproxy.ros2.domain_settings import (
    MOST_AT_PEERS,
    MOST_INTRODUCED_UNPROVEN,
    MOST_OUTSIDE,
    MOST_OUTSIDE_UNPROVEN,
    MOST_PER_HOST,
    MOST_PER_UNPROVEN,
    MOST_TRIED,
    NEXT_PORTS,
    DomainSettings,
    Outgoing,
    Refused,
    sent_to,
)
from rosproxy.ros2.policy.verdicts import Verdicts
from rosproxy.ros2.ports.stand_ins import LocatorStandIns
from rosproxy.ros2.protocol.addressing import is_destination
from rosproxy.ros2.protocol.announcement import dispose_message
from rosproxy.ros2.protocol.parameters import Pid
from rosproxy.ros2.protocol.rtps import source_vendor
from rosproxy.ros2.registry.participants import (
    InsideParticipant,
    OutsideParticipant,
    ParticipantTable,
    TrafficKind,
)
from rosproxy.ros2.rewriting.announced_participant import (
    first_metatraffic,
    lease_duration,
    note_endpoints,
    traits,
)
from rosproxy.ros2.rewriting.discovery import (
    DiscoveryMessage,
    participant_alone,
    read_discovery,
    require_rewritable,
    rewritten,
)
from rosproxy.ros2.sources.address_proofs import AddressProofs

HIDDEN_SOURCE = (
    "this address is the gateway of the proxy's own network: the engine forwards datagrams from "
    "outside with this address, so the proxy does not know the real sender"
)
DISPOSE_MESSAGE_INTERVAL = 2.0
"""Seconds after which a participant inside is told again to forget one outside, until they meet."""


@dataclass(slots=True)
class OutsideParticipants(ParticipantTable[OutsideParticipant]):
    """The participants outside, with their stand-ins."""

    settings: DomainSettings
    stand_ins: LocatorStandIns
    refused: Refused
    proofs: AddressProofs
    verdicts: Verdicts

    def meet(self, message: DiscoveryMessage, source: str, now: float) -> OutsideParticipant | None:
        """The participant that announces itself or its end at an address; None if not accepted.

        Raises RtpsError.
        """
        require_rewritable(message)
        prefix = message.prefix
        datagram = message.datagram
        spdp = message.of_participant
        participant = self.find(prefix, source)
        if spdp is None or spdp.ended or (participant is None and prefix in self.by_prefix):
            if participant is not None:
                # Its end: `introduced` tells inside of it as of any announcement.
                self._keep(participant, message)
            return participant
        metatraffic = first_metatraffic(spdp, datagram, source)
        if metatraffic is None:
            fault = traits(spdp, datagram, source).locator_fault
            text = f"the participant announces no locator for discovery at {source} ({fault})"
            self.refused("no_locator", source, text)
            return None
        if self.stand_ins.is_own_port(metatraffic):
            text = (
                f"the participant announces {metatraffic} for discovery, a port of the proxy itself"
            )
            self.refused("own_port", source, text)
            return None
        participant = participant or self._add(prefix, datagram, source, now)
        if participant is not None:
            participant.heard_at = now
            participant.until = now + lease_duration(spdp, datagram)
            participant.metatraffic = metatraffic
            self._keep(participant, message)
            participant.traits = traits(spdp, datagram, source)
        return participant

    def claimant(
        self, message: DiscoveryMessage, source: str, received: int, now: float
    ) -> OutsideParticipant | None:
        """A participant that announces itself with a prefix that inside uses, which is not added.

        There is none if the message is an end, or leads to the proxy itself, as one that the LAN
        relay hears of its own. ``received`` is how many bytes came. Raises RtpsError.
        """
        require_rewritable(message)
        spdp = message.of_participant
        if spdp is None or spdp.ended:
            return None
        metatraffic = first_metatraffic(spdp, message.datagram, source)
        if metatraffic is None or self.stand_ins.is_own_port(metatraffic):
            return None
        claimant = OutsideParticipant(
            message.prefix, source, source_vendor(message.datagram), now, metatraffic=metatraffic
        )
        claimant.proven = self.proofs.has(source)
        claimant.credit = received
        return claimant

    def imported(
        self, outsider: OutsideParticipant, insider: InsideParticipant, message: DiscoveryMessage
    ) -> bytes:
        """A message of discovery as a participant inside gets it. Raises RtpsError."""
        note_endpoints(self.notes, outsider, message.datagram, message.announcements)
        return self._imported(outsider, insider, message)

    def observed(self, outsider: OutsideParticipant, message: DiscoveryMessage) -> bytes:
        """Note what one outside tells the proxy itself: what it has, and where. RtpsError."""
        note_endpoints(self.notes, outsider, message.datagram, message.announcements)
        # The discovery participant alone gets this: it is rewritten to open the stand-ins. Nothing
        # is hidden, since the discovery participant would ask for that again and again.
        near = self.settings.proxy_address_for(outsider.address)
        lead = self._leading_in(outsider, near, message)
        return rewritten(message, lead, lambda _: False)

    def introduced(
        self,
        outside: Iterable[OutsideParticipant],
        inside: Collection[InsideParticipant],
        now: float,
    ) -> list[Outgoing]:
        """The announcements of participants outside for some inside, as far as these may know."""
        sent = list[Outgoing]()
        by_near = dict[str, list[InsideParticipant]]()
        for insider in inside:
            if insider.metatraffic and not insider.is_apart:
                near = self.settings.proxy_address_for(insider.address)
                by_near.setdefault(near, []).append(insider)
        for outsider in filter(self.may_introduce, outside):
            for near, told in by_near.items():
                datagram = self._introduction(outsider, near)
                for insider in told:
                    sent += self.dispose_message_to(outsider, insider, now)
                    sent += sent_to(insider.metatraffic, [datagram])
        return sent

    def prove(self, address: str) -> tuple[list[OutsideParticipant], list[OutsideParticipant]]:
        """Note that an address has proved to receive.

        Return the participants that inside has to be told of, and those that end for them.
        """
        for outsider in self.at(address):
            outsider.proven = True
        ended = surplus(self._proven_strangers(), MOST_OUTSIDE, subnet)
        told = [p for p in self.at(address) if not p.is_introduced and p not in ended]
        return told, ended

    def may_introduce(self, outsider: OutsideParticipant) -> bool:
        """Whether inside is told of a participant.

        Where many have not proved to receive, inside is told of no more of these: a forger may have
        made them up, and each participant inside would remember all of them.
        """
        if not outsider.is_introduced:
            outsider.is_introduced = (
                outsider.is_known or len(self._unproven_strangers()) <= MOST_INTRODUCED_UNPROVEN
            )
        return outsider.is_introduced

    def dispose_message_to(
        self, outsider: OutsideParticipant, insider: InsideParticipant, now: float
    ) -> list[Outgoing]:
        """What makes one inside forget one outside, if it has to and was not told just now."""
        if (
            insider.dispose_message_times is None
            or now - insider.dispose_message_times.get(outsider.prefix, -inf)
            < DISPOSE_MESSAGE_INTERVAL
        ):
            return []
        insider.dispose_message_times[outsider.prefix] = now
        datagram = dispose_message(outsider.prefix, outsider.vendor, outsider.next_number)
        return sent_to(insider.metatraffic, [datagram])

    def to_met(self, datagram: bytes) -> list[Outgoing]:
        """An announcement of a participant inside, after the first, for all outside.

        Of a peer without a port it goes where participants of the peer receive discovery, and to
        the next well-known ports, which participants take one after the other (DDSI-RTPS 2.5,
        9.6.2.3). The discovery participant announces itself to all ports of peers, so participants
        at other ports are met nevertheless. As long as no participant of a peer is known, all its
        well-known ports are used.
        """
        sent = self.settings.to_lan(datagram)
        for peer in self.settings.peers:
            count = self.count_by_address[peer.host]
            if peer.port:
                targets = [peer]
            elif not count:
                targets = self.settings.well_known_of_peer(peer.host)
            else:
                targets = self._met_at(peer.host, count)
            sent += [Outgoing(target, datagram) for target in targets]
        return sent

    def _met_at(self, host: str, count: int) -> list[HostPort]:
        met = (p.metatraffic for p in self.by_prefix.values() if p.address == host)
        next_ports = self.settings.well_known(host, min(count + NEXT_PORTS, MOST_TRIED))
        return list(dict.fromkeys([*next_ports, *filter(None, met)]))

    def is_met(self, source: str) -> bool:
        """Whether a participant is known at an address, or it is a peer's."""
        return source in self.count_by_address or self.settings.is_peer(source)

    def is_strange(self, source: str) -> bool:
        """Whether nothing from an address is read, since no participant is known there."""
        if self.is_met(source):
            return False
        text = "the address is not a peer, and no participant there has announced itself"
        self.refuse_stranger(source, text)
        return True

    def refuse_stranger(self, source: str, text: str) -> None:
        """Refuse discovery from an address of which the proxy does not know a participant.

        Docker's userland proxy and RootlessKit's port driver `builtin` send datagrams on with the
        address of the network's gateway.
        """
        if source in self.settings.gateways:
            self.refused("hidden_source", source, HIDDEN_SOURCE)
        else:
            self.refused("not_a_peer", source, text)

    def may_announce(self, message: DiscoveryMessage, source: str, asked_by: bytes) -> bool:
        """Whether a participant outside may announce itself to the proxy directly.

        A message that names ``asked_by``, the GUID prefix of the discovery participant, answers its
        announcement, which goes to peers and the LAN relay alone.
        """
        is_met = self.find(message.prefix, source) is not None
        is_named = is_destination(message.datagram, asked_by)
        return is_met or is_named or self.settings.is_peer(source)

    def allowed_questions(
        self, outsider: OutsideParticipant, questions: Iterable[bytes]
    ) -> list[Outgoing]:
        """Questions to a participant about its discovery, as many as it may be sent."""
        target = outsider.metatraffic
        allowed = [q for q in questions if target and outsider.may_be_sent(len(q))]
        return [Outgoing(target, question) for question in allowed] if target else []

    def forget(self, participant: OutsideParticipant) -> None:
        """Forget a participant that has gone."""
        self.remove(participant)
        self.stand_ins.close(participant)

    def gives_place(self, source: str) -> OutsideParticipant | None:
        """The participant that ends for a new one at an address; None if there is none.

        Either there is room without, or the new one gets no place.
        """
        if self.settings.is_peer(source) or self._is_full(source):
            return None
        if self.proofs.has(source):
            return fairer_place(self._proven_strangers(), MOST_OUTSIDE, source, subnet)
        return oldest_unproven(self._unproven_strangers(), MOST_OUTSIDE_UNPROVEN)

    def _why_no_place(self, source: str) -> str:
        """Why a new participant at an address gets no place; empty if it gets one."""
        if self._is_full(source):
            return f"the address already has {self.count_by_address[source]} participants"
        if self.settings.is_peer(source):
            most = MOST_AT_PEERS
            present = [p for p in self.by_prefix.values() if p.trusted]
        elif self.proofs.has(source):
            most = MOST_OUTSIDE
            present = self._proven_strangers()
        else:
            most = MOST_OUTSIDE_UNPROVEN
            present = self._unproven_strangers()
        return f"the proxy already has {most} participants outside" if len(present) >= most else ""

    def _is_full(self, source: str) -> bool:
        """Whether an address has as many participants as it may."""
        is_proven = self.settings.is_peer(source) or self.proofs.has(source)
        return self.count_by_address[source] >= (MOST_PER_HOST if is_proven else MOST_PER_UNPROVEN)

    def _proven_strangers(self) -> list[OutsideParticipant]:
        return [p for p in self.by_prefix.values() if p.proven and not p.trusted]

    def _unproven_strangers(self) -> list[OutsideParticipant]:
        return [p for p in self.by_prefix.values() if not p.proven and not p.trusted]

    def _add(
        self, prefix: bytes, datagram: bytes, source: str, now: float
    ) -> OutsideParticipant | None:
        if reason := self._why_no_place(source):
            self.refused("participants", source, reason)
            return None
        outsider = OutsideParticipant(prefix, source, source_vendor(datagram), now)
        outsider.met_at = now
        outsider.trusted = self.settings.is_peer(source)
        outsider.proven = self.proofs.has(source)
        self.add(outsider)
        self.settings.settled(source)
        return outsider

    def _imported(
        self, outsider: OutsideParticipant, insider: InsideParticipant, message: DiscoveryMessage
    ) -> bytes:
        """A message as a participant inside gets it, without what the policy denies. RtpsError."""
        return rewritten(
            message,
            self._leading_in(outsider, self.settings.proxy_address_for(insider.address), message),
            lambda a: self.verdicts.is_hidden(insider, a, message.datagram, is_own=False),
        )

    def _keep(self, outsider: OutsideParticipant, message: DiscoveryMessage) -> None:
        """Keep what a participant announces of itself, for those inside that come later."""
        announcement = participant_alone(message)
        if announcement != outsider.announcement:
            outsider.announcement = announcement
            outsider.introduction = None
        if message.of_participant is not None:
            outsider.next_number = message.of_participant.sample.sequence + 1

    def _introduction(self, outsider: OutsideParticipant, near: str) -> bytes:
        """The announcement of a participant for those that reach the proxy at ``near``. RtpsError.

        It is made once for all of them: with many parameters that takes a millisecond.
        """
        if outsider.introduction is None or outsider.introduction[0] != near:
            message = read_discovery(outsider.announcement)
            lead = self._leading_in(outsider, near, message)
            outsider.introduction = near, rewritten(message, lead, lambda _: False)
        return outsider.introduction[1]

    def _leading_in(
        self, outsider: OutsideParticipant, near: str, message: DiscoveryMessage
    ) -> Callable[[int, HostPort], HostPort | None]:
        hosts = set(_user_hosts(message))
        return partial(self._lead_in, outsider, near, outsider.address in hosts)

    def _lead_in(
        self,
        outsider: OutsideParticipant,
        near: str,
        only_heard: bool,
        pid: int,
        locator: HostPort,
    ) -> HostPort | None:
        """Where inside reaches a locator of a participant outside; None if it does not."""
        if pid == Pid.METATRAFFIC_UNICAST_LOCATOR:
            # Whichever locator it is, discovery goes to the one at the address that it sends from.
            mapping = outsider.metatraffic and self.stand_ins.open(
                outsider, outsider.metatraffic, TrafficKind.METATRAFFIC
            )
        elif not self.settings.both_ways:
            return None if _leads_elsewhere(outsider, near, only_heard, locator) else locator
        else:
            is_led = locator.host == outsider.address and not self.stand_ins.is_own_port(locator)
            mapping = (
                self.stand_ins.open(outsider, locator, TrafficKind.USER_DATA) if is_led else None
            )
        return HostPort(near, mapping.port) if mapping else None


def _user_hosts(message: DiscoveryMessage) -> Iterator[str]:
    """The hosts at which a message says that users' data is received."""
    for announcement in message.announcements:
        for pid, locator in announcement.reached_at(message.datagram):
            if pid != Pid.METATRAFFIC_UNICAST_LOCATOR:
                yield locator.host


def _leads_elsewhere(
    outsider: OutsideParticipant, near: str, only_heard: bool, locator: HostPort
) -> bool:
    """Whether a locator may mean somebody else where inside reaches the proxy at ``near``.

    ``only_heard``: the message has a locator at the address that its participant was heard from.
    Without one it is behind NAT, as it seems, and may be reached by those that it has. So it may be
    by those of the other family, in which it was not heard.
    """
    heard = outsider.address
    host = locator.host
    if only_heard and (":" in host) == (":" in heard) and host != heard:
        return True
    # These addresses mean the reader's own machine or link, unless all is on one machine.
    is_same_host = is_loopback(near) and is_loopback(heard)
    return not is_same_host and (is_loopback(host) or is_of_link(host))
