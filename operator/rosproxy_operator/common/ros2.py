"""ROS 2 for both operators: versions, domains, peers, well-known ports and the LAN relay."""

import hashlib
import hmac

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.domain_ports import first_unicast_port, multicast_port
from rosproxy.shared.setting_kinds import read_peer
from rosproxy.shared.settings import LEAST_PORTS_PER_DOMAIN

MOST_PEERS = 32
"""The most hosts in a label or field. Each announcement goes to at least 32 ports of each host."""
LEAST_PORTS = LEAST_PORTS_PER_DOMAIN + 1
"""The fewest ports of a ROS 2 proxy with a LAN relay: the proxy's ports, and one for the relay."""
ROS1_DISTROS = frozenset(
    {"fuerte", "groovy", "hydro", "indigo", "jade", "kinetic", "lunar", "melodic", "noetic"}
)
"""The distributions of ROS 1 since Fuerte. No more will come, so all others count as ROS 2."""
LAN_RELAY_COMMAND = ("rosproxy", "lan-relay")
"""The command of a LAN relay, in the proxy's image."""


def well_known_ports(domain: int) -> frozenset[int]:
    """Return the ports on which the proxy of a domain listens in addition to its range."""
    return frozenset({multicast_port(domain), first_unicast_port(domain)})


def read_peer_name(text: str) -> str:
    """Parse and return a peer: ``host`` or ``host:port``, in lower case. Raises ValueError."""
    peer = read_peer(text)
    return (str(peer) if peer.port else peer.host).lower()


def is_dds(rmw: str) -> bool:
    """Whether a value of RMW_IMPLEMENTATION means DDS: any value without ``zenoh``.

    An empty value means the default, which is a DDS.
    """
    return "zenoh" not in rmw


def relay_secret(key: bytes, proxy: str) -> str:
    """Return the secret of a proxy and the LAN relay: 64 hex digits, HMAC-SHA256 (RFC 2104).

    ``key`` is also the key of the proxies' tokens, so a restarted operator computes the same
    secret. The text ``LAN relay of`` keeps the secret different from all tokens.
    """
    return hmac.new(key, f"LAN relay of {proxy}".encode(), hashlib.sha256).hexdigest()


def lan_relay_variables(
    domain: int, lan: str, bind: HostPort, proxy: HostPort, secret: str
) -> dict[str, str]:
    """Return the variables of a LAN relay (`rosproxy.ros2.lan_relay.relay.LanRelaySettings`)."""
    return {
        "ROSPROXY_LAN_RELAY_DOMAIN": str(domain),
        "ROSPROXY_LAN_RELAY_LAN": lan,
        "ROSPROXY_LAN_RELAY_BIND": str(bind),
        "ROSPROXY_LAN_RELAY_PROXY": str(proxy),
        "ROSPROXY_LAN_RELAY_SECRET": secret,
    }
