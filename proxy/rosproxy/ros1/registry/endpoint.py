"""An endpoint: a node behind the proxy, where it is, what it registered, the port it holds."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from rosproxy.net.addresses import HostPort
from rosproxy.ros1.protocol.master_methods import Kind, prefix
from rosproxy.ros1.protocol.uris import InsidePath, parse_slave_uri, path_of
from rosproxy.ros1.registry.node_health import Health, ProbeResult
from rosproxy.telemetry.text import listed

MOST_REGISTRATIONS = 10_000
"""Registrations of one endpoint. A node for each topic of a thousand nodes, as ``rosbag record
-a``, has some thousands; a usual one has ten."""
MOST_CHARACTERS = 2_000_000
"""Characters of all names and types that are registered for one endpoint. Those of 10,000 topics of
a large system are 1,000,000."""
LONGEST_REGISTRATION = 8192
"""Characters of one registration: three names and a URI, the topic's name with its namespace."""
MOST_SERVICE_PORTS = 16
"""TCPROS ports of services that are remembered for one endpoint. rospy and roscpp have one for all
topics and services; of a node with more the rest is asked for nothing after a restart."""
MOST_FORMER_CALLERS = 64
"""Names that were registered at an endpoint and are no longer."""
MOST_NAMED = 3
"""Node names of one endpoint that a message gives: one as a rule, several where a port was used
again by another node."""
STATES = ("ok", "new", "failing", "refused", "silent", "cleaned", "ended", "unverified")


@dataclass(frozen=True, slots=True)
class NodeLocation:
    """Where a node's slave API really is.

    ``address`` is the IP address the proxy connects to. ``named``: the host that the node gives
    leads there, so that neighbours can use it. ``confirmed``: the address is the one that the
    registration came from; if not, the node's TCPROS port is believed only from the node itself.
    ``stale``: the host that the node gives is an address that it no longer has.
    """

    address: str
    named: bool
    confirmed: bool = True
    stale: bool = False


@dataclass(frozen=True, slots=True)
class Registration:
    """One registration at the master, on behalf of an endpoint.

    ``type`` is the topic's message type, ``service_api`` the service URI as the node gave it
    (None after a recovery, when only the node knows it). ``hidden``: the policy denies it, so that
    the master knows nothing of it; see `rosproxy.ros1.policy.hidden`.
    """

    kind: Kind
    name: str
    caller_id: str
    type: str = "*"
    service_api: str | None = None
    since: float = 0.0
    hidden: bool = False

    @property
    def key(self) -> tuple[Kind, str, str]:
        """What tells registrations apart at the master."""
        return self.kind, self.name, self.caller_id

    @property
    def characters(self) -> int:
        """How long its texts are together."""
        texts = self.name, self.caller_id, self.type, self.service_api or ""
        return sum(map(len, texts))


@dataclass(slots=True, eq=False)
class Endpoint:
    """An inside slave URI and the port that stands for it outside.

    ``callers`` are the nodes' names with the number of their registrations, and ``characters`` is
    how long these are together; `Registry` keeps both.
    It is plain state, and `Registry` keeps the indexes by which it is found.

    ``uri`` is what the node calls itself, ``node`` its host and port, ``port`` the one the proxy
    listens on. ``topic_ports`` are the TCPROS ports that the node itself named, by topic: one for
    all in rospy and roscpp, one for each in other client libraries.
    ``trusted`` is False while only the master's data tell of the endpoint. ``source`` is the
    address whose registration it was made for; after a recovery the node's own.

    ``former_uris`` are those by which the master may have known it: the node's own, if it
    registered around the proxy, and advertised ones of places where it was. ``unsettled``: what
    the master has may still be registered with one of them. Until ``settles_at``, a time, a list
    of publishers without this one is taken for one from before it was registered anew.

    ``fast_port`` is a second port of the range, for topics alone, which the kernel forwards where
    it may (None: it has none). ``fast_peers`` tells how many connections the kernel forwards now,
    by the peer's address.
    """

    uri: str
    node: HostPort
    location: NodeLocation
    port: int
    registrations: dict[tuple[Kind, str, str], Registration] = field(default_factory=dict)
    callers: dict[str, int] = field(default_factory=dict)
    characters: int = 0
    topic_ports: dict[str, int] = field(default_factory=dict)
    service_ports: dict[int, None] = field(default_factory=dict)
    """TCPROS ports at which it has registered services, oldest first."""
    former_callers: dict[str, None] = field(default_factory=dict)
    """Names that were registered here and are no longer, oldest first; `Registry` keeps them."""
    connections: int = 0
    """Open connections from outside that the proxy relays."""
    pending: int = 0
    """Calls on their way that register something here: the lease does not end meanwhile."""
    idle_since: float | None = None
    """When the lease was last found unused; None if it is in use, as far as is known."""
    trusted: bool = True
    source: str = ""
    health: Health = field(default_factory=Health)
    admissions: dict[tuple[HostPort, str], None] = field(default_factory=dict)
    """Hosts and ports that mean it, each with its source, oldest first; `Registry` keeps them."""
    former_uris: set[str] = field(default_factory=set)
    unsettled: bool = False
    settles_at: float = 0.0
    fast_port: int | None = None
    fast_peers: Mapping[str, int] = field(default_factory=dict)
    inside: bool = True
    restored: bool = False
    """Whether a former process of the proxy knew it, which may have known more of it."""

    def mark_alive(self, pid: int | None, topic_ports: Mapping[str, int], now: float) -> None:
        """Take in what its node has said of itself: it is served, and what it registered holds."""
        self.trusted = True
        self.topic_ports = dict(topic_ports)
        self.health.note(ProbeResult.ANSWERED, now)
        self.health.pid = pid
        self.health.cleaned = False

    def note_unused(self, now: float) -> float:
        """Note that nobody needs the lease now; for how many seconds that has been so."""
        if self.idle_since is None:
            self.idle_since = now
        return now - self.idle_since

    def note_verified(self, pid: int | None, topic_ports: Mapping[str, int]) -> None:
        """Note that the node itself has borne out what the master says of it."""
        self.topic_ports = dict(topic_ports)
        self.trusted = True
        # A known one stays: by it the prober finds out that this is another process.
        if self.health.pid is None:
            self.health.pid = pid

    def note_former_caller(self, caller_id: str) -> None:
        """Note that a name is no longer registered here."""
        self.former_callers.pop(caller_id, None)
        self.former_callers[caller_id] = None
        while len(self.former_callers) > MOST_FORMER_CALLERS:
            del self.former_callers[next(iter(self.former_callers))]

    def note_moved(self, former_uri: str, uri: str) -> None:
        """Note that the advertised URI has changed; the master still has the former one."""
        self.former_uris.add(former_uri)
        self.former_uris.discard(uri)
        self.unsettled = True

    def confirm(self) -> None:
        """Note that the node registered from its own address: what it says is believed."""
        self.location = replace(self.location, confirmed=True)
        self.trusted = True

    def note_topic_port(self, topic: str, port: int | None) -> None:
        """Note the TCPROS port that the node names for a topic now, if it does.

        Only for those that it has registered: roscpp names its port for any topic, so anybody could
        have names remembered without end.
        """
        if port is not None and self.publishes(topic):
            self.topic_ports[topic] = port
        else:
            self.topic_ports.pop(topic, None)

    def note_service_port(self, port: int) -> bool:
        """Note a TCPROS port at which the node has a service; return whether it was unknown."""
        if port in self.service_ports:
            return False
        self.service_ports[port] = None
        while len(self.service_ports) > MOST_SERVICE_PORTS:
            del self.service_ports[next(iter(self.service_ports))]
        return True

    @property
    def address(self) -> str:
        """The IP address at which the proxy reaches the node."""
        return self.location.address

    @property
    def state(self) -> str:
        """One word for its state: one of STATES."""
        return self.health.state if self.trusted else "unverified"

    @property
    def is_down(self) -> bool:
        """Whether the node is known not to answer, so that its port refuses."""
        return self.health.down

    @property
    def answers(self) -> bool:
        """Whether the node is known to be there, as far as the proxy can tell."""
        return self.trusted and not self.health.down

    @property
    def proven(self) -> bool:
        """Whether its node has ever answered here, as itself."""
        return self.trusted and self.health.answered_at is not None

    @property
    def never_found(self) -> bool:
        """Whether its node registered and has never answered here: it may be elsewhere."""
        health = self.health
        return self.trusted and health.answered_at is None and health.failures > 0

    @property
    def expendable(self) -> bool:
        """Whether its port may go to a node that lives: its own does not answer.

        One that never answered has one chance; what the master alone tells of must be borne out
        when it is asked for the first time.
        """
        if self.pending or self.connected:
            return False
        if self.proven:
            return self.health.down
        return self.health.failures > 0 or not (self.trusted or self.health.answered_at is None)

    @property
    def node_ports(self) -> set[int]:
        """The TCPROS ports that the node has named."""
        return set(self.topic_ports.values())

    @property
    def has_registered_directly(self) -> bool:
        """Whether the node registered around the proxy, so that it may do so again."""
        return any(parse_slave_uri(uri) == self.node for uri in self.former_uris)

    @property
    def inside_path(self) -> InsidePath:
        """What is remembered of where it is."""
        address = None if self.node.host == self.address else self.address
        return InsidePath(self.node, address, path_of(self.uri))

    @property
    def slave(self) -> HostPort:
        """Where the proxy reaches the slave API: what an endpoint is known by."""
        return HostPort(self.location.address, self.node.port)

    @property
    def caller_ids(self) -> list[str]:
        """The names of the nodes registered here; one, as a rule."""
        return sorted(self.callers)

    @property
    def label(self) -> str:
        """How messages name this endpoint: node name and own URI."""
        return f"{listed(self.caller_ids, MOST_NAMED) or 'unnamed node'} ({self.uri})"

    @property
    def log_fields(self) -> dict[str, str | int]:
        """What a log entry about it has as fields, to be given as ``extra``."""
        return {"node": listed(self.caller_ids, MOST_NAMED), "port": self.port}

    def names(self, kind: Kind) -> list[str]:
        """The topics, services or parameters registered as ``kind``."""
        return sorted(r.name for r in self.registrations.values() if r.kind is kind)

    def names_at_master(self, kind: Kind) -> list[str]:
        """The topics, services or parameters of a ``kind`` that the master knows of."""
        registrations = self.registrations.values()
        return sorted(r.name for r in registrations if r.kind is kind and not r.hidden)

    def callers_of(self, kind: Kind, name: str) -> list[str]:
        """The nodes here that have registered something; all that are here if none has."""
        callers = [caller for caller in self.callers if (kind, name, caller) in self.registrations]
        return callers or self.caller_ids

    def publishes(self, topic: str) -> bool:
        """Whether a topic is registered as published."""
        return any((Kind.PUBLISHER, topic, name) in self.registrations for name in self.callers)

    def may_hear_of(self, parameter: str) -> bool:
        """Whether the node may have subscribed to a parameter, or to a namespace that it is in.

        After a recovery that can't be told: the master lists no parameter subscriptions.
        """
        changed = prefix(parameter)
        return self.restored or any(
            changed.startswith(prefix(registration.name))
            for registration in self.registrations.values()
            if registration.kind is Kind.PARAM
        )

    @property
    def topics(self) -> set[str]:
        """The topics registered here, published or subscribed to."""
        return {*self.names(Kind.PUBLISHER), *self.names(Kind.SUBSCRIBER)}

    @property
    def connected(self) -> bool:
        """Whether somebody outside is connected, through the proxy or through the kernel."""
        return bool(self.connections or self.fast_peers)

    @property
    def fast_connections(self) -> int:
        """How many connections the kernel forwards now."""
        return sum(self.fast_peers.values())

    @property
    def reason_full(self) -> str | None:
        """Why nothing more is registered here; None if something may be."""
        for count, most, label in (
            (len(self.registrations), MOST_REGISTRATIONS, "registrations"),
            (self.characters, MOST_CHARACTERS, "characters of registered names"),
        ):
            if count >= most:
                return f"the node at {self.uri} has {count} {label}, at most {most} are accepted"
        return None

    @property
    def unused(self) -> bool:
        """Whether nobody needs the lease: no registration stands, nobody is connected or calls."""
        is_registered = self.registrations and not self.health.cleaned
        return not (is_registered or self.connected or self.pending)


EndpointRegistration = tuple[Endpoint, Registration]
"""A registration and the endpoint that has it."""
