"""Endpoints of rmw_zenoh in variables and commands of containers, and settings of links.

``ZENOH_CONFIG_OVERRIDE`` has ``key=value`` pairs, separated by semicolons (rmw_zenoh,
zenoh_utils.cpp). An endpoint is ``protocol/host:port``.
"""

import re
from collections.abc import Iterable
from typing import Any, NamedTuple

from rosproxy.shared.addresses import HostPort, is_loopback, parse_host_port
from rosproxy.shared.policy.rules import Rule, format_rules
from rosproxy.shared.setting_kinds import ZENOH_PORT, read_site_link, read_zenoh_peer

OVERRIDE = "ZENOH_CONFIG_OVERRIDE"
SESSION_FILE = "ZENOH_SESSION_CONFIG_URI"
MOST_ENDPOINTS = 32
"""The most endpoints that the operator reads from a variable."""
LINK_DIRECTORY = "/etc/rosproxy/link"
"""The directory in a proxy's container with the files of the links to other sites."""
LINK_FILES = {"zenoh_certificate": "tls.crt", "zenoh_key": "tls.key", "zenoh_ca": "ca.crt"}
"""The names of these files, by field of the proxy's `Settings`.

A Secret of type kubernetes.io/tls has the first two names. cert-manager adds the third.
"""
_UNSPECIFIED = ("0.0.0.0", "::")
_WAIT = "connect/timeout_ms=-1"
# No part can take characters of the next, so a variable without the last quote takes no longer.
_ENDPOINT = re.compile(r"[\"']([a-z]+)/([^\"'/?#;]{1,300})(?:[/?#;][^\"']*)?[\"']")
_ROUTER = re.compile(r"(^|[\s/;&])(rmw_)?zenohd($|[\s;&])")


class Endpoint(NamedTuple):
    """The protocol, such as ``tcp``, and the address of an endpoint."""

    protocol: str
    address: HostPort


def client_override(router: HostPort) -> str:
    """Return the value of ZENOH_CONFIG_OVERRIDE that makes nodes clients of a router.

    The nodes wait until they reach the router. With rmw_zenoh's own time-out for clients, which is
    0, a node ends if no router answers at its start (DEFAULT_RMW_ZENOH_SESSION_CONFIG.json5,
    ``connect``).
    """
    return f'mode="client";connect/endpoints=["{tcp_endpoint(router)}"];{_WAIT}'


def tcp_endpoint(router: HostPort) -> str:
    """Return the endpoint of a router, such as ``tcp/10.96.0.7:7448``."""
    return f"tcp/{router}"


def with_client_override(override: str, router: HostPort) -> str:
    """Return a container's own override, extended to make nodes clients of a router.

    The result is empty if the override itself sets the mode or the endpoints.
    """
    keys = {pair.partition("=")[0].strip() for pair in override.split(";")}
    if any(key in ("mode", "connect") or key.startswith("connect/endpoints") for key in keys):
        return ""
    own = client_override(router)
    if any(key.startswith("connect/timeout_ms") for key in keys):
        own = own.removesuffix(f";{_WAIT}")
    return ";".join(filter(None, [override.strip().rstrip(";"), own]))


def is_client(override: str) -> bool:
    """Whether an override makes nodes clients."""
    modes = re.findall(r"(?:^|;)\s*mode\s*=\s*[\"']?(\w+)", override)
    return modes[-1:] == ["client"]


def read_router_name(text: str) -> str:
    """Parse and return a router: ``host:port``, in lower case. Raises ValueError."""
    router = read_zenoh_peer(text.lower())
    if is_loopback(router.host):
        raise ValueError("a loopback address, which means the proxy itself")
    return str(router)


def read_link_name(text: str) -> str:
    """Parse and return a link to another site: ``tls/host:port``, in lower case.

    Raises ValueError.
    """
    link = read_site_link(text.lower())
    if is_loopback(link.peer.host):
        raise ValueError(f"{str(link)!r} is a loopback address, which means the proxy itself")
    return str(link)


def link_settings(
    to: Iterable[str], limits: Iterable[str], rules: tuple[Rule, ...], listen: str = ""
) -> dict[str, Any]:
    """Return the settings of a proxy with links to other sites, by field of `Settings`.

    ``to`` and ``listen`` are as for ``--zenoh-link`` and ``--zenoh-link-listen``.
    """
    return {
        "zenoh_link": tuple(to),
        "zenoh_link_listen": listen or None,
        **{field: f"{LINK_DIRECTORY}/{name}" for field, name in LINK_FILES.items()},
        "zenoh_await_files": True,
        "zenoh_limit": tuple(limits),
        "zenoh_link_policy": format_rules(rules),
    }


def connect_endpoints(override: str) -> list[Endpoint]:
    """Return the endpoints to which ZENOH_CONFIG_OVERRIDE connects the sessions of a container."""
    return _endpoints("connect", override)


def listens_beyond_loopback(override: str) -> bool:
    """Whether the sessions of a container listen at an address that other containers reach.

    zenoh takes the unspecified address for all addresses of the container.
    """
    # The port may be 0, so this text is no `HostPort`.
    hosts = (text.rpartition(":")[0].strip("[]") for _, text in _texts("listen", override))
    return any(host in _UNSPECIFIED or not is_loopback(host) for host in hosts)


def router_port(override: str) -> int:
    """Return the first TCP port on which a container's router listens; ZENOH_PORT without one."""
    ports = [e.address.port for e in _endpoints("listen", override) if e.protocol == "tcp"]
    return ports[0] if ports else ZENOH_PORT


def _endpoints(kind: str, override: str) -> list[Endpoint]:
    found = _texts(kind, override)
    addresses = ((protocol, parse_host_port(text)) for protocol, text in found)
    return [
        Endpoint(protocol, HostPort(address.host.lower(), address.port))
        for protocol, address in addresses
        if address
    ]


def _texts(kind: str, override: str) -> list[tuple[str, str]]:
    """The protocols and the addresses, as text, of the endpoints that count."""
    values = re.findall(rf"(?:^|;)\s*{kind}/endpoints\s*=([^;]*)", override)
    return _ENDPOINT.findall(values[-1])[:MOST_ENDPOINTS] if values else []


def runs_router(command: Iterable[str]) -> bool:
    """Whether a command runs a router: ``rmw_zenohd``, or ``zenohd`` itself."""
    return any(_ROUTER.search(argument) for argument in command)
