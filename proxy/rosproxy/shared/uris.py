"""The addresses in ROS URIs: slave URIs (``http://host:port/``) and service URIs (``rosrpc://``).

An *advertised* URI is ``http://HOST:PORT/`` with a port of the range. Other nodes need no more. The
proxy stores the location of the node elsewhere (`rosproxy.ros1.registry.remembered_leases`), in the
form of a path: ``/10.0.0.5:40001/``. Former versions advertised URIs with this path. If the node
gives a host name, a second segment has the address of the node: ``/c1:40001/10.0.0.5/``. If the
node's own URI has a path, a third segment has this path.
"""

import re
from urllib.parse import quote, unquote, urlsplit

import msgspec

from rosproxy.shared.addresses import HostPort, cached, is_address, parse_authority, parse_host_port

LONGEST_URI = 2048
"""The highest number of characters of a URI. A host name has 253 at most, and stands twice in a URI
that a former version advertised. The proxy treats a longer text as no URI, and neither rewrites nor
remembers it."""

LONGEST_PATH = 512
"""The highest number of characters of a node's own path that the proxy remembers."""
_NO_HOST = re.compile(r"((?:http|rosrpc)://):(\d{1,5})(/?)")
_UNQUOTED = re.compile(r"[A-Za-z0-9_.:\[\]-]*")


class InsidePath(msgspec.Struct, frozen=True):
    """The location of a node: its own host, port and path, and its address if that differs."""

    node: HostPort
    address: str | None = None
    path: str = "/"

    @property
    def slave(self) -> HostPort:
        """The address and port of the slave API."""
        return HostPort(self.address or self.node.host, self.node.port)


def parse_slave_uri(uri: str) -> HostPort | None:
    """Host and port of an ``http://host:port/…`` URI; None if it is no such URI."""
    return parse_authority(uri) if uri.startswith("http://") and _fits(uri) else None


def parse_service_uri(uri: str) -> HostPort | None:
    """Host and port of a ``rosrpc://host:port`` URI; None if it is no such URI."""
    return parse_authority(uri) if uri.startswith("rosrpc://") and _fits(uri) else None


def with_caller_address(uri: str, address: str) -> str:
    """A URI, with ``address`` as the host if the URI has none, as ``http://:41063``.

    roslisp sends such a URI if ROS_HOSTNAME is set to nothing, and rosmaster accepts it.
    """
    match = _NO_HOST.fullmatch(uri)
    return f"{match[1]}{HostPort(address, int(match[2]))}{match[3]}" if match else uri


def slave_uri(host_port: HostPort, path: str = "/") -> str:
    """The slave URI of a host and port."""
    return f"http://{host_port}{path}"


def service_uri(host_port: HostPort) -> str:
    """The service URI of a host and port, without a path, which rospy's parser refuses."""
    return f"rosrpc://{host_port}"


def path_of(uri: str) -> str:
    """The path of a slave URI, as a request names it; "/" if the URI has none."""
    try:
        return urlsplit(uri).path or "/"
    except ValueError:
        return "/"


def inside_path(inside: InsidePath) -> str:
    """The location of a node in the form of a path; the module docstring shows the form.

    A path of the node with more than LONGEST_PATH characters is left out.
    """
    own_path = inside.path if len(inside.path) <= LONGEST_PATH else "/"
    segments = [_quoted(str(inside.node))]
    if inside.address is not None or own_path != "/":
        segments.append(_quoted(inside.slave.host))
    if own_path != "/":
        segments.append(quote(own_path, safe=""))
    return f"/{'/'.join(segments)}/"


@cached
def parse_inside_path(uri: str) -> InsidePath | None:
    """Read the location of a node from the path of an advertised URI; None without a location.

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
