"""When a proxy leaves its ports, and for how long that matters: the same for every engine."""

from dataclasses import dataclass

from rosproxy.leases.ports import PortRange

RETRY_FOR = 20.0
"""Seconds for which a proxy that has served is tried again on its ports before it leaves them."""
TAKEN_FOR = 300.0
"""Seconds for which a port is avoided that the engine has refused."""
MOVED_FOR = 600.0
"""Seconds for which it is told that a proxy had to leave its range."""


@dataclass(frozen=True, slots=True)
class Move:
    """A proxy had to leave the range on which it had served."""

    ports: PortRange
    at: float
