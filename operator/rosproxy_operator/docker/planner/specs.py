"""The specifications of a proxy's containers: names, labels, and bodies for the engine."""

import hashlib
import hmac
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from msgspec.structs import asdict, replace

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.domain_ports import LAST_DOMAIN
from rosproxy.shared.ports import PortRange
from rosproxy.shared.setting_kinds import SettingError, hash_token, parse_range
from rosproxy.shared.settings import MOST_ZENOH_PORTS
from rosproxy.shared.uris import parse_slave_uri
from rosproxy_operator.common.policy import POLICY_WAIT_S, as_variable
from rosproxy_operator.common.port_ranges import local_ports
from rosproxy_operator.common.problem import Fault
from rosproxy_operator.common.ros2 import (
    LAN_RELAY_COMMAND,
    lan_relay_variables,
    relay_secret,
    well_known_ports,
)
from rosproxy_operator.common.zenoh import LINK_DIRECTORY, link_settings
from rosproxy_operator.docker.planner.actions import (
    Create,
    CreateFlush,
    CreateLanRelay,
    CreateRedirect,
    CreateSandbox,
)
from rosproxy_operator.docker.planner.model import STARTED, STARTED_LABEL, THIS_HOST, HostState
from rosproxy_operator.docker.planner.zenoh_redirect import FIRST_PORT
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.proxy_spec.environment import environment
from rosproxy_operator.proxy_spec.fingerprint import LIVE_VARIABLES, digest
from rosproxy_operator.proxy_spec.place import ZENOH, Domain, Graph, Master, Place, ZenohNetwork
from rosproxy_operator.proxy_spec.spec import options

MANAGED = "io.rosproxy.managed"
ROLE = "io.rosproxy.role"
ROLE_SANDBOX = "ports"
ROLE_PROXY = "proxy"
ROLE_LAN_RELAY = "lan-relay"
FORMER_LAN_RELAY = "ear"
"""The role, the command and the end of the name of LAN relays by operators before 0.1.0. The
operator recreates these LAN relays."""
ROLE_REDIRECT = "redirect"
ROLE_FLUSH = "flush"
MASTER_URI = "io.rosproxy.master-uri"
DOMAIN = "io.rosproxy.domain"
ROUTERS = "io.rosproxy.zenoh"
"""Label: ``true`` on the containers of the proxy for rmw_zenoh."""
ADVERTISE_HOST = "io.rosproxy.advertise-host"
RANGE = "io.rosproxy.range"
FINGERPRINT = "io.rosproxy.fingerprint"
SECRET = "io.rosproxy.secret"  # noqa: S105 - the label's name
"""Label of the uplink network: the secret from which the operator makes the tokens of proxies."""

FORMER_TOKEN = "ROSPROXY_ADMIN_TOKEN"  # noqa: S105 - the variable's name
"""The variable with the token of former proxies. Present proxies have only the token's hash."""
ADMIN_PORT = 11312
DEFAULT_MASTER_PORT = 11311
COMMON_HOST_CONFIG: Mapping[str, Any] = {
    "ReadonlyRootfs": True,
    "CapDrop": ["ALL"],
    "SecurityOpt": ["no-new-privileges:true"],
    "RestartPolicy": {"Name": "always"},
}
"""The common part of ``HostConfig`` for all containers of a proxy.

The restart policy is ``always``. After a crash of the engine, the new engine stops all containers,
and counts these as stopped by a user. So the engine starts containers with ``always`` again, but
not containers with ``unless-stopped``.
"""
_KERNEL_CONFIG = {"CapAdd": ["NET_ADMIN"], "SecurityOpt": ["no-new-privileges:false"]}
"""The further ``HostConfig`` of a proxy with the kernel plane: see the proxy's Dockerfile.

no-new-privileges is set to false explicitly, because an engine may have true as the default.
"""
LINK_MOUNT: Mapping[str, Any] = {"Type": "bind", "Target": LINK_DIRECTORY, "ReadOnly": True}
"""The mount of a proxy with links to other sites, without the directory of the host."""
_ROLES = {
    CreateSandbox: ROLE_SANDBOX,
    Create: ROLE_PROXY,
    CreateLanRelay: ROLE_LAN_RELAY,
    CreateRedirect: ROLE_REDIRECT,
    CreateFlush: ROLE_FLUSH,
}
LAN_RELAY_MEMORY_BYTES = 128 * 1024**2
"""Bytes of memory that a LAN relay may have. A LAN relay takes 30 MiB."""
LAN_RELAY_PIDS = 64
"""Threads that a LAN relay may have. A LAN relay has a single thread."""
USER = "10001:10001"
SANDBOX_COMMAND = ("sleep", "infinity")
PROXY_COMMAND = ("rosproxy", "run")
"""The default command of the proxy's image (Dockerfile). The operator gives proxies no command."""
NFT = "/usr/sbin/nft"
FLUSH_SCRIPT = r"""
/usr/sbin/conntrack -L -p udp --orig-port-dst "$1" >/dev/null
/usr/sbin/conntrack -L -p udp |
  sed -n 's/^udp *17 [0-9]* src=[^ ]* dst=[^ ]* sport=[0-9]* dport=\([0-9]*\) .*/\1/p' |
  sort -un |
  while read -r port; do
    if [ "$port" -ge "$1" ] && [ "$port" -le "$2" ]; then
      /usr/sbin/conntrack -D -p udp --orig-port-dst "$port" >/dev/null || :
    fi
  done
"""
"""A script that deletes the conntrack entries, of IPv4 and IPv6, for UDP ports ``$1`` to ``$2``.

The first line fails if the kernel denies access to the entries, and ``sh -e`` then ends the script.
Each ``conntrack -D`` reads the whole table, which takes 10 ms. So the script runs ``conntrack -D``
only for ports with entries.
"""
HELPER_USER = "0:0"
"""Root. The capability of another user would need a program with file capabilities, and
no-new-privileges makes file capabilities ineffective."""
HELPER_MEMORY_BYTES = 64 * 1024**2
"""Bytes of memory that a helper may have. nft and conntrack take 5 MiB."""
HELPER_PIDS = 16
"""Threads that a helper may have."""


@dataclass(frozen=True, slots=True)
class OwnLabels:
    """The content of the labels of an own container. ``role`` is one of ``ROLE_…``."""

    role: str
    place: Place
    range: PortRange
    fingerprint: str


def proxy_name(place: Place) -> str:
    """The name of a proxy's container: master's host, domain or ``zenoh``, and six hex digits."""
    digest = hashlib.sha256(_identity(place).encode()).hexdigest()
    match place.graph:
        case Master() as master:
            label = master.host.lower()
        case Domain(number):
            label = f"domain-{number}"
        case ZenohNetwork():
            label = "zenoh"
    slug = re.sub(r"[^a-z0-9]+", "-", label)[:30].strip("-")
    return f"rosproxy-{slug or 'master'}-{digest[:6]}"


def sandbox_name(place: Place) -> str:
    """The name of the container that holds the ports of a place's proxy."""
    return f"{proxy_name(place)}-ports"


def lan_relay_name(place: Place) -> str:
    """The name of the container in which a place's LAN relay runs."""
    return f"{proxy_name(place)}-lan-relay"


def redirect_name(place: Place, fingerprint: str) -> str:
    """The name of a container that sets a redirect to a place's proxy, with the fingerprint."""
    return f"{proxy_name(place)}-redirect-{fingerprint[:12]}"


def flush_name(place: Place) -> str:
    """The name of the container that deletes conntrack entries for a place's UDP ports."""
    return f"{proxy_name(place)}-flush"


def is_proxy_name(name: str) -> bool:
    """Whether a name has the form of a proxy's, sandbox's or LAN relay's name."""
    return re.fullmatch(r"rosproxy-[a-z0-9-]+-[0-9a-f]{6}(-ports|-lan-relay)?", name) is not None


def _identity(place: Place) -> str:
    """The text that identifies a place, for hashes and secrets."""
    name = place.graph.uri if isinstance(place.graph, Master) else str(place.graph)
    return f"{name} {place.advertise_host}"


def unresolved_master(host: str, observed: HostState) -> Fault:
    """Say that the operator can't resolve the host name of a master.

    A container that does not run has no address. Its name in /etc/hosts would hide its next
    address.
    """
    text = f"the operator can't resolve the host name {host}"
    if host == THIS_HOST:
        return Fault(f"{text} before the network of the proxies exists", "Wait for the operator")
    for container in observed.containers:
        names = {container.name, *(name for a in container.attachments for name in a.names)}
        if host.lower() in {name.lower() for name in names} and container.state not in STARTED:
            return Fault(
                f"{text}: the container {container.name} is {container.state}",
                f"Start the container: docker start {container.name}",
            )
    return Fault(
        text,
        f"Add the line 'ADDRESS {host}' to /etc/hosts of this host; if the operator runs in a "
        f"container, start that container with docker run --add-host {host}:ADDRESS (Compose: "
        "extra_hosts)",
    )


def admin_port(place: Place) -> int:
    """The port of a proxy's admin endpoint: 11312, or 11313 if 11312 is the master port."""
    taken = isinstance(place.graph, Master) and place.master.port == ADMIN_PORT
    return ADMIN_PORT + 1 if taken else ADMIN_PORT


def proxy_token(place: Place, secret: str) -> str:
    """The token of a place's proxy, 64 hex digits: HMAC-SHA256 (RFC 2104) of the place.

    The operator has no disk, and computes the token for each use. The proxy has only the hash of
    the token.
    """
    return hmac.new(secret.encode(), _identity(place).encode(), hashlib.sha256).hexdigest()


def reserved_ports(place: Place) -> frozenset[int]:
    """The ports that can't be in the range of a place's proxy.

    These are the further ports on which the proxy listens. For ROS 2, the default master port is
    reserved as well: each proxy refuses a range that contains the port of ``--master-port``.
    """
    match place.graph:
        case Master() as master:
            return frozenset({admin_port(place), master.port})
        case Domain(number):
            return frozenset({DEFAULT_MASTER_PORT, ADMIN_PORT, *well_known_ports(number)})
        case ZenohNetwork():
            return frozenset({ADMIN_PORT})


def own_range(place: Place, ports: PortRange) -> PortRange:
    """The ports that the proxy itself may use. For ROS 2, the LAN relay has the last port."""
    return PortRange(ports.first, ports.last - 1) if isinstance(place.graph, Domain) else ports


def published_ports(place: Place, ports: PortRange, udp: bool) -> list[tuple[str, int]]:
    """The ports that a place's sandbox publishes, as the engine writes ports, with the host's port.

    If ``udp`` is true, the sandbox of a proxy for ROS 1 publishes the ports for UDP as well, for
    UDPROS. The sandbox for rmw_zenoh publishes no port, since that proxy opens all connections to
    outside.
    """
    match place.graph:
        case Master():
            protocols = ["tcp", "udp"] if udp else ["tcp"]
        case Domain():
            protocols = ["udp"]
        case ZenohNetwork():
            protocols = []
    own = own_range(place, ports).ports()
    return [(f"{port}/{protocol}", port) for protocol in protocols for port in own]


def read_own(labels: Mapping[str, str]) -> OwnLabels | None:
    """Read the labels of an own container.

    None if the labels are not the operator's, or not complete. An image can carry such labels, too:
    see `own_containers`.
    """
    role = labels.get(ROLE, "")
    if role == FORMER_LAN_RELAY:
        role = ROLE_LAN_RELAY
    if labels.get(MANAGED) != "true" or role not in _ROLES.values():
        return None
    place = _read_place(labels)
    try:
        ports = parse_range(RANGE, labels.get(RANGE, ""))
    except SettingError:
        return None
    if place is None or (role == ROLE_LAN_RELAY and not isinstance(place.graph, Domain)):
        return None
    return OwnLabels(role, place, ports, labels.get(FINGERPRINT, ""))


def _read_place(labels: Mapping[str, str]) -> Place | None:
    uri = labels.get(MASTER_URI, "")
    host = labels.get(ADVERTISE_HOST, "")
    domain = labels.get(DOMAIN, "")
    if labels.get(ROUTERS) == "true":
        return None if uri or host or domain else ZENOH
    if not host or bool(uri) == bool(domain):
        return None
    if uri:
        return Place(Master(uri), host) if parse_slave_uri(uri) else None
    is_domain = re.fullmatch(r"[0-9]{1,3}", domain, re.ASCII) and int(domain) <= LAST_DOMAIN
    return Place(Domain(int(domain)), host) if is_domain else None


Creation = CreateSandbox | Create | CreateLanRelay | CreateRedirect | CreateFlush
"""An action that creates a container."""


def flush_command(place: Place, ports: PortRange) -> tuple[str, ...]:
    """The command that deletes the conntrack entries for the UDP ports of a place's sandbox."""
    published = own_range(place, ports)
    return ("/bin/sh", "-ec", FLUSH_SCRIPT, "flush", str(published.first), str(published.last))


def _graph_labels(graph: Graph) -> dict[str, str]:
    """The labels that name the graph. `_read_place` reads these labels."""
    match graph:
        case Master(uri):
            return {MASTER_URI: uri}
        case Domain(number):
            return {DOMAIN: str(number)}
        case ZenohNetwork():
            return {ROUTERS: "true"}


def own_labels(action: Creation) -> dict[str, str]:
    """The labels of a container that the action creates. `read_own` reads these labels."""
    place = action.place
    return {
        MANAGED: "true",
        ROLE: _ROLES[type(action)],
        **_graph_labels(place.graph),
        **({ADVERTISE_HOST: place.advertise_host} if place != ZENOH else {}),
        RANGE: str(action.range),
        FINGERPRINT: action.fingerprint,
        **({STARTED_LABEL: action.started} if isinstance(action, CreateRedirect) else {}),
    }


def sandbox_fingerprint(action: CreateSandbox, settings: PlanSettings) -> str:
    """The fingerprint of a sandbox, 16 hex digits, without name and image."""
    body = sandbox_config(replace(action, fingerprint=""), settings)
    # A sandbox only sleeps, so a new image is no reason to recreate the sandbox and free the ports.
    return digest({**body, "Image": ""})


def proxy_fingerprint(action: Create, settings: PlanSettings, image_id: str, secret: str) -> str:
    """The fingerprint of a proxy's container, 16 hex digits.

    The fingerprint leaves out the container's name and the sandbox. Also left out are the master's
    address and the policy, which the operator sends to the running proxy. The hash of the token and
    the secret of the LAN relay count: with another token, the proxy would refuse the operator.
    """
    body = container_config(replace(action, sandbox="", fingerprint=""), settings, secret, "")
    env = [v for v in body["Env"] if v.partition("=")[0] not in LIVE_VARIABLES]
    return digest({**body, "Image": image_id, "Env": env})


def sandbox_config(action: CreateSandbox, settings: PlanSettings) -> dict[str, Any]:
    """The body of the engine's ``POST /containers/create`` for a sandbox.

    The sandbox only sleeps. In the sandbox's namespace, outgoing connections of the proxy get ports
    outside the range. For rmw_zenoh, these ports begin after the ports of the routers.
    """
    local = local_ports([action.range])
    if action.place == ZENOH:
        local = PortRange(FIRST_PORT + MOST_ZENOH_PORTS, 11000)
    sysctls = {"net.ipv4.ip_local_port_range": f"{local.first} {local.last}"}
    if action.spec.data_plane == "kernel":
        sysctls["net.ipv4.ip_forward"] = "1"
    bindings = {
        name: [{"HostIp": ip, "HostPort": str(port)} for ip in settings.publish_address]
        for name, port in published_ports(action.place, action.range, action.spec.udp)
    }
    return {
        "Image": settings.proxy_image,
        "User": USER,
        "Entrypoint": [*SANDBOX_COMMAND[:1]],
        "Cmd": [*SANDBOX_COMMAND[1:]],
        # The image's health check asks a proxy's admin endpoint (Dockerfile). A sandbox has none.
        "Healthcheck": {"Test": ["NONE"]},
        "Labels": own_labels(action),
        "ExposedPorts": {port: {} for port in bindings},
        "HostConfig": {
            **COMMON_HOST_CONFIG,
            # As process 1, sleep would ignore SIGTERM (pid_namespaces(7)), so that the engine would
            # have to kill sleep after a time-out.
            "Init": True,
            "NetworkMode": settings.uplink,
            "PortBindings": bindings,
            "Sysctls": sysctls,
        },
        "NetworkingConfig": {"EndpointsConfig": {settings.uplink: {}}},
    }


def helper_config(settings: PlanSettings, network_mode: str) -> dict[str, Any]:
    """The common body of the engine's ``POST /containers/create`` for all helpers.

    A helper has NET_ADMIN in a network namespace, does a single task there, and ends.
    """
    return {
        "Image": settings.proxy_image,
        "User": HELPER_USER,
        "Healthcheck": {"Test": ["NONE"]},
        "HostConfig": {
            **COMMON_HOST_CONFIG,
            "RestartPolicy": {"Name": "no"},
            "CapAdd": ["NET_ADMIN"],
            "Init": False,
            "Memory": HELPER_MEMORY_BYTES,
            "PidsLimit": HELPER_PIDS,
            "NetworkMode": network_mode,
        },
    }


def container_config(
    action: Create, settings: PlanSettings, secret: str, master_address: str
) -> dict[str, Any]:
    """The body of the engine's ``POST /containers/create`` for a proxy.

    The operator makes the token from ``secret``. If ``master_address`` is empty, the proxy itself
    resolves the host name of the master.
    """
    fields = _settings_fields(action, settings, secret, master_address)
    variables = environment("docker", fields, always=("port_range", "master_port"))
    limits = {"Memory": settings.proxy_memory, "PidsLimit": settings.proxy_pids}
    return {
        "Image": settings.proxy_image,
        "User": USER,
        "Env": [f"{name}={value}" for name, value in variables.items()],
        "Labels": own_labels(action),
        "HostConfig": {
            **COMMON_HOST_CONFIG,
            **(_KERNEL_CONFIG if action.spec.data_plane == "kernel" else {}),
            "Init": False,
            **{name: limit for name, limit in limits.items() if limit},
            **({"Mounts": [_link_mount(settings)]} if action.links else {}),
            "NetworkMode": f"container:{action.sandbox}",
        },
    }


def _settings_fields(
    action: Create, settings: PlanSettings, secret: str, master_address: str
) -> dict[str, Any]:
    """The settings of a proxy, by field of the proxy's `Settings`.

    Keep the order: another order of variables changes the fingerprint, and recreates all proxies.
    """
    place = action.place
    graph = place.graph
    if place == ZENOH:
        return {
            "admin": HostPort("0.0.0.0", admin_port(place)),
            "admin_token_hash": hash_token(proxy_token(place, secret)),
            "ros": (graph.ros,),
            "zenoh_ports": action.range,
            "zenoh_peer": action.peers,
            **options(action.spec, graph.ros),
            "await_policy": POLICY_WAIT_S,
            "policy_layers": as_variable((*settings.policy, *action.policy)),
            **_link_fields(action, settings),
        }
    return {
        "master_uri": graph.uri if isinstance(graph, Master) else "",
        "advertise_host": place.advertise_host,
        "port_range": own_range(place, action.range),
        "master_port": graph.port if isinstance(graph, Master) else None,
        "admin": HostPort("0.0.0.0", admin_port(place)),
        **options(action.spec, graph.ros),
        "admin_token_hash": hash_token(proxy_token(place, secret)),
        "master_address": master_address,
        **(asdict(settings.proxy_bounds) if isinstance(graph, Master) else {}),
        "await_policy": POLICY_WAIT_S,
        "policy_layers": as_variable((*settings.policy, *action.policy)),
        "ros": (graph.ros,),
        "ros2_domain": graph.number if isinstance(graph, Domain) else None,
        "ros2_peer": action.peers,
        "ros2_lan_relay": action.lan_relay,
        "ros2_lan_relay_secret": _relay_secret(place, secret) if action.lan_relay else None,
    }


def _link_fields(action: Create, settings: PlanSettings) -> dict[str, Any]:
    """The settings of a proxy with links to other sites; empty without links."""
    if not action.links:
        return {}
    return link_settings(action.links, map(str, settings.zenoh_limit), settings.link_rules)


def _link_mount(settings: PlanSettings) -> dict[str, Any]:
    """The mount with the files of the links.

    The engine refuses a directory that does not exist. With ``Binds``, the engine would create the
    directory.
    """
    return {**LINK_MOUNT, "Source": settings.zenoh_link_certificates}


def _relay_secret(place: Place, secret: str) -> str:
    """The secret with which a proxy and the LAN relay prove their datagrams to each other."""
    return relay_secret(secret.encode(), _identity(place))


def lan_relay_config(action: CreateLanRelay, settings: PlanSettings, secret: str) -> dict[str, Any]:
    """The body of the engine's ``POST /containers/create`` for a LAN relay.

    The LAN relay shares only the network with the host. The operator makes the LAN relay's own
    secret from ``secret``.
    """
    graph = action.place.graph
    domain = graph.number if isinstance(graph, Domain) else 0
    own = _relay_secret(action.place, secret)
    variables = lan_relay_variables(domain, action.lan, action.bind, action.proxy, own)
    return {
        "Image": settings.proxy_image,
        "User": USER,
        # The image's entry point is rosproxy already.
        "Cmd": [*LAN_RELAY_COMMAND[1:]],
        "Healthcheck": {"Test": ["NONE"]},
        "Env": [f"{name}={value}" for name, value in variables.items()],
        "Labels": own_labels(action),
        "HostConfig": {
            **COMMON_HOST_CONFIG,
            "Init": False,
            "Memory": LAN_RELAY_MEMORY_BYTES,
            "PidsLimit": LAN_RELAY_PIDS,
            "NetworkMode": "host",
        },
    }


def lan_relay_fingerprint(
    action: CreateLanRelay, settings: PlanSettings, image_id: str, secret: str
) -> str:
    """The fingerprint of a LAN relay, 16 hex digits, without the name."""
    body = lan_relay_config(replace(action, fingerprint=""), settings, secret)
    return digest({**body, "Image": image_id})


def has_kernel_privileges(host: Mapping[str, Any]) -> bool:
    """Whether ``host``, the HostConfig of a proxy, has the privileges for the kernel plane.

    Some engines write capabilities with the prefix ``CAP_``.
    """
    added = [str(name).removeprefix("CAP_") for name in host.get("CapAdd") or ()]
    return (
        added == _KERNEL_CONFIG["CapAdd"]
        and host.get("SecurityOpt") == _KERNEL_CONFIG["SecurityOpt"]
    )
