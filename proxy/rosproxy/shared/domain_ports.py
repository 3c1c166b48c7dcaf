"""The ports that DDS computes from the number of a domain (DDSI-RTPS 2.5, 9.6.2.3)."""

PORTS_PER_DOMAIN = 250
"""Domain d has the ports from 7400 + 250 d on."""
SPDP_MULTICAST = 7400
"""The multicast port of domain 0 for announcements of participants."""
SPDP_UNICAST = 7410
"""The first well-known port of domain 0."""
LAST_DOMAIN = 232
"""The last domain whose well-known ports are below 65536."""


def multicast_port(domain: int) -> int:
    """The port of a domain for announcements to the multicast group."""
    return SPDP_MULTICAST + PORTS_PER_DOMAIN * domain


def first_unicast_port(domain: int) -> int:
    """The first well-known port of a domain, which the first participant of a machine binds."""
    return SPDP_UNICAST + PORTS_PER_DOMAIN * domain
