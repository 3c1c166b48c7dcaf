"""The containers of a proxy: what they are made of, and what is read back from their labels."""

import hashlib
import hmac
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from msgspec.structs import asdict, replace

from rosproxy.leases.ports import PortRange
from rosproxy.net.addresses import HostPort
from rosproxy.ros1.protocol.uris import parse_slave_uri
from rosproxy.setting_kinds import SettingError, hash_token, parse_range
from rosproxy.settings import MOST_ZENOH_PORTS
from rosproxy_operator.common.policy import AWAITED, as_variable
from rosproxy_operator.common.ros2 import (
    LAN_RELAY_COMMAND,
    LAST_DOMAIN,
    lan_relay_variables,
    relay_secret,
    well_known_ports,
)
from rosproxy_operator.docker.planner.actions import (
    Create,
    CreateFlush,
    CreateLanRelay,
    CreateRedirect,
    CreateSandbox,
)
from rosproxy_operator.docker.planner.model import STARTED_LABEL, ZENOH, Key
from rosproxy_operator.docker.planner.zenoh_redirect import FIRST_PORT
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.proxy_spec.environment import environment
from rosproxy_operator.proxy_spec.fingerprint import LIVE_VARIABLES, digest

MANAGED = "io.rosproxy.managed"
ROLE = "io.rosproxy.role"
ROLE_SANDBOX = "ports"
ROLE_PROXY = "proxy"
ROLE_LAN_RELAY = "lan-relay"
FORMER_LAN_RELAY = "ear"
"""The role, command and end of the name of LAN relays that operators before 0.1.0 made. They are
made anew."""
ROLE_REDIRECT = "redirect"
ROLE_FLUSH = "flush"
MASTER_URI = "io.rosproxy.master-uri"
DOMAIN = "io.rosproxy.domain"
ROUTERS = "io.rosproxy.zenoh"
"""``true`` on what is for the proxy for rmw_zenoh."""
ADVERTISE_HOST = "io.rosproxy.advertise-host"
RANGE = "io.rosproxy.range"
FINGERPRINT = "io.rosproxy.fingerprint"
SECRET = "io.rosproxy.secret"  # noqa: S105 - the label's name
"""On the uplink network: what the proxies' tokens are made of."""

FORMER_TOKEN = "ROSPROXY_ADMIN_TOKEN"  # noqa: S105 - the variable's name
"""Where proxies had their token before they got the hash alone."""
ADMIN_PORT = 11312
DEFAULT_MASTER_PORT = 11311
COMMON: Mapping[str, Any] = {
    "ReadonlyRootfs": True,
    "CapDrop": ["ALL"],
    "SecurityOpt": ["no-new-privileges:true"],
    "RestartPolicy": {"Name": "always"},
}
"""The ``HostConfig`` of all containers of a proxy.

An engine that was killed stops what runs when it is back, and then takes it for stopped on purpose:
of that, it starts again what is to run ``always``, not what is so ``unless-stopped``.
"""
_KERNEL = {"CapAdd": ["NET_ADMIN"], "SecurityOpt": ["no-new-privileges:false"]}
"""What a proxy needs besides so that the kernel forwards for it: see the proxy's Dockerfile.

Given explicitly, as an engine may have no-new-privileges for its default.
"""
_ROLES = {
    CreateSandbox: ROLE_SANDBOX,
    Create: ROLE_PROXY,
    CreateLanRelay: ROLE_LAN_RELAY,
    CreateRedirect: ROLE_REDIRECT,
    CreateFlush: ROLE_FLUSH,
}
LAN_RELAY_MEMORY = 128 * 1024**2
LAN_RELAY_PIDS = 64
"""Bytes and threads of a LAN relay, which has 30 MiB and one."""
USER = "10001:10001"
SANDBOX_COMMAND = ("sleep", "infinity")
PROXY_COMMAND = ("rosproxy", "run")
"""What the proxy's image does by itself (its Dockerfile): the operator gives no other command."""
NFT = "/usr/sbin/nft"
FLUSH = r"""
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
"""Deletes the conntrack entries, of IPv4 and IPv6, for the UDP ports from ``$1`` to ``$2``.

The first line fails where this may not be done. Each ``conntrack -D`` reads the whole table, which
takes 10 ms, so it is run only for ports that have entries.
"""
HELPER_USER = "0:0"
"""Root: its capabilities need no file capabilities, which no-new-privileges would defeat."""
HELPER_MEMORY = 64 * 1024**2
"""Bytes of memory that a helper may have: nft and conntrack take 5 MiB."""
HELPER_PIDS = 16
"""Threads that a helper may have."""


@dataclass(frozen=True, slots=True)
class OwnLabels:
    """What a container's labels say that this operator made. ``role`` is one of ``ROLE_…``."""

    role: str
    key: Key
    range: PortRange
    fingerprint: str


def proxy_name(key: Key) -> str:
    """The name of a key's proxy container: master's host or domain, six digits of a hash."""
    digest = hashlib.sha256(_identity(key).encode()).hexdigest()
    labels = {"2": f"domain-{key.domain}", "zenoh": "zenoh"}
    label = labels.get(key.ros) or master(key).host.lower()
    slug = re.sub(r"[^a-z0-9]+", "-", label)[:30].strip("-")
    return f"rosproxy-{slug or 'master'}-{digest[:6]}"


def sandbox_name(key: Key) -> str:
    """The name of the container that holds the ports of a key's proxy."""
    return f"{proxy_name(key)}-ports"


def lan_relay_name(key: Key) -> str:
    """The name of the container in which a key's LAN relay runs."""
    return f"{proxy_name(key)}-lan-relay"


def redirect_name(key: Key, fingerprint: str) -> str:
    """The name of a container that sets a redirect to a key's proxy, by what it is made of."""
    return f"{proxy_name(key)}-redirect-{fingerprint[:12]}"


def flush_name(key: Key) -> str:
    """The name of the container that deletes conntrack entries for a key's UDP ports."""
    return f"{proxy_name(key)}-flush"


def is_proxy_name(name: str) -> bool:
    """Whether a name is one that a proxy's container has, also if it is not there now."""
    return re.fullmatch(r"rosproxy-[a-z0-9-]+-[0-9a-f]{6}(-ports|-lan-relay)?", name) is not None


def _identity(key: Key) -> str:
    """What a key's proxy is known by."""
    return f"{key.master_uri or key.graph} {key.advertise_host}"


def unresolved_master(host: str) -> str:
    """What to do about a master whose host's name leads nowhere.

    An address in its place is no fix: nodes that have one in ROS_MASTER_URI go around the proxy.
    """
    return (
        f"the operator can't resolve the host name {host}. Add the line 'ADDRESS {host}' to "
        "/etc/hosts of this host; if the operator runs in a container, start that container with "
        f"docker run --add-host {host}:ADDRESS (Compose: extra_hosts). Do not replace the name by "
        "an address"
    )


def master(key: Key) -> HostPort:
    """The host and port of a key's master; a key of ROS 2 has none. Raises ValueError."""
    host_port = parse_slave_uri(key.master_uri)
    if host_port is None:
        raise ValueError(f"{key.master_uri!r} is no master's URI")
    return host_port


def admin_port(key: Key) -> int:
    """The port of a proxy's admin endpoint: 11312, or 11313 where nodes find their master there."""
    taken = key.ros == "1" and master(key).port == ADMIN_PORT
    return ADMIN_PORT + 1 if taken else ADMIN_PORT


def proxy_token(key: Key, secret: str) -> str:
    """The token of a key's proxy, 64 hex digits: HMAC-SHA256 (RFC 2104) of the key.

    It is made anew whenever it is needed, so that it is kept nowhere: the proxy has its hash, and
    the operator has no disk.
    """
    return hmac.new(secret.encode(), _identity(key).encode(), hashlib.sha256).hexdigest()


def reserved_ports(key: Key) -> frozenset[int]:
    """The ports on which a key's proxy listens besides its range, so never to be in it."""
    if key.domain is not None:
        return frozenset({DEFAULT_MASTER_PORT, ADMIN_PORT, *well_known_ports(key.domain)})
    return frozenset({admin_port(key), *((master(key).port,) if key.ros == "1" else ())})


def own_range(key: Key, ports: PortRange) -> PortRange:
    """The proxy's own ports of a range: for ROS 2 the last port of the range is the LAN relay's."""
    return PortRange(ports.first, ports.last - 1) if key.is_ros2 else ports


def published_ports(key: Key, ports: PortRange, udp: bool) -> list[tuple[str, int]]:
    """What a key's sandbox publishes, in the engine's words, each with the port of the host.

    ``udp``: that of a proxy for ROS 1 publishes them for UDP as well, for UDPROS. The one for
    rmw_zenoh publishes nothing, as it connects to outside by itself.
    """
    protocols = {"1": ["tcp", *(["udp"] if udp else [])], "2": ["udp"], "zenoh": []}[key.ros]
    own = own_range(key, ports).ports()
    return [(f"{port}/{protocol}", port) for protocol in protocols for port in own]


def read_own(labels: Mapping[str, str]) -> OwnLabels | None:
    """What the labels of a container of this operator say.

    None if they are not those of one, or not whole.
    """
    role = labels.get(ROLE, "")
    if role == FORMER_LAN_RELAY:
        role = ROLE_LAN_RELAY
    if labels.get(MANAGED) != "true" or role not in _ROLES.values():
        return None
    key = _read_key(labels)
    try:
        ports = parse_range(RANGE, labels.get(RANGE, ""))
    except SettingError:
        return None
    if key is None or (role == ROLE_LAN_RELAY and not key.is_ros2):
        return None
    return OwnLabels(role, key, ports, labels.get(FINGERPRINT, ""))


def _read_key(labels: Mapping[str, str]) -> Key | None:
    uri = labels.get(MASTER_URI, "")
    host = labels.get(ADVERTISE_HOST, "")
    domain = labels.get(DOMAIN, "")
    if labels.get(ROUTERS) == "true":
        return None if uri or host or domain else ZENOH
    if not host or bool(uri) == bool(domain):
        return None
    if uri:
        return Key(uri, host) if parse_slave_uri(uri) else None
    is_domain = re.fullmatch(r"[0-9]{1,3}", domain, re.ASCII) and int(domain) <= LAST_DOMAIN
    return Key("", host, int(domain)) if is_domain else None


Creation = CreateSandbox | Create | CreateLanRelay | CreateRedirect | CreateFlush
"""An action that creates a container."""


def flush_command(key: Key, ports: PortRange) -> tuple[str, ...]:
    """What deletes the conntrack entries for the UDP ports that a key's sandbox publishes."""
    published = own_range(key, ports)
    return ("/bin/sh", "-ec", FLUSH, "flush", str(published.first), str(published.last))


def own_labels(action: Creation) -> dict[str, str]:
    """The labels of a container, from which `read_own` reads it back."""
    key = action.key
    graph = {"1": {MASTER_URI: key.master_uri}, "2": {DOMAIN: str(key.domain)}}
    return {
        MANAGED: "true",
        ROLE: _ROLES[type(action)],
        **graph.get(key.ros, {ROUTERS: "true"}),
        **({ADVERTISE_HOST: key.advertise_host} if key != ZENOH else {}),
        RANGE: str(action.range),
        FINGERPRINT: action.fingerprint,
        **({STARTED_LABEL: action.started} if isinstance(action, CreateRedirect) else {}),
    }


def sandbox_fingerprint(action: CreateSandbox, settings: PlanSettings) -> str:
    """What a sandbox is made of, in 16 hex digits. Its name and the image are not in it."""
    body = sandbox_config(replace(action, fingerprint=""), settings)
    # It only sleeps, so a new image is no reason to take its ports down.
    return digest({**body, "Image": ""})


def proxy_fingerprint(action: Create, settings: PlanSettings, image_id: str, secret: str) -> str:
    """What a proxy's own container is made of, in 16 hex digits.

    Neither its name, its sandbox nor the master's address are in it. The hash of its token is: a
    proxy that knows another one would not listen to the operator. So is what it shares with its
    LAN relay.
    """
    body = container_config(replace(action, sandbox="", fingerprint=""), settings, secret, "")
    env = [v for v in body["Env"] if v.partition("=")[0] not in LIVE_VARIABLES]
    return digest({**body, "Image": image_id, "Env": env})


def sandbox_config(action: CreateSandbox, settings: PlanSettings) -> dict[str, Any]:
    """The body of the engine's ``POST /containers/create`` for a sandbox.

    It does nothing until it is stopped. Outgoing connections, which are the proxy's, start
    below the ports that a proxy is to listen on, and above those of its routers for rmw_zenoh.
    """
    first = FIRST_PORT + MOST_ZENOH_PORTS if action.key == ZENOH else 1024
    sysctls = {"net.ipv4.ip_local_port_range": f"{first} 11000"}
    if action.spec.data_plane == "kernel":
        sysctls["net.ipv4.ip_forward"] = "1"
    bindings = {
        name: [{"HostIp": ip, "HostPort": str(port)} for ip in settings.publish_address]
        for name, port in published_ports(action.key, action.range, action.spec.udp)
    }
    return {
        "Image": settings.proxy_image,
        "User": USER,
        "Entrypoint": [*SANDBOX_COMMAND[:1]],
        # The image's health check asks a proxy's admin endpoint (Dockerfile), which is not here.
        "Cmd": [*SANDBOX_COMMAND[1:]],
        "Healthcheck": {"Test": ["NONE"]},
        "Labels": own_labels(action),
        "ExposedPorts": {port: {} for port in bindings},
        "HostConfig": {
            # As process 1, sleep would ignore SIGTERM (pid_namespaces(7)), and be killed only after
            # the engine's time-out.
            **COMMON,
            "Init": True,
            "NetworkMode": settings.uplink,
            "PortBindings": bindings,
            "Sysctls": sysctls,
        },
        "NetworkingConfig": {"EndpointsConfig": {settings.uplink: {}}},
    }


def helper_config(settings: PlanSettings, network_mode: str) -> dict[str, Any]:
    """What all helpers have of the body of the engine's ``POST /containers/create``.

    A helper does one thing in a network namespace with NET_ADMIN, and ends.
    """
    return {
        "Image": settings.proxy_image,
        "User": HELPER_USER,
        "Healthcheck": {"Test": ["NONE"]},
        "HostConfig": {
            **COMMON,
            "RestartPolicy": {"Name": "no"},
            "CapAdd": ["NET_ADMIN"],
            "Init": False,
            "Memory": HELPER_MEMORY,
            "PidsLimit": HELPER_PIDS,
            "NetworkMode": network_mode,
        },
    }


def container_config(
    action: Create, settings: PlanSettings, secret: str, master_address: str
) -> dict[str, Any]:
    """The body of the engine's ``POST /containers/create`` for a proxy.

    ``secret`` is what its token is made of. ``master_address`` may be empty: then the proxy
    resolves its master's host itself.
    """
    told = _told(action, settings, secret, master_address)
    variables = environment("docker", told, always=("port_range", "master_port"))
    limits = {"Memory": settings.proxy_memory, "PidsLimit": settings.proxy_pids}
    return {
        "Image": settings.proxy_image,
        "User": USER,
        "Env": [f"{name}={value}" for name, value in variables.items()],
        "Labels": own_labels(action),
        "HostConfig": {
            **COMMON,
            **(_KERNEL if action.spec.data_plane == "kernel" else {}),
            "Init": False,
            **{name: limit for name, limit in limits.items() if limit},
            "NetworkMode": f"container:{action.sandbox}",
        },
    }


def _told(
    action: Create, settings: PlanSettings, secret: str, master_address: str
) -> dict[str, Any]:
    """The settings of a proxy, by their fields, in the order of `environment`."""
    key = action.key
    if key == ZENOH:
        return {
            "admin": HostPort("0.0.0.0", admin_port(key)),
            "admin_token_hash": hash_token(proxy_token(key, secret)),
            "ros": (key.ros,),
            "zenoh_ports": action.range,
            "zenoh_peer": action.peers,
        }
    return {
        "master_uri": key.master_uri,
        "advertise_host": key.advertise_host,
        "port_range": own_range(key, action.range),
        "master_port": None if key.is_ros2 else master(key).port,
        "admin": HostPort("0.0.0.0", admin_port(key)),
        **asdict(action.spec),
        "admin_token_hash": hash_token(proxy_token(key, secret)),
        "master_address": master_address,
        **({} if key.is_ros2 else asdict(settings.proxy_bounds)),
        "await_policy": AWAITED,
        "policy_layers": as_variable((*settings.policy, *action.policy)),
        "ros": (key.ros,),
        "ros2_domain": key.domain,
        "ros2_peer": action.peers,
        "ros2_lan_relay": action.lan_relay,
        "ros2_lan_relay_secret": _relay_secret(key, secret) if action.lan_relay else None,
    }


def _relay_secret(key: Key, secret: str) -> str:
    """What a key's proxy and its LAN relay prove to each other that they know."""
    return relay_secret(secret.encode(), _identity(key))


def lan_relay_config(action: CreateLanRelay, settings: PlanSettings, secret: str) -> dict[str, Any]:
    """The body of the engine's ``POST /containers/create`` for a LAN relay.

    It has the host's network and nothing else of the host's. ``secret`` is what its own is made of.
    """
    own = _relay_secret(action.key, secret)
    variables = lan_relay_variables(
        action.key.domain or 0, action.lan, action.bind, action.proxy, own
    )
    return {
        "Image": settings.proxy_image,
        "User": USER,
        # The image's entry point is rosproxy already.
        "Cmd": [*LAN_RELAY_COMMAND[1:]],
        "Healthcheck": {"Test": ["NONE"]},
        "Env": [f"{name}={value}" for name, value in variables.items()],
        "Labels": own_labels(action),
        "HostConfig": {
            **COMMON,
            "Init": False,
            "Memory": LAN_RELAY_MEMORY,
            "PidsLimit": LAN_RELAY_PIDS,
            "NetworkMode": "host",
        },
    }


def lan_relay_fingerprint(
    action: CreateLanRelay, settings: PlanSettings, image_id: str, secret: str
) -> str:
    """What a LAN relay is made of, in 16 hex digits; its name is not in it."""
    body = lan_relay_config(replace(action, fingerprint=""), settings, secret)
    return digest({**body, "Image": image_id})


def is_kernel_host(host: Mapping[str, Any]) -> bool:
    """Whether a proxy's HostConfig, as the engine tells it, has the rights of the kernel plane.

    Engines lead capabilities by ``CAP_`` or not.
    """
    added = [str(name).removeprefix("CAP_") for name in host.get("CapAdd") or ()]
    return added == _KERNEL["CapAdd"] and host.get("SecurityOpt") == _KERNEL["SecurityOpt"]
