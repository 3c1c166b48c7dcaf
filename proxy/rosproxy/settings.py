"""The settings of a proxy: plain data, checked.

Each is written once, in `Settings`: its field, type, default, and the `Option` from which come the
option of ``rosproxy run``, its variable, its key in the file of ``--config``, its help, its bounds
and its row in docs/reference/options.md.
"""

from dataclasses import dataclass, field
from typing import Annotated, Literal

from rosproxy import setting_kinds as kinds
from rosproxy.access.layers import PolicyLayer, PolicyMode, check_bounds
from rosproxy.access.rules import Rule
from rosproxy.leases.ports import PortMap, PortRange
from rosproxy.net.addresses import HostPort, Network
from rosproxy.setting_kinds import DataPlane, Direction, Option, SettingError, SlaveControl

MEBIBYTE = 1024 * 1024
LEAST_PER_DOMAIN = 4
"""Ports of the range for a domain of ROS 2: one to be found at, three for a participant."""
DEFAULT_ADMIN = HostPort("127.0.0.1", 11312)
DEFAULT_RANGE = PortRange(11000, 11099)


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """Everything that ``rosproxy run`` can be told. Times are in seconds.

    ``inside_networks`` empty means: the networks of the proxy's own interfaces. If there are
    others, ROS 1 with ``direction`` ``both`` leaves out that of the default route, and ROS 2 leaves
    out that of the advertised host. A ``ros2_peer`` with port 0 is told at the well-known ports.
    Raises SettingError where two of them don't go together.
    """

    ros: Annotated[
        tuple[Literal["1", "2"], ...],
        Option(
            "Version of ROS that the proxy is for. Repeatable: one process for both, with one "
            "range, which ROS 1 uses for TCP and ROS 2 for UDP.",
            repeatable=True,
            note="`1 2` for both",
        ),
    ] = ("1",)
    master_uri: Annotated[
        str,
        Option(
            "The real master, e.g. `http://robot:11311`. It need not be up when the proxy starts.",
            kinds.MASTER_URI,
            variables=("ROSPROXY_MASTER_URI", "ROS_MASTER_URI"),
            default="required for ROS 1",
        ),
    ] = ""
    master_address: Annotated[
        str | None,
        Option(
            "IP address of the master's host, to connect to instead of resolving its name; the "
            "name may then be [one of the proxy itself](../guide/by-hand.md#keep-the-masters-name)."
            " It can be changed at run time.",
            kinds.ADDRESS,
            default="where its name leads",
        ),
    ] = None
    advertise_host: Annotated[
        str,
        Option(
            "Name or address under which outside nodes and the master reach this host. All of "
            "them must be able to resolve it.",
            kinds.HOST,
        ),
    ]
    master_port: Annotated[
        int,
        Option(
            "Where inside nodes find their master: `ROS_MASTER_URI=http://<proxy>:11311`.",
            kinds.PORT,
        ),
    ] = 11311
    port_range: Annotated[
        PortRange,
        Option(
            "Ports that the proxy listens on. [One for each node inside]"
            "(../guide/by-hand.md#how-many-ports); publish exactly these.",
            kinds.PORT_RANGE,
        ),
    ] = DEFAULT_RANGE
    advertise_port_range: Annotated[
        PortRange | None,
        Option(
            "The same ports as outside sees them, if that differs: as many, in the same order.",
            kinds.PORT_RANGE,
            default="as `--port-range`",
        ),
    ] = None
    publish_master: Annotated[
        int | None,
        Option(
            "Where the master itself runs inside: offers it to outside on this port (publish it "
            "too). It calls nodes at the advertised address, so it must itself reach the host's "
            "published ports; Docker's own port proxy sees to that, NAT without hairpin does not.",
            kinds.PORT,
            default="off",
        ),
    ] = None
    bind: Annotated[
        str,
        Option("Address to listen on; `::` for IPv4 and IPv6.", kinds.BIND_ADDRESS),
    ] = "0.0.0.0"
    admin: Annotated[
        HostPort,
        Option(
            "The admin endpoint ([API](admin-api.md)) and the live page. To let Prometheus scrape, "
            "bind it to an address that only your monitoring reaches.",
            kinds.HOST_PORT,
            name="--admin-bind",
        ),
    ] = DEFAULT_ADMIN
    admin_token: Annotated[
        str | None,
        Option(
            "What callers that are not on loopback must send to change anything at the admin "
            "endpoint, and give to see the [live page](../guide/live-page.md#who-may-look): 8 to "
            "200 printable ASCII characters without spaces. Better given as a variable: a command "
            "line can be seen by all.",
            kinds.TOKEN,
            default="none",
        ),
    ] = field(default=None, repr=False)
    admin_token_hash: Annotated[
        str | None,
        Option(
            "The same for a proxy that is not to hold the token: its SHA-256 in 64 hex digits "
            "(`printf %s \"$TOKEN\" | sha256sum`). Whoever reads the proxy's environment can't "
            "call it then, as long as the token can't be guessed: make it of `openssl rand -hex "
            "16`.",
            kinds.TOKEN_HASH,
            default="none",
        ),
    ] = None
    inside_networks: Annotated[
        tuple[Network, ...],
        Option(
            "A network of nodes inside. Only addresses in one, or selected by an operator, may use "
            "the proxy as their master; there nodes reach each other directly. Repeatable.",
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
            "Time between probes of an idle node. One that ends is noticed at once.",
            kinds.time(0.05),
        ),
    ] = 5.0
    probe_timeout: Annotated[float, Option("Time that a node has to answer.", kinds.time(0.05))] = (
        3.0
    )
    cleanup_after: Annotated[
        float,
        Option(
            "Time after which a node that is gone is unregistered at the master. 0: never.",
            kinds.time(0),
        ),
    ] = 30.0
    linger: Annotated[
        float,
        Option("Time for which a port is kept after its node has ended.", kinds.time(0)),
    ] = 30.0
    master_interval: Annotated[
        float, Option("Time between looks at the master.", kinds.time(0.05))
    ] = 2.0
    slave_control: Annotated[
        SlaveControl,
        Option(
            "Who may call `shutdown`, `publisherUpdate` and `paramUpdate` at inside nodes. With "
            "`master`, `rosnode kill` works from the master's host only."
        ),
    ] = "any"
    policy_rules: Annotated[
        tuple[tuple[Rule, ...], ...],
        Option(
            "What outside may see and do, and what inside may take from outside: [rules]"
            "(policy.md) such as `deny publish /camera/*`. Repeatable.",
            kinds.POLICY_RULES,
            name="--policy",
            repeatable=True,
            default="none",
            note="one text, rules separated by `;` or line ends",
        ),
    ] = ()
    policy_mode: Annotated[
        Literal["enforce", "audit"],
        Option("Whether the rules of `--policy` and `--policy-file` are enforced, or only told."),
    ] = "enforce"
    policy_file: Annotated[
        str | None,
        Option(
            "A file with more such rules, a line each; it is read again when it changes.",
            kinds.FILE,
            default="none",
        ),
    ] = None
    policy_layers: Annotated[
        tuple[PolicyLayer, ...],
        Option(
            "For operators: the layers of rules at the start, as [`POST /policy`]"
            "(admin-api.md#policy) takes them.",
            kinds.POLICY_LAYERS,
            default="none",
        ),
    ] = ()
    await_policy: Annotated[
        float,
        Option(
            "For operators: time at the start without registrations before `POST /policy` comes.",
            kinds.time(0),
        ),
    ] = 0.0
    direction: Annotated[
        Direction,
        Option(
            "`both`: nodes inside reach those outside through the proxy, too, at [ports on its "
            "inside addresses](../guide/by-hand.md#no-way-out-but-the-proxy)."
        ),
    ] = "out"
    udp: Annotated[
        bool,
        Option(
            "With `--direction both`: the range is published for UDP, too, so that UDPROS of a "
            "publisher outside comes in. Without, a subscriber gets TCPROS if it offers that."
        ),
    ] = False
    data_plane: Annotated[
        DataPlane, Option("How topics' bytes are forwarded, see [data plane](#data-plane).")
    ] = "auto"
    max_lease_call: Annotated[
        int,
        Option(
            "Longest call of outside to a node, with 10,000 XML elements for each MiB. This and "
            "the next five: [bounds](limits.md).",
            kinds.MEBIBYTES,
        ),
    ] = 1
    max_master_call: Annotated[
        int,
        Option(
            "Longest call with addresses of a node to the master; 5,000 elements for each MiB.",
            kinds.MEBIBYTES,
        ),
    ] = 4
    max_body: Annotated[
        int,
        Option(
            "Longest parameter, or other call or reply without addresses, that passes.",
            kinds.MEBIBYTES,
        ),
    ] = 64
    max_buffered: Annotated[
        int,
        Option(
            "Memory for all calls and replies that are read; one source gets half of it.",
            kinds.MEBIBYTES,
        ),
    ] = 32
    max_connections_per_source: Annotated[
        int,
        Option(
            "Connections from one address; behind NAT or Docker's port proxy many share one.",
            kinds.CONNECTIONS,
        ),
    ] = 4096
    max_connections_per_lease: Annotated[
        int, Option("Connections to one port of the range.", kinds.CONNECTIONS)
    ] = 2048
    ros2_domain: Annotated[
        tuple[int, ...],
        Option(
            "[ROS 2](../guide/ros2.md): a domain. Repeatable; they share out the range equally.",
            kinds.DOMAIN,
            variables=("ROSPROXY_ROS2_DOMAINS", "ROS_DOMAIN_ID"),
            repeatable=True,
            default="0",
        ),
    ] = ()
    ros2_peer: Annotated[
        tuple[HostPort, ...],
        Option(
            "ROS 2: a host outside that is told of participants inside, at the well-known ports of "
            "its first 32 participants; or another proxy, with the first port of its range, where "
            "this one has a single domain. Repeatable.",
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
            "ROS 2: where [`rosproxy lan-relay`](../guide/ros2.md#the-lan) listens, for a single "
            "domain.",
            kinds.HOST_PORT,
            default="none",
        ),
    ] = None
    ros2_lan_relay_secret: Annotated[
        str | None,
        Option(
            "The secret that `rosproxy lan-relay` has as `--secret`: both programs prove by it "
            "what they send each other. Better given as a variable: a command line can be seen by "
            "all.",
            kinds.TOKEN,
            default="none",
        ),
    ] = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if self.admin_token and self.admin_token_hash:
            raise SettingError("--admin-token-hash", "give either this or --admin-token, not both")
        try:
            check_bounds((*self.policy, *self.policy_layers))
        except ValueError as error:
            raise SettingError("--policy", str(error)) from None
        if self.for_ros1 and not self.master_uri:
            text = "missing; give the real ROS master, e.g. http://robot:11311 (ROS_MASTER_URI)"
            raise SettingError("--master-uri", text)
        self._check_ports()
        if self.for_ros2:
            self._check_ros2()

    def _check_ports(self) -> None:
        ports = self.port_range
        advertise = self.advertise_port_range
        if advertise and len(advertise) != len(ports):
            text = f"{advertise} has {len(advertise)} ports and --port-range {ports} has"
            text += f" {len(ports)}; both need the same number"
            raise SettingError("--advertise-port-range", text)
        uses = dict.fromkeys(ports.ports(), f"lies in --port-range {ports}")
        for option, port in (
            ("--master-port", self.master_port),
            ("--publish-master", self.publish_master),
            ("--admin-bind", self.admin.port),
        ):
            if port in uses:
                raise SettingError(option, f"port {port} {uses[port]}; move one of them")
            if port is not None:
                uses[port] = f"is taken by {option}"

    def _check_ros2(self) -> None:
        count = len(self.domains)
        if len(self.port_range) < LEAST_PER_DOMAIN * count:
            text = f"{self.port_range} is too short: each of {count} domains needs"
            raise SettingError("--port-range", f"{text} {LEAST_PER_DOMAIN} ports")
        # An announcement need not tell its domain: what has one port has one domain.
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

    @property
    def ports(self) -> PortMap:
        """What the proxy listens on, and what outside sees."""
        return PortMap(self.port_range, self.advertise_port_range or self.port_range)

    @property
    def policy(self) -> tuple[PolicyLayer, ...]:
        """The layer of the options' own rules; none without rules."""
        rules = tuple(rule for given in self.policy_rules for rule in given)
        return (PolicyLayer("--policy", rules, PolicyMode(self.policy_mode)),) if rules else ()

    @property
    def for_ros1(self) -> bool:
        """Whether it is for ROS 1."""
        return "1" in self.ros

    @property
    def for_ros2(self) -> bool:
        """Whether it is for ROS 2."""
        return "2" in self.ros

    @property
    def domains(self) -> tuple[int, ...]:
        """The domains of ROS 2."""
        return tuple(dict.fromkeys(self.ros2_domain)) or (0,)

    @property
    def token_hash(self) -> str | None:
        """The hash of what callers that are not on loopback must know; None: they may do nothing.

        It is that of the token where that was given: the admin endpoint holds a hash in any case.
        """
        return kinds.hash_token(self.admin_token) if self.admin_token else self.admin_token_hash
