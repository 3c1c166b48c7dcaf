"""The kernel plane: which ports the kernel forwards to where, and why it doesn't.

Plain decisions; `syncer` reads and changes the kernel's table. A forward never sees a connection
header. Should a policy ever need one (who may subscribe to what), `destination` is the place to
answer why such an endpoint stays in user space.
"""

from collections.abc import Collection, Iterable, Mapping

import msgspec

from rosproxy.leases.fast_ports import LeaseHolder
from rosproxy.net.addresses import HostPort, Route, is_loopback

Forwards = Mapping[int, HostPort]
"""Ports with the addresses of the nodes that they are forwarded to."""

FIRST_PAUSE = 5.0
LONGEST_PAUSE = 3600.0
"""Seconds for which a forward behind which nobody answered is not made again; the first and the
longest time, it doubles from one to the other."""


class HostForwarding(msgspec.Struct, frozen=True):
    """What the kernel can do here: forward IPv4, forward IPv6.

    ``longest_packet`` is the largest MTU of this network namespace's interfaces, in bytes.
    """

    ipv4: bool = True
    ipv6: bool = True
    longest_packet: int = 0


def destination(
    endpoint: LeaseHolder, host: HostForwarding, route: Route, has_connections: bool
) -> HostPort | str:
    """Where an endpoint's fast port may be forwarded to, or why it may not.

    The address is the one that the proxy found the node at, and ``route`` leads there; the port is
    the one that the node itself named: a forged registration can't make the kernel forward to
    another host.
    """
    ports = endpoint.node_ports
    if endpoint.is_down or not endpoint.trusted:
        return "the node does not answer"
    if not ports:
        return "no subscriber has asked for a topic of the node yet"
    if len(ports) > 1:
        return "the node has topics on several TCPROS ports"
    obstacle = _obstacle(endpoint.address, host, route, has_connections)
    return obstacle or HostPort(endpoint.address, next(iter(ports)))


def _obstacle(
    address: str, host: HostForwarding, route: Route, has_connections: bool
) -> str | None:
    """What keeps the kernel from forwarding to an address; None if nothing does."""
    # What is led to an own address passes no forward hook, where the table's chain would see it.
    if is_loopback(address) or route.source == address:
        return "the node runs in the network namespace of the proxy itself"
    if not (host.ipv6 if ":" in address else host.ipv4):
        missing = "net.ipv6.conf.all.forwarding" if ":" in address else "net.ipv4.ip_forward"
        return f"{missing} is not 1 in the proxy's network namespace"
    if is_loopback(route.source):
        return f"the proxy has no route to {address}: add the proxy to the node's network"
    # Linux tells the sender of a packet that is too long for the way inside (ICMP). Connection
    # tracking translates such a message. Without tracking it names an address that is not known
    # outside, and the sender goes on to send packets of that length.
    if not has_connections and route.mtu < host.longest_packet:
        return (
            f"the route to {address} takes packets of at most {route.mtu} bytes, and packets of "
            f"{host.longest_packet} bytes may arrive: give the proxy's networks the same MTU"
        )
    return None


def forwards_to_keep(
    current: Forwards, endpoints: Iterable[LeaseHolder], recovered: bool
) -> dict[int, HostPort]:
    """The forwards from before a restart that nothing is known against yet.

    Until the registry is rebuilt these are all; after that those of endpoints whose node has not
    been heard yet, if they lead to the address where it is looked for.
    """
    if not recovered:
        return dict(current)
    waiting = {e.fast_port: e.address for e in endpoints if not e.trusted and e.fast_port}
    return {port: target for port, target in current.items() if waiting.get(port) == target.host}


def unchanged_forwards(
    current: Forwards, owners: Mapping[int, LeaseHolder], changed: Collection[LeaseHolder]
) -> dict[int, HostPort]:
    """The forwards of all endpoints that still have them, without those that have changed."""
    owned = ((port, target, owners.get(port)) for port, target in current.items())
    return {
        port: target
        for port, target, owner in owned
        if owner is not None and owner.fast_port == port and owner not in changed
    }


class Changes(msgspec.Struct, frozen=True):
    """What is to be taken out of the kernel's maps, and then put in."""

    removed: Mapping[int, HostPort] = {}
    added: Mapping[int, HostPort] = {}

    def __bool__(self) -> bool:
        """Whether there is anything to do."""
        return bool(self.removed or self.added)


def changes(current: Forwards, wanted: Forwards) -> Changes:
    """What turns the ``current`` forwards into those that are ``wanted``."""
    return Changes(_difference(current, wanted), _difference(wanted, current))


def _difference(forwards: Forwards, subtracted: Forwards) -> dict[int, HostPort]:
    """The forwards that are not in ``subtracted``; identity first: nearly all of them are."""
    triples = ((p, t, subtracted.get(p)) for p, t in forwards.items())
    return {p: t for p, t, s in triples if t is not s and t != s}


class Pauses:
    """Forwards that are not made for a while, since nobody answered behind them."""

    def __init__(self) -> None:
        self._until: dict[tuple[int, HostPort], tuple[float, float, str]] = {}

    def note(self, port: int, target: HostPort, why: str, now: float) -> None:
        """Note that a forward failed at a time; for longer each time."""
        _, pause, _ = self._until.get((port, target), (0.0, FIRST_PAUSE / 2, ""))
        pause = min(2 * pause, LONGEST_PAUSE)
        self._until[port, target] = now + pause, pause, why

    def why(self, port: int, target: HostPort, now: float) -> str | None:
        """Why a forward is not made now; None if it may be."""
        until, _, why = self._until.get((port, target), (now, 0.0, ""))
        return why if now < until else None

    def keep(self, ports: Collection[int]) -> None:
        """Forget what was noted about all other ports."""
        self._until = {key: value for key, value in self._until.items() if key[0] in ports}
