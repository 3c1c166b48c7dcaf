"""UDPROS: the offers of subscribers lead to ports of the proxy, which pass the datagrams on.

A subscriber offers in ``requestTopic`` where it wants its datagrams
(clients/roscpp/src/libros/subscription.cpp); the publisher sends them there from a port that nobody
is told (transport_udp.cpp). So the offer is all that has to be rewritten. rospy has no UDPROS.

With ``--direction both`` neither side can send to the other:

  * an offer to a node inside, from outside or from another inside network, leads to a UDP port of
    the stand-ins on the proxy's inside address, and from there to the subscriber (`lead_outwards`);
  * an inside subscriber's offer to a node outside leads to a UDP port of the range as outside sees
    it, if the range is published for UDP (``--udp``), and from there inside (`lead_inwards`).

An offer for which there is no relay is taken out of the call: the publisher then chooses TCPROS if
that was offered, too. So is one whose connection header names another topic than the call: roscpp
serves the topic of the header (topic_manager.cpp), and the policy was asked about the call's.

A relay lasts as long as both ends of it: until the subscriber refuses, or one of them is not
registered any more (`sweep`), or the subscriber may not have the topic any more (`cut_denied`).
"""

import logging
from collections import Counter
from collections.abc import Awaitable, Callable, Collection, Iterable, Iterator
from dataclasses import dataclass
from hashlib import blake2b

import msgspec

from rosproxy.forwarding.datagrams import DatagramRelay, bind
from rosproxy.net.addresses import HostPort
from rosproxy.net.resolver import NODES, resolve
from rosproxy.ros1.context import Context
from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.protocol.xmlrpc import document as xmlrpc
from rosproxy.ros1.protocol.xmlrpc.document import Call
from rosproxy.ros1.protocol.xmlrpc.values import Edit
from rosproxy.ros1.registry.client_kinds import ClientKind
from rosproxy.ros1.registry.endpoint import Endpoint
from rosproxy.ros1.registry.stand_ins import PORTS, StandIn
from rosproxy.ros1.rewriting.udpros_offers import read_offers, redirect_offer
from rosproxy.ros1.stand_ins.outside_nodes import Outside

log = logging.getLogger(__name__)

MOST_RELAYS = 256
MOST_RELAYS_EACH = 64
"""Relays of one proxy, and of subscribers at one address. For one more the oldest relay of the
address that has most is ended: who asks for many takes none from others."""
TRIES = 64
"""Ports that are tried for one relay."""


class UdprosSubscription(msgspec.Struct, frozen=True):
    """A subscription that datagrams serve.

    ``port`` is the publisher's, lease or stand-in, ``peer`` the subscriber's address, ``target``
    where it wants its datagrams. ``inside_asks``: it is a node inside.
    """

    port: int
    topic: str
    caller_id: str
    peer: str
    target: HostPort
    inside_asks: bool


@dataclass(frozen=True, slots=True)
class _RelayCondition:
    """Checked anew each time: whether both ends are registered, and the policy allows the relay."""

    is_registered: Callable[[], bool]
    is_allowed: Callable[[], bool]

    def holds(self) -> bool:
        """Whether the relay may be open."""
        return self.is_registered() and self.is_allowed()


class UdprosRelays:
    """Opens relays for the offers that pass, and ends them."""

    def __init__(self, context: Context, outside: Outside) -> None:
        self._context = context
        self._policy = context.policy
        self._outside = outside
        self._open: dict[UdprosSubscription, tuple[DatagramRelay, _RelayCondition]] = {}

    def __iter__(self) -> Iterator[tuple[UdprosSubscription, DatagramRelay]]:
        """All that are open."""
        return iter([(s, relay) for s, (relay, _) in self._open.items()])

    def __len__(self) -> int:
        """How many there are."""
        return len(self._open)

    def connections(self) -> set[tuple[int, str, str]]:
        """The publisher's port, the topic and the subscriber's name of each."""
        return {(s.port, s.topic, s.caller_id) for s in self._open}

    async def lead_outwards(
        self, endpoint: Endpoint, call: Call, body: bytes, source: str
    ) -> bytes:
        """The call of a subscriber, for a node inside: its offers lead to ports of the proxy."""
        proxy = self._context.caller_at(endpoint).proxy
        topic = call.string(1) or ""
        caller_id = call.string(0) or ""

        def is_registered() -> bool:
            is_current = self._context.registry.by_port.get(endpoint.port) is endpoint
            return is_current and topic in endpoint.names(Kind.PUBLISHER)

        def is_allowed() -> bool:
            return not self._policy.check_outside("topic", topic, endpoint, source, caller_id)

        condition = _RelayCondition(is_registered, is_allowed)

        async def redirect(offered: HostPort) -> HostPort | None:
            target = await self._reachable(offered, source)
            if target is None:
                return None
            port = endpoint.port
            sources = [endpoint.location.address]
            subscription = UdprosSubscription(port, topic, caller_id, source, target, False)
            relay_port = self._relay_port(
                subscription, condition, proxy, _candidates(subscription, PORTS), sources
            )
            return HostPort(proxy, relay_port) if relay_port else None

        return await _rewritten(call, body, condition, redirect)

    async def lead_inwards(self, stand_in: StandIn, call: Call, body: bytes, source: str) -> bytes:
        """The call of a subscriber inside, for a node outside: its offers lead to the proxy."""
        topic = call.string(1) or ""
        caller_id = call.string(0) or ""
        settings = self._context.settings
        registry = self._context.registry

        def is_registered() -> bool:
            endpoint = registry.by_caller.get(caller_id)
            if not settings.udp or endpoint is None or endpoint.address != source:
                return False
            return (Kind.SUBSCRIBER, topic, caller_id) in endpoint.registrations

        def is_allowed() -> bool:
            return not self._policy.check_inside("topic", topic, source, caller_id)

        condition = _RelayCondition(is_registered, is_allowed)

        async def redirect(offered: HostPort) -> HostPort | None:
            # To the address that asks, whatever host the offer names: nobody has datagrams sent to
            # another machine inside.
            target = HostPort(source, offered.port)
            port = stand_in.local.port
            subscription = UdprosSubscription(port, topic, caller_id, source, target, True)
            publisher = self._context.upstream.reach(stand_in.target).host
            sources = await resolve(publisher, NODES)
            ports = _candidates(subscription, settings.ports.listen.ports())
            relay_port = self._relay_port(subscription, condition, settings.bind, ports, sources)
            return self._context.addressing.outside(relay_port) if relay_port else None

        return await _rewritten(call, body, condition, redirect)

    def sweep(self) -> None:
        """End those whose publisher or subscriber is not registered any more."""
        for subscription in [s for s, (_, c) in self._open.items() if not c.is_registered()]:
            self._end(subscription)

    def cut_denied(self) -> int:
        """End those whose subscribers may not have the topic any more; how many."""
        self.sweep()
        denied = [s for s, (_, c) in self._open.items() if not c.is_allowed()]
        for subscription in denied:
            self._end(subscription)
        return len(denied)

    def close(self) -> None:
        """End all."""
        for subscription in list(self._open):
            self._end(subscription)

    async def _reachable(self, offered: HostPort, source: str) -> HostPort | None:
        """Where the datagrams go for a subscriber that asks from an address; None if nowhere.

        That is outside or, on another inside network, at the very address that asks.
        """
        if self._context.client_kind(source) is ClientKind.ADMITTED:
            return HostPort(source, offered.port)
        try:
            return await self._outside.reach(offered)
        except OSError as error:
            log.debug("UDPROS: the subscriber at %s can't be reached: %s", offered, error)
            return None

    def _relay_port(
        self,
        subscription: UdprosSubscription,
        condition: _RelayCondition,
        address: str,
        ports: Iterable[int],
        sources: Collection[str],
    ) -> int | None:
        """The port of the relay for a subscription, opened if there is none; None if none can be.

        ``address`` and ``ports`` are where it may be, ``sources`` from where datagrams may come.
        """
        if existing := self._open.get(subscription):
            return existing[0].port
        self._make_room(subscription.peer)
        for port in ports:
            try:
                sock = bind(address, port)
                relay = DatagramRelay(
                    sock, sources, subscription.target, lambda: self._end(subscription)
                )
            except OSError as error:
                log.debug("UDPROS: no relay of %s at port %d: %s", subscription.topic, port, error)
                continue
            self._open[subscription] = relay, condition
            log.debug(
                "UDPROS: datagrams of %s that come to port %d go to %s",
                subscription.topic,
                relay.port,
                subscription.target,
            )
            return relay.port
        return None

    def _make_room(self, peer: str) -> None:
        """End a relay if there are too many of a subscriber's address, or at all."""
        counts = Counter(s.peer for s in self._open)
        if counts[peer] < MOST_RELAYS_EACH:
            if len(self._open) < MOST_RELAYS:
                return
            peer = counts.most_common(1)[0][0]
        self._end(next(s for s in self._open if s.peer == peer))

    def _end(self, subscription: UdprosSubscription) -> None:
        relay, _ = self._open.pop(subscription, (None, None))
        if relay is not None:
            relay.close()


def _candidates(subscription: UdprosSubscription, ports: range) -> list[int]:
    """The ports to try for a subscription: after a restart the same comes first."""
    seed = blake2b(
        f"{subscription.port} {subscription.topic} {subscription.caller_id}".encode(), digest_size=8
    ).digest()
    first = int.from_bytes(seed, "big")
    count = len(ports)
    return [ports[(first + number) % count] for number in range(min(TRIES, count))]


async def _rewritten(
    call: Call,
    body: bytes,
    condition: _RelayCondition,
    redirect: Callable[[HostPort], Awaitable[HostPort | None]],
) -> bytes:
    """A call with each of its offers redirected, or taken out if there may or can be no relay."""
    topic = call.string(1) or ""
    edits = list[Edit]()
    for offer in read_offers(call):
        target = None
        if offer.receiver and offer.topic == topic and condition.holds():
            target = await redirect(offer.receiver)
        edits += redirect_offer(offer, target)
    return xmlrpc.apply(body, edits)
