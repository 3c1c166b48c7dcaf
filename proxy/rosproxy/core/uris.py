"""The addresses in ROS URIs: slave URIs (``http://host:port/``) and service URIs (``rosrpc://``).

An *advertised* URI carries the inside address in its path, ``http://HOST:PORT/10.0.0.5:40001/``.
Where the node calls itself by a name, a second segment holds the address that it was found at:
``http://HOST:PORT/c1:40001/10.0.0.5/``. roscpp drops
the path and rospy sends it back; the port alone always suffices. The path is what lets a
restarted proxy rebuild its table from what the master holds.
"""

import re
from dataclasses import dataclass
from ipaddress import ip_address
from urllib.parse import quote, unquote, urlsplit

_HOST = re.compile(r"[\w.-]+|[0-9A-Fa-f.]*:[0-9A-Fa-f:.]*(%[\w.-]+)?")


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
    segment = f"{quote(str(node), safe=':[]')}/"
    return f"/{segment}" if node.host == address else f"/{segment}{quote(address, safe=':')}/"


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


def is_address(host: str) -> bool:
    """Whether a host is an IP address rather than a name."""
    try:
        ip_address(host)
    except ValueError:
        return False
    return True


def is_loopback(host: str) -> bool:
    """Whether a host is ``localhost``, a loopback address or the unspecified address.

    All of them mean another machine to everybody else.
    """
    bare = plain_address(host)
    if is_address(bare):
        return ip_address(bare).is_loopback or ip_address(bare).is_unspecified
    return f".{host}".lower().endswith(".localhost")


def plain_address(address: str) -> str:
    """An IP address without an IPv4-in-IPv6 prefix (``::ffff:``) and without a zone."""
    bare = address.partition("%")[0]
    try:
        parsed = ip_address(bare)
    except ValueError:
        return bare
    mapped = getattr(parsed, "ipv4_mapped", None)
    return str(mapped or parsed)


def parse_address(text: str) -> str | None:
    """An IP address that something may be reached at, in its plain form; None if it is none.

    The unspecified address, multicast and one with a zone are not.
    """
    address = plain_address(text)
    if "%" in text or not is_address(address):
        return None
    parsed = ip_address(address)
    return None if parsed.is_unspecified or parsed.is_multicast else str(parsed)


def _authority(uri: str) -> HostPort | None:
    try:
        parts = urlsplit(uri)
        port = parts.port
    except ValueError:
        return None
    host = parts.netloc.rpartition(":")[0].removeprefix("[").removesuffix("]")
    return HostPort(host, port) if port and _HOST.fullmatch(host) else None
