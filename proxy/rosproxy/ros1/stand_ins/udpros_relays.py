"""UDPROS: redirect the offers of subscribers to ports of the proxy, which relay the datagrams.

A subscriber offers in ``requestTopic`` an address for datagrams
(clients/roscpp/src/libros/subscription.cpp). The publisher sends the datagrams there from a port
that it does not announce (transport_udp.cpp). So the proxy only has to rewrite the offer. rospy has
no UDPROS.

``--direction both`` is for networks in which neither side can send to the other. There:

  * The proxy redirects an offer to a node inside to a UDP port at the proxy's inside address, with
    a number from the ports of the stand-ins. The subscriber is outside, or in another inside
    network. The proxy relays the datagrams from the port to the subscriber
    (`redirect_offers_to_inside`).
  * The proxy redirects an offer of a subscriber inside to a node outside to a UDP port of the
    range, if the range is published for UDP (``--udp``). The offer then names the advertised host
    and the advertised port. The proxy relays the datagrams from the port to the subscriber
    (`redirect_offers_to_outside`).

If there is no relay for an offer, the proxy removes the offer from the call. The publisher then
chooses TCPROS if that was offered, too. The proxy also removes an offer whose connection header
names another topic than the call. The reason: roscpp serves the topic of the header
(topic_manager.cpp), but the policy has checked the topic of the call.

A relay ends when an ICMP error shows that the subscriber has closed its port, when the node inside
is no longer registered for the topic (`sweep`), or when the policy denies the topic (`cut_denied`).
"""

import logging
from collections import Counter
from collections.abc import Awaitable, Callable, Collection, Iterable, Iterator
from dataclasses import dataclass
from hashlib import blake2b

import msgspec

from rosproxy.forwarding.datagrams import DatagramRelay, bind
from rosproxy.ros1.context import Context
from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.protocol.xmlrpc import document as xmlrpc
from rosproxy.ros1.protocol.xmlrpc.document import Call
from rosproxy.ros1.protocol.xmlrpc.values import Edit
from rosproxy.ros1.registry.client_kinds import ClientKind
from rosproxy.ros1.registry.endpoint import Endpoint
from rosproxy.ros1.registry.stand_ins import StandIn
from rosproxy.ros1.rewriting.udpros_offers import read_offers, redirect_offer
from rosproxy.ros1.stand_ins.outside_nodes import Outside
from rosproxy.shared.addresses import HostPort, subnet
from rosproxy.shared.machine.resolver import NODES, resolve
from rosproxy.shared.ports import STAND_IN_PORTS

log = logging.getLogger(__name__)

MOST_RELAYS = 256
"""The highest number of relays. A further relay ends the oldest relay of the subscriber address, or
IPv6 network (/64), with the most relays. So an address with many relays takes none from others."""
MOST_RELAYS_EACH = 64
"""The highest number of relays for one subscriber address. A further relay of this address ends the
oldest."""
MOST_PORTS_TRIED = 64
"""The highest number of ports that the proxy tries for a relay."""


class UdprosSubscription(msgspec.Struct, frozen=True):
    """A subscription by datagrams.

    ``port`` is the lease or stand-in of the publisher, ``peer`` the address of the subscriber.
    ``target`` is the address and port at which the subscriber receives datagrams. ``inside_asks``:
    the subscriber is inside.
    """

    port: int
    topic: str
    caller_id: str
    peer: str
    target: HostPort
    inside_asks: bool


@dataclass(frozen=True, slots=True)
class _RelayCondition:
    """What a relay needs: the node inside is registered, and the policy allows the topic.

    Each call evaluates the present state.
    """

    is_registered: Callable[[], bool]
    is_allowed: Callable[[], bool]

    def holds(self) -> bool:
        """Whether the relay may be open."""
        return self.is_registered() and self.is_allowed()


class UdprosRelays:
    """Opens relays for offers, and ends these relays."""

    def __init__(self, context: Context, outside: Outside) -> None:
        self._context = context
        self._policy = context.policy
        self._outside = outside
        self._open: dict[UdprosSubscription, tuple[DatagramRelay, _RelayCondition]] = {}

    def __iter__(self) -> Iterator[tuple[UdprosSubscription, DatagramRelay]]:
        """All open relays with their subscriptions."""
        return iter([(s, relay) for s, (relay, _) in self._open.items()])

    def __len__(self) -> int:
        """The number of open relays."""
        return len(self._open)

    def connections(self) -> set[tuple[int, str, str]]:
        """The publisher's port, the topic and the subscriber's name, of each open relay."""
        return {(s.port, s.topic, s.caller_id) for s in self._open}

    async def redirect_offers_to_inside(
        self, endpoint: Endpoint, call: Call, body: bytes, source: str
    ) -> bytes:
        """The call of a subscriber to a node inside; the offers lead to relays."""
        proxy = self._context.caller_at(endpoint).proxy
        topic = call.string(1) or ""
        caller_id = call.string(0) or ""

        def is_registered() -> bool:
            is_current = self._context.registry.by_port.get(endpoint.port) is endpoint
            return is_current and endpoint.publishes(topic)

        def is_allowed() -> bool:
            return not self._policy.check_outside("topic", topic, endpoint, source, caller_id)

        condition = _RelayCondition(is_registered, is_allowed)

        async def redirect(offered: HostPort) -> HostPort | None:
            target = await self._receiver_of(offered, source)
            if target is None:
                return None
            port = endpoint.port
            sources = [endpoint.location.address]
            subscription = UdprosSubscription(port, topic, caller_id, source, target, False)
            ports = _candidates(subscription, STAND_IN_PORTS.ports())
            relay_port = self._open_relay(subscription, condition, proxy, ports, sources)
            return HostPort(proxy, relay_port) if relay_port else None

        return await _rewritten(call, body, condition, redirect)

    async def redirect_offers_to_outside(
        self, stand_in: StandIn, call: Call, body: bytes, source: str
    ) -> bytes:
        """The call of a subscriber inside to a node outside; the offers lead to relays."""
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
            # The target is the source of the call, whatever host the offer names. So no subscriber
            # directs datagrams to another machine inside.
            target = HostPort(source, offered.port)
            port = stand_in.local.port
            subscription = UdprosSubscription(port, topic, caller_id, source, target, True)
            publisher = self._context.upstream.reach(stand_in.target).host
            sources = await resolve(publisher, NODES)
            ports = _candidates(subscription, settings.ports.listen.ports())
            relay_port = self._open_relay(subscription, condition, settings.bind, ports, sources)
            return self._context.addressing.outside(relay_port) if relay_port else None

        return await _rewritten(call, body, condition, redirect)

    def sweep(self) -> None:
        """End relays whose node inside is no longer registered for the topic."""
        for subscription in [s for s, (_, c) in self._open.items() if not c.is_registered()]:
            self._end(subscription)

    def cut_denied(self) -> int:
        """End relays whose topic the policy denies now; return their number."""
        self.sweep()
        denied = [s for s, (_, c) in self._open.items() if not c.is_allowed()]
        for subscription in denied:
            self._end(subscription)
        return len(denied)

    def close(self) -> None:
        """End all relays."""
        for subscription in list(self._open):
            self._end(subscription)

    async def _receiver_of(self, offered: HostPort, source: str) -> HostPort | None:
        """The address to which the proxy sends the datagrams for an offer; None without a route.

        For a subscriber inside, this is the offered port at the source of the call.
        """
        if self._context.client_kind(source) is ClientKind.ADMITTED:
            return HostPort(source, offered.port)
        try:
            return await self._outside.reach(offered)
        except OSError as error:
            log.debug("UDPROS: the subscriber at %s can't be reached: %s", offered, error)
            return None

    def _open_relay(
        self,
        subscription: UdprosSubscription,
        condition: _RelayCondition,
        address: str,
        ports: Iterable[int],
        sources: Collection[str],
    ) -> int | None:
        """The port of the subscription's relay. Opens the relay if there is none.

        None if no port can be bound. The relay binds ``address`` and one of ``ports``, and accepts
        datagrams from ``sources`` alone.
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
        """End a relay if there are too many for the subscriber's address, or in all."""
        of_peer = [s for s in self._open if s.peer == peer]
        if len(of_peer) >= MOST_RELAYS_EACH:
            self._end(of_peer[0])
        elif len(self._open) >= MOST_RELAYS:
            networks = Counter(subnet(s.peer) for s in self._open)
            largest = networks.most_common(1)[0][0]
            self._end(next(s for s in self._open if subnet(s.peer) == largest))

    def _end(self, subscription: UdprosSubscription) -> None:
        relay, _ = self._open.pop(subscription, (None, None))
        if relay is not None:
            relay.close()


def _candidates(subscription: UdprosSubscription, ports: range) -> list[int]:
    """The ports to try for a subscription, in the same order after a restart."""
    seed = blake2b(
        f"{subscription.port} {subscription.topic} {subscription.caller_id}".encode(), digest_size=8
    ).digest()
    first = int.from_bytes(seed, "big")
    count = len(ports)
    return [ports[(first + number) % count] for number in range(min(MOST_PORTS_TRIED, count))]


async def _rewritten(
    call: Call,
    body: bytes,
    condition: _RelayCondition,
    redirect: Callable[[HostPort], Awaitable[HostPort | None]],
) -> bytes:
    """The call with the first valid offer redirected. An offer without a relay is removed.

    So are all further offers: subscribers offer UDPROS once, and a call has room for hundreds.
    """
    topic = call.string(1) or ""
    edits = list[Edit]()
    is_redirected = False
    for offer in read_offers(call):
        target = None
        is_valid = offer.topic == topic and not is_redirected
        if offer.receiver and is_valid and condition.holds():
            is_redirected = True
            target = await redirect(offer.receiver)
        edits += redirect_offer(offer, target)
    return xmlrpc.apply(body, edits)
