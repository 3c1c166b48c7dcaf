"""The state of a Docker host, and the proxies that the operator wants there."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from ipaddress import IPv4Network

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.policy.rules import Rule
from rosproxy.shared.ports import PortRange
from rosproxy_operator.proxy_spec.place import Place
from rosproxy_operator.proxy_spec.spec import OWN_SPEC, ProxySpec, Wishes

ALIVE = frozenset({"created", "running", "paused", "restarting"})
"""States of a container, in the engine's words, in which the nodes run, or may run soon."""
STARTED = frozenset({"running", "paused"})
"""States of a container that has processes and a network namespace."""
SERVING = STARTED | {"restarting"}
"""States of a container that runs, or that the engine is about to restart."""
THIS_HOST = "host.docker.internal"
"""The host name by which containers reach their own host."""
STARTED_LABEL = "io.rosproxy.started"
"""Label of a redirect's container: the start time of the container with the network namespace."""


@dataclass(frozen=True, slots=True)
class Attachment:
    """The connection of a container to a network.

    ``address`` is the container's IPv4 address on the network, empty while the container does not
    run. ``names`` are the names that the engine's name server resolves to the container on the
    network: aliases, name, short id. ``endpoint`` is the engine's id of the connection, and
    changes with each start. ``network_id`` and ``endpoint`` are empty before the first start.
    """

    network: str
    address: str = ""
    names: frozenset[str] = frozenset()
    network_id: str = ""
    endpoint: str = ""


@dataclass(frozen=True, slots=True)
class Container:
    """A container, as the engine reports it.

    Fields from the inspection are empty while the engine has not answered the inspection.

    Attributes:
        network_mode: ``bridge``, ``host``, ``none``, ``container:ID`` or the name of a network.
        master_uri: The variable ROS_MASTER_URI; empty without.
        master_entry: The address that /etc/hosts of the container has for the host of
            ``master_uri`` (``--add-host``), or ``host-gateway``; empty without an entry.
        host_ports: TCP ports of the host that the container publishes now, or after a start.
        hostname: The host name of the container itself.
        variables: The variables that the operator needs: the ROS version, settings of ROS 2,
            ROS_IP and ROS_HOSTNAME.
        udp_ports: As ``host_ports``, for UDP.
        started_at: Time of the last start, as the engine writes times; empty before the first.
        forged: Why a container with the labels of the operator's own containers is not the
            operator's; empty for all other containers.
        exit_code: Exit code of the last run.
        is_zenoh_router: Whether the command runs a router of zenoh.
    """

    id: str
    name: str
    state: str
    labels: Mapping[str, str] = field(default_factory=dict)
    network_mode: str = ""
    attachments: tuple[Attachment, ...] = ()
    master_uri: str = ""
    master_entry: str = ""
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
        """Whether the container runs, or may run soon."""
        return self.state in ALIVE

    @property
    def network_container(self) -> str | None:
        """The id or name of the container whose network namespace this container shares.

        None if the container does not share a namespace.
        """
        _, separator, container = self.network_mode.partition("container:")
        return container if separator else None

    @property
    def networks(self) -> frozenset[str]:
        """The names of the container's networks."""
        return frozenset(attachment.network for attachment in self.attachments)


@dataclass(frozen=True, slots=True)
class Network:
    """A network of the engine. ``gateway`` is the IPv4 gateway; empty without.

    ``made_by_operator``: the network has the operator's label. ``dual_stack``: the network has IPv4
    and IPv6.
    """

    id: str
    name: str
    driver: str = "bridge"
    internal: bool = False
    gateway: str = ""
    subnets: tuple[IPv4Network, ...] = ()
    made_by_operator: bool = False
    dual_stack: bool = False


@dataclass(frozen=True, slots=True)
class OwnContainer:
    """A container of this operator on the host, and the content of its labels.

    ``range`` are the proxy's ports. ``fingerprint`` is a hash of the creation request.
    """

    place: Place
    container: Container
    range: PortRange
    fingerprint: str


class Sandbox(OwnContainer):
    """The container that holds a proxy's network namespace: published ports, networks and names.

    The proxy itself runs in another container in the same namespace. So the operator replaces a
    proxy within half a second. To free and publish the ports again, the engine needs seconds.
    """


class Proxy(OwnContainer):
    """The container in which a proxy runs. `network_container` is the proxy's sandbox."""


class LanRelayContainer(OwnContainer):
    """The container in which the LAN relay of a proxy for ROS 2 runs, in the host's network."""


class RedirectContainer(OwnContainer):
    """A container that sets or deletes rules in the network namespace of another container.

    The ended container stays as the record of the rules. `network_container` is the id of the other
    container.
    """

    @property
    def started(self) -> str:
        """The start time of the other container, in whose namespace the rules were set.

        Each start of that container makes a new namespace, without rules.
        """
        return self.container.labels.get(STARTED_LABEL, "")

    @property
    def done(self) -> bool:
        """Whether the container has ended without error, so that the rules are set."""
        return self.container.state == "exited" and self.container.exit_code == 0


class FlushContainer(OwnContainer):
    """A container that deletes the host's conntrack entries for the UDP ports of a sandbox.

    The ended container stays as the record of the last run, at the time ``started_at``.
    """

    @property
    def done(self) -> bool:
        """Whether the last run has ended without error."""
        return self.container.state == "exited" and self.container.exit_code == 0


@dataclass(frozen=True, slots=True)
class HostState:
    """The state of a Docker host at one moment.

    Attributes:
        containers: All containers except the operator's own.
        ephemeral: The range from which the kernel takes ports for outgoing connections.
        listening: TCP ports of the host on which a program listens, except ports of busy
            sandboxes. If the operator is not in the host's network, this field is empty. So are
            then ``listening_udp``, ``advertise`` and ``default_route_address``.
        listening_udp: Bound UDP ports of the host, except ports of busy sandboxes and LAN relays.
        image_id: The id of the proxy's image; empty if the host does not have the image.
        advertise: This host's address towards a master, by the master's host name. A host name
            without entry has no known address.
        default_route_address: This host's address on the default route; empty if unknown.
        redirects: The records of rules in the networks of containers.
        flushes: The records of deleted conntrack entries.
        masters: The addresses of the masters' hosts, by host name; empty if unknown.
        busy: The names of own containers without a current inspection. The operator leaves these
            containers alone in this look.
        retired: The names of the proxies that have unregistered their ROS 1 nodes, and accept no
            others. The operator reads this from the status of a proxy, so a name may come later.
        addresses: The addresses of all containers, the operator's own included.
        secret: The secret from which the operator makes the tokens of the proxies.
        deletes_udp_entries: Whether the engine itself deletes outdated conntrack entries for UDP.
    """

    containers: tuple[Container, ...]
    networks: tuple[Network, ...]
    proxies: tuple[Proxy, ...]
    ephemeral: PortRange
    listening: frozenset[int] = frozenset()
    listening_udp: frozenset[int] = frozenset()
    image_id: str = ""
    advertise: Mapping[str, str] = field(default_factory=dict)
    default_route_address: str = ""
    sandboxes: tuple[Sandbox, ...] = ()
    lan_relays: tuple[LanRelayContainer, ...] = ()
    redirects: tuple[RedirectContainer, ...] = ()
    flushes: tuple[FlushContainer, ...] = ()
    masters: Mapping[str, str] = field(default_factory=dict)
    busy: frozenset[str] = frozenset()
    retired: frozenset[str] = frozenset()
    addresses: frozenset[str] = frozenset()
    secret: str = field(default="", repr=False)
    deletes_udp_entries: bool = False

    @property
    def own(self) -> tuple[OwnContainer, ...]:
        """The sandboxes, proxies and LAN relays, but not the records of redirects and flushes."""
        return (*self.sandboxes, *self.proxies, *self.lan_relays)

    @property
    def places(self) -> frozenset[Place]:
        """The places that have a sandbox, a proxy or a LAN relay."""
        return frozenset(own.place for own in self.own)

    def sandboxes_of(self, place: Place) -> tuple[Sandbox, ...]:
        """The sandboxes of a place."""
        return tuple(s for s in self.sandboxes if s.place == place)

    def proxies_of(self, place: Place) -> tuple[Proxy, ...]:
        """The proxies of a place."""
        return tuple(p for p in self.proxies if p.place == place)

    def gateway(self, name: str) -> str:
        """The gateway of a network; empty without a gateway, or without the network."""
        return next((n.gateway for n in self.networks if n.name == name), "")

    def lan_relays_of(self, place: Place) -> tuple[LanRelayContainer, ...]:
        """The LAN relays of a place."""
        return tuple(e for e in self.lan_relays if e.place == place)

    def sandbox_of(self, proxy: Proxy) -> Sandbox | None:
        """The sandbox in whose network namespace a proxy runs; None if the sandbox is gone."""
        sandbox_id = proxy.container.network_container
        return next((s for s in self.sandboxes if s.container.id == sandbox_id), None)


@dataclass(frozen=True, slots=True)
class Member:
    """A container with a proxy, and what the container asks of this proxy.

    A member whose container has exited creates no proxy. For the operator's grace, the existing
    proxy keeps the networks and options of this member.

    Attributes:
        ports: Least number of ports of the proxy; 0 without the label.
        networks: The names of the networks on which container and proxy meet.
        wanted_alias: The name by which ROS 1 nodes look for the proxy: the host in ROS_MASTER_URI,
            or ``rosproxy`` without this variable. Empty if no alias can help.
        wishes: The options that further labels ask for.
        policy: Rules for the nodes of this container alone.
        peers: ROS 2: the hosts outside to which the proxy announces participants. rmw_zenoh: the
            routers to which the proxy connects.
        links: rmw_zenoh: the proxies at other sites to which the proxy connects, as
            ``tls/host:port``.
        redirect: The value of the label ``rosproxy.redirect``; None without the label.
        redirected: The addresses and ports that the operator redirects to the proxy, in the
            container's network namespace: of the master, or of the routers that nodes of rmw_zenoh
            look for.
    """

    container: Container
    place: Place
    ports: int = 0
    networks: frozenset[str] = frozenset()
    wanted_alias: str = ""
    wishes: Wishes = field(default_factory=dict)
    policy: tuple[Rule, ...] = ()
    peers: frozenset[str] = frozenset()
    links: frozenset[str] = frozenset()
    redirect: bool | None = None
    redirected: tuple[HostPort, ...] = ()


@dataclass(frozen=True, slots=True)
class Desired:
    """The proxy that the operator wants for a place.

    If ``live`` is false, no live container needs the proxy. Until the grace ends, the operator then
    only disconnects the sandbox from networks. ``ports`` is the least number of ports. ``members``
    are the live containers. ``peers`` are the hosts or routers of all members (`Member`) and, for
    DDS, of the operator's option. ``links`` are the links of all members and of the operator's
    option.
    """

    place: Place
    live: bool
    ports: int
    networks: frozenset[str] = frozenset()
    members: tuple[Member, ...] = ()
    spec: ProxySpec = OWN_SPEC
    peers: tuple[str, ...] = ()
    links: tuple[str, ...] = ()
