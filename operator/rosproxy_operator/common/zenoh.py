"""What both engines know of rmw_zenoh: which containers have it, and which run a router.

`ZENOH_CONFIG_OVERRIDE` has ``key=value`` pairs with semicolons between (rmw_zenoh,
zenoh_utils.cpp); an endpoint is ``protocol/host:port``.
"""

import re
from collections.abc import Iterable
from typing import NamedTuple

from rosproxy.net.addresses import HostPort, parse_host_port
from rosproxy.setting_kinds import ZENOH_PORT

OVERRIDE = "ZENOH_CONFIG_OVERRIDE"
SESSION_FILE = "ZENOH_SESSION_CONFIG_URI"
MOST_ENDPOINTS = 32
"""Endpoints that are read of a variable."""
_ENDPOINT = re.compile(r"[\"']([a-z]+)/([^\"'/?#;]{1,300})[^\"']*[\"']")
_ROUTER = re.compile(r"(^|[\s/;&])(rmw_)?zenohd($|[\s;&])")


class Endpoint(NamedTuple):
    """An endpoint: its protocol, such as ``tcp``, its host and its port."""

    protocol: str
    address: HostPort


def connect_endpoints(override: str) -> list[Endpoint]:
    """The endpoints to which the sessions of a container connect, by its variable."""
    return _endpoints("connect", override)


def router_port(override: str) -> int:
    """The port at which the router of a container listens, by its variable."""
    ports = [e.address.port for e in _endpoints("listen", override) if e.protocol == "tcp"]
    return ports[0] if ports else ZENOH_PORT


def _endpoints(kind: str, override: str) -> list[Endpoint]:
    texts = re.findall(rf"(?:^|;)\s*{kind}/endpoints\s*=([^;]*)", override)
    found = _ENDPOINT.findall(texts[-1])[:MOST_ENDPOINTS] if texts else []
    addresses = ((protocol, parse_host_port(text)) for protocol, text in found)
    return [
        Endpoint(protocol, HostPort(address.host.lower(), address.port))
        for protocol, address in addresses
        if address
    ]


def runs_router(command: Iterable[str]) -> bool:
    """Whether a command runs a router: ``rmw_zenohd``, or ``zenohd`` itself."""
    return any(_ROUTER.search(argument) for argument in command)
