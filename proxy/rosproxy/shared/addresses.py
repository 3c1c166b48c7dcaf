"""IP addresses, hosts and ports as text.

A host is a name or an IP address. An address is *plain* without an IPv4-in-IPv6 prefix and without
a zone. The proxy compares plain addresses.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, wraps
from ipaddress import IPv4Address, IPv4Network, IPv6Address, IPv6Network, ip_address
from typing import NamedTuple, TypeVar
from urllib.parse import urlsplit

Network = IPv4Network | IPv6Network

_MOST_CACHED_RESULTS = 4096
_LONGEST_CACHED_CHARACTERS = 200
_T = TypeVar("_T")
_HOST = re.compile(r"[\w.-]+|[0-9A-Fa-f.]*:[0-9A-Fa-f:.]*(%[\w.-]+)?")


def cached(read: Callable[[str], _T]) -> Callable[[str], _T]:
    """Cache the results of a function of a short text.

    Each reading of the master's graph brings the same texts. Any client may send long texts, so the
    cache is only for texts of up to 200 characters.
    """
    remembered = lru_cache(_MOST_CACHED_RESULTS)(read)

    @wraps(read)
    def cached_read(text: str) -> _T:
        return remembered(text) if len(text) <= _LONGEST_CACHED_CHARACTERS else read(text)

    return cached_read


@dataclass(frozen=True, slots=True)
class HostPort:
    """A host (name or IP address, IPv6 without brackets) and a port."""

    host: str
    port: int

    def __str__(self) -> str:
        """``host:port``, with brackets around an IPv6 address."""
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


class Route(NamedTuple):
    """A route: ``source`` is the own address, ``mtu`` the most bytes of a packet."""

    source: str
    mtu: int


def parse_host_port(text: str) -> HostPort | None:
    """Parse ``host:port`` or ``[v6]:port``; None without a valid port or host."""
    return parse_authority(f"//{text}")


@cached
def as_ip(host: str) -> IPv4Address | IPv6Address | None:
    """Parse a host as an IP address; None for a name."""
    try:
        return ip_address(host)
    except ValueError:
        return None


def is_address(host: str) -> bool:
    """Whether a host is an IP address rather than a name."""
    return as_ip(host) is not None


def is_loopback(host: str) -> bool:
    """Whether a host is ``localhost``, a loopback address or the unspecified address.

    On each machine such a host means that machine itself.
    """
    parsed = as_ip(plain_address(host))
    if parsed is not None:
        return parsed.is_loopback or parsed.is_unspecified
    return f".{host}".lower().endswith(".localhost")


def is_ipv6_link_local(host: str) -> bool:
    """Whether a host is a link-local IPv6 address, which other links can't reach."""
    parsed = as_ip(host)
    return parsed is not None and parsed.version == 6 and parsed.is_link_local


@cached
def subnet(address: str) -> str:
    """The /64 network of an IPv6 address; an IPv4 address or name unchanged.

    A machine may have any number of addresses in a /64 network (RFC 4291, 2.5.1; RFC 8981).
    """
    parsed = as_ip(address)
    if parsed is None or parsed.version == 4:
        return address
    return str(IPv6Network((parsed, 64), strict=False))


@cached
def plain_address(address: str) -> str:
    """An IP address without an IPv4-in-IPv6 prefix (``::ffff:``) and without a zone.

    A host name stays unchanged.
    """
    bare = address.partition("%")[0]
    parsed = as_ip(bare)
    if parsed is None:
        return bare
    mapped = getattr(parsed, "ipv4_mapped", None)
    return str(mapped or parsed)


def parse_address(text: str) -> str | None:
    """Parse a unicast IP address, and return the plain form; None for any other text.

    None also for the unspecified address, and for an address with a zone.
    """
    parsed = as_ip(plain_address(text))
    if "%" in text or parsed is None:
        return None
    return None if parsed.is_unspecified or parsed.is_multicast else str(parsed)


@cached
def parse_authority(uri: str) -> HostPort | None:
    """Parse host and port of a URI of any scheme; None without a valid port or host."""
    try:
        split_uri = urlsplit(uri)
        port = split_uri.port
    except ValueError:
        return None
    # `hostname` changes the host to lower case, and drops a user name before an @. Here an @ makes
    # the URI invalid.
    host = split_uri.netloc.rpartition(":")[0].removeprefix("[").removesuffix("]")
    return HostPort(host, port) if port and _HOST.fullmatch(host) else None


def is_inside(address: str, networks: Sequence[Network]) -> bool:
    """Whether an IP address is in one of the networks; False for a name."""
    parsed = as_ip(address)
    return parsed is not None and any(parsed in network for network in networks)
