"""UDPROS: the offers of subscribers lead to ports of the proxy, which pass the datagrams on.

A subscriber offers in ``requestTopic`` where it wants its datagrams
(clients/roscpp/src/libros/subscription.cpp); the publisher sends them there from a port that nobody
is told (transport_udp.cpp). So the offer is all that has to be rewritten. rospy has no UDPROS.

With ``--direction both`` neither side can send to the other:

  * an outside subscriber's offer to a node inside leads to a port on the proxy's inside address,
    and from there to the subscriber (`lead_outwards`);
  * an inside subscriber's offer to a node outside leads to a UDP port of the range as outside sees
    it, if the range is published for UDP (``--udp``), and from there inside (`lead_inwards`).

An offer that can't be had is taken out of the call: the publisher then chooses TCPROS if that was
offered, too. So is one whose connection header names another topic than the call: that header is
what roscpp serves (topic_manager.cpp), and the policy has been asked for the other.

A relay lasts as long as its subscriber: until that refuses, is not registered any more, or may not
have the topic any more (`sweep`).
"""

import logging
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator
from hashlib import blake2b

import msgspec

from rosproxy.access.rules import RuleKind
from rosproxy.forwarding.datagrams import DatagramRelay, bind
from rosproxy.net.addresses import HostPort
from rosproxy.net.resolver import NODES, resolve
from rosproxy.ros1.context import Context
from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.protocol.xmlrpc import document as xmlrpc
from rosproxy.ros1.protocol.xmlrpc.document import Call, Edit
from rosproxy.ros1.registry.endpoint import Endpoint
from rosproxy.ros1.registry.stand_ins import StandIn
from rosproxy.ros1.rewriting.udpros import lead_to, read_offers
from rosproxy.ros1.servers.judge import PolicyJudge
from rosproxy.ros1.standins.outside import Outside

log = logging.getLogger(__name__)

MOST_RELAYS = 256
MOST_RELAYS_EACH = 64
"""Relays of one proxy, and of subscribers at one address; with one more the oldest of those that
have most goes: who asks for many takes none from others."""
TRIES = 64
"""Ports of the range that are tried for one."""


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


class UdprosRelays:
    """Opens relays for the offers that pass, and ends them."""

    def __init__(self, context: Context, judge: PolicyJudge, outside: Outside) -> None:
        self._context, self._judge, self._outside = context, judge, outside
        self._open: dict[UdprosSubscription, tuple[DatagramRelay, Callable[[], bool]]] = {}

    def __iter__(self) -> Iterator[tuple[UdprosSubscription, DatagramRelay]]:
        """All that are open."""
        return iter([(one, relay) for one, (relay, _) in self._open.items()])

    def __len__(self) -> int:
        """How many there are."""
        return len(self._open)

    def connections(self) -> set[tuple[int, str, str]]:
        """Of each the publisher's port, the topic and the subscriber's name."""
        return {(one.port, one.topic, one.caller_id) for one in self._open}

    async def lead_outwards(
        self, endpoint: Endpoint, call: Call, body: bytes, source: str
    ) -> bytes:
        """The call of a subscriber outside as a node inside is to have it."""
        proxy = self._context.node_asker(endpoint).proxy
        topic, caller_id, edits = call.string(1) or "", call.string(0) or "", list[Edit]()

        def may() -> bool:
            there = self._context.registry.by_port.get(endpoint.port) is endpoint
            publishes = topic in endpoint.names(Kind.PUBLISHER)
            kind = RuleKind.PUBLISH
            return (
                there
                and publishes
                and not self._judge.outside_may_not(kind, topic, endpoint, source, caller_id)
            )

        for offer in read_offers(call):
            led = None
            if offer.where and offer.topic == topic and may():
                target = await self._reachable(offer.where)
                if target is not None:
                    port, sources = endpoint.port, [endpoint.place.address]
                    one = UdprosSubscription(port, topic, caller_id, source, target, False)
                    led = self._lead(one, may, proxy, [0], sources)
            edits += lead_to(offer, HostPort(proxy, led) if led else None)
        return xmlrpc.apply(body, edits)

    async def lead_inwards(self, stand_in: StandIn, call: Call, body: bytes, source: str) -> bytes:
        """The call of a subscriber inside as a node outside is to have it."""
        topic, caller_id, edits = call.string(1) or "", call.string(0) or "", list[Edit]()
        settings, registry = self._context.settings, self._context.registry

        def may() -> bool:
            endpoint = registry.by_caller.get(caller_id)
            itself = endpoint is not None and endpoint.address == source
            subscribes = (Kind.SUBSCRIBER, topic, caller_id) in (
                endpoint.registrations if endpoint else ()
            )
            kind = RuleKind.SUBSCRIBE
            return (
                itself
                and subscribes
                and not self._judge.inside_may_not(kind, topic, source, caller_id)
            )

        for offer in read_offers(call):
            led = None
            if settings.udp and offer.where and offer.topic == topic and may():
                target, port = HostPort(source, offer.where.port), stand_in.local.port
                one = UdprosSubscription(port, topic, caller_id, source, target, True)
                publisher = self._context.upstream.reach(stand_in.where).host
                sources = await resolve(publisher, NODES)
                led = self._lead(one, may, settings.bind, self._range_for(one), sources)
            edits += lead_to(offer, self._context.addressing.outside(led) if led else None)
        return xmlrpc.apply(body, edits)

    def sweep(self) -> int:
        """End those whose subscribers are gone, or may not have the topic any more; how many."""
        over = [one for one, (_, may) in self._open.items() if not may()]
        for one in over:
            self._end(one)
        return len(over)

    def close(self) -> None:
        """End all."""
        for one in list(self._open):
            self._end(one)

    async def _reachable(self, where: HostPort) -> HostPort | None:
        """Where an address outside is; None if it is not outside, or not to be found."""
        try:
            return await self._outside.reach(where)
        except OSError as error:
            log.debug("no datagrams to %s: %s", where, error)
            return None

    def _range_for(self, one: UdprosSubscription) -> list[int]:
        """The ports of the range to try: after a restart the same comes first."""
        ports = list(self._context.settings.ports.listen.ports())
        seed = blake2b(f"{one.port} {one.topic} {one.caller_id}".encode(), digest_size=8).digest()
        first = int.from_bytes(seed, "big") % len(ports)
        return [*ports[first:], *ports[:first]][:TRIES]

    def _lead(
        self,
        one: UdprosSubscription,
        may: Callable[[], bool],
        address: str,
        ports: Iterable[int],
        sources: Collection[str],
    ) -> int | None:
        """The port of the relay for a subscription, opened if there is none; None if none can be.

        ``address`` and ``ports`` are where it may be, ``sources`` from where datagrams may come.
        """
        if known := self._open.get(one):
            return known[0].port
        self._make_room(one.peer)
        for port in ports:
            try:
                sock = bind(address, port)
                relay = DatagramRelay(sock, sources, one.target, lambda: self._end(one))
            except OSError as error:
                log.debug("no datagrams for %s at port %d: %s", one.topic, port, error)
                continue
            self._open[one] = relay, may
            log.debug("datagrams of %s at port %d go to %s", one.topic, relay.port, one.target)
            return relay.port
        return None

    def _make_room(self, peer: str) -> None:
        """End a relay if there are too many of a subscriber's address, or at all."""
        crowds = Counter(one.peer for one in self._open)
        if crowds[peer] < MOST_RELAYS_EACH:
            if len(self._open) < MOST_RELAYS:
                return
            peer = crowds.most_common(1)[0][0]
        self._end(next(one for one in self._open if one.peer == peer))

    def _end(self, one: UdprosSubscription) -> None:
        relay, _ = self._open.pop(one, (None, None))
        if relay is not None:
            relay.close()
