"""Which ports of the proxy stand in for nodes outside, and what inside nodes are told of them.

A *stand-in* is a port on one of the proxy's inside addresses. What arrives there is passed on to
one node outside, or to the server of one service. There are two cases of it:

  * ``--direction both``: inside has no way outwards but the proxy. Every URI of outside gets a
    stand-in, at a port of the proxy's choice, and inside is told that port instead. A slave URI
    carries the original in its path, ``http://PROXY:PORT/outside/http%3A%2F%2Frobot%3A41234%2F``,
    so that whatever comes back can be undone without memory. A service URI can carry no path
    (`rosproxy.ros1.protocol.uris`): it is known by its port.
  * The master's host name leads to the proxy (a network alias of Docker, so that ``ROS_MASTER_URI``
    need not change). The nodes on the master's host give that very name in their URIs, which lead
    to the proxy, too. So the same port numbers stand in for theirs, and the URIs stay as they are.

The port of a URI follows from its text, so that a proxy which has lost all memory gives it the same
one again: subscribers come back to the port that they were connected to, by themselves. Only where
two texts meet at one port does the order count; then the master's list, which subscribers get after
a restart, leads them on.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from hashlib import blake2b
from urllib.parse import quote, unquote, urlsplit

from rosproxy.net.addresses import HostPort, is_address, is_loopback
from rosproxy.ros1.protocol.uris import (
    LONGEST_URI,
    parse_service_uri,
    parse_slave_uri,
    service_uri,
    slave_uri,
)
from rosproxy.settings import Settings

MOST_STAND_INS = 1024
"""How many ports stand in for nodes at most."""
PORTS = range(20_000, 32_768)
"""Where they are chosen from: below those that Linux gives to outgoing connections."""
TRIES = 16
"""How many ports are tried for a URI."""
_PREFIX = "/outside/"


@dataclass(slots=True, eq=False)
class StandIn:
    """A port that stands in for a node outside, or for a service there.

    ``local`` is where it listens, ``uri`` what the master has. ``kept``: inside is told the URI as
    it is, which leads to ``local``. ``topic_ports`` are the TCPROS ports by topic that the node has
    named.
    """

    local: HostPort
    uri: str
    where: HostPort
    kept: bool
    topic_ports: dict[str, int] = field(default_factory=dict)

    @property
    def told(self) -> str:
        """What inside is told instead of the URI."""
        if self.kept:
            return self.uri
        if parse_service_uri(self.uri):
            return service_uri(self.local)
        return slave_uri(self.local, _PREFIX + quote(self.uri, safe=""))


class StandIns:
    """The stand-ins by where they listen and by what they stand for.

    ``aliased`` is the master's host name in lower case, if it may lead to the proxy.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self.both = settings.direction == "both"
        self.aliased = aliased_host(settings.master_uri) or ""
        self.by_local: dict[HostPort, StandIn] = {}
        """The one that was of no use for longest first."""
        self._by_uri: dict[tuple[str, str], StandIn] = {}

    def target(self, uri: str) -> HostPort | None:
        """What a stand-in for a URI of the master's has to lead to; None if it needs none.

        The caller knows that it is no URI of this proxy's own, and none of inside.
        """
        where = parse_slave_uri(uri) or parse_service_uri(uri)
        if where is None or self.both:
            return where
        return where if self.aliased and where.host.lower() == self.aliased else None

    def candidates(self, uri: str, where: HostPort, address: str) -> Iterator[StandIn]:
        """Those to try for a URI at an address, one after the other; always the same."""
        if not self.both:
            yield StandIn(HostPort(address, where.port), uri, where, kept=True)
            return
        seed = int.from_bytes(blake2b(uri.encode(), digest_size=8).digest(), "big")
        for number in range(TRIES):
            port = PORTS[(seed + number * number) % len(PORTS)]
            yield StandIn(HostPort(address, port), uri, where, kept=False)

    def address(self, towards: str) -> str:
        """Where stand-ins listen for a node inside that sees the proxy at an address.

        At that address alone; but at all where the URIs are kept, since a name may lead to any.
        """
        return towards if self.both else self._settings.bind

    def at(self, local: HostPort) -> StandIn | None:
        """The stand-in at which a connection arrived."""
        return self.by_local.get(HostPort(self.address(local.host), local.port))

    def find(self, address: str, uri: str) -> StandIn | None:
        """The stand-in for a URI at one of the proxy's addresses."""
        return self._by_uri.get((address, uri))

    def add(self, stand_in: StandIn) -> None:
        """Take in one that listens now."""
        self.by_local[stand_in.local] = stand_in
        self._by_uri[stand_in.local.host, stand_in.uri] = stand_in

    def remove(self, stand_in: StandIn) -> None:
        """Forget one that listens no more."""
        del self.by_local[stand_in.local]
        del self._by_uri[stand_in.local.host, stand_in.uri]

    def note_used(self, stand_in: StandIn) -> None:
        """Note that it is of use."""
        if self.by_local.get(stand_in.local) is stand_in:
            self.by_local[stand_in.local] = self.by_local.pop(stand_in.local)

    def advice(self, where: HostPort, why: str, address: str) -> str:
        """What is wrong where no port can stand in, and the cure; ``address`` is the master's."""
        if self.both:
            return f"inside nodes can't reach it: no port stands in for {where}; the last {why}"
        return (
            f"inside nodes can't reach it: port {where.port} {why}. Start that node with "
            f"ROS_IP={address}, so that it gives its address instead of its host name"
        )

    def import_uri(self, uri: str, address: str) -> str:
        """What inside nodes are told instead of a URI of outside, given the proxy's address."""
        found = self.find(self.address(address), uri)
        return found.told if found else uri

    def export_uri(self, uri: str) -> str | None:
        """The URI of outside that inside nodes were once told this one for; None if it is none."""
        if not self.both or len(uri) > LONGEST_URI:
            return None
        if where := parse_service_uri(uri):
            found = self.at(where)
            return found.uri if found else None
        return _original(uri)


def aliased_host(master_uri: str) -> str | None:
    """The master's host if it is a name that can lead to the proxy, in lower case."""
    where = parse_slave_uri(master_uri)
    if where is None or is_address(where.host) or is_loopback(where.host):
        return None
    return where.host.lower()


def path_of(uri: str) -> str:
    """The path of a slave URI, as a request has it."""
    try:
        return urlsplit(uri).path or "/"
    except ValueError:
        return "/"


def obstacle(port: int, settings: Settings) -> str | None:
    """What the proxy itself needs a port for, so that it can't stand in; None if nothing."""
    if port in settings.ports.listen:
        return f"lies in --port-range {settings.ports.listen}"
    own = {
        settings.master_port: "--master-port",
        settings.publish_master: "--publish-master",
        settings.admin.port: "--admin-bind",
    }
    return f"is that of {own[port]}" if port in own else None


def _original(uri: str) -> str | None:
    """What the path of a slave URI carries; None if it carries no URI."""
    if parse_slave_uri(uri) is None:
        return None
    try:
        path = urlsplit(uri).path
    except ValueError:
        return None
    original = unquote(path.removeprefix(_PREFIX)) if path.startswith(_PREFIX) else ""
    return original if parse_slave_uri(original) else None
