"""Which ports of the proxy stand in for nodes outside, and what inside nodes are told of them.

A *stand-in* is a port on one of the proxy's inside addresses. What arrives there is passed on to
one node outside, or to the server of one service. There are two cases of it:

  * ``--direction both``: inside has no way outwards but the proxy. Every URI of outside gets a
    stand-in, at a port of the proxy's choice, and inside is told that port instead,
    ``http://PROXY:PORT/``: what comes back from inside is turned back by it.
  * The master's host name leads to the proxy (a network alias of Docker, so that ``ROS_MASTER_URI``
    need not change). The nodes on the master's host give that very name in their URIs, which lead
    to the proxy, too. So the same port numbers stand in for theirs, and the URIs stay as they are.

The port of a URI follows from its text, so that a proxy which has lost all memory gives it the same
one again: subscribers come back to the port that they were connected to, by themselves. Only where
two texts meet at one port does the order count; then the master's list, which subscribers get after
a restart, leads them on.

A slave URI gets a second port with the first, the *fast port*: topics are had there where the
kernel forwards (`rosproxy.forwarding.kernel`).
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from hashlib import blake2b

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
"""Where they are chosen from: below those that Linux gives to outgoing connections. The first half
is for the ports themselves, the second for their fast ports."""
_HALF = len(PORTS) // 2
TRIES = 16
"""How many ports are tried for a URI."""
MOST_TOPICS = 512
"""How many topics of a node are remembered with their port."""
MOST_FORMER = 2048
"""How many ports that stand in no more are remembered with what they stood for."""


@dataclass(slots=True, eq=False)
class StandIn:
    """A port that stands in for a node outside, or for a service there.

    ``local`` is where it listens, ``uri`` what the master has. ``is_uri_kept``: inside is told the
    URI as it is, which leads to ``local``. ``topic_ports`` are the TCPROS ports by topic that the
    node has named. ``address`` is where the node was reached, empty before.

    ``fast_port`` is a second port, for topics alone, which the kernel forwards where it may (None:
    it has none). ``fast_peers`` tells how many connections it forwards now, by the inside address.
    ``fast_attempts`` counts the candidates for it that other stand-ins had.
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
        """What the kernel plane knows it by: the port that may be its fast port; 0 if none may."""
        return self.fast_candidate.port if self.fast_candidate else 0

    @property
    def fast_connections(self) -> int:
        """How many connections the kernel forwards now."""
        return sum(self.fast_peers.values())

    @property
    def label(self) -> str:
        """How messages name the node."""
        return self.uri

    @property
    def node_ports(self) -> set[int]:
        """The TCPROS ports that the node has named."""
        return set(self.topic_ports.values())

    @property
    def caller_ids(self) -> list[str]:
        """What metrics call the node: by its host, since its URI is another at each start."""
        return [self.target.host]

    @property
    def fast_candidate(self) -> HostPort | None:
        """Where its fast port is to listen; None for a service, and where URIs are kept.

        The kernel's rules tell ports apart, but not the proxy's addresses: so a URI has another one
        at each of them.
        """
        if self.is_uri_kept or parse_service_uri(self.uri):
            return None
        number = _number(f"{self.local.host} {self.uri}") + self.fast_attempts**2
        return HostPort(self.local.host, PORTS[_HALF + number % _HALF])

    def note_topic_port(self, topic: str, port: int) -> None:
        """Note the TCPROS port that the node has named for a topic, and the latest such alone.

        roscpp names its port for any topic: whoever asks could have names remembered without end.
        """
        self.topic_ports.pop(topic, None)
        self.topic_ports[topic] = port
        while len(self.topic_ports) > MOST_TOPICS:
            del self.topic_ports[next(iter(self.topic_ports))]

    @property
    def inside_uri(self) -> str:
        """What inside is told instead of the URI."""
        if self.is_uri_kept:
            return self.uri
        if parse_service_uri(self.uri):
            return service_uri(self.local)
        return slave_uri(self.local)


class StandIns:
    """The stand-ins by where they listen and by what they stand for.

    ``aliased`` is the master's host name in lower case, if it may lead to the proxy.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self.is_bidirectional = settings.direction == "both"
        self.aliased = aliased_host(settings.master_uri) or ""
        self.by_local: dict[HostPort, StandIn] = {}
        """By where they listen, the one that was unused for longest first."""
        self._by_uri: dict[tuple[str, str], StandIn] = {}
        self._former: dict[HostPort, str] = {}
        """URIs by where something stood in for them, longest ago first."""
        self.by_port: dict[int, StandIn] = {}
        """The stand-ins with a fast port, by that port."""

    def target(self, uri: str) -> HostPort | None:
        """What a stand-in for a URI of the master's has to lead to; None if it needs none.

        The caller makes sure that it is no URI of this proxy's own, and none of inside.
        """
        host_port = parse_slave_uri(uri) or parse_service_uri(uri)
        if host_port is None or self.is_bidirectional:
            return host_port
        return host_port if self.aliased and host_port.host.lower() == self.aliased else None

    def candidates(self, uri: str, target: HostPort, address: str) -> Iterator[StandIn]:
        """The stand-ins to try for a URI at an address, one after the other; always the same."""
        if not self.is_bidirectional:
            yield StandIn(HostPort(address, target.port), uri, target, is_uri_kept=True)
            return
        seed = _number(uri)
        for number in range(TRIES):
            port = PORTS[(seed + number * number) % _HALF]
            yield StandIn(HostPort(address, port), uri, target, is_uri_kept=False)

    def address(self, proxy: str) -> str:
        """Where stand-ins listen for a node inside that sees the proxy at an address.

        At that address alone. Where the URIs are kept, at all addresses (``--bind``): the name in
        them may lead to any.
        """
        return proxy if self.is_bidirectional else self._settings.bind

    def at(self, local: HostPort) -> StandIn | None:
        """The stand-in at which a connection arrived."""
        return self.by_local.get(HostPort(self.address(local.host), local.port))

    def find(self, address: str, uri: str) -> StandIn | None:
        """The stand-in for a URI at one of the proxy's addresses."""
        return self._by_uri.get((address, uri))

    def choose_fast_candidate(self, stand_in: StandIn) -> HostPort | None:
        """Go on to the first of its candidates that no other stand-in has; None if all are taken.

        None as well if it needs none, since it has a fast port or may have none.
        """
        if stand_in.fast_port is not None or stand_in.fast_candidate is None:
            return None
        # `port` and `fast_candidate` follow from the attribute that is counted up here.
        for stand_in.fast_attempts in range(TRIES):
            if stand_in.port not in self.by_port:
                return stand_in.fast_candidate
        return None

    def is_own_port(self, port: int) -> bool:
        """Whether the proxy itself listens at a port, or may."""
        stands_in = port in self.by_port or any(port == local.port for local in self.by_local)
        return stands_in or obstacle(port, self._settings) is not None

    def add(self, stand_in: StandIn) -> None:
        """Take in a stand-in that listens now."""
        self.by_local[stand_in.local] = stand_in
        self._by_uri[stand_in.local.host, stand_in.uri] = stand_in
        self._former.pop(stand_in.local, None)

    def remove(self, stand_in: StandIn) -> None:
        """Forget a stand-in that listens no more."""
        del self.by_local[stand_in.local]
        del self._by_uri[stand_in.local.host, stand_in.uri]
        self._former[stand_in.local] = stand_in.uri
        if len(self._former) > MOST_FORMER:
            del self._former[next(iter(self._former))]
        self.note_fast_port(stand_in, None)

    def note_fast_port(self, stand_in: StandIn, port: int | None) -> None:
        """Note that a stand-in has a fast port, or none any more."""
        stand_in.fast_port = port
        if port is not None:
            self.by_port[stand_in.port] = stand_in
            return
        stand_in.fast_peers = {}  # nobody counts them any more
        if self.by_port.get(stand_in.port) is stand_in:
            del self.by_port[stand_in.port]

    def note_used(self, stand_in: StandIn) -> None:
        """Note that a stand-in is used."""
        if self.by_local.get(stand_in.local) is stand_in:
            self.by_local[stand_in.local] = self.by_local.pop(stand_in.local)

    def advice(self, target: HostPort, reason: str, address: str) -> str:
        """What is wrong where no port can stand in, and the fix; ``address`` is the master's."""
        if self.is_bidirectional:
            return (
                f"inside nodes can't reach {target}: the proxy found no stand-in port; the last "
                f"candidate {reason}"
            )
        return (
            f"inside nodes can't reach {target}: port {target.port} {reason}. Start that node with "
            f"ROS_IP={address}; the node then gives its address instead of its host name"
        )

    def import_uri(self, uri: str, address: str) -> str:
        """What inside nodes are told instead of a URI of outside, given the proxy's address."""
        stand_in = self.find(self.address(address), uri)
        return stand_in.inside_uri if stand_in else uri

    def export_uri(self, uri: str) -> str | None:
        """The URI of outside that inside nodes were once told this one for; None if it is none."""
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
    """What the proxy itself needs a port for, so that it can't stand in; None if nothing."""
    if port in settings.ports.listen:
        return f"lies in the range {settings.ports.listen} of the proxy"
    use_by_port = {
        settings.master_port: "the proxy's master API",
        settings.publish_master: "the published master",
        settings.admin.port: "the admin endpoint",
    }
    return f"is taken by {use_by_port[port]}" if port in use_by_port else None


def _number(text: str) -> int:
    """A number that follows from a text, and looks like any other."""
    return int.from_bytes(blake2b(text.encode(), digest_size=8).digest(), "big")
