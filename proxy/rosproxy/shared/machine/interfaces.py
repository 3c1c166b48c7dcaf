"""Routes and interfaces of this machine, from the kernel."""

import errno
import socket
from ipaddress import ip_address, ip_network
from pathlib import Path

from rosproxy.shared.addresses import Network, Route, is_loopback, plain_address

_IP_MTU = 14
_IPV6_MTU = 24
"""Options of a connected socket (ip(7), ipv6(7)), which Python's module socket lacks."""
_LOOPBACK_MTU = 65_536


def address_towards(address: str) -> str:
    """The own source address of connections to ``address``."""
    return route_towards(address).source


def route_towards(address: str) -> Route:
    """The route to ``address``; the loopback route if there is no route.

    Connecting a UDP socket looks the route up, and sends no packet.
    """
    is_ipv6 = ":" in address
    with socket.socket(socket.AF_INET6 if is_ipv6 else socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            if is_ipv6 and _is_own_anycast(address):
                return Route(plain_address(address), _LOOPBACK_MTU)
            probe.connect((address, 9))
            if is_ipv6:
                mtu = probe.getsockopt(socket.IPPROTO_IPV6, _IPV6_MTU)
            else:
                mtu = probe.getsockopt(socket.IPPROTO_IP, _IP_MTU)
        except OSError:
            return Route("::1" if is_ipv6 else "127.0.0.1", _LOOPBACK_MTU)
        return Route(plain_address(probe.getsockname()[0]), mtu)


def address_into(network: Network) -> str:
    """The own source address of connections into a network."""
    # To the first host of the network, or to the only address.
    return address_towards(str(network[min(1, network.num_addresses - 1)]))


def interface_index(address: str) -> int:
    """The index of the interface with an own IPv6 address. Raises OSError for another address."""
    packed = socket.inet_pton(socket.AF_INET6, address).hex()
    for line in _lines("/proc/net/if_inet6"):
        digits, index, *_ = line.split()
        if digits == packed:
            return int(index, 16)
    raise OSError(errno.ENODEV, f"no interface has the address {address}")


def is_own(address: str) -> bool:
    """Whether an IP address belongs to this machine: a peer at the address is a program here.

    The source address of a route to an own address is the same address.
    """
    return is_loopback(address) or address_towards(address) == address


def _is_own_anycast(address: str) -> bool:
    """Whether an IPv6 address is an anycast address of this machine.

    A machine that forwards IPv6 receives what is sent to the first address of each of its networks
    (RFC 4291, 2.6.1). But Linux gives a route to this address another source.
    """
    packed = socket.inet_pton(socket.AF_INET6, address.partition("%")[0]).hex()
    return any(packed == line.split()[2] for line in _lines("/proc/net/anycast6"))


def interface_networks(without_uplink: bool = False) -> tuple[Network, ...]:
    """The networks of the interfaces of this machine, without loopback and IPv6 link-local.

    ``without_uplink``: also without the interface of the default route, unless there is no other.
    Of several default routes, the kernel uses the route with the lowest metric.
    """
    by_interface: dict[str, list[Network]] = {}
    default_routes: list[tuple[int, str]] = []
    for line in _lines("/proc/net/route")[1:]:
        interface, target, gateway, *_, metric, mask = line.split()[:8]
        if target == "00000000":
            default_routes.append((int(metric), interface))
        elif interface != "lo" and gateway == "00000000":
            network = ip_network(f"{_quad(target)}/{_quad(mask)}", strict=False)
            by_interface.setdefault(interface, []).append(network)
    for line in _lines("/proc/net/if_inet6"):
        digits, _, prefix, _, _, interface = line.split()
        address = ip_address(bytes.fromhex(digits))
        # Every interface is in fe80::/64, so this network does not tell interfaces apart.
        if interface != "lo" and not address.is_link_local:
            network = ip_network(f"{address}/{int(prefix, 16)}", strict=False)
            by_interface.setdefault(interface, []).append(network)
    _, uplink = min(default_routes, default=(0, ""))
    if without_uplink and by_interface.keys() - {uplink}:
        by_interface.pop(uplink, None)
    return tuple(network for networks in by_interface.values() for network in networks)


def default_gateways() -> frozenset[str]:
    """The gateways of the IPv4 default routes of this machine."""
    routes = [line.split() for line in _lines("/proc/net/route")[1:]]
    return frozenset(_quad(gateway) for _, target, gateway, *_ in routes if target == "00000000")


def _quad(digits: str) -> str:
    # /proc/net/route shows an address as a number in the host's byte order: little-endian here.
    return socket.inet_ntoa(bytes.fromhex(digits)[::-1])


def _lines(path: str) -> list[str]:
    try:
        return Path(path).read_text(encoding="ascii").splitlines()
    except OSError:
        return []
