"""The proxy's own participants in a domain: what they say, and what they are told.

The *observer* reads which readers and writers others have, on both sides; the *keeper* has those
inside keep their ports for the next process. Neither has any of its own, and neither is told to the
other side: each side knows them as its own.
"""

from dataclasses import dataclass
from functools import partial

from rosproxy.net.addresses import HostPort
from rosproxy.ros2.discovery.domain_settings import DomainSettings, Outgoing, sent_to
from rosproxy.ros2.discovery.fragments import FragmentStores, Rewrite
from rosproxy.ros2.discovery.inside import InsideParticipants
from rosproxy.ros2.discovery.keeper import Keeper
from rosproxy.ros2.discovery.observer import Observer
from rosproxy.ros2.discovery.outside import OutsideParticipants
from rosproxy.ros2.discovery.returning import Returning
from rosproxy.ros2.protocol.announcement import farewell
from rosproxy.ros2.registry.participants import InsideParticipant
from rosproxy.ros2.rewriting.discovery import DiscoveryMessage


@dataclass(slots=True)
class OwnParticipants:
    """The observer and the keeper of a domain, and the tables in which they note what they hear."""

    settings: DomainSettings
    observer: Observer
    keeper: Keeper
    inside: InsideParticipants
    outside: OutsideParticipants
    returning: Returning
    fragments: FragmentStores

    def announced_inside(self, near: str) -> bytes:
        """The observer's announcement for a network inside, where the proxy has an address."""
        return self.observer.announcement(HostPort(near, self.settings.unicast_port))

    def announced_outside(self) -> list[Outgoing]:
        """The observer's announcement for outside, as far as that is known by name."""
        port = self.settings.ports.advertised(self.settings.discovery_port)
        reached_at = (HostPort(host, port) for host in self.settings.hosts)
        return self.settings.to_outside(self.observer.announcement(*reached_at))

    def asked_first(self, one: InsideParticipant) -> list[Outgoing]:
        """What asks one inside that has announced itself for its readers and writers."""
        return sent_to(one.metatraffic, self.observer.first_question(one.prefix))

    def met_elsewhere(self, one: InsideParticipant) -> list[Outgoing]:
        """What has one forget the keeper, which it knows where the proxy is no more."""
        self.keeper.forget(one.prefix)  # it is to remember its ports again
        return sent_to(one.metatraffic, [farewell(self.keeper.prefix)])

    def keeping(self) -> list[Outgoing]:
        """What has participants inside keep the ports that they have now."""
        everybody = self.inside.by_prefix.values()
        return [sent for one in everybody for sent in self.returning.reminders(one)]

    def told_inside(self, message: DiscoveryMessage, source: str, now: float) -> list[Outgoing]:
        """Take in what a participant inside tells the keeper, or the observer. Raises RtpsError."""
        prefix = message.prefix
        one = self.inside.at(prefix, source)
        waits = self.returning.has(prefix, source)
        if (waits or one) and self.keeper.take(prefix, message.datagram):
            return []
        if one is None:
            return []
        observed = partial(self.inside.observed, one, now=now, kept=self.returning.had(prefix))
        return sent_to(one.metatraffic, self._taken(self.settings.unicast_port, message, observed))

    def told_outside(self, message: DiscoveryMessage, source: str) -> list[Outgoing]:
        """Take in what a participant outside tells the observer. Raises RtpsError."""
        there = self.outside.at(message.prefix, source)
        if there is None:
            return []
        there.note_sent(message.datagram, self.observer.prefix)
        observed = partial(self.outside.observed, there)
        asked = self._taken(self.settings.discovery_port, message, observed)
        return self.outside.asked(there, asked)

    def forget(self, prefix: bytes) -> None:
        """Forget what a participant has told that has gone."""
        self.observer.forget(prefix)
        self.returning.forget_participant(prefix)

    def _taken(self, port: int, message: DiscoveryMessage, observed: Rewrite) -> list[bytes]:
        """What the observer asks for, after a message of discovery that came to it at a port."""
        told, asked = self.fragments.rewritten(port, message, self.observer.prefix, observed)
        for datagram in told:
            asked += self.observer.take(message.prefix, datagram)
        return asked
