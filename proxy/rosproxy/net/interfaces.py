"""What the operating system knows of addresses: routes and interfaces."""

import socket
from ipaddress import ip_address, ip_network
from pathlib import Path

from rosproxy.net.addresses import Network, is_loopback, plain_address


def address_towards(address: str) -> str:
    """The address of this machine that connections to ``address`` come from.

    Connecting a UDP socket only looks up the route; nothing is sent.
    """
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    with socket.socket(family, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((address, 9))
        except OSError:
            return "::1" if family == socket.AF_INET6 else "127.0.0.1"
        return plain_address(probe.getsockname()[0])


def is_own(address: str) -> bool:
    """Whether an IP address is this machine's own, so that a peer that has it is a program here.

    The route to an own address begins at that address.
    """
    return is_loopback(address) or address_towards(address) == address


def interface_networks() -> tuple[Network, ...]:
    """The networks that this machine's own interfaces are in, without loopback."""
    networks: list[Network] = []
    for line in _lines("/proc/net/route")[1:]:
        interface, target, gateway, *_, mask = line.split()[:8]
        if interface != "lo" and gateway == "00000000" and target != "00000000":
            networks.append(ip_network(f"{_quad(target)}/{_quad(mask)}", strict=False))
    for line in _lines("/proc/net/if_inet6"):
        digits, _, prefix, _, _, interface = line.split()
        address = ip_address(bytes.fromhex(digits))
        if interface != "lo" and not address.is_link_local:
            networks.append(ip_network(f"{address}/{int(prefix, 16)}", strict=False))
    return tuple(networks)


def _quad(digits: str) -> str:
    return socket.inet_ntoa(bytes.fromhex(digits)[::-1])


def _lines(path: str) -> list[str]:
    try:
        return Path(path).read_text(encoding="ascii").splitlines()
    except OSError:
        return []
