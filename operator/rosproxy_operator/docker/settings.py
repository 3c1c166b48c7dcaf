"""The settings of ``rosproxy-operator docker``: plain data, each written once.

See `rosproxy.settings`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

from rosproxy import setting_kinds as kinds
from rosproxy.access.layers import PolicyLayer
from rosproxy.leases.ports import PortRange
from rosproxy.net.addresses import HostPort
from rosproxy.setting_kinds import (
    DataPlane,
    Direction,
    Option,
    SettingError,
    SlaveControl,
    make_settings,
    time,
)
from rosproxy_operator.common.images import IMAGE
from rosproxy_operator.common.policy import administrators_policy
from rosproxy_operator.common.proxy_bounds import OWN_BOUNDS, ProxyBounds, make_proxy_bounds
from rosproxy_operator.docker import option_values

DEFAULT_ADMIN = HostPort("127.0.0.1", 11313)
GIBIBYTE = 1024 * 1024 * 1024
WINDOW = PortRange(11412, 65535)
"""Where ports are looked for: above the master's, the admin endpoint's, and rosserial's (11411)."""


@dataclass(frozen=True, slots=True)
class PlanSettings:
    """The operator's options that decide what is planned.

    ``master_uri``, ``advertise_host``, ``data_plane``, ``direction`` and ``udp`` are for containers
    without a label of their own. ``grace`` is in seconds. ``proxy_memory``, in bytes, and
    ``proxy_pids`` are by default several times what a thousand connections take at full rate
    (docs/performance.md): 32 MiB and 50 KiB for each in the process, 64 MiB of pipes and, where the
    kernel counts them in, 0.7 MiB of socket buffers for each; two threads for each.
    ``proxy_bounds`` are what else each proxy may take, ``policy`` is the administrator's, for all
    proxies: one layer or none. ``secret`` is what the proxies' tokens are made of; empty: the one
    that the uplink network has.
    """

    master_uri: Annotated[
        str | None,
        Option(
            "The real ROS master of containers that name none.",
            option_values.SHARED_MASTER_URI,
            variables=("ROSPROXY_MASTER_URI", "ROS_MASTER_URI"),
            default="none",
        ),
    ] = None
    advertise_host: Annotated[
        str | None,
        Option(
            "Name or address under which outside nodes and masters reach this host. Needed unless "
            "the operator is in the host's network.",
            kinds.HOST,
            default="the host's address towards the master",
        ),
    ] = None
    ports: Annotated[
        int, Option("Ports of a proxy, one per node behind it.", option_values.PORTS)
    ] = 32
    port_window: Annotated[
        PortRange, Option("Where ranges of ports are looked for.", kinds.PORT_RANGE)
    ] = WINDOW
    publish_address: Annotated[
        tuple[str, ...],
        Option(
            "Address of this host on which ports are published. One of a single interface keeps "
            "them off the others. Repeatable.",
            kinds.BIND_ADDRESS,
            repeatable=True,
        ),
    ] = ("0.0.0.0",)
    proxy_image: Annotated[
        str,
        Option(
            "The proxies' image. A new image of that name replaces them, one after the other.",
            IMAGE,
        ),
    ] = "rosproxy:latest"
    data_plane: Annotated[
        DataPlane,
        Option(
            "How proxies forward topics whose containers have no label for it; `kernel`: they get "
            "the capability NET_ADMIN for it."
        ),
    ] = "auto"
    direction: Annotated[
        Direction,
        Option(
            "`both`: nodes reach those outside through the proxy, too. Proxies with a container on "
            "an internal network do so in any case, unless its label says `out`."
        ),
    ] = "out"
    udp: Annotated[
        bool,
        Option(
            "Proxies of both directions publish their ports for UDP as well: [UDPROS]"
            "(../guide/docker.md#udpros) of nodes outside reaches containers."
        ),
    ] = False
    slave_control: Annotated[
        SlaveControl,
        Option(
            "Who may call shutdown, publisherUpdate and paramUpdate at the nodes of all proxies; a "
            "label can only narrow it."
        ),
    ] = "any"
    allow_master: Annotated[
        tuple[str, ...],
        Option(
            "A master that containers may name by label or `ROS_MASTER_URI`. `*` and `?` stand for "
            "other characters: `robot*:11311`, `*.lab.example`. Without a port: at any. "
            "`--master-uri` is allowed in any case. Repeatable.",
            option_values.HOST_PATTERN,
            repeatable=True,
            default="any, from port 1024 on",
            note="separated by spaces",
        ),
    ] = ()
    allow_alias: Annotated[
        tuple[str, ...],
        Option(
            "A name that a label or `ROS_MASTER_URI` may [give a proxy](labels.md#names) on the "
            "container's networks: the host name of its master. `*` and `?` stand for other "
            "characters: `robot*`, `*.lab.example`. That of `--master-uri` is allowed in any case. "
            "Repeatable.",
            option_values.NAME_PATTERN,
            repeatable=True,
            default="names of a LAN that no container has or had",
            note="separated by spaces",
        ),
    ] = ()
    redirect: Annotated[
        bool,
        Option(
            "Whether a master that a container's `ROS_MASTER_URI` gives by address [leads to the "
            "proxy](../guide/docker.md#a-master-given-by-address), by a rule in that container's "
            "network."
        ),
    ] = True
    max_ports: Annotated[
        int,
        Option(
            "Most ports that a label may ask for. What `--ports` says they get anyway.",
            option_values.PORTS,
        ),
    ] = 100
    allow_data_plane: Annotated[
        tuple[DataPlane, ...],
        Option(
            "A data plane that labels may ask for. That of `--data-plane` is allowed in any case. "
            "Repeatable.",
            repeatable=True,
            default="all but kernel",
        ),
    ] = ()
    proxy_memory: Annotated[
        int,
        Option(
            "Most memory of each proxy (`512m`, `1g`, from 64m on; 0: no bound). A thousand "
            "connections at full rate take 0.2 GiB, and where the kernel counts socket buffers in "
            "(cgroup v2) 0.8.",
            option_values.MEMORY,
            default="1g",
        ),
    ] = GIBIBYTE
    proxy_pids: Annotated[
        int,
        Option(
            "Most threads and processes of each proxy, from 256 on; 0: no bound. A connection "
            "takes one or two: that is for 4,000 that talk both ways.",
            option_values.PIDS,
        ),
    ] = 8192
    proxy_bounds: ProxyBounds = OWN_BOUNDS
    policy: tuple[PolicyLayer, ...] = ()
    secret: Annotated[
        str,
        Option(
            "A file with the secret that the proxies' tokens are made of: at least 32 characters "
            "(`openssl rand -hex 32`). If it changes, proxies are made anew on their ports; nodes "
            "go on.",
            option_values.SECRET,
            name="--secret-file",
            default="a random secret, kept as a label of the uplink network",
        ),
    ] = field(default="", repr=False)
    allow_peer: Annotated[
        tuple[str, ...],
        Option(
            "ROS 2: a host that the label `rosproxy.peers` may name, written as `--allow-master`. "
            "Without a port: at any, and at the well-known ones. `--ros2-peer` is allowed in any "
            "case. Repeatable.",
            option_values.HOST_PATTERN,
            repeatable=True,
            default="any",
        ),
    ] = ()
    ros2_peer: Annotated[
        tuple[str, ...],
        Option(
            "ROS 2: a host outside that every proxy tells of its participants, or another proxy, "
            "with the first port of its range. Repeatable.",
            option_values.PEER_NAME,
            variables=("ROSPROXY_ROS2_PEERS",),
            repeatable=True,
            default="none",
            note="separated by spaces",
        ),
    ] = ()
    ros2_lan: Annotated[
        str,
        Option(
            "ROS 2: this host's IPv4 address on the LAN whose multicast the [LAN relays]"
            "(../guide/docker.md#ros-2) hear; `none`: no LAN relays.",
            option_values.LAN,
            default="the advertised address, else that towards hosts far away",
        ),
    ] = ""
    expose_by_default: Annotated[
        bool,
        Option(
            "Containers with `ROS_MASTER_URI`, or of ROS 2 by `ROS_VERSION` or `ROS_DISTRO`, count "
            "without a label."
        ),
    ] = False
    grace: Annotated[
        float, Option("Time for which a proxy outlives its last container.", time(0))
    ] = 60.0
    uplink: Annotated[
        str,
        Option(
            "Network that is created for the proxies; it has to sort before all others.",
            option_values.NETWORK,
        ),
    ] = "0-rosproxy"


def make_plan_settings(options: Mapping[str, Any]) -> PlanSettings:
    """Settings from the values of the command line's options, by their names.

    Raises SettingError if they don't go together.
    """
    settings = make_settings(
        PlanSettings,
        options,
        policy=administrators_policy(options["policy"], options["policy_mode"]),
        proxy_bounds=make_proxy_bounds(options),
    )
    window = settings.port_window
    ports = settings.ports
    if len(window) < ports:
        raise SettingError("--port-window", f"{window} has {len(window)} ports, --ports is {ports}")
    return settings
