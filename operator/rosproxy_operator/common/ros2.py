"""What both engines know of ROS 2: versions, domains, peers, well-known ports and the LAN relay."""

import hashlib
import hmac

from rosproxy.net.addresses import HostPort
from rosproxy.ros2.domain_settings import PORTS_PER_DOMAIN, SPDP_MULTICAST, SPDP_UNICAST
from rosproxy.setting_kinds import read_peer
from rosproxy.settings import LEAST_PER_DOMAIN

LAST_DOMAIN = 232
"""The last one whose well-known ports are ports (DDSI-RTPS 2.5, 9.6.2.3)."""
MOST_PEERS = 32
"""Hosts that one label or field may name: each announcement goes to 32 ports of each."""
LEAST_PORTS = LEAST_PER_DOMAIN + 1
"""Ports of a proxy for ROS 2 with a LAN relay: what the proxy has at least, and the relay's one."""
ROS1_DISTROS = frozenset(
    {"fuerte", "groovy", "hydro", "indigo", "jade", "kinetic", "lunar", "melodic", "noetic"}
)
"""There will be no more of them, so any other is one of ROS 2."""
LAN_RELAY_COMMAND = ("rosproxy", "lan-relay")
"""What the proxy's image does as a LAN relay."""


def discovery_port(domain: int) -> int:
    """The well-known port at which the first participant of a machine gets announcements."""
    return SPDP_UNICAST + PORTS_PER_DOMAIN * domain


def well_known_ports(domain: int) -> frozenset[int]:
    """The ports on which a domain's proxy listens besides its range."""
    return frozenset({SPDP_MULTICAST + PORTS_PER_DOMAIN * domain, discovery_port(domain)})


def read_peer_name(text: str) -> str:
    """A peer, ``host`` or ``host:port``, in its one form. Raises ValueError."""
    peer = read_peer(text)
    return str(peer) if peer.port else peer.host.lower()


def is_dds(rmw: str) -> bool:
    """Whether an RMW_IMPLEMENTATION, empty for the default, is one that can be proxied."""
    return "zenoh" not in rmw


def relay_secret(key: bytes, proxy: str) -> str:
    """The secret of a proxy and its LAN relay, 64 hex digits: HMAC-SHA256 (RFC 2104) of the proxy.

    ``key`` is what the operator makes the tokens of proxies of, so that an operator that starts
    again tells both the same secret. No token is one: the proxy's name never begins like this.
    """
    return hmac.new(key, f"LAN relay of {proxy}".encode(), hashlib.sha256).hexdigest()


def lan_relay_variables(
    domain: int, lan: str, bind: HostPort, proxy: HostPort, secret: str
) -> dict[str, str]:
    """What a LAN relay is told; see `rosproxy.ros2.lan_relay.relay.LanRelaySettings`."""
    return {
        "ROSPROXY_LAN_RELAY_DOMAIN": str(domain),
        "ROSPROXY_LAN_RELAY_LAN": lan,
        "ROSPROXY_LAN_RELAY_BIND": str(bind),
        "ROSPROXY_LAN_RELAY_PROXY": str(proxy),
        "ROSPROXY_LAN_RELAY_SECRET": secret,
    }
