"""Decisions of the kernel plane: the target of each port, or the reason against a forward.

`syncer` reads and changes the kernel's table. The kernel reads no connection headers. So an
endpoint gets no fast port if a rule may deny a topic or service of the node
(`rosproxy.ros1.policy.checks`, may_bypass).
"""

from collections.abc import Collection, Iterable, Mapping

import msgspec

from rosproxy.forwarding.fast_ports import LeaseHolder
from rosproxy.shared.addresses import HostPort, Route, is_loopback

Forwards = Mapping[int, HostPort]
"""The address and port of the target for each forwarded port."""

FIRST_PAUSE_S = 5.0
"""Seconds of the first pause of a forward whose node has not answered; each failure doubles it."""
LONGEST_PAUSE_S = 3600.0
"""Seconds of a pause at most."""


class HostForwarding(msgspec.Struct, frozen=True):
    """Whether the kernel forwards IPv4 and IPv6 in this network namespace.

    ``longest_packet`` is the largest MTU of this network namespace's interfaces, in bytes.
    """

    ipv4: bool = True
    ipv6: bool = True
    longest_packet: int = 0


def destination(
    endpoint: LeaseHolder, host: HostForwarding, route: Route, has_connections: bool
) -> HostPort | str:
    """The target for the fast port of an endpoint, or the reason why the kernel may not forward.

    The target has the address at which the proxy has found the node, and the port that the node
    itself has named. So a forged registration can't make the kernel forward to another host.
    ``route`` is the route to that address. ``has_connections``: the kernel tracks connections, as
    for TCP.
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
    """The reason why the kernel can't forward to an address; None if the kernel can."""
    # Packets to an own address do not pass the forward hook, where the table has a chain.
    if is_loopback(address) or route.source == address:
        return "the node runs in the network namespace of the proxy itself"
    if not (host.ipv6 if ":" in address else host.ipv4):
        missing = "net.ipv6.conf.all.forwarding" if ":" in address else "net.ipv4.ip_forward"
        return f"{missing} is not 1 in the proxy's network namespace"
    if is_loopback(route.source):
        return f"the proxy has no route to {address}: add the proxy to the node's network"
    # If a packet is too long for the way inside, Linux sends ICMP to the sender. Connection
    # tracking translates the addresses in this ICMP message. Without tracking, the message has an
    # address that outside does not know, and the sender continues with packets of that length.
    if not has_connections and route.mtu < host.longest_packet:
        return (
            f"the route to {address} takes packets of at most {route.mtu} bytes, and packets of "
            f"{host.longest_packet} bytes may arrive: give the proxy's networks the same MTU"
        )
    return None


def forwards_to_keep(
    current: Forwards, endpoints: Iterable[LeaseHolder], recovered: bool
) -> dict[int, HostPort]:
    """The forwards of the earlier process that stay for now.

    ``recovered``: the registry is rebuilt. Until then, all forwards stay. Afterwards a forward
    stays if the endpoint is not ``trusted`` yet, and the forward leads to the endpoint's address.
    """
    if not recovered:
        return dict(current)
    waiting = {e.fast_port: e.address for e in endpoints if not e.trusted and e.fast_port}
    return {port: target for port, target in current.items() if waiting.get(port) == target.host}


def unchanged_forwards(
    current: Forwards, owners: Mapping[int, LeaseHolder], changed: Collection[LeaseHolder]
) -> dict[int, HostPort]:
    """The forwards whose endpoints still have the fast port and are not among ``changed``."""
    owned = ((port, target, owners.get(port)) for port, target in current.items())
    return {
        port: target
        for port, target, owner in owned
        if owner is not None and owner.fast_port == port and owner not in changed
    }


class Changes(msgspec.Struct, frozen=True):
    """Forwards to remove from the kernel's maps, and forwards to add afterwards."""

    removed: Mapping[int, HostPort] = {}
    added: Mapping[int, HostPort] = {}

    def __bool__(self) -> bool:
        """Whether there is a forward to remove or to add."""
        return bool(self.removed or self.added)


def changes(current: Forwards, wanted: Forwards) -> Changes:
    """The changes from the ``current`` forwards to the ``wanted`` forwards."""
    return Changes(_difference(current, wanted), _difference(wanted, current))


def _difference(forwards: Forwards, subtracted: Forwards) -> dict[int, HostPort]:
    """The forwards that are not in ``subtracted``.

    Compares by identity first, which is fast: nearly all targets are the same object.
    """
    triples = ((p, t, subtracted.get(p)) for p, t in forwards.items())
    return {p: t for p, t, s in triples if t is not s and t != s}


class Pauses:
    """Pauses of forwards after the node has not answered through the kernel."""

    def __init__(self) -> None:
        # By port and target: the end, the length in seconds, and the reason.
        self._pauses: dict[tuple[int, HostPort], tuple[float, float, str]] = {}

    def note(self, port: int, target: HostPort, reason: str, now: float) -> None:
        """Note a failure at the time ``now`` (s); each further pause is twice as long."""
        _, pause, _ = self._pauses.get((port, target), (0.0, FIRST_PAUSE_S / 2, ""))
        pause = min(2 * pause, LONGEST_PAUSE_S)
        self._pauses[port, target] = now + pause, pause, reason

    def reason(self, port: int, target: HostPort, now: float) -> str | None:
        """The reason for the pause of a forward; None without a pause."""
        until, _, reason = self._pauses.get((port, target), (now, 0.0, ""))
        return reason if now < until else None

    def keep(self, ports: Collection[int]) -> None:
        """Forget the failures of all ports that are not in ``ports``."""
        self._pauses = {key: value for key, value in self._pauses.items() if key[0] in ports}
