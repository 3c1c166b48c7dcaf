"""Which zenoh peers of a router outside do not reach the other peers of this router.

A router passes no data between its own peers. So peers on two machines exchange nothing, unless
they have a session with each other. That is the usual mistake with rmw_zenoh: in a container, or on
a laptop, ``ZENOH_CONFIG_OVERRIDE`` names the robot's router without ``mode="client"``.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from typing import NamedTuple

from rosproxy.shared.addresses import is_loopback
from rosproxy.zenoh.protocol.report import Ends, RouterReport, ends_of

PEER = "peer"
MOST_PEERS_APART = 100
"""Addresses with such peers that the proxy reports."""


class PeersApart(NamedTuple):
    """Zenoh peers of a router outside at an address, apart from peers at other addresses.

    ``router``: the zenoh ID of the router. ``sessions``: the zenoh IDs of the peers.
    ``is_own_address``: the router knows the hub by the same address.
    """

    router: str
    address: str
    sessions: tuple[str, ...]
    is_own_address: bool


def peers_apart(
    routers: Iterable[str], hub: str, described: Sequence[RouterReport]
) -> tuple[PeersApart, ...]:
    """The peers that are apart, of the routers with these zenoh IDs.

    ``hub`` is the zenoh ID of the hub. ``described`` are routers outside and peers. If neither of
    two peers is described, the sessions between them are not known. So they do not count as apart.
    """
    by_zid = {description.zid: description for description in described}
    linked: dict[str, set[str]] = {}
    for description in described:
        for session in description.sessions:
            linked.setdefault(description.zid, set()).add(session.peer)
            linked.setdefault(session.peer, set()).add(description.zid)
    found = [
        apart
        for zid in routers
        if zid in by_zid
        for apart in _apart_at(by_zid[zid], hub, linked, by_zid.keys())
    ]
    return tuple(found[:MOST_PEERS_APART])


def _apart_at(
    router: RouterReport, hub: str, linked: Mapping[str, Set[str]], described: Set[str]
) -> Iterator[PeersApart]:
    """Yield the peers of a router that are apart; those on the machine of the router count too."""
    hosts: dict[str, set[str]] = {}
    own = ""
    for session in router.sessions:
        ends = ends_of(session)
        if ends and session.whatami == PEER:
            hosts.setdefault(_host(ends), set()).add(session.peer)
        elif ends and session.peer == hub:
            own = _host(ends)
    peers = {peer for at_host in hosts.values() for peer in at_host}
    for host, at_host in hosts.items():
        elsewhere = peers - at_host
        known = elsewhere & described
        apart = [
            peer
            for peer in sorted(at_host)
            if (elsewhere if peer in described else known) - linked.get(peer, frozenset())
        ]
        if host and apart:
            yield PeersApart(router.zid, host, tuple(apart), host == own)


def _host(ends: Ends) -> str:
    """The address of the other end; empty on the machine of the router."""
    remote = ends.remote.host
    return "" if remote == ends.local.host or is_loopback(remote) else remote
