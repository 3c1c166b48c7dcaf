"""UDPROS: the offers of subscribers lead to ports of the proxy, which pass the datagrams on.

A subscriber offers in ``requestTopic`` where it wants its datagrams
(clients/roscpp/src/libros/subscription.cpp); the publisher sends them there from a port that nobody
is told (transport_udp.cpp). So the offer is all that has to be rewritten. rospy has no UDPROS.

With ``--direction both`` neither side can send to the other:

  * an offer to a node inside, from outside or from another inside network, leads to a UDP port of
    the stand-ins on the proxy's inside address, and from there to the subscriber (`lead_outwards`);
  * an inside subscriber's offer to a node outside leads to a UDP port of the range as outside sees
    it, if the range is published for UDP (``--udp``), and from there inside (`lead_inwards`).

An offer that can't be had is taken out of the call: the publisher then chooses TCPROS if that was
offered, too. So is one whose connection header names another topic than the call: that header is
what roscpp serves (topic_manager.cpp), and the policy has been asked for the other.

A relay lasts as long as both ends of it: until the subscriber refuses, or one of them is not
registered any more (`sweep`), or the subscriber may not have the topic any more (`cut_denied`).
"""

import logging
from collections import Counter
from collections.abc import Awaitable, Callable, Collection, Iterable, Iterator
from dataclasses import dataclass
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
from rosproxy.ros1.registry.selection import ClientKind
from rosproxy.ros1.registry.stand_ins import PORTS, StandIn
from rosproxy.ros1.rewriting.udpros import lead_to, read_offers
from rosproxy.ros1.servers.access_checks import AccessChecks
from rosproxy.ros1.standins.outside import Outside

log = logging.getLogger(__name__)

MOST_RELAYS = 256
MOST_RELAYS_EACH = 64
"""Relays of one proxy, and of subscribers at one address; with one more the oldest of those that
have most goes: who asks for many takes none from others."""
TRIES = 64
"""Ports that are tried for one."""


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
class _Right:
    """Asked anew each time: whether both ends are there still, and whether the policy lets them."""

    there: Callable[[], bool]
    allowed: Callable[[], bool]

    def holds(self) -> bool:
        """Whether a relay may be."""
        return self.there() and self.allowed()


class UdprosRelays:
    """Opens relays for the offers that pass, and ends them."""

    def __init__(self, context: Context, access: AccessChecks, outside: Outside) -> None:
        self._context, self._access, self._outside = context, access, outside
        self._open: dict[UdprosSubscription, tuple[DatagramRelay, _Right]] = {}

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
        """The call of a subscriber that asks through the proxy as a node inside is to have it."""
        proxy = self._context.caller_at(endpoint).proxy
        topic, caller_id = call.string(1) or "", call.string(0) or ""

        def there() -> bool:
            known = self._context.registry.by_port.get(endpoint.port) is endpoint
            return known and topic in endpoint.names(Kind.PUBLISHER)

        def allowed() -> bool:
            kind = RuleKind.PUBLISH
            return not self._access.outside_may_not(kind, topic, endpoint, source, caller_id)

        right = _Right(there, allowed)

        async def lead(where: HostPort) -> HostPort | None:
            target = await self._reachable(where, source)
            if target is None:
                return None
            port, sources = endpoint.port, [endpoint.location.address]
            one = UdprosSubscription(port, topic, caller_id, source, target, False)
            led = self._lead(one, right, proxy, _tried(one, PORTS), sources)
            return HostPort(proxy, led) if led else None

        return await _rewritten(call, body, right, lead)

    async def lead_inwards(self, stand_in: StandIn, call: Call, body: bytes, source: str) -> bytes:
        """The call of a subscriber inside as a node outside is to have it."""
        topic, caller_id = call.string(1) or "", call.string(0) or ""
        settings, registry = self._context.settings, self._context.registry

        def there() -> bool:
            endpoint = registry.by_caller.get(caller_id)
            if not settings.udp or endpoint is None or endpoint.address != source:
                return False
            return (Kind.SUBSCRIBER, topic, caller_id) in endpoint.registrations

        def allowed() -> bool:
            return not self._access.inside_may_not(RuleKind.SUBSCRIBE, topic, source, caller_id)

        right = _Right(there, allowed)

        async def lead(where: HostPort) -> HostPort | None:
            target, port = HostPort(source, where.port), stand_in.local.port
            one = UdprosSubscription(port, topic, caller_id, source, target, True)
            publisher = self._context.upstream.reach(stand_in.where).host
            sources = await resolve(publisher, NODES)
            ports = _tried(one, settings.ports.listen.ports())
            led = self._lead(one, right, settings.bind, ports, sources)
            return self._context.addressing.outside(led) if led else None

        return await _rewritten(call, body, right, lead)

    def sweep(self) -> None:
        """End those of which an end is gone."""
        for one in [one for one, (_, right) in self._open.items() if not right.there()]:
            self._end(one)

    def cut_denied(self) -> int:
        """End those whose subscribers may not have the topic any more; how many."""
        self.sweep()
        denied = [one for one, (_, right) in self._open.items() if not right.allowed()]
        for one in denied:
            self._end(one)
        return len(denied)

    def close(self) -> None:
        """End all."""
        for one in list(self._open):
            self._end(one)

    async def _reachable(self, where: HostPort, source: str) -> HostPort | None:
        """Where a subscriber wants its datagrams that asks from an address; None: not to be had.

        That is outside or, on another inside network, at the very address that asks.
        """
        if self._context.client_kind(source) is ClientKind.ADMITTED:
            return HostPort(source, where.port)
        try:
            return await self._outside.reach(where)
        except OSError as error:
            log.debug("no datagrams to %s: %s", where, error)
            return None

    def _lead(
        self,
        one: UdprosSubscription,
        right: _Right,
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
            self._open[one] = relay, right
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


def _tried(one: UdprosSubscription, ports: range) -> list[int]:
    """The ports to try for a subscription: after a restart the same comes first."""
    seed = blake2b(f"{one.port} {one.topic} {one.caller_id}".encode(), digest_size=8).digest()
    first, count = int.from_bytes(seed, "big"), len(ports)
    return [ports[(first + number) % count] for number in range(min(TRIES, count))]


async def _rewritten(
    call: Call,
    body: bytes,
    right: _Right,
    lead: Callable[[HostPort], Awaitable[HostPort | None]],
) -> bytes:
    """A call with each of its offers led elsewhere, or taken out if it may not or can't be had."""
    topic, edits = call.string(1) or "", list[Edit]()
    for offer in read_offers(call):
        led = None
        if offer.where and offer.topic == topic and right.holds():
            led = await lead(offer.where)
        edits += lead_to(offer, led)
    return xmlrpc.apply(body, edits)
