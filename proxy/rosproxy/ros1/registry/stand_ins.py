"""Which ports of the proxy stand in for nodes outside, and which URIs nodes inside get.

A *stand-in* is a port on an inside address of the proxy. The proxy passes what arrives there on to
a node outside, or to the server of a service outside. There are two cases:

  * ``--direction both``: inside reaches outside only through the proxy. Every URI of outside gets a
    stand-in, at a port that the proxy chooses. Nodes inside get ``http://PROXY:PORT/`` instead of
    the URI. When a node inside sends this URI back, the proxy restores the original URI.
  * The host name of the master leads to the proxy (a network alias of Docker, so that
    ``ROS_MASTER_URI`` stays unchanged). Nodes on the master's host give the same name in their
    URIs, and these URIs lead to the proxy, too. So the proxy opens stand-ins at the same port
    numbers, and the URIs stay as they are.

The port of a URI follows from the text of the URI. So after a restart the proxy gives the URI the
same port again, and subscribers connect to this port again by themselves. The order in which URIs
come counts only if two texts lead to the same port. Then subscribers find the new port in the list
of publishers, which the proxy sends after a restart.

A slave URI also gets a second port, the *fast port*, for topics that the kernel forwards
(`rosproxy.forwarding.kernel`).
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from hashlib import blake2b

from rosproxy.shared.addresses import HostPort, is_address, is_loopback
from rosproxy.shared.ports import STAND_IN_PORTS
from rosproxy.shared.settings import Settings
from rosproxy.shared.uris import (
    LONGEST_URI,
    parse_service_uri,
    parse_slave_uri,
    service_uri,
    slave_uri,
)

MOST_STAND_INS = 1024
"""The highest number of stand-ins."""
_PORTS = STAND_IN_PORTS.ports()
_HALF = len(_PORTS) // 2
"""The first half of the ports is for the stand-ins, the second for their fast ports."""
MOST_TRIES = 16
"""The highest number of ports that the proxy tries for a URI."""
MOST_TOPICS = 512
"""The highest number of remembered topics with their ports, for a node."""
MOST_FORMER = 2048
"""The highest number of remembered former stand-ins."""


@dataclass(slots=True, eq=False)
class StandIn:
    """A port that stands in for a node or a service outside.

    - ``local``: where the stand-in listens. ``uri``: the URI at the master.
    - ``is_uri_kept``: nodes inside get the URI unchanged, and this URI leads to ``local``.
    - ``topic_ports``: the TCPROS ports that the node has named, by topic.
    - ``address``: where the proxy has reached the node; empty before.
    - ``fast_port``: a second port for topics only, which the kernel forwards if possible. None: no
      fast port.
    - ``fast_peers``: the number of connections that the kernel forwards now, by inside address.
    - ``fast_attempts``: the number of candidates for the fast port that other stand-ins had.
    """

    local: HostPort
    uri: str
    target: HostPort
    is_uri_kept: bool
    topic_ports: dict[str, int] = field(default_factory=dict)
    address: str = ""
    fast_port: int | None = None
    fast_peers: Mapping[str, int] = field(default_factory=dict)
    fast_attempts: int = 0
    inside: bool = False
    trusted: bool = True
    is_down: bool = False

    @property
    def port(self) -> int:
        """The key in the kernel plane: the number of the possible fast port; 0 if there is none."""
        return self.fast_candidate.port if self.fast_candidate else 0

    @property
    def fast_connections(self) -> int:
        """The number of connections that the kernel forwards now."""
        return sum(self.fast_peers.values())

    @property
    def label(self) -> str:
        """The node in messages."""
        return self.uri

    @property
    def node_ports(self) -> set[int]:
        """The TCPROS ports that the node has named."""
        return set(self.topic_ports.values())

    @property
    def caller_ids(self) -> list[str]:
        """The node in metrics: by host, because the URI changes with each start of the node."""
        return [self.target.host]

    @property
    def fast_candidate(self) -> HostPort | None:
        """The possible fast port; None for a service, and if the URI is kept.

        The rules of the kernel distinguish ports, but not addresses of the proxy. So a URI has a
        different fast port at each address.
        """
        if self.is_uri_kept or parse_service_uri(self.uri):
            return None
        number = _number(f"{self.local.host} {self.uri}") + self.fast_attempts**2
        return HostPort(self.local.host, _PORTS[_HALF + number % _HALF])

    def note_topic_port(self, topic: str, port: int) -> None:
        """Record the TCPROS port that the node has named for a topic. Only the latest topics stay.

        roscpp names its port for any topic, so a caller could make the proxy record names without
        end.
        """
        self.topic_ports.pop(topic, None)
        self.topic_ports[topic] = port
        while len(self.topic_ports) > MOST_TOPICS:
            del self.topic_ports[next(iter(self.topic_ports))]

    @property
    def inside_uri(self) -> str:
        """The URI that nodes inside get."""
        if self.is_uri_kept:
            return self.uri
        if parse_service_uri(self.uri):
            return service_uri(self.local)
        return slave_uri(self.local)


class StandIns:
    """The stand-ins by local address and by URI.

    ``aliased`` is the master's host name in lower case if this name may lead to the proxy, else "".
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self.is_bidirectional = settings.direction == "both"
        self.aliased = aliased_host(settings.master_uri) or ""
        self.by_local: dict[HostPort, StandIn] = {}
        """By listening address and port; the stand-in that has been unused longest is the first."""
        self._by_uri: dict[tuple[str, str], StandIn] = {}
        self._former: dict[HostPort, str] = {}
        """The URIs of former stand-ins, by listening address and port, oldest first."""
        self.by_port: dict[int, StandIn] = {}
        """The stand-ins with a fast port, by that port."""

    def target(self, uri: str) -> HostPort | None:
        """The host and port of a URI from the master that needs a stand-in; None if none is needed.

        The caller makes sure that the URI is neither of this proxy nor of inside.
        """
        host_port = parse_slave_uri(uri) or parse_service_uri(uri)
        if host_port is None or self.is_bidirectional:
            return host_port
        return host_port if self.aliased and host_port.host.lower() == self.aliased else None

    def candidates(self, uri: str, target: HostPort, address: str) -> Iterator[StandIn]:
        """The stand-ins to try for a URI at an address, always in the same order."""
        if not self.is_bidirectional:
            yield StandIn(HostPort(address, target.port), uri, target, is_uri_kept=True)
            return
        seed = _number(uri)
        for number in range(MOST_TRIES):
            port = _PORTS[(seed + number * number) % _HALF]
            yield StandIn(HostPort(address, port), uri, target, is_uri_kept=False)

    def address(self, proxy: str) -> str:
        """The address where stand-ins listen for a node inside that sees the proxy at ``proxy``.

        With ``--direction both`` this is ``proxy``. Otherwise URIs are kept, and this is
        ``--bind``, because the host name in a URI may lead to any address of the proxy.
        """
        return proxy if self.is_bidirectional else self._settings.bind

    def at(self, local: HostPort) -> StandIn | None:
        """The stand-in at which a connection arrived; None if the stand-in was removed."""
        return self.by_local.get(HostPort(self.address(local.host), local.port))

    def find(self, address: str, uri: str) -> StandIn | None:
        """The stand-in for a URI at one of the proxy's addresses."""
        return self._by_uri.get((address, uri))

    def choose_fast_candidate(self, stand_in: StandIn) -> HostPort | None:
        """Choose the first candidate that no other stand-in has, as the fast port to open.

        None if all candidates are taken. None as well if the stand-in has a fast port or may not
        have one.
        """
        if stand_in.fast_port is not None or stand_in.fast_candidate is None:
            return None
        # `port` and `fast_candidate` follow from `fast_attempts`, the loop variable.
        for stand_in.fast_attempts in range(MOST_TRIES):
            if stand_in.port not in self.by_port:
                return stand_in.fast_candidate
        return None

    def is_own_port(self, port: int) -> bool:
        """Whether the proxy itself listens at a port, or may listen there."""
        stands_in = port in self.by_port or any(port == local.port for local in self.by_local)
        return stands_in or obstacle(port, self._settings) is not None

    def add(self, stand_in: StandIn) -> None:
        """Add a stand-in that listens now."""
        self.by_local[stand_in.local] = stand_in
        self._by_uri[stand_in.local.host, stand_in.uri] = stand_in
        self._former.pop(stand_in.local, None)

    def remove(self, stand_in: StandIn) -> None:
        """Remove a stand-in that no longer listens."""
        del self.by_local[stand_in.local]
        del self._by_uri[stand_in.local.host, stand_in.uri]
        self._former[stand_in.local] = stand_in.uri
        if len(self._former) > MOST_FORMER:
            del self._former[next(iter(self._former))]
        self.note_fast_port(stand_in, None)

    def note_fast_port(self, stand_in: StandIn, port: int | None) -> None:
        """Record the fast port of a stand-in; None: the stand-in no longer has one."""
        stand_in.fast_port = port
        if port is not None:
            self.by_port[stand_in.port] = stand_in
            return
        stand_in.fast_peers = {}  # without a fast port, the plane counts no connections
        if self.by_port.get(stand_in.port) is stand_in:
            del self.by_port[stand_in.port]

    def note_used(self, stand_in: StandIn) -> None:
        """Record that a stand-in is used: the stand-in becomes the last of `by_local`."""
        if self.by_local.get(stand_in.local) is stand_in:
            self.by_local[stand_in.local] = self.by_local.pop(stand_in.local)

    def advice(self, target: HostPort, reason: str, address: str) -> str:
        """Why no port can stand in for a node, and the fix; ``address`` is the master's."""
        if self.is_bidirectional:
            return (
                f"inside nodes can't reach {target}: the proxy found no stand-in port; the last "
                f"candidate {reason}"
            )
        return (
            f"inside nodes can't reach {target}: port {target.port} {reason}. Start that node with "
            f"ROS_IP={address}; the node then gives its address instead of its host name"
        )

    def export_uri(self, uri: str) -> str | None:
        """The URI of outside for which nodes inside once got this URI; None if there is none."""
        if not self.is_bidirectional or len(uri) > LONGEST_URI:
            return None
        service = parse_service_uri(uri)
        local = service or parse_slave_uri(uri)
        if local is None:
            return None
        stand_in = self.at(local)
        original = stand_in.uri if stand_in else self._former.get(local)
        if original is None or bool(parse_service_uri(original)) is not bool(service):
            return None
        return original


def aliased_host(master_uri: str) -> str | None:
    """The master's host if it is a name that can lead to the proxy, in lower case."""
    master = parse_slave_uri(master_uri)
    if master is None or is_address(master.host) or is_loopback(master.host):
        return None
    return master.host.lower()


def obstacle(port: int, settings: Settings) -> str | None:
    """The use of a port by the proxy itself, which excludes a stand-in; None if there is none.

    The text continues a sentence about the port: "lies in …" or "is taken by …".
    """
    if port in settings.ports.listen:
        return f"lies in the range {settings.ports.listen} of the proxy"
    use_by_port = {
        settings.master_port: "the proxy's master API",
        settings.publish_master: "the published master",
        settings.admin.port: "the admin endpoint",
    }
    return f"is taken by {use_by_port[port]}" if port in use_by_port else None


def _number(text: str) -> int:
    """A number that depends on a text alone, spread evenly."""
    return int.from_bytes(blake2b(text.encode(), digest_size=8).digest(), "big")
