"""The settings of a proxy: plain data, checked.

Each setting is written once, in `Settings`: field, type, default and `Option`. From these come the
option of ``rosproxy run``, the variable, the key in the file of ``--config``, the help, the bounds
and the row in docs/reference/options.md.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Annotated, Literal

from rosproxy.shared import setting_kinds as kinds
from rosproxy.shared.addresses import HostPort, Network
from rosproxy.shared.policy.layers import PolicyLayer, PolicyMode, check_bounds
from rosproxy.shared.policy.rules import Rule
from rosproxy.shared.ports import PortMap, PortRange
from rosproxy.shared.setting_kinds import (
    Credentials,
    DataPlane,
    Direction,
    LinkPort,
    LogLevel,
    Option,
    SettingError,
    SiteLink,
    SlaveControl,
    TopicLimit,
)

MEBIBYTE = 1024 * 1024
LEAST_PORTS_PER_DOMAIN = 4
"""Ports of the range for a domain of ROS 2: one for discovery, three for a participant."""
DEFAULT_ADMIN = HostPort("127.0.0.1", 11312)
DEFAULT_RANGE = PortRange(11000, 11099)
DEFAULT_ZENOH_PORTS = PortRange(7448, 7467)
MOST_ZENOH_PORTS = 256
"""Routers for containers of a proxy; each takes half a megabyte."""
MOST_ZENOH_PEERS = 64
"""Links of the hub router to other routers."""
MOST_ZENOH_HUBS = 128
"""Hubs of other hosts. Each hub has a session with each other hub."""
MOST_ZENOH_LINKS = 16
"""Links to other sites."""
MOST_ZENOH_LIMITS = 64
"""Limits of topics on links. zenoh compares the key of each new publisher with all limits."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """All settings of ``rosproxy run``. Times are in seconds.

    Without ``inside_networks``, the networks of the proxy's own interfaces are inside. If the proxy
    has several networks, one may count as outside. For ROS 1 with ``direction`` ``both``, this is
    the network of the default route. For ROS 2, this is the network of the advertised host.

    The proxy announces participants to a ``ros2_peer`` with port 0 at the well-known ports. Raises
    SettingError if a necessary setting is missing, or if settings exclude each other.
    """

    ros: Annotated[
        tuple[Literal["1", "2", "zenoh"], ...],
        Option(
            "ROS version that the proxy serves: `1`, `2` (DDS), or `zenoh` ([rmw_zenoh]"
            "(../guide/zenoh.md)). Repeatable: one process can serve several versions. ROS 1 and "
            "ROS 2 then share the range: ROS 1 uses the ports for TCP, ROS 2 for UDP.",
            repeatable=True,
            note="`1 2` for both",
        ),
    ] = ("1",)
    master_uri: Annotated[
        str,
        Option(
            "The real master, for example `http://robot:11311`. The proxy also starts while "
            "the master is down.",
            kinds.MASTER_URI,
            variables=("ROSPROXY_MASTER_URI", "ROS_MASTER_URI"),
            default="required for ROS 1",
        ),
    ] = ""
    master_address: Annotated[
        str | None,
        Option(
            "IP address of the master's host. The proxy connects to this address instead of "
            "resolving the host name. Inside, the name can then be [an alias of the "
            "proxy](../guide/by-hand.md#keep-the-masters-name). The address can be changed at "
            "run time.",
            kinds.ADDRESS,
            default="the address of the master's name",
        ),
    ] = None
    advertise_host: Annotated[
        str,
        Option(
            "Name or address under which outside nodes and the master reach this host. All of "
            "them must be able to resolve the name.",
            kinds.HOST,
            default="required for ROS 1 and 2",
        ),
    ] = ""
    master_port: Annotated[
        int,
        Option(
            "Port at which inside nodes find their master: `ROS_MASTER_URI=http://<proxy>:11311`.",
            kinds.PORT,
        ),
    ] = 11311
    port_range: Annotated[
        PortRange,
        Option(
            "Ports that the proxy listens on: [one port for each inside "
            "node](../guide/by-hand.md#how-many-ports). Publish exactly these ports.",
            kinds.PORT_RANGE,
        ),
    ] = DEFAULT_RANGE
    advertise_port_range: Annotated[
        PortRange | None,
        Option(
            "The same ports as outside sees them, if outside sees other numbers. Both ranges "
            "need the same number of ports, in the same order.",
            kinds.PORT_RANGE,
            default="as `--port-range`",
        ),
    ] = None
    publish_master: Annotated[
        int | None,
        Option(
            "For a master that runs inside: port on which the proxy offers this master to "
            "outside. Publish this port, too. The master calls nodes at the advertised "
            "address, so the master must reach the host's published ports. Docker's own port "
            "proxy (`userland-proxy`, on by default) makes that possible. NAT does so only if it "
            "leads connections from inside to the host's address back inside (hairpin NAT).",
            kinds.PORT,
            default="off",
        ),
    ] = None
    bind: Annotated[
        str,
        Option("Address to listen on. `::` listens on IPv4 and IPv6.", kinds.BIND_ADDRESS),
    ] = "0.0.0.0"
    admin: Annotated[
        HostPort,
        Option(
            "Address and port of the [admin endpoint](admin-api.md) and of the live page. To "
            "let Prometheus scrape the metrics, bind the endpoint to an address that only your "
            "monitoring reaches.",
            kinds.HOST_PORT,
            name="--admin-bind",
        ),
    ] = DEFAULT_ADMIN
    admin_token: Annotated[
        str | None,
        Option(
            "Token for callers that are not on loopback. Such a caller needs the token to "
            "change anything at the admin endpoint, and to see the [live "
            "page](../guide/live-page.md#who-may-look). 8 to 200 printable ASCII characters "
            "without spaces. Prefer the variable: all users of the machine can see a command "
            "line.",
            kinds.TOKEN,
            default="none",
        ),
    ] = field(default=None, repr=False)
    admin_token_hash: Annotated[
        str | None,
        Option(
            'SHA-256 of the token in 64 hex digits (`printf %s "$TOKEN" | sha256sum`), in '
            "place of `--admin-token`. The proxy's environment then does not contain the "
            "token. Choose a token that cannot be guessed: `openssl rand -hex 16`.",
            kinds.TOKEN_HASH,
            default="none",
        ),
    ] = None
    inside_networks: Annotated[
        tuple[Network, ...],
        Option(
            "Network of inside nodes. Only addresses in an inside network may use the proxy as "
            "their master. Once an operator has selected addresses, only the selected "
            "addresses may. Nodes in the same inside network reach each other directly. "
            "Repeatable.",
            kinds.NETWORK,
            name="--inside-network",
            variables=("ROSPROXY_INSIDE_NETWORKS",),
            repeatable=True,
            default="networks of the proxy's interfaces",
            note="separated by spaces",
        ),
    ] = ()
    probe_interval: Annotated[
        float,
        Option(
            "Time between two probes of an idle node. The proxy notices the end of a node "
            "immediately, without a probe.",
            kinds.time(0.05),
        ),
    ] = 5.0
    probe_timeout: Annotated[
        float, Option("Time in which a node must answer.", kinds.time(0.05))
    ] = 3.0
    cleanup_after: Annotated[
        float,
        Option(
            "Time after which the proxy unregisters a dead node at the master. 0: never.",
            kinds.time(0),
        ),
    ] = 30.0
    linger: Annotated[
        float,
        Option("Time for which the proxy keeps a port after the end of its node.", kinds.time(0)),
    ] = 30.0
    master_interval: Annotated[
        float, Option("Time between two checks of the master.", kinds.time(0.05))
    ] = 2.0
    slave_control: Annotated[
        SlaveControl,
        Option(
            "Which outside hosts may call `shutdown`, `publisherUpdate` and `paramUpdate` at "
            "inside nodes: `any`, or only the `master`'s host. With `master`, `rosnode kill` "
            "works from the master's host only."
        ),
    ] = "any"
    policy_rules: Annotated[
        tuple[tuple[Rule, ...], ...],
        Option(
            "[Rules](policy.md) about what outside may see and do, and what inside may take "
            "from outside, for example `deny publish /camera/*`. Repeatable.",
            kinds.POLICY_RULES,
            name="--policy",
            repeatable=True,
            default="none",
            note="one text, rules separated by `;` or line ends",
        ),
    ] = ()
    policy_mode: Annotated[
        Literal["enforce", "audit"],
        Option(
            "`enforce`: the proxy enforces the rules of `--policy` and `--policy-file`. "
            "`audit`: the proxy only reports what the rules would deny."
        ),
    ] = "enforce"
    policy_file: Annotated[
        str | None,
        Option(
            "File with more such rules, one per line. The proxy reads the file again when the "
            "file changes.",
            kinds.FILE,
            default="none",
        ),
    ] = None
    policy_layers: Annotated[
        tuple[PolicyLayer, ...],
        Option(
            "For operators: the layers of rules at the start, in the form of [`POST "
            "/policy`](admin-api.md#policy).",
            kinds.POLICY_LAYERS,
            default="none",
        ),
    ] = ()
    await_policy: Annotated[
        float,
        Option(
            "For operators: longest time that the proxy waits for `POST /policy` after the "
            "start. Meanwhile the proxy accepts no registrations.",
            kinds.time(0),
        ),
    ] = 0.0
    direction: Annotated[
        Direction,
        Option(
            "`out`: only outside nodes reach nodes through the proxy. `both`: inside nodes "
            "reach outside nodes through the proxy, too, at [ports on the proxy's inside "
            "addresses](../guide/by-hand.md#no-way-out-but-the-proxy)."
        ),
    ] = "out"
    udp: Annotated[
        bool,
        Option(
            "With `--direction both`: the host also publishes the range for UDP, so that "
            "UDPROS from an outside publisher arrives. Without this option, a subscriber gets "
            "TCPROS if the subscriber offers TCPROS."
        ),
    ] = False
    data_plane: Annotated[
        DataPlane,
        Option(
            "How topics are forwarded. `kernel`: by the kernel. `splice`, `copy`: by the "
            "proxy. `auto`: by the kernel if possible, else as `splice`. See "
            "[docs/reference/options.md](#data-plane)."
        ),
    ] = "auto"
    max_lease_call: Annotated[
        int,
        Option(
            "Maximum size of a call from outside to a node. A call may have 10,000 XML elements "
            "for each MiB of this maximum. [docs/reference/limits.md](limits.md) explains this "
            "option and the next five.",
            kinds.MEBIBYTES,
        ),
    ] = 1
    max_master_call: Annotated[
        int,
        Option(
            "Maximum size of a call with addresses from a node to the master. A call may have "
            "5,000 XML elements for each MiB of this maximum.",
            kinds.MEBIBYTES,
        ),
    ] = 4
    max_body: Annotated[
        int,
        Option(
            "Maximum size of a parameter, and of any other call or reply without addresses.",
            kinds.MEBIBYTES,
        ),
    ] = 64
    max_buffered: Annotated[
        int,
        Option(
            "Memory for all calls and replies that the proxy is reading. A source gets at most "
            "half of this memory.",
            kinds.MEBIBYTES,
        ),
    ] = 32
    max_connections_per_source: Annotated[
        int,
        Option(
            "Most connections from one address. Behind NAT or Docker's port proxy, many "
            "machines have the same address.",
            kinds.CONNECTIONS,
        ),
    ] = 4096
    max_connections_per_lease: Annotated[
        int, Option("Most connections to one port of the range.", kinds.CONNECTIONS)
    ] = 2048
    ros2_domain: Annotated[
        tuple[int, ...],
        Option(
            "[ROS 2](../guide/ros2.md): domain that the proxy serves. Repeatable: the domains "
            "share the range equally.",
            kinds.DOMAIN,
            variables=("ROSPROXY_ROS2_DOMAINS", "ROS_DOMAIN_ID"),
            repeatable=True,
            default="0",
        ),
    ] = ()
    ros2_peer: Annotated[
        tuple[HostPort, ...],
        Option(
            "ROS 2: outside host to which the proxy announces inside participants, at the "
            "well-known ports of at least the first 32 participants of that host. For another "
            "proxy, add the first port of its range. A proxy with such a peer serves a single "
            "domain only. Repeatable.",
            kinds.PEER,
            variables=("ROSPROXY_ROS2_PEERS",),
            repeatable=True,
            default="none",
            note="separated by spaces",
        ),
    ] = ()
    ros2_lan_relay: Annotated[
        HostPort | None,
        Option(
            "ROS 2: address and port at which [`rosproxy lan-relay`](../guide/ros2.md#the-lan) "
            "listens. Possible with a single domain only.",
            kinds.HOST_PORT,
            default="none",
        ),
    ] = None
    ros2_lan_relay_secret: Annotated[
        str | None,
        Option(
            "Secret that `rosproxy lan-relay` has as `--secret`. With this secret, the two "
            "programs authenticate each other's messages. Prefer the variable: all users of "
            "the machine can see a command line.",
            kinds.TOKEN,
            default="none",
        ),
    ] = field(default=None, repr=False)
    zenoh_ports: Annotated[
        PortRange,
        Option(
            "[rmw_zenoh](../guide/zenoh.md): ports for containers, with a zenoh router at each. "
            "Containers whose nodes are clients may share a port. A container with nodes in the "
            "default mode needs a port of its own. Only containers need these ports.",
            kinds.PORT_RANGE,
        ),
    ] = DEFAULT_ZENOH_PORTS
    zenoh_peer: Annotated[
        tuple[HostPort, ...],
        Option(
            "rmw_zenoh: router outside to which the proxy connects, for example the "
            "`rmw_zenohd` of a robot. Without a port: 7447. Repeatable.",
            kinds.ZENOH_PEER,
            variables=("ROSPROXY_ZENOH_PEERS",),
            repeatable=True,
            default="none",
            note="separated by spaces",
        ),
    ] = ()
    zenoh_hub: Annotated[
        tuple[HostPort, ...],
        Option(
            "rmw_zenoh: proxy on another host that serves the same graph, at the port of its "
            "`--zenoh-hub-listen`. Without a port: 7447. Unlike with `--zenoh-peer`, both proxies "
            "may name each other, and a proxy that is away is no fault. Repeatable.",
            kinds.ZENOH_PEER,
            variables=("ROSPROXY_ZENOH_HUBS",),
            repeatable=True,
            default="none",
            note="separated by spaces",
        ),
    ] = ()
    zenoh_hub_listen: Annotated[
        int | None,
        Option(
            "rmw_zenoh: port at which the proxies on other hosts connect that name this proxy as "
            "`--zenoh-hub`, usually 7447. Let only these hosts reach this port.",
            kinds.PORT,
            default="off",
        ),
    ] = None
    zenoh_hub_certificate: Annotated[
        Credentials | None,
        Option(
            "rmw_zenoh: [key and certificate](../guide/zenoh.md#several-hosts) with which this "
            "proxy and the proxies of `--zenoh-hub` prove themselves to each other: the private "
            "key, the certificate and the CA, as PEM. All these proxies need certificates of the "
            "same CA, and a certificate has to contain the name in `--zenoh-hub`. Set the "
            "variable: all users of the machine can see a command line.",
            kinds.HUB_CERTIFICATE,
            default="none",
        ),
    ] = field(default=None, repr=False)
    zenoh_listen: Annotated[
        int | None,
        Option(
            "rmw_zenoh: port at which laptops, and routers of other sites, connect to the proxy, "
            "usually 7447. The [policy](../guide/zenoh.md#policy) applies there. Publish this "
            "port.",
            kinds.PORT,
            default="off",
        ),
    ] = None
    zenoh_link: Annotated[
        tuple[SiteLink, ...],
        Option(
            "rmw_zenoh: proxy [at another site](../guide/zenoh.md#a-link-between-sites) to which "
            "the proxy connects with TLS and certificates of both sides, for example "
            "`tls/cloud.example:7447`. `quic/…` uses QUIC, over UDP. Without a port: 7447. "
            "Repeatable.",
            kinds.SITE_LINK,
            variables=("ROSPROXY_ZENOH_LINKS",),
            repeatable=True,
            default="none",
            note="separated by spaces",
        ),
    ] = ()
    zenoh_link_listen: Annotated[
        LinkPort | None,
        Option(
            "rmw_zenoh: port at which proxies of other sites connect with `--zenoh-link`, for "
            "example `tls/7447`, or `quic/7447` for QUIC. Publish this port.",
            kinds.LINK_PORT,
            default="off",
        ),
    ] = None
    zenoh_certificate: Annotated[
        str,
        Option(
            "rmw_zenoh: file with the certificate of this site for links, as PEM. With "
            "`--zenoh-link-listen`, the certificate has the host name by which other sites "
            "connect.",
            kinds.FILE,
            default="none",
        ),
    ] = ""
    zenoh_key: Annotated[
        str,
        Option(
            "rmw_zenoh: file with the private key of `--zenoh-certificate`, as PEM without a "
            "passphrase.",
            kinds.FILE,
            default="none",
        ),
    ] = ""
    zenoh_ca: Annotated[
        str,
        Option(
            "rmw_zenoh: file with the certificates of the CAs for links, as PEM. The proxy "
            "accepts other sites with certificates of these CAs only.",
            kinds.FILE,
            default="none",
        ),
    ] = ""
    zenoh_await_files: Annotated[
        bool,
        Option(
            "rmw_zenoh: start also while a file of the links can't be used, and make the links "
            "when it can. The operators set this option, so that a missing certificate costs the "
            "links alone."
        ),
    ] = False
    zenoh_limit: Annotated[
        tuple[TopicLimit, ...],
        Option(
            "rmw_zenoh: most messages a second that leave by all links to other sites, of a topic "
            "or of several topics together, for example `/camera/*=2Hz`. The first limit that "
            "matches a topic counts. Repeatable.",
            kinds.TOPIC_LIMIT,
            variables=("ROSPROXY_ZENOH_LIMITS",),
            repeatable=True,
            default="none",
            note="separated by spaces",
        ),
    ] = ()
    zenoh_link_policy: Annotated[
        tuple[tuple[Rule, ...], ...],
        Option(
            "rmw_zenoh: [rules](policy.md) about the topics and services that pass links to other "
            "sites. All nodes of this site count as inside, for example `allow publish /status; "
            "deny publish *`. Repeatable.",
            kinds.POLICY_RULES,
            repeatable=True,
            default="everything passes",
            note="rules separated by `;`",
        ),
    ] = ()
    log_level: Annotated[
        LogLevel,
        Option("Lowest severity that is logged.", any_case=True),
    ] = "info"

    def __post_init__(self) -> None:
        if self.admin_token and self.admin_token_hash:
            raise SettingError("--admin-token-hash", "give either this or --admin-token, not both")
        try:
            check_bounds((*self.policy, *self.policy_layers))
        except ValueError as error:
            raise SettingError("--policy", str(error)) from None
        if self.range_versions and not self.advertise_host:
            text = "missing; give name or address under which outside nodes and the master reach "
            text += "this host (ROSPROXY_ADVERTISE_HOST)"
            raise SettingError("--advertise-host", text)
        if self.for_ros1 and not self.master_uri:
            text = "missing; give the real ROS master, e.g. http://robot:11311 (ROS_MASTER_URI)"
            raise SettingError("--master-uri", text)
        self._check_ports()
        if self.for_ros2:
            self._check_ros2()
        if self.for_zenoh:
            self._check_zenoh()

    def _check_ports(self) -> None:
        ports = self.port_range
        advertise = self.advertise_port_range
        if advertise and len(advertise) != len(ports):
            text = f"{advertise} has {len(advertise)} ports and --port-range {ports} has"
            text += f" {len(ports)}; both need the same number"
            raise SettingError("--advertise-port-range", text)
        uses: dict[int, str] = {}
        if self.range_versions:
            uses = dict.fromkeys(ports.ports(), f"lies in --port-range {ports}")
        for option, port in self._listeners():
            if port in uses:
                raise SettingError(option, f"port {port} {uses[port]}; move one of them")
            uses[port] = f"is taken by {option}"

    def _listeners(self) -> Iterator[tuple[str, int]]:
        """Yield the option and the port of each listener, except the listeners of the range."""
        if self.for_ros1:
            yield "--master-port", self.master_port
        if self.for_ros1 and self.publish_master is not None:
            yield "--publish-master", self.publish_master
        yield "--admin-bind", self.admin.port
        yield from self.zenoh_listeners()

    def _check_ros2(self) -> None:
        count = len(self.domains)
        if len(self.port_range) < LEAST_PORTS_PER_DOMAIN * count:
            text = f"{self.port_range} is too small: each of {count} domains needs"
            raise SettingError("--port-range", f"{text} {LEAST_PORTS_PER_DOMAIN} ports")
        # An announcement may lack the domain, so a port can serve only a single domain.
        fix = "start a proxy for each domain"
        if self.ros2_lan_relay and count > 1:
            raise SettingError("--ros2-lan-relay", f"a LAN relay is for one domain: {fix}")
        if self.ros2_lan_relay and not self.ros2_lan_relay_secret:
            text = "missing; give this option and rosproxy lan-relay --secret the same secret"
            fix = "openssl rand -hex 16 makes one (ROSPROXY_ROS2_LAN_RELAY_SECRET)"
            raise SettingError("--ros2-lan-relay-secret", f"{text}: {fix}")
        for peer in self.ros2_peer:
            if peer.port and count > 1:
                text = f"{peer} has a port, which is for one domain: {fix}"
                raise SettingError("--ros2-peer", text)

    def _check_zenoh(self) -> None:
        if len(self.zenoh_ports) > MOST_ZENOH_PORTS:
            text = f"{self.zenoh_ports} has {len(self.zenoh_ports)} ports; give at most"
            raise SettingError("--zenoh-ports", f"{text} {MOST_ZENOH_PORTS}")
        if len(self.zenoh_peer) > MOST_ZENOH_PEERS:
            text = f"{len(self.zenoh_peer)} routers; give at most {MOST_ZENOH_PEERS}"
            raise SettingError("--zenoh-peer", text)
        if len(self.zenoh_hub) > MOST_ZENOH_HUBS:
            text = f"{len(self.zenoh_hub)} proxies; give at most {MOST_ZENOH_HUBS}"
            raise SettingError("--zenoh-hub", text)
        if len(self.zenoh_link) > MOST_ZENOH_LINKS:
            text = f"{len(self.zenoh_link)} links; give at most {MOST_ZENOH_LINKS}"
            raise SettingError("--zenoh-link", text)
        if len(self.zenoh_limit) > MOST_ZENOH_LIMITS:
            text = f"{len(self.zenoh_limit)} limits; give at most {MOST_ZENOH_LIMITS}"
            raise SettingError("--zenoh-limit", text)
        if self.has_site_links:
            self._check_site_links()

    def _check_site_links(self) -> None:
        files = {
            "--zenoh-certificate": self.zenoh_certificate,
            "--zenoh-key": self.zenoh_key,
            "--zenoh-ca": self.zenoh_ca,
        }
        for option, file in files.items():
            if not file:
                text = "missing; links between sites need a certificate, its key, and the CA of "
                raise SettingError(option, f"{text}the other sites, each in a file")
        try:
            check_bounds(self.link_policy)
        except ValueError as error:
            raise SettingError("--zenoh-link-policy", str(error)) from None

    @property
    def ports(self) -> PortMap:
        """The listen range and the advertised range."""
        return PortMap(self.port_range, self.advertise_port_range or self.port_range)

    @property
    def policy(self) -> tuple[PolicyLayer, ...]:
        """The layer with the rules of ``--policy``; empty without rules."""
        rules = tuple(rule for given in self.policy_rules for rule in given)
        return (PolicyLayer("--policy", rules, PolicyMode(self.policy_mode)),) if rules else ()

    @property
    def link_policy(self) -> tuple[PolicyLayer, ...]:
        """The layer with the rules of ``--zenoh-link-policy``; empty without rules."""
        rules = tuple(rule for given in self.zenoh_link_policy for rule in given)
        return (PolicyLayer("--zenoh-link-policy", rules, PolicyMode.ENFORCE),) if rules else ()

    @property
    def has_site_links(self) -> bool:
        """Whether the proxy connects to other sites, or accepts links of other sites."""
        return self.for_zenoh and bool(self.zenoh_link or self.zenoh_link_listen)

    @property
    def for_ros1(self) -> bool:
        """Whether the proxy serves ROS 1."""
        return "1" in self.ros

    @property
    def for_ros2(self) -> bool:
        """Whether the proxy serves ROS 2."""
        return "2" in self.ros

    @property
    def for_zenoh(self) -> bool:
        """Whether the proxy serves rmw_zenoh."""
        return "zenoh" in self.ros

    def zenoh_listeners(self) -> Iterator[tuple[str, int]]:
        """Yield the option and the port of each zenoh listener; nothing without rmw_zenoh."""
        if self.for_zenoh:
            yield from (("--zenoh-ports", port) for port in self.zenoh_ports.ports())
        if self.for_zenoh and self.zenoh_hub_listen is not None:
            yield "--zenoh-hub-listen", self.zenoh_hub_listen
        if self.for_zenoh and self.zenoh_listen is not None:
            yield "--zenoh-listen", self.zenoh_listen
        if self.for_zenoh and self.zenoh_link_listen is not None:
            yield "--zenoh-link-listen", self.zenoh_link_listen.port

    @property
    def range_versions(self) -> tuple[str, ...]:
        """The versions of ROS that use the range and the advertised host: 1 and 2."""
        return tuple(version for version in self.ros if version != "zenoh")

    @property
    def domains(self) -> tuple[int, ...]:
        """The domains of ROS 2."""
        return tuple(dict.fromkeys(self.ros2_domain)) or (0,)

    @property
    def token_hash(self) -> str | None:
        """The hash of the token for callers that are not on loopback; None: there is no token.

        The admin endpoint holds a hash, also if the setting is the token.
        """
        return kinds.hash_token(self.admin_token) if self.admin_token else self.admin_token_hash
