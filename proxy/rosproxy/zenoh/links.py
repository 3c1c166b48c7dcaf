"""The links to routers outside and to other sites: which links are up, and why a link is down.

The hub dials each peer again and again, and the router of the links to other sites dials each site.
Both report the sessions, but not why there is no session with a peer. So the proxy tries to connect
to such a peer.
"""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from enum import Enum

from rosproxy.shared.addresses import HostPort, is_address
from rosproxy.zenoh.protocol.report import Ends, RouterReport, all_ends_of


class LinkFault(Enum):
    """Why a link is not up."""

    NOT_TRIED = "not tried yet"
    UNRESOLVABLE = "unresolvable"
    REFUSED = "refused"
    SILENT = "silent"
    UNREACHABLE = "unreachable"
    ITSELF = "the proxy itself"
    NO_SESSION = "no session"
    MOVED = "no session at the new address"
    NO_QUIC_SESSION = "no session over UDP"
    NO_TLS = "no TLS"
    PEER_EXPIRED = "the certificate of the peer has expired"
    PEER_TOO_EARLY = "the certificate of the peer is not valid yet"
    PEER_FOREIGN = "the certificate of the peer is of a foreign CA"
    PEER_OTHER_NAME = "the certificate of the peer is for another host name"
    PEER_INVALID = "the certificate of the peer is not valid"
    OWN_EXPIRED = "the peer refuses the own certificate as expired"
    OWN_FOREIGN = "the peer refuses the own certificate as of a foreign CA"
    OWN_REFUSED = "the peer refuses the own certificate"


CERTIFICATE_FAULTS = frozenset(
    fault.value
    for fault in LinkFault
    if fault is LinkFault.NO_TLS or fault.name.startswith(("PEER_", "OWN_"))
)
"""Values of the faults of a peer that accepts connections: the peer does not prove itself, or
refuses the certificate of the proxy."""
_VERIFY_FAULTS = {
    7: LinkFault.PEER_FOREIGN,  # a CA with the same name and another key
    9: LinkFault.PEER_TOO_EARLY,
    10: LinkFault.PEER_EXPIRED,
    18: LinkFault.PEER_FOREIGN,
    19: LinkFault.PEER_FOREIGN,
    20: LinkFault.PEER_FOREIGN,
    21: LinkFault.PEER_FOREIGN,
    62: LinkFault.PEER_OTHER_NAME,
    64: LinkFault.PEER_OTHER_NAME,
}
"""Results of the check of a certificate (openssl/x509_vfy.h, X509_V_ERR_...)."""
_ALERT_FAULTS = {
    "CERTIFICATE_EXPIRED": LinkFault.OWN_EXPIRED,
    "UNKNOWN_CA": LinkFault.OWN_FOREIGN,
    "DECRYPT_ERROR": LinkFault.OWN_FOREIGN,  # a CA with the same name and another key
    "CERTIFICATE": LinkFault.OWN_REFUSED,
}
"""Words in the alerts of TLS with which a peer refuses a certificate (RFC 8446, 6.2)."""


def verify_fault(code: int) -> LinkFault:
    """The fault for a result of OpenSSL's check of a peer's certificate."""
    return _VERIFY_FAULTS.get(code, LinkFault.PEER_INVALID)


def alert_fault(reason: str) -> LinkFault:
    """The fault for the reason that OpenSSL gives after a peer has ended a connection of TLS."""
    return next((f for word, f in _ALERT_FAULTS.items() if word in reason), LinkFault.NO_SESSION)


@dataclass
class Link:
    """A link to a peer. ``addresses``: the addresses of the peer's host name.

    ``protocol`` is tls or quic for a link to another site, otherwise tcp.

    ``fault``: None if the link is up. ``since``: the time in seconds at which the link went up or
    down.
    ``is_hub``: the router is the hub of another proxy, and is no fault while away.
    ``former``: the addresses of the last session, if the host name leads elsewhere now.
    """

    peer: HostPort
    since: float
    is_hub: bool = False
    protocol: str = "tcp"
    addresses: tuple[str, ...] = ()
    fault: LinkFault | None = LinkFault.NOT_TRIED
    former: tuple[str, ...] = ()

    def __str__(self) -> str:
        """The peer, for a link to another site with the protocol."""
        return f"{self.protocol}/{self.peer}" if self.is_to_site else str(self.peer)

    @property
    def is_to_site(self) -> bool:
        """Whether the link leads to the proxy of another site."""
        return self.protocol != "tcp"

    @property
    def is_lost(self) -> bool:
        """Whether there is no session with the peer, not even at a former address."""
        return self.fault is not None and self.fault is not LinkFault.ITSELF and not self.former

    @property
    def is_to_router(self) -> bool:
        """Whether the link leads to a router outside (``--zenoh-peer``)."""
        return not self.is_hub and not self.is_to_site

    def note_addresses(self, addresses: tuple[str, ...]) -> None:
        """Note the addresses of the host name. If the name has no address now, the former stay."""
        if not addresses:
            return
        if self.fault is None and not {*addresses} & {*self.addresses}:
            self.former = self.addresses
        self.addresses = addresses

    def note(self, fault: LinkFault | None, now: float) -> bool:
        """Note the state of the link. Return whether the state or the fault has changed."""
        if fault is None:
            self.former = ()
        if fault == self.fault:
            return False
        if fault is None or self.fault is None:
            self.since = now
        self.fault = fault
        return True


def own_peers(links: Iterable[Link], routers: Sequence[RouterReport]) -> set[HostPort]:
    """The peers at which the hub, the last router, has reached another router of the proxy.

    The hub dials these routers by sockets, and access control distinguishes it from nodes by that.
    So at such a peer, the hub would be a node without rules. zenoh looks up the names of peers by
    itself. So if no link has the address, all names with the port count whose link is down.

    A link to another site leads to no such router: these routers speak neither TLS nor QUIC.
    """
    own = {router.zid for router in routers}
    hub = routers[-1:]
    sessions = (session for router in hub for session in router.sessions if session.peer in own)
    reached = [ends.remote for session in sessions for ends in all_ends_of(session)]
    at_port = [link for link in links if any(link.peer.port == end.port for end in reached)]
    found = {
        link.peer
        for link in at_port
        if any(end.host == link.peer.host or end.host in link.addresses for end in reached)
    }
    return found or {link.peer for link in at_port if link.fault and not is_address(link.peer.host)}


def left_behind(link: Link, links: Iterable[Link], routers: Iterable[Ends]) -> set[HostPort]:
    """The ends of connections with former addresses of a peer, if no other link leads there."""
    of_others = {
        address
        for other in links
        if other is not link
        for address in (*other.addresses, other.peer.host)
    }
    hosts = {*link.former}.difference(link.addresses, of_others)
    remotes = {ends.remote for ends in routers}
    return {end for end in remotes if end.port == link.peer.port and end.host in hosts}


def is_linked(
    peer: HostPort, addresses: Collection[str], routers: Iterable[Ends], listen: Collection[int]
) -> bool:
    """Whether a connection of the hub with one of ``routers`` is with a peer at these addresses.

    The peer may have dialed the proxy, at a port of ``listen``. For QUIC, zenoh reports the host
    name that the router has dialed.
    """
    return any(
        (ends.remote.host in addresses or ends.remote.host == peer.host)
        and (ends.remote.port == peer.port or ends.local.port in listen)
        for ends in routers
    )
