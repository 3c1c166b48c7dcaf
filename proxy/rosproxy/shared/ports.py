"""Ranges of ports: listened on, advertised, free, and those of stand-ins."""

from collections import OrderedDict
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class PortRange:
    """The ports ``first`` to ``last``, both included."""

    first: int
    last: int

    def __len__(self) -> int:
        """How many ports there are."""
        return self.last - self.first + 1

    def __contains__(self, port: object) -> bool:
        """Whether a port is in the range."""
        return isinstance(port, int) and self.first <= port <= self.last

    def __str__(self) -> str:
        """``first-last``."""
        return f"{self.first}-{self.last}"

    def ports(self) -> range:
        """All ports, in order."""
        return range(self.first, self.last + 1)


STAND_IN_PORTS = PortRange(20_000, 32_767)
"""The ports of stand-ins, through which inside reaches outside. They are below the ports that Linux
gives to outgoing connections."""


@dataclass(frozen=True, slots=True)
class PortMap:
    """Listen range and advertised range, of the same length, with the same offset for all ports."""

    listen: PortRange
    advertise: PortRange

    def advertised(self, port: int) -> int:
        """The advertised port of a port that the proxy listens on."""
        return port - self.listen.first + self.advertise.first

    def listening(self, advertised: int) -> int | None:
        """The listen port of an advertised port; None outside the advertised range."""
        if advertised not in self.advertise:
            return None
        return advertised - self.advertise.first + self.listen.first


class PortPool:
    """The free ports of a range.

    A port that is given back goes to the end of the queue, so the next node gets it as late as
    possible. A peer that still uses the port for the old node then finds no node there, instead of
    a wrong node. ``blocked``: the ports that another program on this machine holds.
    """

    def __init__(self, ports: PortRange) -> None:
        self.range = ports
        self._free = OrderedDict.fromkeys(ports.ports())
        self.blocked: set[int] = set()

    @property
    def free(self) -> int:
        """How many ports are free."""
        return len(self._free)

    def take(self, prefer: int | None = None) -> int | None:
        """Take ``prefer`` if free, else the port that was free longest; None if no port is free."""
        if prefer is not None and prefer in self._free:
            del self._free[prefer]
            return prefer
        return self._free.popitem(last=False)[0] if self._free else None

    def is_free(self, port: int) -> bool:
        """Whether a port of the range is free."""
        return port in self._free

    def claim(self, port: int) -> bool:
        """Take exactly this port; False if the port is not free."""
        return port in self._free and self.take(port) == port

    def give_back(self, port: int) -> None:
        """Return a port that was taken; a blocked port stays blocked."""
        if port not in self.blocked:
            self._free[port] = None

    def unblock(self, port: int) -> None:
        """Make a blocked port free, because another program has released the port."""
        self.blocked.discard(port)
        self._free[port] = None

    def block(self, port: int) -> None:
        """Take a port out of the free ports, until `unblock`."""
        self.blocked.add(port)
        self._free.pop(port, None)
