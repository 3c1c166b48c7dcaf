"""The links of the hub router to routers outside: which links are up, and why a link is down.

The hub dials each peer again and again. The hub reports the sessions, but not why there is no
session with a peer. So the proxy tries to connect to such a peer.
"""

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from enum import Enum

from rosproxy.net.addresses import HostPort
from rosproxy.zenoh.protocol.report import Ends


class LinkFault(Enum):
    """Why a link is not up."""

    NOT_TRIED = "not tried yet"
    UNRESOLVABLE = "unresolvable"
    REFUSED = "refused"
    SILENT = "silent"
    UNREACHABLE = "unreachable"
    NO_SESSION = "no session"


@dataclass
class Link:
    """A link to a peer. ``addresses``: the addresses of the peer's host name.

    ``fault``: None if the link is up. ``since``: the time in seconds at which the link went up or
    down.
    ``is_hub``: the router is the hub of another proxy, and is no fault while away.
    """

    peer: HostPort
    since: float
    is_hub: bool = False
    addresses: tuple[str, ...] = ()
    fault: LinkFault | None = LinkFault.NOT_TRIED

    def note(self, fault: LinkFault | None, now: float) -> bool:
        """Note the state of the link. Return whether the state or the fault has changed."""
        if fault == self.fault:
            return False
        if fault is None or self.fault is None:
            self.since = now
        self.fault = fault
        return True


def is_linked(
    peer: HostPort, addresses: Collection[str], routers: Iterable[Ends], listen: int | None
) -> bool:
    """Whether a connection of the hub with one of ``routers`` is with a peer at these addresses.

    The peer may have dialed the hub, at the port ``listen``; None: the hub has no such port.
    """
    return any(
        ends.remote.host in addresses
        and (ends.remote.port == peer.port or ends.local.port == listen)
        for ends in routers
    )
