"""What is seen on a Docker host, and what is wanted there."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from ipaddress import IPv4Network
from typing import Literal

from rosproxy.access.rules import Rule
from rosproxy.leases.ports import PortRange
from rosproxy.net.addresses import HostPort
from rosproxy_operator.proxy_spec.spec import OWN_SPEC, ProxySpec, Wishes

ALIVE = frozenset({"created", "running", "paused", "restarting"})
"""States of a container, in the engine's words, in which its nodes run, or may soon."""
STARTED = frozenset({"running", "paused"})
SERVING = STARTED | {"restarting"}
"""States of a container that runs, or does again in a moment."""
THIS_HOST = "host.docker.internal"
"""How containers call the host that they run on."""
STARTED_LABEL = "io.rosproxy.started"
"""On a redirect's container: when the one was started whose network it is in."""


@dataclass(frozen=True, slots=True)
class Attachment:
    """A container on a network.

    ``address`` is its IPv4 address there, empty while it does not run. ``names`` are those by
    which the engine's name server knows it on that network: aliases, name, short id.
    ``network_id`` and ``endpoint``, the engine's id of the connection, are empty where it does not
    tell (a container never started). The endpoint changes with each start.
    """

    network: str
    address: str = ""
    names: frozenset[str] = frozenset()
    network_id: str = ""
    endpoint: str = ""


@dataclass(frozen=True, slots=True)
class Container:
    """A container, in the engine's words.

    ``network_mode`` is ``bridge``, ``host``, ``none``, ``container:ID`` or a network's name,
    ``master_uri`` ROS_MASTER_URI of its environment or empty, ``variables`` those that say what it
    is of ROS 2, and how its nodes call their host. ``host_ports`` are the TCP ports that it
    publishes on the host, or will once it is started, ``udp_ports`` the UDP ports. ``started_at``
    is empty if it never was, or if nobody asked; ``exit_code`` is how it ended last.
    ``is_zenoh_router``: its command runs a router of zenoh. ``forged`` says of one that has the
    labels of this operator's own what shows that it is none; it is empty for all others.
    """

    id: str
    name: str
    state: str
    labels: Mapping[str, str] = field(default_factory=dict)
    network_mode: str = ""
    attachments: tuple[Attachment, ...] = ()
    master_uri: str = ""
    host_ports: frozenset[int] = frozenset()
    hostname: str = ""
    variables: Mapping[str, str] = field(default_factory=dict)
    udp_ports: frozenset[int] = frozenset()
    started_at: str = ""
    forged: str = ""
    exit_code: int = 0
    is_zenoh_router: bool = False

    @property
    def alive(self) -> bool:
        """Whether it runs or is about to."""
        return self.state in ALIVE

    @property
    def network_container(self) -> str | None:
        """The container whose network namespace it is in, by id or name; None if in its own."""
        _, separator, container = self.network_mode.partition("container:")
        return container if separator else None

    @property
    def networks(self) -> frozenset[str]:
        """The names of its networks."""
        return frozenset(attachment.network for attachment in self.attachments)


@dataclass(frozen=True, slots=True)
class Network:
    """A network of the engine. ``gateway`` is its IPv4 gateway, empty if it has none.

    ``made_by_operator``: its label says so.
    """

    id: str
    name: str
    driver: str = "bridge"
    internal: bool = False
    gateway: str = ""
    subnets: tuple[IPv4Network, ...] = ()
    made_by_operator: bool = False


@dataclass(frozen=True, slots=True, order=True)
class Key:
    """What tells proxies of one host apart: master's URI or domain, and the advertised host.

    ROS 1 has a master. ROS 2 has a domain, and its ``master_uri`` is empty: a container with both
    has two proxies, since the containers of a master are not those of a domain. All containers of
    rmw_zenoh share one proxy (`ZENOH`), which publishes no port: zenoh keeps domains apart itself.
    """

    # Ordering never compares a domain with None: keys of ROS 1 have a master_uri, those of ROS 2
    # an advertised host, and the one of rmw_zenoh neither.
    master_uri: str
    advertise_host: str
    domain: int | None = None

    @property
    def ros(self) -> Literal["1", "2", "zenoh"]:
        """What the proxy serves, in the words of its option ``--ros``."""
        if self.is_ros2:
            return "2"
        return "1" if self.master_uri else "zenoh"

    @property
    def is_ros2(self) -> bool:
        """Whether it is of a proxy for ROS 2, which publishes UDP ports instead of TCP ports."""
        return self.domain is not None

    @property
    def graph(self) -> str:
        """What its nodes have in common, as users are told of it."""
        graphs = {"1": f"master {self.master_uri}", "2": f"ROS 2 domain {self.domain}"}
        return graphs.get(self.ros, "zenoh network")


ZENOH = Key("", "")
"""The key of the proxy for rmw_zenoh."""


@dataclass(frozen=True, slots=True)
class OwnContainer:
    """A container of this operator, as found on the host, and what its labels say.

    ``range`` are the proxy's ports, ``fingerprint`` is that of the settings it was created with.
    """

    key: Key
    container: Container
    range: PortRange
    fingerprint: str


class Sandbox(OwnContainer):
    """It holds a proxy's network namespace: published ports, networks and the names on them.

    The proxy itself runs in another container in the same namespace. So it can be replaced in no
    time, while taking published ports down and up again costs an engine seconds.
    """


class Proxy(OwnContainer):
    """A proxy runs in it, in the namespace of its sandbox, the `network_container`."""


class LanRelayContainer(OwnContainer):
    """The LAN relay of a proxy for ROS 2 runs in it, in the host's network."""


class RedirectContainer(OwnContainer):
    """It has set, or taken away, rules in another container's network namespace, and has ended.

    It is kept as the record of them. `network_container` is that container's id, ``started`` when
    it was started: each start of it makes another namespace.
    """

    @property
    def started(self) -> str:
        """When the container was started whose network it has been in."""
        return self.container.labels.get(STARTED_LABEL, "")

    @property
    def done(self) -> bool:
        """Whether its rules are as it was to make them."""
        return self.container.state == "exited" and self.container.exit_code == 0


class FlushContainer(OwnContainer):
    """It has deleted the host's conntrack entries for a sandbox's UDP ports, and has ended.

    It is kept as the record of that: ``started_at`` is when it ran last.
    """

    @property
    def done(self) -> bool:
        """Whether its last run did what it is for."""
        return self.container.state == "exited" and self.container.exit_code == 0


@dataclass(frozen=True, slots=True)
class HostState:
    """A Docker host at one moment.

    ``containers`` are all but the operator's own: the proxies and their sandboxes. ``ephemeral``
    is the range from which the kernel takes ports for connections, ``listening`` are TCP ports on
    which something listens in the operator's own network namespace, ``listening_udp`` UDP ports.
    ``image_id`` is the id of the proxy's image, empty if the host does not have it. ``advertise``
    gives, for a master's host name, this host's address towards it; without an entry it is not
    known. ``far`` is its address towards hosts far away, empty where unknown. ``masters`` are the
    addresses of the masters' hosts, by name, empty where unknown. ``busy`` are the names of own
    containers of which not everything is known yet, so that nothing can be done to them, and
    ``addresses`` those of all containers. ``secret`` is what the tokens of proxies are made of.
    ``redirects`` are the records of rules in containers' networks, ``flushes`` those of deleted
    conntrack entries; neither is among its ``own``, as no proxy is made of them.
    ``deletes_udp_entries``: the engine itself deletes the entries that a flush would.
    """

    containers: tuple[Container, ...]
    networks: tuple[Network, ...]
    proxies: tuple[Proxy, ...]
    ephemeral: PortRange
    listening: frozenset[int] = frozenset()
    listening_udp: frozenset[int] = frozenset()
    image_id: str = ""
    advertise: Mapping[str, str] = field(default_factory=dict)
    far: str = ""
    sandboxes: tuple[Sandbox, ...] = ()
    lan_relays: tuple[LanRelayContainer, ...] = ()
    redirects: tuple[RedirectContainer, ...] = ()
    flushes: tuple[FlushContainer, ...] = ()
    masters: Mapping[str, str] = field(default_factory=dict)
    busy: frozenset[str] = frozenset()
    addresses: frozenset[str] = frozenset()
    secret: str = field(default="", repr=False)
    deletes_udp_entries: bool = False

    @property
    def own(self) -> tuple[OwnContainer, ...]:
        """All that is the operator's own."""
        return (*self.sandboxes, *self.proxies, *self.lan_relays)

    @property
    def keys(self) -> frozenset[Key]:
        """The keys of all that is the operator's own."""
        return frozenset(own.key for own in self.own)

    def sandboxes_of(self, key: Key) -> tuple[Sandbox, ...]:
        """The sandboxes of a key."""
        return tuple(s for s in self.sandboxes if s.key == key)

    def proxies_of(self, key: Key) -> tuple[Proxy, ...]:
        """The proxies of a key."""
        return tuple(p for p in self.proxies if p.key == key)

    def gateway(self, name: str) -> str:
        """The gateway of a network; empty if it has none or is not there."""
        return next((n.gateway for n in self.networks if n.name == name), "")

    def lan_relays_of(self, key: Key) -> tuple[LanRelayContainer, ...]:
        """The LAN relays of a key."""
        return tuple(e for e in self.lan_relays if e.key == key)

    def sandbox_of(self, proxy: Proxy) -> Sandbox | None:
        """The sandbox in whose network namespace a proxy is; None if it is there no more."""
        sandbox_id = proxy.container.network_container
        return next((s for s in self.sandboxes if s.container.id == sandbox_id), None)


@dataclass(frozen=True, slots=True)
class Member:
    """A labelled container, and what it wants of its proxy: labels and settings put together.

    ``ports`` is 0 without a label, ``wishes`` are what its other labels ask for. ``networks`` are
    the names of those on which it wants to meet its proxy. ``wanted_alias`` is the host in its
    ROS_MASTER_URI: the name by which it looks for the proxy, ``rosproxy`` if it has no such
    variable, empty where no alias can help it. ``policy`` are rules for its own nodes alone.
    ``peers`` are hosts outside, for a member of a ROS 2 domain, and routers for rmw_zenoh.
    ``redirect`` is what its label says, None without one; ``redirected`` are the addresses and
    ports that are to lead to its proxy, in its network: its master's, or those of the routers that
    its nodes of rmw_zenoh look for. A container that is not alive only
    keeps networks joined, and what else its labels made its proxy, for a while.
    """

    container: Container
    key: Key
    ports: int = 0
    networks: frozenset[str] = frozenset()
    wanted_alias: str = ""
    wishes: Wishes = field(default_factory=dict)
    policy: tuple[Rule, ...] = ()
    peers: frozenset[str] = frozenset()
    redirect: bool | None = None
    redirected: tuple[HostPort, ...] = ()


@dataclass(frozen=True, slots=True)
class Desired:
    """What one proxy is to be.

    Without ``live`` no running container wants it any more: it is left as it is, but for the
    networks that it leaves, until its grace ends. ``ports`` is the least number of ports. ``peers``
    are whom a proxy for ROS 2 tells of its participants, and routers that one for rmw_zenoh dials.
    """

    key: Key
    live: bool
    ports: int
    networks: frozenset[str] = frozenset()
    members: tuple[Member, ...] = ()
    spec: ProxySpec = OWN_SPEC
    peers: tuple[str, ...] = ()
