"""A DDS domain for the tests of a process.

The ports of a domain follow from its number, and all programs of a machine receive the domain's
multicast. With the same domain, tests in two processes disturb each other.
"""

import socket

from rosproxy.shared.domain_ports import multicast_port

_DOMAINS = range(29, 0, -1)
"""Domains with ports below the ports that tests draw (`PortDraws`)."""
_SIGN = 240
"""The offset of a port of the domain that no program of the tests uses."""
_held = list[socket.socket]()


def own_domain() -> int:
    """Return the number of a domain that no other caller gets until this process ends."""
    for domain in _DOMAINS:
        sign = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            sign.bind(("127.0.0.1", multicast_port(domain) + _SIGN))
        except OSError:
            sign.close()
            continue
        _held.append(sign)
        return domain
    raise AssertionError("other processes use all domains that tests may have")
