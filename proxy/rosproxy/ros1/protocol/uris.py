"""The addresses in ROS URIs: slave URIs (``http://host:port/``) and service URIs (``rosrpc://``).

An *advertised* URI is ``http://HOST:PORT/`` with a port of the range, which says all that others
need. Where the node is is remembered elsewhere (`rosproxy.ros1.registry.remembered_leases`), in the
form of a path, in which former versions advertised it: ``/10.0.0.5:40001/``. Where the node calls
itself by a name, a second segment holds the address that it was found at: ``/c1:40001/10.0.0.5/``.
Where its own URI has a path, a third one holds that.
"""

import re
from urllib.parse import quote, unquote, urlsplit

import msgspec

from rosproxy.net.addresses import HostPort, cached, is_address, parse_authority, parse_host_port

LONGEST_URI = 2048
"""Characters of a URI at most. A host's name has 253 at most, and stands twice in a URI that a
former version advertised. What is longer is no URI to the proxy: it is neither rewritten nor
remembered."""

LONGEST_PATH = 512
"""Characters of a node's own path at most that is remembered with its lease."""
_NO_HOST = re.compile(r"((?:http|rosrpc)://):(\d{1,5})(/?)")
_UNQUOTED = re.compile(r"[A-Za-z0-9_.:\[\]-]*")


class InsidePath(msgspec.Struct, frozen=True):
    """Where a node is: its own host, port and path, and its address if that is another."""

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


def with_caller_address(uri: str, address: str) -> str:
    """A URI with the address that it came from where it names no host, as ``http://:41063``.

    roslisp says so where ROS_HOSTNAME is set to nothing, and rosmaster takes it.
    """
    match = _NO_HOST.fullmatch(uri)
    return f"{match[1]}{HostPort(address, int(match[2]))}{match[3]}" if match else uri


def slave_uri(host_port: HostPort, path: str = "/") -> str:
    """The slave URI of a host and port."""
    return f"http://{host_port}{path}"


def service_uri(host_port: HostPort) -> str:
    """The service URI of a host and port; it has no path (rospy's parser takes none)."""
    return f"rosrpc://{host_port}"


def path_of(uri: str) -> str:
    """The path of a slave URI, as a request has it."""
    try:
        return urlsplit(uri).path or "/"
    except ValueError:
        return "/"


def inside_path(inside: InsidePath) -> str:
    """What is remembered of where a node is, in the form of a path; see the module's text."""
    own_path = inside.path if len(inside.path) <= LONGEST_PATH else "/"
    segments = [_quoted(str(inside.node))]
    if inside.address is not None or own_path != "/":
        segments.append(_quoted(inside.slave.host))
    if own_path != "/":
        segments.append(quote(own_path, safe=""))
    return f"/{'/'.join(segments)}/"


@cached
def parse_inside_path(uri: str) -> InsidePath | None:
    """Where the node of an advertised URI with a path is; None if the path does not tell.

    An address segment must be an IP address; a name there is refused.
    """
    if not _fits(uri):
        return None
    try:
        segments = [unquote(segment) for segment in urlsplit(uri).path.strip("/").split("/")]
    except ValueError:
        return None
    node = parse_host_port(segments[0])
    if node is None or len(segments) > 3 or (len(segments) > 1 and not is_address(segments[1])):
        return None
    path = segments[2] if len(segments) > 2 else "/"
    if not path.startswith("/"):
        return None
    return InsidePath(node, segments[1] if len(segments) > 1 else None, path)


def _fits(uri: str) -> bool:
    return len(uri) <= LONGEST_URI


def _quoted(text: str) -> str:
    return text if _UNQUOTED.fullmatch(text) else quote(text, safe=":[]")
