"""The addresses in ROS URIs: slave URIs (``http://host:port/``) and service URIs (``rosrpc://``).

An *advertised* URI carries the inside address in its path, ``http://HOST:PORT/10.0.0.5:40001/``.
Where the node calls itself by a name, a second segment holds the address that it was found at:
``http://HOST:PORT/c1:40001/10.0.0.5/``. Where its own URI has a path, as one has that another proxy
behind this one advertises, a third segment holds that. roscpp drops
the path and rospy sends it back; the port alone always suffices. The path is what lets a
restarted proxy rebuild its table from what the master holds.
"""

import re
from urllib.parse import quote, unquote, urlsplit

import msgspec

from rosproxy.net.addresses import HostPort, cached, is_address, parse_authority, parse_host_port

LONGEST_URI = 2048
"""Characters of a URI at most: a host's name has 253 at most, and it stands twice in an advertised
URI. What is longer is no URI to the proxy: it is neither rewritten nor remembered."""

LONGEST_PATH = 512
"""Characters of a node's own path that an advertised URI carries at most."""
_NO_HOST = re.compile(r"((?:http|rosrpc)://):(\d{1,5})(/?)")
_UNQUOTED = re.compile(r"[A-Za-z0-9_.:\[\]-]*")


class InsidePath(msgspec.Struct, frozen=True):
    """What an advertised URI says: the node's own host, port and path, and its address."""

    node: HostPort
    address: str | None = None
    path: str = "/"

    @property
    def slave(self) -> HostPort:
        """Where the slave API is reached."""
        return HostPort(self.address or self.node.host, self.node.port)


def parse_slave_uri(uri: str) -> HostPort | None:
    """Host and port of an ``http://host:port/…`` URI, or None if it is no such URI."""
    return parse_authority(uri) if uri.startswith("http://") and _fits(uri) else None


def parse_service_uri(uri: str) -> HostPort | None:
    """Host and port of a ``rosrpc://host:port`` URI, or None if it is no such URI."""
    return parse_authority(uri) if uri.startswith("rosrpc://") and _fits(uri) else None


def placed(uri: str, address: str) -> str:
    """A URI with the address that it came from where it names no host, as ``http://:41063``.

    roslisp says so where it has ROS_IP alone, and rosmaster takes it.
    """
    found = _NO_HOST.fullmatch(uri)
    return f"{found[1]}{HostPort(address, int(found[2]))}{found[3]}" if found else uri


def slave_uri(where: HostPort, path: str = "/") -> str:
    """The slave URI of a host and port."""
    return f"http://{where}{path}"


def service_uri(where: HostPort) -> str:
    """The service URI of a host and port; it has no path (rospy's parser takes none)."""
    return f"rosrpc://{where}"


def path_of(uri: str) -> str:
    """The path of a slave URI, as a request has it."""
    try:
        return urlsplit(uri).path or "/"
    except ValueError:
        return "/"


def inside_path(uri: str, node: HostPort, address: str) -> str:
    """The path that carries a node's own URI and its address; see the module's text."""
    segments, path = [_quoted(str(node))], path_of(uri)
    carried = path if len(path) <= LONGEST_PATH else "/"
    if node.host != address or carried != "/":
        segments.append(_quoted(address))
    if carried != "/":
        segments.append(quote(carried, safe=""))
    return f"/{'/'.join(segments)}/"


@cached
def parse_inside_path(uri: str) -> InsidePath | None:
    """The inside address in the path of an advertised URI, or None if it carries none.

    An address segment must be an IP address; a name there is refused.
    """
    if not _fits(uri):
        return None
    try:
        parts = [unquote(part) for part in urlsplit(uri).path.strip("/").split("/")]
    except ValueError:
        return None
    node = parse_host_port(parts[0])
    if node is None or len(parts) > 3 or (len(parts) > 1 and not is_address(parts[1])):
        return None
    path = parts[2] if len(parts) > 2 else "/"
    if not path.startswith("/"):
        return None
    return InsidePath(node, parts[1] if len(parts) > 1 else None, path)


def _fits(uri: str) -> bool:
    return len(uri) <= LONGEST_URI


def _quoted(text: str) -> str:
    return text if _UNQUOTED.fullmatch(text) else quote(text, safe=":[]")
