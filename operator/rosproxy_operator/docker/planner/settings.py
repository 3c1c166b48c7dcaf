"""What the planning depends on besides what is seen on the host."""

from dataclasses import dataclass

from rosproxy.leases.ports import PortRange
from rosproxy.settings import DataPlane

MOST_PORTS = 1000
"""Ports that one proxy may ask for: each costs rules and, by default, a process of the engine."""
WINDOW = PortRange(11400, 65535)
"""Where ports are looked for: above the master's and the admin endpoint's."""


@dataclass(frozen=True, slots=True)
class PlanSettings:
    """The operator's options that decide what is planned.

    ``master_uri`` and ``advertise_host`` are for containers without a label of their own and may
    be empty. ``ports`` is the least number of ports that a proxy gets, ``window`` where they are
    looked for, ``publish`` the host's addresses on which they are published. ``grace`` is in
    seconds: how long a proxy outlives its last container. ``data_plane`` is that of proxies whose
    containers ask for none.
    """

    master_uri: str = ""
    advertise_host: str = ""
    ports: int = 32
    window: PortRange = WINDOW
    publish: tuple[str, ...] = ("0.0.0.0",)
    image: str = "rosproxy:latest"
    expose_by_default: bool = False
    grace: float = 60.0
    uplink: str = "0-rosproxy"
    data_plane: DataPlane = "auto"
