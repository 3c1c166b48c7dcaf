"""IP addresses, hosts and ports as text.

A host is a name or an IP address. An address is *plain* without an IPv4-in-IPv6 prefix and without
a zone: the form in which addresses of peers are compared.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, wraps
from ipaddress import IPv4Address, IPv4Network, IPv6Address, IPv6Network, ip_address
from typing import NamedTuple, TypeVar
from urllib.parse import urlsplit

Network = IPv4Network | IPv6Network

_MOST_CACHED = 4096
_LONGEST_CACHED = 200
_T = TypeVar("_T")
_HOST = re.compile(r"[\w.-]+|[0-9A-Fa-f.]*:[0-9A-Fa-f:.]*(%[\w.-]+)?")


def cached(read: Callable[[str], _T]) -> Callable[[str], _T]:
    """Cache how short texts are read: those of a graph come with every call, and anybody's, too."""
    remembered = lru_cache(_MOST_CACHED)(read)

    @wraps(read)
    def cached_read(text: str) -> _T:
        return remembered(text) if len(text) <= _LONGEST_CACHED else read(text)

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
    """How packets go to an address: from which own address, and of how many bytes at most."""

    source: str
    mtu: int


def parse_host_port(text: str) -> HostPort | None:
    """Parse ``host:port`` or ``[v6]:port``; None if there is no valid port or no host."""
    return parse_authority(f"//{text}")


@cached
def as_ip(host: str) -> IPv4Address | IPv6Address | None:
    """A host as an IP address; None if it is a name."""
    try:
        return ip_address(host)
    except ValueError:
        return None


def is_address(host: str) -> bool:
    """Whether a host is an IP address rather than a name."""
    return as_ip(host) is not None


def is_loopback(host: str) -> bool:
    """Whether a host is ``localhost``, a loopback address or the unspecified address.

    All of them mean another machine to everybody else.
    """
    parsed = as_ip(plain_address(host))
    if parsed is not None:
        return parsed.is_loopback or parsed.is_unspecified
    return f".{host}".lower().endswith(".localhost")


def is_of_link(host: str) -> bool:
    """Whether a host is an IPv6 address that means something on its own link alone."""
    parsed = as_ip(host)
    return parsed is not None and parsed.version == 6 and parsed.is_link_local


@cached
def subnet(address: str) -> str:
    """An IPv4 address itself, and of an IPv6 address its network of 64 bits.

    One machine has any number of the addresses in such a network (RFC 4291, 2.5.1; RFC 8981).
    """
    parsed = as_ip(address)
    if parsed is None or parsed.version == 4:
        return address
    return str(IPv6Network((parsed, 64), strict=False))


@cached
def plain_address(address: str) -> str:
    """An IP address without an IPv4-in-IPv6 prefix (``::ffff:``) and without a zone."""
    bare = address.partition("%")[0]
    parsed = as_ip(bare)
    if parsed is None:
        return bare
    mapped = getattr(parsed, "ipv4_mapped", None)
    return str(mapped or parsed)


def parse_address(text: str) -> str | None:
    """An IP address that something may be reached at, in its plain form; None if it is none.

    The unspecified address, multicast and one with a zone are not.
    """
    parsed = as_ip(plain_address(text))
    if "%" in text or parsed is None:
        return None
    return None if parsed.is_unspecified or parsed.is_multicast else str(parsed)


@cached
def parse_authority(uri: str) -> HostPort | None:
    """Host and port of a URI of any scheme, or None if it has no valid port or no host."""
    try:
        split_uri = urlsplit(uri)
        port = split_uri.port
    except ValueError:
        return None
    # `hostname` would be in lower case and without what stands before an @, which is refused here.
    host = split_uri.netloc.rpartition(":")[0].removeprefix("[").removesuffix("]")
    return HostPort(host, port) if port and _HOST.fullmatch(host) else None


def is_inside(address: str, networks: Sequence[Network]) -> bool:
    """Whether an IP address lies in one of some networks; a name lies in none."""
    parsed = as_ip(address)
    return parsed is not None and any(parsed in network for network in networks)
