"""A DDS domain: what the proxy does with each datagram of discovery, and as time passes.

Participants inside announce themselves (SPDP) to a multicast group, or to the proxy's well-known
port if ROS_STATIC_PEERS names the proxy. The proxy maps a port of the range to each of their
locators (`PortMappings`), and announces the participants to outside with these ports
(`AnnouncementsToOutside`). An announcement that outside sends to a port for metatraffic goes on to
the participant inside, with a *stand-in* in place of the locator for metatraffic
(`AnnouncementsToInside`). So all discovery goes through the proxy, in both directions, and the
proxy can rewrite all of it.

User data to inside goes through the range. User data to outside goes directly or, with
``--direction both``, through stand-ins. The proxy forwards user data unread, with two exceptions:
some implementations act on discovery that arrives at a port for user data. So the proxy also reads
discovery at such a port (`Participant.reads_discovery_at`). And samples of ``ros_discovery_info``
name the nodes of a participant (`NodeNames`).

This module does no I/O: methods that handle a datagram or the passing of time return the datagrams
to send. After each call, `stand_ins` has the ports of stand-ins that have to be open.

Each datagram may be forged. So these rules hold:

- A participant inside has an address inside. Only locators at this address get a port: no
  announcement makes the proxy a way to another host.
- The proxy refuses a participant with the GUID prefix of a participant at another address, or on
  the other side (`PrefixOwners` has the exceptions).
- The proxy accepts a participant outside in three cases: its address is that of a peer, the LAN
  relay has heard it, or it answers the discovery participant. In the third case, another
  participant must be known at the same address. The proxy sends only to locators at the
  participant's own address.
- A proof with a shared secret identifies the LAN relay. The address that the relay states for a
  participant must neither be inside nor belong to the proxy.
- Until the address of a participant outside is proven, the proxy sends the participant no more
  bytes than came from it. After the participant has named the discovery participant or one inside
  as the destination of a message, the proxy may send ANSWERED_FACTOR times as many
  (`OutsideParticipant`). Only an answer to a *question* of the proxy proves the address: the
  question has a secret GUID prefix, and the answer names this prefix (`AddressProofs`). So no
  sender can make the proxy flood another machine.
- Each source has an allowance for discovery. At the discovery port and inside, the charge includes
  the datagrams that the proxy sends in consequence. At range ports and stand-ins, the proxy charges
  only the received datagram. The first answer of a participant to a question takes no allowance:
  the proxy charges only the datagrams that it sends in consequence.
"""

from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from functools import partial
from itertools import islice

from msgspec.structs import replace

from rosproxy.ros2.discovery.announcements.to_inside import AnnouncementsToInside, ForInside
from rosproxy.ros2.discovery.announcements.to_outside import AnnouncementsToOutside, ForOutside
from rosproxy.ros2.discovery.discovery_participant import DiscoveryParticipant
from rosproxy.ros2.discovery.disposal import Disposal
from rosproxy.ros2.discovery.fragments import FragmentStores
from rosproxy.ros2.discovery.node_names import NodeNames
from rosproxy.ros2.discovery.participants.inside import InsideParticipants
from rosproxy.ros2.discovery.participants.outside import OutsideParticipants
from rosproxy.ros2.discovery.participants.prefix_owners import PrefixOwners
from rosproxy.ros2.discovery.proxy_participants import ProxyParticipants
from rosproxy.ros2.discovery.rediscovery import Rediscovery
from rosproxy.ros2.domain_settings import (
    MOST_DATAGRAMS_PER_PART,
    DomainSettings,
    LanRelayLink,
    Outgoing,
    Refused,
    sent_to,
)
from rosproxy.ros2.policy.verdicts import Verdicts
from rosproxy.ros2.ports.former_ports import FormerPorts
from rosproxy.ros2.ports.locator_ports import LocatorPorts, NamedBy
from rosproxy.ros2.ports.mappings import PortMappings
from rosproxy.ros2.ports.stand_ins import LocatorStandIns, StandInUser
from rosproxy.ros2.protocol.addressing import (
    carries_samples,
    destinations,
    may_be_discovery,
)
from rosproxy.ros2.protocol.relay_envelope import unwrapped
from rosproxy.ros2.protocol.relay_proof import Direction
from rosproxy.ros2.protocol.rtps import (
    MAGIC,
    NO_VENDOR,
    RtpsError,
    source_prefix,
    source_vendor,
)
from rosproxy.ros2.registry.participants import (
    InsideParticipant,
    OutsideParticipant,
    PortMapping,
    TrafficKind,
)
from rosproxy.ros2.rewriting.discovery import (
    DiscoveryMessage,
    credited_messages,
    participant_alone,
    read_messages,
    require_rewritable,
)
from rosproxy.ros2.sources.address_proofs import AddressProofs, is_question_of_proxy
from rosproxy.ros2.sources.claimed_addresses import claim_fault
from rosproxy.ros2.sources.rates import DiscoveryRates, Standing, cost
from rosproxy.shared.ports import PortPool

MOST_ENDED_PER_CALL = 64
"""Participants of a side that `Domain.expire` ends in one call."""

_Passing = tuple[list[bytes], list[Outgoing]]
"""Datagrams to pass on, and datagrams to send back."""


class Domain:
    """A domain with its participants.

    A domain starts without participants. ``discovery_prefix`` is the random GUID prefix of the
    discovery participant. ``secret`` is the random key of the questions that prove addresses.
    ``monotonic_s`` and ``unix_s`` are the present time, by the monotonic clock and since 1970.
    ``passed`` counts bytes that passed, by kind and by whether they went inwards.
    """

    def __init__(
        self,
        settings: DomainSettings,
        pool: PortPool,
        discovery_prefix: bytes,
        secret: bytes,
        monotonic_s: float,
        unix_s: float = 0.0,
    ) -> None:
        pool.claim(settings.discovery_port)  # never for a locator: outside announces itself there
        self.settings = settings
        self.refused = refused = Refused(settings.note)
        self.proofs = proofs = AddressProofs(secret)
        self.rates = DiscoveryRates()
        self.node_names = NodeNames(self.standing)
        self.passed = Counter[tuple[TrafficKind, bool]]()
        self.ports = LocatorPorts(pool, monotonic_s)
        self.mappings = PortMappings(settings, self.ports, refused, proofs)
        self.stand_ins = LocatorStandIns(settings, refused)
        verdicts = Verdicts(settings.judge)
        inside = InsideParticipants(settings, self.mappings, refused, proofs, verdicts)
        outside = OutsideParticipants(settings, self.stand_ins, refused, proofs, verdicts)
        self.inside = inside
        self.outside = outside
        settings.participants_at = outside.count_by_address.__getitem__
        self.to_inside = AnnouncementsToInside(settings, inside, outside)
        self.to_outside = AnnouncementsToOutside(settings, outside)
        former_ports = FormerPorts.starting(settings, self.ports, proofs, unix_s - monotonic_s)
        self.former_ports = former_ports
        discovery_participant = DiscoveryParticipant(discovery_prefix)
        self.owners = PrefixOwners(settings, inside, outside, former_ports, proofs)
        self.rediscovery = Rediscovery(settings, inside, outside, self.to_inside)
        self._steps = deque[Callable[[], list[Outgoing]]]()
        self._questions: Iterator[Outgoing] = iter(())
        self._has_questions = False
        self.fragments = fragments = FragmentStores()
        self.proxy_participants = ProxyParticipants(
            settings, discovery_participant, inside, outside, former_ports, fragments, proofs
        )
        self.disposal = Disposal(
            settings, inside, outside, self.proxy_participants, former_ports,
            self.rediscovery, fragments, proofs, refused,
        )  # fmt: skip

    @property
    def is_busy(self) -> bool:
        """Whether `go_on` has further parts of the work to do.

        Hundreds of participants may have to rediscover hundreds of others. So the proxy does the
        work in parts.
        """
        return bool(self._steps) or self._has_questions or self.rediscovery.is_busy

    def heard_inside(self, datagram: bytes, source: str, now: float) -> list[Outgoing]:
        """Handle a datagram from inside, at the multicast group or at the well-known port."""
        is_answer = self.proofs.is_first_answer(source, datagram)
        if not is_answer and not self._take_allowance(datagram, source, now):
            return []
        sent = list[Outgoing]()
        try:
            for message in read_messages(datagram):
                sent += self._heard_inside(message, source, now)
        except RtpsError as error:
            sent += self._drop("malformed", source, str(error))
        self._charge(source, sent)
        return sent

    def heard_outside(
        self, datagram: bytes, source: str, now: float, received: int | None = None
    ) -> list[Outgoing]:
        """Handle a datagram at the discovery port.

        Participants outside announce themselves there, directly or through the LAN relay. Known
        participants send their answers to the discovery participant there. ``received`` is the
        number of bytes that came, if not all of the datagram.
        """
        relay = self.settings.relay
        # No datagram of the LAN relay starts with RTPS. Such a datagram is from another program at
        # the relay's address.
        if relay and source == relay.address.host and not datagram.startswith(MAGIC):
            return self._heard_by_relay(relay, datagram, now)
        # Forged participants may fill the table, so that no participant is known at this address.
        # So the proxy accepts the first answer to a question from any source.
        if not self.proofs.is_first_answer(source, datagram) and self.outside.refuses_source(
            source
        ):
            return []
        received = len(datagram) if received is None else received
        return self._heard_at_discovery(datagram, source, False, received, now)

    def source_of(self, datagram: bytes, source: str) -> str:
        """The original source of a datagram: the LAN relay may have passed the datagram on."""
        relay = self.settings.relay
        if relay is None or source != relay.address.host or datagram.startswith(MAGIC):
            return source
        try:
            heard_at, _ = unwrapped(relay.proof.opened(Direction.TO_PROXY, datagram))
        except RtpsError:
            return source
        return heard_at

    def _heard_by_relay(self, relay: LanRelayLink, datagram: bytes, now: float) -> list[Outgoing]:
        """Handle a datagram of the LAN relay.

        The proxy refuses a datagram without a valid proof, and an impossible claimed address.
        """
        try:
            content = relay.proof.opened(Direction.TO_PROXY, datagram)
            source, announcement = unwrapped(content)
            is_known = source_prefix(announcement) in self.inside.by_prefix
        except RtpsError as error:
            return self._drop("relay_proof", relay.address.host, str(error))
        self.rediscovery.lan_relay_heard = True
        if fault := claim_fault(source, self.settings):
            # With IPv6 the relay may receive from the inside network (datagrams.py,
            # _IPV6_MULTICAST_ALL). So the announcement of a participant inside is no fault.
            return [] if is_known else self._drop("claimed_address", source, fault)
        return self._heard_at_discovery(announcement, source, True, len(announcement), now)

    def _heard_at_discovery(
        self, datagram: bytes, source: str, by_relay: bool, received: int, now: float
    ) -> list[Outgoing]:
        is_answer = self.proofs.is_first_answer(source, datagram)
        if not is_answer and not self._take_allowance(datagram, source, now):
            return []
        sent = list[Outgoing]()
        try:
            for message, credited in credited_messages(datagram, received):
                if by_relay and message.of_participant is None:
                    raise RtpsError("the LAN relay may pass on only announcements of participants")
                sent += self._heard_outside(message, source, by_relay, credited, now)
        except RtpsError as error:
            sent += self._drop("malformed", source, str(error))
        self._charge(source, sent)
        return sent

    def must_queue_discovery(self, datagram: bytes, source: str) -> bool:
        """Whether a datagram at the discovery port must wait in the queue of discovery.

        A datagram waits if the proxy is going to read it: a participant is known at its source, the
        source is a peer, or the LAN relay has passed the datagram on. The first answer of a
        participant to a question does not wait.
        """
        if self.proofs.is_first_answer(source, datagram):
            return False
        return self.outside.is_met(source) or self.source_of(datagram, source) != source

    def must_queue_inside(self, datagram: bytes, source: str) -> bool:
        """Whether a datagram for `heard_inside` must wait in the queue of discovery.

        The first answer of a participant to a question does not wait.
        """
        return not self.proofs.is_first_answer(source, datagram)

    def must_queue_at_range_port(self, port: int, datagram: bytes, source: str) -> bool:
        """Whether a datagram for `at_range_port` must wait in the queue of discovery."""
        mapped = self.mappings.by_port.get(port)
        if mapped is None:
            return False
        _, mapping = mapped
        may_be_read = mapping.is_read and self.outside.is_met(source)
        return may_be_read and may_be_discovery(datagram)

    def must_queue_at_stand_in(self, port: int, datagram: bytes, _: str) -> bool:
        """Whether a datagram for `at_stand_in` must wait in the queue of discovery.

        The proxy reads these datagrams, and no others.
        """
        users = self.stand_ins.by_port.get(port, ())
        may_be_read = any(outsider.reads_discovery_at(mapping) for outsider, mapping in users)
        return may_be_read and may_be_discovery(datagram)

    def at_range_port(
        self, port: int, datagram: bytes, source: str, now: float, received: int | None = None
    ) -> list[Outgoing]:
        """Handle a datagram from outside at a port of the range; see `heard_outside`."""
        mapped = self.mappings.by_port.get(port)
        try:
            if mapped is None:  # the port may belong to a participant from before the start
                self._note_former_use(port, datagram, source, now)
                return []
            insider, mapping = mapped
            is_for_data = mapping.kind is TrafficKind.USER_DATA
            if is_for_data and not (mapping.is_read and may_be_discovery(datagram)):
                self.node_names.read(self.outside, datagram, source, now)
                return [self._passed(mapping, datagram, True, is_user_data=True)]
            if self.outside.refuses_source(source):
                return []
            passed = [datagram]
            back = list[Outgoing]()
            # A port for metatraffic may get user data: Cyclone DDS has one locator for both kinds.
            is_read = is_for_data or may_be_discovery(datagram)
            if is_read:
                if not self._take_allowance(datagram, source, now):
                    return []
                received = len(datagram) if received is None else received
                passed, back = self._read_at_range_port(
                    port, source, insider, datagram, received, now
                )
            else:
                self.node_names.read(self.outside, datagram, source, now)
        except RtpsError as error:
            return self._drop("malformed", source, str(error))
        return [self._passed(mapping, d, True, is_user_data=not is_read) for d in passed] + back

    def at_stand_in(self, port: int, datagram: bytes, source: str, now: float) -> list[Outgoing]:
        """Handle a datagram from inside at a stand-in."""
        users = list(self.stand_ins.by_port.get(port, ()))
        sent = list[Outgoing]()
        if not self.must_queue_at_stand_in(port, datagram, source):
            is_of_participant = source in self.inside.count_by_address
            self.node_names.read(self.inside, datagram, source, now)
            return self._to_outside(users, datagram, True) if is_of_participant else []
        if not self._take_allowance(datagram, source, now):
            return []
        try:
            for message in read_messages(datagram):
                sent += self._exported(port, source, users, message, now)
        except RtpsError as error:
            sent += self._drop("malformed", source, str(error))
        return sent

    def continue_pending(self, now: float) -> list[Outgoing]:
        """Repeat questions about former ports, and begin or continue rediscoveries that are due.

        Calls come twice a second. Between these calls, `go_on` does the parts of the work.
        """
        self._questions = self.former_ports.repeated_questions(now)
        self._has_questions = True
        self.rediscovery.look_for_due()
        return self.go_on(now)

    def go_on(self, now: float) -> list[Outgoing]:
        """Do the next part of the work; see `is_busy`. A part takes some milliseconds."""
        sent = self._next_steps()
        if len(sent) >= MOST_DATAGRAMS_PER_PART:
            return sent
        sent += islice(self._questions, MOST_DATAGRAMS_PER_PART - len(sent))
        self._has_questions = len(sent) == MOST_DATAGRAMS_PER_PART
        if self._has_questions:
            return sent
        return sent + self.rediscovery.next_datagrams(now)

    def admit(self, prefix: bytes, now: float) -> list[Outgoing]:
        """Serve a participant inside that has waited because of its former ports.

        The participant has answered, or the time for the answer is over.
        """
        waited = self.former_ports.end_wait(prefix)
        if waited is None:
            return []  # the participant has ended meanwhile
        source, message = waited
        try:
            sent = self._serve_inside(message, source, now)
        except RtpsError as error:
            sent = self._drop("malformed", source, str(error))
        if prefix not in self.inside.by_prefix:
            self.former_ports.forget_answers(prefix)
        return sent

    def apply_policy(self, now: float) -> list[Outgoing]:
        """Start the rediscovery of the participants for which the policy now decides otherwise."""
        self.fragments.clear()  # received under the former policy
        self.rediscovery.review()
        return self.rediscovery.next_datagrams(now)

    def move_to(self, hosts: tuple[str, ...], now: float) -> list[Outgoing]:
        """Announce the participants inside with the new addresses of the advertised host.

        Fast DDS accepts no new locators of a known participant (PDPListener.cpp). So all
        participants outside rediscover the participants inside and the discovery participant.
        """
        sent = self.settings.to_outside(
            self.proxy_participants.discovery_participant.dispose_message()
        )
        self.settings.hosts = hosts
        self._do_later(self._move, self.inside.by_prefix.values())
        return sent + self.go_on(now)

    def retire(self, now: float) -> list[Outgoing]:
        """Let the participants of both sides forget each other, because no proxy takes over now.

        A proxy may start later and serve the participants that still live. Both sides discover
        each other then only if they have forgotten each other (`Rediscovery`).
        """
        self.former_ports.forget({insider.address for insider in self.inside.by_prefix.values()})
        self._do_later(self._retire, self.inside.by_prefix.values())
        return self.go_on(now)

    def standing(self, source: str) -> Standing:
        """The standing of a source, on which its allowance for discovery depends."""
        if self.settings.is_peer(source):
            return Standing.PROVEN
        is_proven = self.proofs.has(source)
        if self.settings.is_inside(source):
            return Standing.PROVEN if is_proven else Standing.INSIDE
        return Standing.PROVEN_OUTSIDE if is_proven else Standing.OUTSIDE

    def has_confirmed_ports(self, participant: InsideParticipant) -> bool:
        """Whether a participant inside has confirmed all its ports to the port store.

        Then the next process of the proxy can learn these ports from the participant.
        """
        return self.proxy_participants.port_store.keeps(participant.prefix, participant.ports)

    def expire(self, now: float) -> list[Outgoing]:
        """End participants whose lease duration is over. Return the datagrams for outside.

        Inside gets no dispose messages. A call ends at most `MOST_ENDED_PER_CALL` of each side, and
        no further one inside after `MOST_DATAGRAMS_PER_PART`.

        A participant on two networks may have lost the network on which the proxy served the
        participant. After the end of its lease duration, the proxy accepts its announcement on the
        other network.
        """
        sent = list[Outgoing]()
        insiders = [p for p in self.inside.by_prefix.values() if p.until < now]
        for insider in insiders[:MOST_ENDED_PER_CALL]:
            if len(sent) >= MOST_DATAGRAMS_PER_PART:
                break
            sent += self.disposal.end_inside(insider)
        outsiders = [p for p in self.outside.by_prefix.values() if p.until < now]
        for outsider in outsiders[:MOST_ENDED_PER_CALL]:
            self.disposal.forget_outside(outsider)
        self.proofs.expire(now, self.inside, self.outside)
        return sent

    def end_participants_at(self, addresses: Collection[str]) -> list[Outgoing]:
        """End the participants whose inside address is gone. Return the first datagrams.

        `go_on` ends the other participants; see `is_busy`. Without this, outside would keep these
        participants until the end of their lease durations.
        """
        self.former_ports.forget(addresses)
        leavers = [p for p in self.inside.by_prefix.values() if p.address in addresses]
        self._do_later(self.disposal.end_inside, leavers)
        return self._next_steps()

    def _do_later(
        self,
        step: Callable[[InsideParticipant], list[Outgoing]],
        insiders: Iterable[InsideParticipant],
    ) -> None:
        """Let `go_on` do a step for each participant inside, unless the participant has gone."""
        self._steps += [partial(self._step_known, step, insider) for insider in insiders]

    def _next_steps(self) -> list[Outgoing]:
        """Do the next steps, until these lead to MOST_DATAGRAMS_PER_PART."""
        sent = list[Outgoing]()
        while self._steps and len(sent) < MOST_DATAGRAMS_PER_PART:
            sent += self._steps.popleft()()
        return sent

    def _step_known(
        self, step: Callable[[InsideParticipant], list[Outgoing]], insider: InsideParticipant
    ) -> list[Outgoing]:
        is_known = self.inside.by_prefix.get(insider.prefix) is insider
        return step(insider) if is_known else []

    def _move(self, insider: InsideParticipant) -> list[Outgoing]:
        try:
            return self.rediscovery.move(insider)
        except RtpsError as error:  # continue with the other participants
            return self._drop("malformed", insider.address, str(error))

    def _retire(self, insider: InsideParticipant) -> list[Outgoing]:
        self.disposal.forget_inside(insider)  # before the work that remains to be done
        return self.rediscovery.separate(insider)

    def _heard_inside(self, message: DiscoveryMessage, source: str, now: float) -> list[Outgoing]:
        prefix = message.prefix
        spdp = message.of_participant
        if source_vendor(message.datagram) == NO_VENDOR or self.proxy_participants.is_of_proxy(
            prefix
        ):
            return []  # participants of a proxy are not announced to the other side
        if self.proofs.note(source, message.datagram, now):
            sent = self.disposal.end_former_processes(prefix, source)
            return sent + [
                out for p in self.inside.over_limit() for out in self.disposal.end_inside(p)
            ]
        if spdp is None:
            return self.proxy_participants.handle_from_inside(message, source, now)
        if spdp.ended:
            return self._end_inside(message, source, now)
        is_new = prefix not in self.inside.by_prefix
        if is_new and (
            self.ports.is_restoring(now) or self.inside.must_answer_first(prefix, source)
        ):
            return self._wait(message, source, now)
        return self._serve_inside(message, source, now)

    def _serve_inside(self, message: DiscoveryMessage, source: str, now: float) -> list[Outgoing]:
        """Serve a participant inside, unless its prefix belongs to a participant outside."""
        if not self.owners.yields_to_inside(message.prefix):
            outsider = self.outside.by_prefix[message.prefix]
            self.former_ports.forget_participant(message.prefix)
            text = f"GUID prefix {outsider.guid_prefix} belongs to a participant outside, at "
            return self._drop("prefix", source, text + outsider.address)
        sent = self.disposal.give_prefix_to_inside(message.prefix, source)
        return sent + self._handle_inside_announcement(message, source, now)

    def _wait(self, message: DiscoveryMessage, source: str, now: float) -> list[Outgoing]:
        """Let a participant inside wait until it has answered the proxy."""
        if message.prefix in self.former_ports.waiting:
            return []
        sent = self.former_ports.wait(message, source, now)
        if sent and self.owners.yields_to_inside(message.prefix):
            sent += self.disposal.give_prefix_to_inside(message.prefix, source)
        return sent + self.proxy_participants.question_to_announced(message, source)

    def _heard_outside(
        self,
        message: DiscoveryMessage,
        source: str,
        by_relay: bool,
        received: int,
        now: float,
    ) -> list[Outgoing]:
        if self.proxy_participants.is_of_proxy(message.prefix):
            return []
        if is_question_of_proxy(message):
            return self.proxy_participants.answer_to_proxy(
                self.proxy_participants.discovery_participant.prefix, message, source
            )
        if message.of_participant is None:
            return self._handle_message_from_outside(message, source, received, now)
        if not by_relay and not self.outside.may_announce(
            message, source, self.proxy_participants.discovery_participant.prefix
        ):
            self.outside.refuse_stranger(
                source, "a participant announces itself, and the address is not a peer"
            )
            return []
        if self.owners.is_inside(message.prefix):
            return self._claimed_by_outside(message, source, received, now)
        return self._handle_outside_announcement(message, source, received, now)

    def _claimed_by_outside(
        self, message: DiscoveryMessage, source: str, received: int, now: float
    ) -> list[Outgoing]:
        """Handle an announcement from outside with a prefix of inside. Raises RtpsError."""
        claimant = self.outside.claimant(message, source, received, now)
        if claimant is None:
            # The message announces an end, or no metatraffic locator at the source. Or the LAN
            # relay has heard the proxy's own announcement.
            return []
        if self.owners.yields_to_outside(message.prefix, source, now):
            self.disposal.give_prefix_to_outside(message.prefix, source)
            return self._handle_outside_announcement(message, source, received, now)
        text = f"GUID prefix {claimant.guid_prefix} belongs to a participant inside"
        self.refused("prefix", source, text)
        return self.proxy_participants.question_to_outside(claimant)

    def _handle_message_from_outside(
        self, message: DiscoveryMessage, source: str, received: int, now: float
    ) -> list[Outgoing]:
        """Handle a message from outside to a participant of the proxy. Raises RtpsError."""
        sent = list[Outgoing]()
        if self.proofs.note(source, message.datagram, now):
            sent += self.disposal.end_former_processes(message.prefix, source)
            to_announce, ended = self.outside.prove(source)
            inside = self.inside.by_prefix.values()
            sent += [
                out for outsider in ended for out in self.disposal.end_outside(outsider, inside)
            ]
            sent += self.to_inside.of_outside(to_announce, inside, now)
        return sent + self.proxy_participants.handle_from_outside(message, source, received)

    def _handle_outside_announcement(
        self, message: DiscoveryMessage, source: str, received: int, now: float
    ) -> list[Outgoing]:
        """Handle the announcement of a participant outside, and announce the participant inside.

        Raises RtpsError.
        """
        outsider, sent = self._meet_outside(message, source, now)
        if outsider is None:
            return sent
        outsider.credit += received
        sent += self.to_inside.of_outside([outsider], self.inside.by_prefix.values(), now)
        if message.of_participant is None or not message.of_participant.ended:
            return sent + self.proxy_participants.question_to_outside(outsider)
        self.disposal.forget_outside(outsider)  # inside has just been told
        return sent

    def _meet_outside(
        self, message: DiscoveryMessage, source: str, now: float
    ) -> tuple[OutsideParticipant | None, list[Outgoing]]:
        """The participant in an announcement, and the datagrams that end another participant.

        The other participant ends to make room. The participant is None if the proxy refuses the
        announcement. Raises RtpsError.
        """
        end_datagrams = self._end_one_for_place(message, source)
        return self.outside.meet(message, source, now), end_datagrams

    def _end_one_for_place(self, message: DiscoveryMessage, source: str) -> list[Outgoing]:
        """End a participant outside in favour of a new one, if necessary."""
        spdp = message.of_participant
        if spdp is None or spdp.ended or message.prefix in self.outside.by_prefix:
            return []
        outsider = self.outside.participant_to_end(source)
        return (
            self.disposal.end_outside(outsider, self.inside.by_prefix.values()) if outsider else []
        )

    def _handle_inside_announcement(
        self, message: DiscoveryMessage, source: str, now: float
    ) -> list[Outgoing]:
        """Handle the announcement of a participant inside, and announce the participant outside."""
        prefix = message.prefix
        is_new = prefix not in self.inside.by_prefix
        if is_new and self.inside.must_answer_first(prefix, source):
            # The proxy serves the participant with all ports or not at all, because Fast DDS
            # accepts no new locators of a known participant. The participant will announce itself
            # again.
            return self.proxy_participants.question_to_announced(message, source)
        ending = self.inside.participant_to_end(prefix, source) if is_new else None
        sent = self.disposal.end_inside(ending) if ending else []
        insider = self.inside.meet(message, source, now)
        if insider is None:
            if prefix not in self.inside.by_prefix:
                # An answer proves the address, and the next announcement may get a place.
                sent += self.proxy_participants.question_to_announced(message, source)
            return sent
        if is_new:
            sent += self._end_former_users_of_ports(insider, now)
        mapping_count = len(insider.mappings)
        for_outside = ForOutside(self.inside, insider, now, self.former_ports.of(prefix))
        exported = for_outside.rewritten(message)
        sent += self.to_inside.of_neighbour(insider, message)
        # If outside knows former ports of the participant, all participants outside have to
        # rediscover it. The participant may know the port store at a former address of the proxy.
        # So the proxy also sends it dispose messages of the port store.
        if is_new and self.former_ports.must_be_rediscovered(prefix):
            sent += self.proxy_participants.port_store_dispose_message(insider)
            insider.separation_due_from = now
        else:
            sent += self._port_reminders(insider, mapping_count, now)
        if not is_new and len(insider.mappings) > mapping_count:
            insider.separation_due_from = now  # Fast DDS outside accepts no new locators
        # The proxy repeats the announcement, also after a change of the policy. So readers and
        # writers in the message must not be part of it.
        alone = participant_alone(replace(message, datagram=exported))
        sent += self.to_outside.of_inside(insider, alone, now)
        if is_new:
            sent += self.to_inside.of_outside(self.outside.by_prefix.values(), [insider], now)
        sent += self.proxy_participants.question_to_inside(
            insider.address, prefix, insider.metatraffic
        )
        return sent + self.proxy_participants.first_questions(insider)

    def _end_former_users_of_ports(self, insider: InsideParticipant, now: float) -> list[Outgoing]:
        """End the former users of the ports of a new participant inside.

        These are participants of crashed processes that had the same socket. They are also
        participants that hold ports of the range to which the new participant has a better or equal
        claim. Return the datagrams for outside.
        """
        prefix = insider.prefix
        # An answer shows that a former process at this socket is gone. The answer may have come
        # while the participant waited, when the proxy did not yet know its socket.
        sent = self.disposal.end_former_processes(prefix, insider.address)
        insider.was_inside = self.former_ports.was_inside(prefix)
        for holder in self.ports.displaced_by(prefix, now):
            sent += self.disposal.give_up_ports(self.inside.by_prefix[holder])
        return sent

    def _end_inside(self, message: DiscoveryMessage, source: str, now: float) -> list[Outgoing]:
        self.former_ports.end(message.prefix, source)
        insider = self.inside.find(message.prefix, source)
        if insider is None:
            return []
        require_rewritable(message)
        # The message may have other announcements as well.
        exported = ForOutside(self.inside, insider, now).rewritten(message)
        self.disposal.forget_inside(insider)
        return self.settings.to_outside(exported)

    def _exported(
        self,
        port: int,
        source: str,
        users: Sequence[StandInUser],
        message: DiscoveryMessage,
        now: float,
    ) -> list[Outgoing]:
        """Rewrite discovery from inside for outside.

        Return the questions and port reminders for inside, and the rewritten datagrams. Raises
        RtpsError.
        """
        insider = self.inside.find(message.prefix, source)
        if insider is None:
            return self._drop(
                "unknown_participant",
                source,
                "the participant has not announced itself to the proxy",
            )
        if insider.is_separated:
            return []
        readers = [outsider.prefix for outsider, _ in _addressed_users(users, message.datagram)]
        if len(users) == 1 or destinations(message.datagram):
            for reader in readers:
                self.rediscovery.note_met(insider, reader)
        reader = readers[0] if readers else users[0][0].prefix
        count = len(insider.mappings)
        for_outside = ForOutside(self.inside, insider, now)
        passed, questions = self.fragments.rewritten(port, message, reader, for_outside.rewritten)
        back = sent_to(insider.metatraffic, questions) + self._port_reminders(insider, count, now)
        return back + [
            sent for d in passed for sent in self._to_outside(_addressed_users(users, d), d, False)
        ]

    def _port_reminders(
        self, insider: InsideParticipant, former_count: int, now: float
    ) -> list[Outgoing]:
        """The datagrams with which the port store tells a participant its new ports.

        Empty if the participant has no more than ``former_count`` ports, or can't remember ports
        (`FormerPorts.keepers`). `FormerPorts` repeats these datagrams regularly, but the proxy may
        be killed before.
        """
        has_more = len(insider.mappings) > former_count
        if not has_more or insider not in self.former_ports.keepers(
            self.inside.at(insider.address)
        ):
            return []
        return self.former_ports.reminders(insider, now)

    def _read_at_range_port(
        self,
        port: int,
        source: str,
        insider: InsideParticipant,
        datagram: bytes,
        received: int,
        now: float,
    ) -> _Passing:
        """Handle discovery from outside at a port of the range. Raises RtpsError."""
        passed = list[bytes]()
        back = list[Outgoing]()
        for message, credited in credited_messages(datagram, received):
            if is_question_of_proxy(message):
                back += self.proxy_participants.answer_to_proxy(insider.prefix, message, source)
                continue
            forwarded, replies = self._imported(port, source, insider, now, message, credited)
            passed += forwarded
            back += replies
        return passed, back

    def _imported(
        self,
        port: int,
        source: str,
        insider: InsideParticipant,
        now: float,
        message: DiscoveryMessage,
        received: int,
    ) -> _Passing:
        """Rewrite discovery from outside for a participant inside.

        Return the rewritten datagrams, and the questions to outside. Raises RtpsError.
        """
        outsider = self.outside.find(message.prefix, source)
        spdp = message.of_participant
        if outsider is not None:
            outsider.has_come_in = True
        belongs_to_other = (
            message.prefix in self.inside.by_prefix
            or self.proxy_participants.is_of_proxy(message.prefix)
        )
        if belongs_to_other or insider.is_separated:
            return [], []
        back = list[Outgoing]()
        if spdp is not None:
            if outsider is None and not self.settings.is_peer(source):
                text = "a new participant announces itself, and the address is not a peer"
                self.outside.refuse_stranger(source, text)
                return [], []
            outsider, back = self._meet_outside(message, source, now)
        if outsider is None:
            return [], back
        outsider.note_received(message.datagram, received, insider.prefix)
        if not self.outside.may_be_announced(outsider):
            return [], back
        near = self.settings.proxy_address_for(insider.address)
        for_inside = ForInside(self.outside, outsider, near, insider)
        passed, questions = self.fragments.rewritten(
            port, message, insider.prefix, for_inside.rewritten
        )
        back += self.outside.allowed_questions(outsider, questions)
        if spdp is not None and spdp.ended:
            self.disposal.forget_outside(outsider)
        return passed, back

    def _to_outside(
        self, users: Sequence[StandInUser], datagram: bytes, is_user_data: bool
    ) -> list[Outgoing]:
        """The datagrams for participants outside, as far as their credit allows."""
        sent = list[Outgoing]()
        for target, mapping in users:
            if target.take_credit(len(datagram)):
                sent.append(self._passed(mapping, datagram, False, is_user_data))
            else:
                text = f"participant {target.guid_prefix} has not yet answered the proxy's question"
                sent += self._drop("unproven", target.address, text)
        return sent

    def _passed(
        self, mapping: PortMapping, datagram: bytes, inwards: bool, is_user_data: bool
    ) -> Outgoing:
        """Count a datagram that passes, and return the datagram for the target of a mapping."""
        mapping.note_passed(len(datagram), is_user_data and carries_samples(datagram))
        self.passed[mapping.kind, inwards] += len(datagram)
        return Outgoing(mapping.target, datagram)

    def _note_former_use(self, port: int, datagram: bytes, source: str, now: float) -> None:
        """Note the destination of a datagram at a port without a mapping. Raises RtpsError."""
        if not self.ports.is_restoring(now):
            return
        if may_be_discovery(datagram) and not self._take_allowance(datagram, source, now):
            return
        self.ports.note_use(port, datagram, self._reliability_of(source), now)

    def _charge(self, source: str, sent: Sequence[Outgoing]) -> None:
        """Charge a source for the datagrams that the proxy sends in consequence."""
        total = sum(cost(len(out.datagram)) for out in sent)
        self.rates.charge(source, total, self.standing(source))

    def _take_allowance(self, datagram: bytes, source: str, now: float) -> bool:
        """Charge a source for a datagram. If the allowance is used up, refuse and return False."""
        if self.rates.take(source, len(datagram), now, self.standing(source)):
            return True
        text = "the source sends more discovery in a second than one source may send"
        self.refused("rate", source, text)
        return False

    def _reliability_of(self, source: str) -> NamedBy:
        """How reliable a source is when it names a participant at a port."""
        if self.settings.is_peer(source):
            return NamedBy.PEER
        # A participant inside may have a proven address, too, and send to ports of the range.
        is_proven = self.proofs.has(source) and not self.settings.is_inside(source)
        return NamedBy.PROVEN if is_proven else NamedBy.OTHERS

    def _drop(self, reason: str, source: str, text: str) -> list[Outgoing]:
        self.refused(reason, source, text)
        return []


def _addressed_users(users: Sequence[StandInUser], datagram: bytes) -> Sequence[StandInUser]:
    """The participants outside behind a stand-in that a message is for.

    All of them if the message names none. A single participant gets all messages, and ignores
    messages for other participants. Raises RtpsError.
    """
    named = destinations(datagram) if len(users) > 1 else None
    return [user for user in users if user[0].prefix in named] if named else users
