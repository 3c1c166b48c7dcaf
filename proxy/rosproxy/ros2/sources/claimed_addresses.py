"""Addresses at which no participant outside can be, whatever a datagram claims.

The LAN relay passes on the source addresses of announcements, and source addresses may be forged.
The proxy opens stand-ins inside that lead to a participant outside. No stand-in may lead back
inside, to the machine of the proxy, or to the proxy's own ports.
"""

from collections.abc import Container

from rosproxy.ros2.domain_settings import DomainSettings
from rosproxy.shared.addresses import HostPort, as_ip, is_ipv6_link_local, is_loopback

_BROADCAST = "255.255.255.255"


def claim_fault(address: str, settings: DomainSettings) -> str | None:
    """Return why no participant outside can be at an address; None if a participant can.

    The address of the advertised host may be claimed, even if the proxy itself has that address:
    participants may run on the LAN relay's machine. `is_proxy_port` protects the proxy's ports.
    """
    parsed = as_ip(address)
    if parsed is None or is_loopback(address) or address == _BROADCAST or parsed.is_multicast:
        return f"{address} is not an address of a machine on a LAN"
    if is_ipv6_link_local(address):
        return f"{address} is a link-local address; use a global address on that machine"
    if settings.is_inside(address):
        return f"{address} is in an inside network"
    if address not in settings.hosts and settings.proxy_address_for(address) == address:
        return f"{address} is an address of the proxy itself"
    return None


def is_proxy_port(locator: HostPort, stand_ins: Container[int], settings: DomainSettings) -> bool:
    """Return whether a locator is a port of the proxy, seen from outside or the proxy's machine.

    A stand-in for this locator would lead back inside. ``stand_ins`` are the open stand-ins.
    """
    if locator.port in settings.ports.advertise and locator.host in settings.hosts:
        return True
    port = locator.port
    is_open = port in settings.ports.listen or port == settings.unicast_port or port in stand_ins
    return is_open and settings.proxy_address_for(locator.host) == locator.host
