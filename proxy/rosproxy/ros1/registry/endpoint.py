"""An endpoint: a node behind the proxy, with location, registrations and port."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from rosproxy.ros1.protocol.master_methods import Kind, prefix
from rosproxy.ros1.registry.node_health import Health, ProbeResult
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.output.text import listed
from rosproxy.shared.uris import InsidePath, parse_slave_uri, path_of

MOST_REGISTRATIONS = 10_000
"""The highest number of registrations of an endpoint. ``rosbag record -a`` on a system of a
thousand nodes has a few thousand, most nodes have ten."""
MOST_CHARACTERS = 2_000_000
"""The highest number of characters of all registered names and types of an endpoint. 10,000 topics
of a large system have 1,000,000."""
MOST_CALLERS = 64
"""The highest number of node names of an endpoint. Most endpoints have a single name. The policy
judges a topic for each name of an endpoint."""
LONGEST_REGISTRATION = 8192
"""Most characters of a registration: three names and a URI. The topic name has the namespace."""
MOST_SERVICE_PORTS = 16
"""Remembered TCPROS ports of services for an endpoint. rospy and roscpp have a single port for all
topics and services. After a restart the proxy does not try ports beyond this number."""
MOST_FORMER_CALLERS = 64
"""Remembered names that are no longer registered at an endpoint."""
MOST_SHOWN_NAMES = 3
"""Most node names of an endpoint in a message. Most endpoints have a single name. An endpoint has
several names if another node has used the same port again."""
STARTING_S = 10.0
"""Seconds after its last registration in which a node may register more. Most nodes register all
their topics within a second."""
STATES = ("ok", "new", "failing", "refused", "silent", "cleaned", "ended", "unverified")
"""The values of `Endpoint.state`."""


@dataclass(frozen=True, slots=True)
class NodeLocation:
    """The location of a node's slave API.

    - ``address``: the IP address to which the proxy connects.
    - ``named``: the host name that the node gives leads to this address, so neighbours can use
      the name.
    - ``confirmed``: the registration came from this address. If not, the proxy takes the TCPROS
      port only from the node itself.
    - ``stale``: the host that the node gives is an address that the node no longer has.
    """

    address: str
    named: bool
    confirmed: bool = True
    stale: bool = False


@dataclass(frozen=True, slots=True)
class Registration:
    """A registration at the master, on behalf of an endpoint.

    ``type`` is the message type of the topic, ``service_api`` the service URI as the node gave it.
    The URI is None after a recovery, because only the node knows the URI. ``since`` is the time of
    the registration in seconds of the proxy's clock; 0 if only the master mentions it.
    ``hidden``: the policy denies the registration, and the master does not have it; see
    `rosproxy.ros1.policy.hidden`. ``characters`` is the number of characters of all texts. Each
    character counts as its bytes in XML, six at most. ROS allows only characters that have one byte
    there, but rosmaster accepts all characters.
    """

    kind: Kind
    name: str
    caller_id: str
    type: str = "*"
    service_api: str | None = None
    since: float = 0.0
    hidden: bool = False
    characters: int = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Count the characters, once for all checks of a bound."""
        texts = (self.name + self.caller_id + self.type + (self.service_api or "")).encode()
        escaped = len(texts) - len(texts.translate(None, b"&<>\"'"))
        object.__setattr__(self, "characters", len(texts) + 5 * escaped)

    @property
    def key(self) -> tuple[Kind, str, str]:
        """The values that identify a registration at the master."""
        return self.kind, self.name, self.caller_id


@dataclass(slots=True, eq=False)
class Endpoint:
    """An inside slave URI, and the port at which outside reaches the node.

    An endpoint is plain state. `Registry` keeps the indexes, ``callers`` (the keys of the
    registrations by node name) and ``characters`` (the length of all registrations).

    - ``uri``: the slave URI from the node. ``node``: the host and port of this URI.
    - ``port``: the lease, where the proxy listens.
    - ``topic_ports``: the TCPROS ports that the node itself named, by topic. rospy and roscpp have
      a single port for all topics, other client libraries a port for each topic.
    - ``trusted``: False while only the data of the master mention the endpoint.
    - ``source``: the address from which the first registration came. After a recovery, the address
      of the node.
    - ``former_uris``: other URIs by which the master may have the node. A node that registered at
      the real master directly has its own URI there. A node that moved has former advertised URIs.
    - ``unsettled``: the master may still have registrations with a former URI.
    - ``settles_at``: until this time, the proxy takes a list of publishers without this node for a
      list from before the new registration.
    - ``fast_port``: a second port of the range for topics only, which the kernel forwards if
      possible. None: no fast port.
    - ``fast_peers``: the number of connections that the kernel forwards now, by address of the
      peer.
    """

    uri: str
    node: HostPort
    location: NodeLocation
    port: int
    registrations: dict[tuple[Kind, str, str], Registration] = field(default_factory=dict)
    callers: dict[str, dict[tuple[Kind, str, str], None]] = field(default_factory=dict)
    characters: int = 0
    topic_ports: dict[str, int] = field(default_factory=dict)
    service_ports: dict[int, None] = field(default_factory=dict)
    """TCPROS ports at which the node has registered services, oldest first."""
    former_callers: dict[str, None] = field(default_factory=dict)
    """Names that are no longer registered at this endpoint, oldest first. `Registry` adds names."""
    connections: int = 0
    """Open connections from outside that the proxy relays."""
    promised: Counter[str] = field(default_factory=Counter)
    """Registrations that the proxy has admitted and the master has not answered yet, by node name.
    `Registry` counts these."""
    promised_characters: int = 0
    """The number of characters of these registrations."""
    pending: int = 0
    """Calls under way that register something here. The lease does not end meanwhile."""
    idle_since: float | None = None
    """When the lease was first found unused after its last use; None while the lease is in use, as
    far as known."""
    trusted: bool = True
    source: str = ""
    health: Health = field(default_factory=Health)
    admissions: dict[tuple[HostPort, str], None] = field(default_factory=dict)
    """Hosts and ports of this endpoint with the source of each, oldest first. `Registry` adds
    entries."""
    former_uris: set[str] = field(default_factory=set)
    unsettled: bool = False
    settles_at: float = 0.0
    fast_port: int | None = None
    fast_peers: Mapping[str, int] = field(default_factory=dict)
    inside: bool = True
    restored: bool = False
    """Whether a former process of the proxy had the endpoint, perhaps with registrations that are
    unknown now."""

    def mark_alive(self, pid: int | None, topic_ports: Mapping[str, int], now: float) -> None:
        """Record an answer of the node. The proxy serves the node, and the registrations hold."""
        self.trusted = True
        self.topic_ports = dict(topic_ports)
        self.health.note(ProbeResult.ANSWERED, now)
        self.health.pid = pid
        self.health.cleaned = False

    def note_unused(self, now: float) -> float:
        """Record that the lease is unused now; return the seconds since `idle_since`."""
        if self.idle_since is None:
            self.idle_since = now
        return now - self.idle_since

    def note_verified(self, pid: int | None, topic_ports: Mapping[str, int]) -> None:
        """Record that the node itself has confirmed the registrations at the master."""
        self.topic_ports = dict(topic_ports)
        self.trusted = True
        # A known pid stays, so that the prober notices another process.
        if self.health.pid is None:
            self.health.pid = pid

    def is_starting(self, now: float) -> bool:
        """Whether the node registers now, or has registered lately."""
        latest = max((r.since for r in self.registrations.values()), default=now)
        return self.pending > 0 or now - latest < STARTING_S

    def note_former_caller(self, caller_id: str) -> None:
        """Record that a name is no longer registered here."""
        self.former_callers.pop(caller_id, None)
        self.former_callers[caller_id] = None
        while len(self.former_callers) > MOST_FORMER_CALLERS:
            del self.former_callers[next(iter(self.former_callers))]

    def note_moved(self, former_uri: str, uri: str) -> None:
        """Record that the advertised URI has changed. The master still has the former URI."""
        self.former_uris.add(former_uri)
        self.former_uris.discard(uri)
        self.unsettled = True

    def confirm(self) -> None:
        """Record a registration from the node's own address, so that the proxy trusts the node."""
        self.location = replace(self.location, confirmed=True)
        self.trusted = True

    def note_topic_port(self, topic: str, port: int | None) -> None:
        """Record the TCPROS port that the node names for a topic; None removes the topic.

        Only registered topics are recorded. roscpp names a port for any topic, so a caller could
        make the proxy record names without end.
        """
        if port is not None and self.publishes(topic):
            self.topic_ports[topic] = port
        else:
            self.topic_ports.pop(topic, None)

    def note_service_port(self, port: int) -> bool:
        """Record a TCPROS port at which the node has a service; return whether the port is new."""
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
        """The state of the node, from STATES."""
        return self.health.state if self.trusted else "unverified"

    @property
    def is_down(self) -> bool:
        """Whether the node counts as dead, so that its port refuses connections."""
        return self.health.down

    @property
    def answers(self) -> bool:
        """Whether the node counts as alive."""
        return self.trusted and not self.health.down

    @property
    def proven(self) -> bool:
        """Whether the node itself has ever answered at this address."""
        return self.trusted and self.health.answered_at is not None

    @property
    def never_found(self) -> bool:
        """Whether all probes of the node have failed here, so that the node may be elsewhere."""
        health = self.health
        return self.trusted and health.answered_at is None and health.failures > 0

    @property
    def expendable(self) -> bool:
        """Whether the port may go to a live node, because this endpoint's node does not answer.

        A port in use is never expendable. A node that has never answered gets a single probe. If
        only the master mentions a node, its first answer must confirm the registrations.
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
        """Whether the node registered at the real master directly, and so may do that again."""
        return any(parse_slave_uri(uri) == self.node for uri in self.former_uris)

    @property
    def inside_path(self) -> InsidePath:
        """What the proxy remembers about the location of the node."""
        address = None if self.node.host == self.address else self.address
        return InsidePath(self.node, address, path_of(self.uri))

    @property
    def slave(self) -> HostPort:
        """The address and port of the slave API, which identify the endpoint."""
        return HostPort(self.location.address, self.node.port)

    @property
    def caller_ids(self) -> list[str]:
        """The names of the nodes registered here, usually a single name."""
        return sorted(self.callers)

    @property
    def label(self) -> str:
        """The endpoint in messages: node names and own URI."""
        return f"{listed(self.caller_ids, MOST_SHOWN_NAMES) or 'unnamed node'} ({self.uri})"

    @property
    def log_fields(self) -> dict[str, str | int]:
        """The fields of a log entry about the endpoint, for ``extra``."""
        return {"node": listed(self.caller_ids, MOST_SHOWN_NAMES), "port": self.port}

    def names(self, kind: Kind) -> list[str]:
        """The topics, services or parameters registered as ``kind``."""
        return sorted(r.name for r in self.registrations.values() if r.kind is kind)

    def names_at_master(self, kind: Kind) -> list[str]:
        """The topics, services or parameters of a ``kind`` that the master knows."""
        registrations = self.registrations.values()
        return sorted(r.name for r in registrations if r.kind is kind and not r.hidden)

    def callers_of(self, kind: Kind, name: str) -> list[str]:
        """The nodes here that have made a registration; all nodes here if there is none."""
        callers = [caller for caller in self.callers if (kind, name, caller) in self.registrations]
        return callers or self.caller_ids

    def publishes(self, topic: str) -> bool:
        """Whether a topic is registered as published."""
        return any((Kind.PUBLISHER, topic, name) in self.registrations for name in self.callers)

    def may_hear_of(self, parameter: str) -> bool:
        """Whether the node may be subscribed to a parameter or to a namespace around the parameter.

        After a recovery the answer is yes, because the master lists no parameter subscriptions.
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
        """Whether a program outside is connected, through the proxy or through the kernel."""
        return bool(self.connections or self.fast_peers)

    @property
    def fast_connections(self) -> int:
        """The number of connections that the kernel forwards now."""
        return sum(self.fast_peers.values())

    def registrations_of(self, caller_id: str) -> list[Registration]:
        """The registrations of a node name."""
        return [self.registrations[key] for key in self.callers.get(caller_id, ())]

    def reason_full(self, caller_id: str, is_new: bool = True) -> str | None:
        """Why the endpoint accepts no more registrations of a node name; None if there is room.

        ``is_new``: the endpoint does not have the registration yet. Registrations that the proxy
        has admitted count as well.
        """
        names = self.callers.keys() | self.promised.keys()
        registrations = len(self.registrations) + self.promised.total()
        characters = self.characters + self.promised_characters
        divide = "Divide the topics and services among several nodes"
        rows = [(characters, MOST_CHARACTERS, "characters of registered names", divide)]
        if is_new:
            same_name = "Start the node with the same name each time"
            rows.append((registrations, MOST_REGISTRATIONS, "registrations", divide))
            rows.append((len(names - {caller_id}), MOST_CALLERS, "node names", same_name))
        for count, most, label, fix in rows:
            if count >= most:
                text = f"the node at {self.uri} has {count} {label}, at most {most} are accepted"
                return f"{text}. {fix}"
        return None

    @property
    def unused(self) -> bool:
        """Whether the lease has no registration, no connection and no call under way.

        Registrations that the proxy has taken back at the master do not count.
        """
        is_registered = self.registrations and not self.health.cleaned
        return not (is_registered or self.connected or self.pending)


EndpointRegistration = tuple[Endpoint, Registration]
"""An endpoint, and a registration of the endpoint."""
