"""Restores ports after a start: participants get their former ports again.

In the first `EVIDENCE_PERIOD_S`, the first announcement of a participant inside waits. The proxy
asks the participant for its former ports (`rosproxy.ros2.ports.store` explains how the participant
remembers these). The wait ends with the answer, or after `ANSWER_TIMEOUT_S` without an answer. The
wait lasts at least until outside has had `SETTLING_PERIOD_S` to send to former ports
(`LocatorPorts`). Later, reminders make participants remember their present ports.
"""

from collections import Counter
from collections.abc import Collection, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Self

from rosproxy.ros2.domain_settings import (
    MOST_PER_ADDRESS,
    MOST_WAITING,
    DomainSettings,
    Outgoing,
)
from rosproxy.ros2.ports.locator_ports import LocatorPorts
from rosproxy.ros2.ports.store import PortStore
from rosproxy.ros2.registry.participants import InsideParticipant
from rosproxy.ros2.rewriting.announced_participant import first_metatraffic
from rosproxy.ros2.rewriting.discovery import DiscoveryMessage, read_discovery
from rosproxy.ros2.sources.address_proofs import AddressProofs
from rosproxy.shared.addresses import HostPort

ANSWER_TIMEOUT_S = 5.0
"""Seconds that a participant has to name its former ports."""


class WaitingParticipant(NamedTuple):
    """A participant inside that waits, with the source of the announcement, and the announcement.

    The announcement is kept as it came: when it is read, it takes up to 30 times as much memory.
    ``metatraffic`` is the locator for questions, and ``since`` the start of the wait.
    """

    source: str
    datagram: bytes
    metatraffic: HostPort | None
    since: float


@dataclass(slots=True)
class FormerPorts:
    """The participants inside that wait, and their ports from before the start.

    ``waiting`` is by prefix. At an address, as many participants may wait as may be served.
    ``recorded`` has ports by prefix, until the participant has gone: the operator has recorded
    these for participants that knew the proxy at another address, or with another range.
    ``displaced`` are the last participants that the proxy has ended, and that may be alive.

    Fast DDS accepts no new locators of a known participant (PDPListener.cpp,
    PDPSimple::updateInfoMatchesEDP). So all participants outside must rediscover the ``recorded``
    and ``displaced`` participants.
    """

    settings: DomainSettings
    ports: LocatorPorts
    port_store: PortStore
    proofs: AddressProofs
    waiting: dict[bytes, WaitingParticipant] = field(default_factory=dict)
    recorded: dict[bytes, tuple[int, ...]] = field(default_factory=dict)
    displaced: dict[bytes, None] = field(default_factory=dict)
    _counts: Counter[str] = field(default_factory=Counter)
    """The number of waiting participants, by address."""

    @classmethod
    def starting(
        cls,
        settings: DomainSettings,
        ports: LocatorPorts,
        proofs: AddressProofs,
        unix_offset: float,
    ) -> Self:
        """The former ports of a proxy that starts, with the port store that asks for them.

        ``unix_offset`` is Unix time minus the time ``now`` of the methods, in seconds.
        """
        port_store = PortStore.of(
            settings.host,
            settings.ports.listen,
            settings.number,
            unix_offset,
            settings.port_store_key,
        )
        return cls(settings, ports, port_store, proofs)

    def is_waiting(self, prefix: bytes, source: str) -> bool:
        """Whether a participant at an address waits."""
        return prefix in self.waiting and self.waiting[prefix].source == source

    def wait(self, message: DiscoveryMessage, source: str, now: float) -> list[Outgoing]:
        """Hold an announcement until ports may be given. Return questions for the former ports.

        Empty if no further participant may wait.
        """
        if not self._make_room(message.prefix, source):
            return []  # the participant announces itself again, and there may be room then
        spdp = message.of_participant
        target = first_metatraffic(spdp, message.datagram, source) if spdp else None
        waiting = WaitingParticipant(source, message.datagram, target, now)
        self.waiting[message.prefix] = waiting
        self._counts[source] += 1
        return self._questions(message.prefix, waiting, now)

    def _make_room(self, prefix: bytes, source: str) -> bool:
        """Return whether a further participant may wait at an address.

        If necessary, end another wait. If only the number of all waiting participants is too
        great, the first participant that has not proved an address leaves. If the address is full,
        such a participant at this address leaves, and only in favour of a participant that has
        answered.
        """
        is_full = self._counts[source] >= MOST_PER_ADDRESS
        if not is_full and len(self.waiting) < MOST_WAITING:
            return True
        if is_full and not self.proofs.has_answered(source, prefix):
            return False
        unproven = (
            waiting
            for waiting, (address, *_) in self.waiting.items()
            if (address == source or not is_full) and not self.proofs.has_answered(address, waiting)
        )
        leaver = next(unproven, None)
        if leaver is not None:
            self._forget_waiting(leaver)
        return leaver is not None

    def repeated_questions(self, now: float) -> Iterator[Outgoing]:
        """Yield the questions to waiting participants whose answers are still due.

        The questions to a participant are made when the first of these is taken. With 512 waiting
        participants they take 35 ms, and the caller can do other work in between.
        """
        for prefix, waiting in list(self.waiting.items()):
            is_waiting = self.waiting.get(prefix) is waiting
            if is_waiting and not self._is_question_closed(prefix, waiting.since, now):
                yield from self._questions(prefix, waiting, now)

    def ready(self, now: float) -> list[bytes]:
        """The waiting participants that may get ports now. Each waits on until `end_wait`."""
        if not self.ports.may_give_ports(now):
            return []
        return [
            p for p, (*_, since) in self.waiting.items() if self._is_question_closed(p, since, now)
        ]

    def end_wait(self, prefix: bytes) -> tuple[str, DiscoveryMessage] | None:
        """End the wait of a participant. Return the source and the announcement.

        None if the participant does not wait.
        """
        if prefix not in self.waiting:
            return None
        waiting = self.waiting.pop(prefix)
        self._counts -= Counter((waiting.source,))
        return waiting.source, read_discovery(waiting.datagram)

    def forget(self, addresses: Collection[str]) -> None:
        """Forget the waiting participants at addresses that are gone, with their claims."""
        for prefix in [p for p, (source, *_) in self.waiting.items() if source in addresses]:
            self._forget_waiting(prefix)

    def end(self, prefix: bytes, source: str) -> None:
        """Forget a waiting participant that has ended."""
        if self.is_waiting(prefix, source):
            self._forget_waiting(prefix)

    def note_recorded(
        self, recorded: Mapping[bytes, Sequence[int]], present: Container[bytes]
    ) -> None:
        """Note the ports that the operator has recorded, except for participants in ``present``.

        If not all ports of a participant are in this range, the participant gets other ports.
        """
        for prefix, ports in recorded.items():
            in_range = all(port in self.ports.pool.range for port in ports)
            if ports and prefix not in present and len(self.recorded) < MOST_WAITING:
                self.recorded[prefix] = tuple(ports) if in_range else ()
                self.ports.note_claims(prefix, self.recorded[prefix], len(ports))

    def of(self, prefix: bytes) -> Sequence[int]:
        """The ports of a participant from before the start, in the order of its locators.

        Empty if these are unknown.
        """
        return self.recorded.get(prefix) or self.port_store.former_ports(prefix)

    def take_answer(self, prefix: bytes, source: str, datagram: bytes) -> bool:
        """If a datagram is an answer of a participant to the port store, note the answer.

        Return whether the datagram is an answer. Only an answer of a waiting participant is a
        claim. Later answers follow from the present ports. Raises RtpsError.
        """
        if not self.port_store.take(prefix, datagram):
            return False
        if self.is_waiting(prefix, source) and prefix not in self.recorded:
            proven_count = self.port_store.proven_count(prefix)
            self.ports.note_claims(prefix, self.port_store.former_ports(prefix), proven_count)
        return True

    def was_inside(self, prefix: bytes) -> bool:
        """Whether there is evidence that a former process served a participant inside.

        The participant's own word does not count. The kernel's table does not count either: it has
        addresses, but no GUID prefixes.
        """
        return (
            prefix in self.recorded
            or self.port_store.proven_count(prefix) > 0
            or self.ports.is_named(prefix)
        )

    def must_be_rediscovered(self, prefix: bytes) -> bool:
        """Whether outside knows a participant by former ports.

        If so, all participants outside have to rediscover the participant.
        """
        return prefix in self.recorded or prefix in self.displaced

    def displace(self, prefix: bytes) -> None:
        """Note that the proxy has ended a participant that may be alive, and may come back."""
        if len(self.displaced) >= MOST_WAITING:
            del self.displaced[next(iter(self.displaced))]
        self.displaced[prefix] = None

    def forget_participant(self, prefix: bytes) -> None:
        """Forget a participant that has gone."""
        self.recorded.pop(prefix, None)
        self.displaced.pop(prefix, None)
        self.port_store.forget(prefix)
        self.ports.forget_claims(prefix)

    def forget_answers(self, prefix: bytes) -> None:
        """Forget the answers of a participant that has waited, and that gets no place.

        The proxy asks again after the next announcement.
        """
        self.port_store.forget(prefix)
        if prefix not in self.recorded:
            self.ports.forget_claims(prefix)

    def reminders(self, participant: InsideParticipant, now: float) -> list[Outgoing]:
        """The datagrams with which a participant keeps its present ports."""
        if participant.metatraffic is None:
            return []
        datagrams = self.port_store.reminders(
            participant.prefix, participant.ports, self._reply_target(participant.address), now
        )
        return [Outgoing(participant.metatraffic, datagram) for datagram in datagrams]

    def keepers(self, participants: Iterable[InsideParticipant]) -> list[InsideParticipant]:
        """The participants that can keep their ports.

        Of each process of Cyclone DDS this is a single participant. The participants of a process
        share the locator for metatraffic. They also share the number that is expected next from a
        writer, whichever participant a heartbeat is for (ddsi_receive.c, handle_Heartbeat). The
        first participant that has answered keeps its ports. A participant that has not answered may
        be forged.
        """
        ordered = list(participants)
        keepers = dict[tuple[str, HostPort | None], InsideParticipant]()
        for participant in ordered:
            if self.proofs.has_answered(participant.address, participant.prefix):
                keepers.setdefault((participant.address, participant.metatraffic), participant)
        return [p for p in ordered if keepers.get((p.address, p.metatraffic), p) is p]

    def _forget_waiting(self, prefix: bytes) -> None:
        self._counts -= Counter((self.waiting.pop(prefix).source,))
        self.forget_participant(prefix)

    def _is_question_closed(self, prefix: bytes, since: float, now: float) -> bool:
        """Whether a participant has answered, needs no answer, or has had `ANSWER_TIMEOUT_S`."""
        return (
            self.must_be_rediscovered(prefix)
            or self.port_store.has_answered(prefix)
            or now - since >= ANSWER_TIMEOUT_S
        )

    def _questions(self, prefix: bytes, waiting: WaitingParticipant, now: float) -> list[Outgoing]:
        if waiting.metatraffic is None:
            return []
        reached_at = self._reply_target(waiting.source)
        questions = self.port_store.questions(prefix, reached_at, now)
        return [Outgoing(waiting.metatraffic, datagram) for datagram in questions]

    def _reply_target(self, address: str) -> HostPort:
        """The address and port at which a participant inside reaches the port store."""
        return HostPort(self.settings.proxy_address_for(address), self.settings.unicast_port)
