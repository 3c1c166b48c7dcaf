"""The addresses in ROS URIs: slave URIs (``http://host:port/``) and service URIs (``rosrpc://``).

An *advertised* URI carries the inside address in its path, ``http://HOST:PORT/10.0.0.5:40001/``.
Where the node calls itself by a name, a second segment holds the address that it was found at:
``http://HOST:PORT/c1:40001/10.0.0.5/``. roscpp drops
the path and rospy sends it back; the port alone always suffices. The path is what lets a
restarted proxy rebuild its table from what the master holds.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, wraps
from ipaddress import IPv4Address, IPv6Address, ip_address
from typing import TypeVar
from urllib.parse import quote, unquote, urlsplit

_MOST_CACHED, _LONGEST_CACHED = 4096, 200
_UNQUOTED = re.compile(r"[A-Za-z0-9_.:\[\]-]*")
_T = TypeVar("_T")
_HOST = re.compile(r"[\w.-]+|[0-9A-Fa-f.]*:[0-9A-Fa-f:.]*(%[\w.-]+)?")


def _cached(read: Callable[[str], _T]) -> Callable[[str], _T]:
    """Remember what short texts mean: those of a graph come with every call, and anybody's too."""
    remembered = lru_cache(_MOST_CACHED)(read)

    @wraps(read)
    def cached(text: str) -> _T:
        return remembered(text) if len(text) <= _LONGEST_CACHED else read(text)

    return cached


@dataclass(frozen=True, slots=True)
class HostPort:
    """A host (name or IP address, IPv6 without brackets) and a port."""

    host: str
    port: int

    def __str__(self) -> str:
        """``host:port``, with brackets around an IPv6 address."""
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


@dataclass(frozen=True, slots=True)
class InsidePath:
    """What the path of an advertised URI says: the node's own host and port, and its address."""

    node: HostPort
    address: str | None = None


def parse_host_port(text: str) -> HostPort | None:
    """Parse ``host:port`` or ``[v6]:port``; None if there is no valid port or no host."""
    return _authority(f"//{text}")


def parse_slave_uri(uri: str) -> HostPort | None:
    """Host and port of an ``http://host:port/…`` URI, or None if it is no such URI."""
    return _authority(uri) if uri.startswith("http://") else None


def parse_service_uri(uri: str) -> HostPort | None:
    """Host and port of a ``rosrpc://host:port`` URI, or None if it is no such URI."""
    return _authority(uri) if uri.startswith("rosrpc://") else None


def slave_uri(where: HostPort, path: str = "/") -> str:
    """The slave URI of a host and port."""
    return f"http://{where}{path}"


def service_uri(where: HostPort) -> str:
    """The service URI of a host and port; it has no path (rospy's parser takes none)."""
    return f"rosrpc://{where}"


def inside_path(node: HostPort, address: str) -> str:
    """The path that carries an inside address; see the module's text."""
    segment = _quoted(str(node))
    return f"/{segment}/" if node.host == address else f"/{segment}/{_quoted(address)}/"


@_cached
def parse_inside_path(uri: str) -> InsidePath | None:
    """The inside address in the path of an advertised URI, or None if it carries none.

    An address segment must be an IP address; a name there is refused.
    """
    try:
        parts = [unquote(part) for part in urlsplit(uri).path.strip("/").split("/")]
    except ValueError:
        return None
    node = parse_host_port(parts[0])
    if node is None or len(parts) > 2 or (len(parts) == 2 and not is_address(parts[1])):
        return None
    return InsidePath(node, parts[1] if len(parts) == 2 else None)


@_cached
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


@_cached
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


def _quoted(text: str) -> str:
    return text if _UNQUOTED.fullmatch(text) else quote(text, safe=":[]")


@_cached
def _authority(uri: str) -> HostPort | None:
    try:
        parts = urlsplit(uri)
        port = parts.port
    except ValueError:
        return None
    host = parts.netloc.rpartition(":")[0].removeprefix("[").removesuffix("]")
    return HostPort(host, port) if port and _HOST.fullmatch(host) else None
