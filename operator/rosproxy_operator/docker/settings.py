"""The settings of ``rosproxy-operator docker``: plain data, each setting written once.

See `rosproxy.shared.settings`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

from rosproxy.shared import setting_kinds as kinds
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.policy.layers import PolicyLayer, check_bounds
from rosproxy.shared.policy.rules import Rule
from rosproxy.shared.ports import PortRange
from rosproxy.shared.setting_kinds import (
    DataPlane,
    Direction,
    Option,
    SettingError,
    SlaveControl,
    TopicLimit,
    make_settings,
    time,
)
from rosproxy.shared.settings import MOST_ZENOH_LIMITS, MOST_ZENOH_LINKS
from rosproxy.shared.zenoh_rules.key_expressions import check_limits
from rosproxy.shared.zenoh_rules.name_sets import check_layers
from rosproxy_operator.common.images import IMAGE
from rosproxy_operator.common.policy import administrators_policy
from rosproxy_operator.common.proxy_bounds import OWN_BOUNDS, ProxyBounds, make_proxy_bounds
from rosproxy_operator.docker import option_values

DEFAULT_ADMIN = HostPort("127.0.0.1", 11313)
GIBIBYTE = 1024 * 1024 * 1024
WINDOW = PortRange(11412, 65535)
"""The default window: above the ports of the master, the admin endpoint and rosserial (11411)."""


@dataclass(frozen=True, slots=True)
class PlanSettings:
    """The options of the operator that decide the plan.

    ``master_uri``, ``advertise_host``, ``data_plane``, ``direction`` and ``udp`` are for containers
    without the label of the same name. ``grace`` is in seconds. ``policy`` is the administrator's
    policy for all proxies: a single layer, or none. The operator makes the proxies' tokens from
    ``secret``, or from the secret of the uplink network if ``secret`` is empty.

    ``proxy_memory`` (bytes) and ``proxy_pids`` bound each proxy, as do ``proxy_bounds``. The
    defaults are several times the need of a thousand connections at full rate
    (docs/performance.md). The process takes 32 MiB, and 50 KiB and two threads for each connection.
    Pipes take 64 MiB. Where the kernel counts socket buffers, each connection takes another
    0.7 MiB.
    """

    master_uri: Annotated[
        str | None,
        Option(
            "The real ROS master of containers that name no master.",
            option_values.SHARED_MASTER_URI,
            variables=("ROSPROXY_MASTER_URI", "ROS_MASTER_URI"),
            default="none",
        ),
    ] = None
    advertise_host: Annotated[
        str | None,
        Option(
            "Name or address under which outside nodes and masters reach this host. Required "
            "unless the operator runs in the host's network.",
            kinds.HOST,
            default="the address from which this host reaches the master",
        ),
    ] = None
    ports: Annotated[
        int,
        Option(
            "Number of ports of each proxy: one for each ROS 1 node behind the proxy.",
            option_values.PORTS,
        ),
    ] = 32
    port_window: Annotated[
        PortRange,
        Option(
            "Ports of this host among which the operator chooses the ranges of the proxies.",
            kinds.PORT_RANGE,
        ),
    ] = WINDOW
    publish_address: Annotated[
        tuple[str, ...],
        Option(
            "Address of this host on which the operator publishes ports. The address of one "
            "interface keeps the ports off all other interfaces. Repeatable.",
            kinds.BIND_ADDRESS,
            repeatable=True,
        ),
    ] = ("0.0.0.0",)
    proxy_image: Annotated[
        str,
        Option(
            "Image of the proxies. When the engine has a new image under this name, the operator "
            "replaces the proxies, one after the other.",
            IMAGE,
        ),
    ] = "rosproxy:latest"
    data_plane: Annotated[
        DataPlane,
        Option(
            "How proxies forward topics, for containers without the label `rosproxy.data-plane`. "
            "With `kernel`, the proxies get the capability NET_ADMIN. With `auto`, they splice."
        ),
    ] = "auto"
    direction: Annotated[
        Direction,
        Option(
            "`both`: inside nodes reach outside nodes through the proxy, too. A proxy with a "
            "container on an internal network always has the direction `both`, unless the "
            "container's label says `out`."
        ),
    ] = "out"
    udp: Annotated[
        bool,
        Option(
            "Proxies with the direction `both` also publish their ports for UDP, so that "
            "[UDPROS](../guide/docker.md#udpros) from outside nodes reaches containers."
        ),
    ] = False
    slave_control: Annotated[
        SlaveControl,
        Option(
            "Which outside hosts may call `shutdown`, `publisherUpdate` and `paramUpdate` at "
            "the nodes of all proxies: `any`, or only the `master`'s host. A label can only "
            "narrow this option."
        ),
    ] = "any"
    allow_master: Annotated[
        tuple[str, ...],
        Option(
            "Master that containers may name by label or `ROS_MASTER_URI`. `*` and `?` are "
            "wildcards: `robot*:11311`, `*.lab.example`. An entry without a port allows any "
            "port. `--master-uri` is always allowed. Repeatable.",
            option_values.HOST_PATTERN,
            repeatable=True,
            default="any, from port 1024 on",
            note="separated by spaces",
        ),
    ] = ()
    allow_alias: Annotated[
        tuple[str, ...],
        Option(
            "Host name of a master that a label or `ROS_MASTER_URI` may [give the "
            "proxy](labels.md#names) on the container's networks. `*` and `?` are wildcards: "
            "`robot*`, `*.lab.example`. The host name of `--master-uri` is always allowed. "
            "Repeatable.",
            option_values.NAME_PATTERN,
            repeatable=True,
            default="names of a LAN that no container has, or had while the operator ran",
            note="separated by spaces",
        ),
    ] = ()
    redirect: Annotated[
        bool,
        Option(
            "Redirect a master that a container's `ROS_MASTER_URI` gives by address: a rule in "
            "the container's network [leads that address to the "
            "proxy](../guide/docker.md#a-master-given-by-address)."
        ),
    ] = True
    max_ports: Annotated[
        int,
        Option(
            "Most ports that a label may ask for. If `--ports` is higher, `--ports` applies.",
            option_values.PORTS,
        ),
    ] = 100
    allow_data_plane: Annotated[
        tuple[DataPlane, ...],
        Option(
            "Data plane that labels may ask for. The value of `--data-plane` is always allowed. "
            "Repeatable.",
            repeatable=True,
            default="all but kernel",
        ),
    ] = ()
    proxy_memory: Annotated[
        int,
        Option(
            "Most memory of each proxy, such as `512m` or `1g`: at least 64m, or 0 for no "
            "bound. A thousand connections at full rate take 0.2 GiB, or 0.8 GiB if the kernel "
            "counts socket buffers, too (cgroup v2).",
            option_values.MEMORY,
            default="1g",
        ),
    ] = GIBIBYTE
    proxy_pids: Annotated[
        int,
        Option(
            "Most threads and processes of each proxy: at least 256, or 0 for no bound. A "
            "connection takes one or two threads. The default is enough for 4,000 connections "
            "that carry data both ways.",
            option_values.PIDS,
        ),
    ] = 8192
    proxy_bounds: ProxyBounds = OWN_BOUNDS
    policy: tuple[PolicyLayer, ...] = ()
    secret: Annotated[
        str,
        Option(
            "File with the secret from which the operator makes the tokens of the proxies: at "
            "least 32 characters (`openssl rand -hex 32`). If the secret changes, the operator "
            "recreates the proxies on the same ports, and the nodes keep running.",
            option_values.SECRET,
            name="--secret-file",
            default="a random secret, kept as a label of the uplink network",
        ),
    ] = field(default="", repr=False)
    allow_peer: Annotated[
        tuple[str, ...],
        Option(
            "ROS 2: host that the label `rosproxy.peers` may name, written as for "
            "`--allow-master`. For rmw_zenoh, also the variable `ZENOH_CONFIG_OVERRIDE`. An entry "
            "without a port allows any port, and the well-known ports. For DDS, `--ros2-peer` is "
            "always allowed. Repeatable.",
            option_values.HOST_PATTERN,
            repeatable=True,
            default="any",
        ),
    ] = ()
    ros2_peer: Annotated[
        tuple[str, ...],
        Option(
            "ROS 2: outside host to which every proxy for DDS announces its participants. Or "
            "another proxy, with the first port of that proxy's range. Repeatable.",
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
            "ROS 2: this host's IPv4 address on the LAN whose multicast the [LAN "
            "relays](../guide/docker.md#ros-2) receive. `none`: no LAN relays.",
            option_values.LAN,
            default="the advertised address, else the address on the default route",
        ),
    ] = ""
    zenoh_link: Annotated[
        tuple[str, ...],
        Option(
            "rmw_zenoh: proxy [at another site](../guide/zenoh.md#a-link-with-the-operator-for-"
            "docker) to which the proxy of this host connects with TLS, for example "
            "`tls/cloud.example:7447`. `quic/…` uses QUIC. Without a port: 7447. Repeatable.",
            option_values.LINK_NAME,
            variables=("ROSPROXY_ZENOH_LINKS",),
            repeatable=True,
            default="none",
            note="separated by spaces",
        ),
    ] = ()
    allow_link: Annotated[
        tuple[str, ...],
        Option(
            "rmw_zenoh: proxy at another site that the label `rosproxy.zenoh-link` may name, for "
            "example `tls/*.example:7447`. `*` and `?` are wildcards. An entry without a port "
            "allows any port. `--zenoh-link` is always allowed. Repeatable.",
            option_values.LINK_PATTERN,
            repeatable=True,
            default="none",
            note="separated by spaces",
        ),
    ] = ()
    zenoh_link_certificates: Annotated[
        str,
        Option(
            "rmw_zenoh: directory of the Docker host with the certificate of this site "
            "(`tls.crt`), its key (`tls.key`), and the CAs of the other sites (`ca.crt`). Needed "
            "for links. The proxy's user, 10001, has to be able to read the files.",
            option_values.HOST_DIRECTORY,
            default="none: no links",
        ),
    ] = ""
    zenoh_limit: Annotated[
        tuple[TopicLimit, ...],
        Option(
            "rmw_zenoh: most messages a second that leave by the links, of a topic or of several "
            "topics together, for example `/camera/image=2Hz`. The first limit that matches a "
            "topic counts. Repeatable.",
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
            "rmw_zenoh: [rules](policy.md) about the topics and services that pass the links, for "
            "example `allow publish /status; deny publish *`. All nodes of this host count as "
            "inside. Repeatable.",
            kinds.POLICY_RULES,
            repeatable=True,
            default="everything passes",
            note="rules separated by `;`",
        ),
    ] = ()
    expose_by_default: Annotated[
        bool,
        Option(
            "Containers without the label `rosproxy.enable` also get a proxy, if they have "
            "`ROS_MASTER_URI`, or if `ROS_VERSION` or `ROS_DISTRO` states ROS 2."
        ),
    ] = False
    grace: Annotated[
        float,
        Option("Time for which a proxy keeps running after its last container has gone.", time(0)),
    ] = 60.0
    uplink: Annotated[
        str,
        Option(
            "Network that the operator creates for the proxies. Its name must sort before the "
            "names of all other networks.",
            option_values.NETWORK,
        ),
    ] = "0-rosproxy"

    @property
    def link_rules(self) -> tuple[Rule, ...]:
        """The rules of ``--zenoh-link-policy``."""
        return tuple(rule for given in self.zenoh_link_policy for rule in given)


def make_plan_settings(options: Mapping[str, Any]) -> PlanSettings:
    """Return the settings from the values of the command line's options, by name.

    Raises SettingError if two values contradict each other.
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
        raise SettingError(
            "--port-window", f"{window} has {len(window)} ports, fewer than --ports {ports}"
        )
    _check_links(settings)
    return settings


def _check_links(settings: PlanSettings) -> None:
    """Raise SettingError for links that the proxy would refuse at its start."""
    if (settings.zenoh_link or settings.allow_link) and not settings.zenoh_link_certificates:
        text = "missing; links between sites need a directory with tls.crt, tls.key and ca.crt"
        raise SettingError("--zenoh-link-certificates", text)
    for option, count, most in (
        ("--zenoh-link", len(settings.zenoh_link), MOST_ZENOH_LINKS),
        ("--zenoh-limit", len(settings.zenoh_limit), MOST_ZENOH_LIMITS),
    ):
        if count > most:
            raise SettingError(option, f"given {count} times; give it at most {most} times")
    layers = (PolicyLayer("--zenoh-link-policy", settings.link_rules),)
    try:
        check_limits(settings.zenoh_limit)
    except ValueError as error:
        raise SettingError("--zenoh-limit", str(error)) from None
    try:
        check_layers(check_bounds(layers))
    except ValueError as error:
        raise SettingError("--zenoh-link-policy", str(error)) from None
