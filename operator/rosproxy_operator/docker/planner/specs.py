"""The containers of a proxy: what they are made of, and what is read back from their labels."""

import hashlib
import hmac
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from msgspec.structs import replace

from rosproxy.leases.ports import PortRange
from rosproxy.net.addresses import HostPort
from rosproxy.ros1.protocol.uris import parse_slave_uri
from rosproxy.settings import SettingError, hash_token, parse_range
from rosproxy_operator.common.policy import POLICY_VARIABLES, policy_variables
from rosproxy_operator.common.proxy_bounds import bound_variables
from rosproxy_operator.docker.planner.actions import Create, CreateSandbox
from rosproxy_operator.docker.planner.model import Key, PlanSettings

MANAGED = "io.rosproxy.managed"
ROLE = "io.rosproxy.role"
ROLE_SANDBOX = "ports"
ROLE_PROXY = "proxy"
MASTER_URI = "io.rosproxy.master-uri"
ADVERTISE_HOST = "io.rosproxy.advertise-host"
RANGE = "io.rosproxy.range"
FINGERPRINT = "io.rosproxy.fingerprint"
SECRET = "io.rosproxy.secret"  # noqa: S105 - the label's name
"""On the uplink network: what the proxies' tokens are made of."""

FORMER_TOKEN = "ROSPROXY_ADMIN_TOKEN"  # noqa: S105 - the variable's name
"""Where proxies had their token before they got the hash alone."""
ADMIN_PORT = 11312
_COMMON: Mapping[str, Any] = {
    "ReadonlyRootfs": True,
    "CapDrop": ["ALL"],
    "SecurityOpt": ["no-new-privileges:true"],
    "RestartPolicy": {"Name": "unless-stopped"},
}
"""The ``HostConfig`` of both containers of a proxy."""
_KERNEL = {"CapAdd": ["NET_ADMIN"], "SecurityOpt": ["no-new-privileges:false"]}
"""What a proxy needs besides so that the kernel forwards for it: see the proxy's Dockerfile.

Said in so many words, as an engine may have no-new-privileges for its default.
"""
USER = "10001:10001"
SANDBOX_COMMAND = ("sleep", "infinity")
PROXY_COMMAND = ("rosproxy", "run")
"""What the proxy's image does by itself (its Dockerfile): the operator gives no other command."""


@dataclass(frozen=True, slots=True)
class OwnLabels:
    """What a container's labels say that this operator made. ``role`` is one of ``ROLE_…``."""

    role: str
    key: Key
    range: PortRange
    fingerprint: str


def proxy_name(key: Key) -> str:
    """The name of a key's proxy container: its master's host and six digits of the key's hash."""
    digest = hashlib.sha256(f"{key.master_uri} {key.advertise_host}".encode()).hexdigest()
    slug = re.sub(r"[^a-z0-9]+", "-", master(key).host.lower())[:30].strip("-")
    return f"rosproxy-{slug or 'master'}-{digest[:6]}"


def sandbox_name(key: Key) -> str:
    """The name of the container that holds the ports of a key's proxy."""
    return f"{proxy_name(key)}-ports"


def is_proxy_name(name: str) -> bool:
    """Whether a name is one that a proxy or its sandbox has, also if it is not there now."""
    return re.fullmatch(r"rosproxy-[a-z0-9-]+-[0-9a-f]{6}(-ports)?", name) is not None


def master(key: Key) -> HostPort:
    """The host and port of a key's master."""
    where = parse_slave_uri(key.master_uri)
    if where is None:
        raise ValueError(f"{key.master_uri!r} is no master's URI")
    return where


def admin_port(key: Key) -> int:
    """The port of a proxy's admin endpoint: 11312, or 11313 where nodes find their master there."""
    return ADMIN_PORT + 1 if master(key).port == ADMIN_PORT else ADMIN_PORT


def proxy_token(key: Key, secret: str) -> str:
    """The token of a key's proxy, 64 hex digits: HMAC-SHA256 (RFC 2104) of the key.

    It is made anew whenever it is needed, so that it is kept nowhere: the proxy has its hash, and
    the operator has no disk.
    """
    text = f"{key.master_uri} {key.advertise_host}"
    return hmac.new(secret.encode(), text.encode(), hashlib.sha256).hexdigest()


def reserved_ports(key: Key) -> frozenset[int]:
    """The ports on which a key's proxy listens besides its range, so never to be in it."""
    return frozenset({master(key).port, admin_port(key)})


def read_own(labels: Mapping[str, str]) -> OwnLabels | None:
    """What the labels of a container of this operator say.

    None if they are not those of one, or not whole.
    """
    role = labels.get(ROLE, "")
    if labels.get(MANAGED) != "true" or role not in (ROLE_SANDBOX, ROLE_PROXY):
        return None
    key = Key(labels.get(MASTER_URI, ""), labels.get(ADVERTISE_HOST, ""))
    try:
        ports = parse_range(RANGE, labels.get(RANGE, ""))
    except SettingError:
        return None
    if parse_slave_uri(key.master_uri) is None or not key.advertise_host:
        return None
    return OwnLabels(role, key, ports, labels.get(FINGERPRINT, ""))


def own_labels(made: CreateSandbox | Create) -> dict[str, str]:
    """The labels of a container, from which `read_own` reads it back."""
    return {
        MANAGED: "true",
        ROLE: ROLE_SANDBOX if isinstance(made, CreateSandbox) else ROLE_PROXY,
        MASTER_URI: made.key.master_uri,
        ADVERTISE_HOST: made.key.advertise_host,
        RANGE: str(made.range),
        FINGERPRINT: made.fingerprint,
    }


def sandbox_fingerprint(made: CreateSandbox, settings: PlanSettings) -> str:
    """What a sandbox is made of, in 16 hex digits. Its name and the image are not in it."""
    body = sandbox_config(replace(made, fingerprint=""), settings)
    return _digest({**body, "Image": ""})


def proxy_fingerprint(made: Create, settings: PlanSettings, image_id: str, secret: str) -> str:
    """What a proxy's own container is made of, in 16 hex digits.

    Neither its name, its sandbox nor the master's address are in it. The hash of its token is: a
    proxy that knows another one would not listen to the operator.
    """
    # Nor is its policy, which a running proxy is told: another one makes no proxy anew. One that
    # is started again while the operator is away begins with the policy of its creation.
    body = container_config(replace(made, sandbox="", fingerprint=""), settings, secret, "")
    env = [one for one in body["Env"] if one.partition("=")[0] not in POLICY_VARIABLES]
    return _digest({**body, "Image": image_id, "Env": env})


def sandbox_config(made: CreateSandbox, settings: PlanSettings) -> dict[str, Any]:
    """The body of the engine's ``POST /containers/create`` for a sandbox.

    It does nothing, as long as it is let. Outgoing connections, which are the proxy's, start
    below the ports that a proxy is to listen on.
    """
    sysctls = {"net.ipv4.ip_local_port_range": "1024 11000"}
    if made.forwards:
        sysctls["net.ipv4.ip_forward"] = "1"
    bindings = {
        f"{port}/tcp": [{"HostIp": ip, "HostPort": str(port)} for ip in settings.publish_address]
        for port in made.range.ports()
    }
    return {
        "Image": settings.proxy_image,
        "User": USER,
        "Entrypoint": [*SANDBOX_COMMAND[:1]],
        "Cmd": [*SANDBOX_COMMAND[1:]],
        "Healthcheck": {"Test": ["NONE"]},
        "Labels": own_labels(made),
        "ExposedPorts": {port: {} for port in bindings},
        "HostConfig": {
            **_COMMON,
            "Init": True,
            "NetworkMode": settings.uplink,
            "PortBindings": bindings,
            "Sysctls": sysctls,
        },
        "NetworkingConfig": {"EndpointsConfig": {settings.uplink: {}}},
    }


def container_config(
    made: Create, settings: PlanSettings, secret: str, master_address: str
) -> dict[str, Any]:
    """The body of the engine's ``POST /containers/create`` for a proxy.

    ``secret`` is what its token is made of. ``master_address`` may be empty: then the proxy
    resolves its master's host itself.
    """
    variables = {
        "ROS_MASTER_URI": made.key.master_uri,
        "ROSPROXY_ADVERTISE_HOST": made.key.advertise_host,
        "ROSPROXY_PORT_RANGE": str(made.range),
        "ROSPROXY_MASTER_PORT": str(master(made.key).port),
        "ROSPROXY_ADMIN_BIND": f"0.0.0.0:{admin_port(made.key)}",
        "ROSPROXY_DATA_PLANE": "" if made.data_plane == "auto" else made.data_plane,
        "ROSPROXY_DIRECTION": "" if made.direction == "out" else made.direction,
        "ROSPROXY_SLAVE_CONTROL": "" if made.slave_control == "any" else made.slave_control,
        "ROSPROXY_ADMIN_TOKEN_HASH": hash_token(proxy_token(made.key, secret)),
        "ROSPROXY_MASTER_ADDRESS": master_address,
        **bound_variables(settings.proxy_bounds),
        **policy_variables((*settings.policy, *made.policy)),
    }
    limits = {"Memory": settings.proxy_memory, "PidsLimit": settings.proxy_pids}
    return {
        "Image": settings.proxy_image,
        "User": USER,
        "Env": [f"{name}={value}" for name, value in variables.items() if value],
        "Labels": own_labels(made),
        "HostConfig": {
            **_COMMON,
            **(_KERNEL if made.data_plane == "kernel" else {}),
            "Init": False,
            **{name: most for name, most in limits.items() if most},
            "NetworkMode": f"container:{made.sandbox}",
        },
    }


def is_kernel_host(host: Mapping[str, Any]) -> bool:
    """Whether a proxy's HostConfig, as the engine tells it, has the rights of the kernel plane.

    Engines lead capabilities by ``CAP_`` or not.
    """
    added = [str(name).removeprefix("CAP_") for name in host.get("CapAdd") or ()]
    return added == _KERNEL["CapAdd"] and host.get("SecurityOpt") == _KERNEL["SecurityOpt"]


def _digest(body: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(body, sort_keys=True).encode()).hexdigest()[:16]
