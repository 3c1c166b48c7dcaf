"""Multicast groups: sockets that hear them, and that send to them through some network.

Participants announce themselves to one group with IPv4, and to one of two with IPv6, which has no
standard there: Fast DDS has one of global scope (UDPv6Transport.cpp), Cyclone DDS one of link scope
(ddsi_udp.c). A membership is by an own address with IPv4, by the interface's index with IPv6, and
a group of link scope has a socket for each link.

A membership stays with its socket when the network goes, and of those of IPv4 a socket has 20
(igmp_max_memberships): so they are given up, and where one socket has no room the next one has.
"""

import contextlib
import errno
import socket
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

from rosproxy.forwarding.datagrams import RECEIVE_BUFFER
from rosproxy.net.addresses import HostPort
from rosproxy.net.interfaces import interface_index

GROUP = "239.255.0.1"
GROUP_FAST_DDS6 = "ff1e::ffff:efff:1"
GROUP_CYCLONE6 = "ff02::ffff:efff:1"
"""Where participants announce themselves (DDSI-RTPS 2.5, 9.6.2.4.1)."""
_SHARED = {socket.AF_INET: (GROUP,), socket.AF_INET6: (GROUP_FAST_DDS6,)}
_OF_LINK = {socket.AF_INET: (), socket.AF_INET6: (GROUP_CYCLONE6,)}
_IP_MULTICAST_ALL = 49
"""Of linux/in.h: whether a socket hears the group on networks that only other sockets have joined.
With IPv6 it does always: the kernel compares the address alone (inet6_mc_check)."""


def family_of(address: str) -> socket.AddressFamily:
    """The family of an address's sockets."""
    return socket.AF_INET6 if ":" in address else socket.AF_INET


def groups_of(address: str) -> tuple[str, ...]:
    """The groups of the network where this machine has an address."""
    family = family_of(address)
    return _SHARED[family] + _OF_LINK[family]


class Membership(NamedTuple):
    """A socket that hears a group on a network; ``request`` names both to the kernel."""

    sock: socket.socket
    request: bytes

    def end(self) -> None:
        """Hear it no more. The network may have gone."""
        is_v6 = self.sock.family == socket.AF_INET6
        level = socket.IPPROTO_IPV6 if is_v6 else socket.IPPROTO_IP
        option = socket.IPV6_LEAVE_GROUP if is_v6 else socket.IP_DROP_MEMBERSHIP
        with contextlib.suppress(OSError):
            self.sock.setsockopt(level, option, self.request)


@dataclass(slots=True)
class _Network:
    """What hears the groups on a network: its own sockets, and memberships of shared ones."""

    sockets: list[socket.socket] = field(default_factory=list)
    memberships: list[Membership] = field(default_factory=list)


class GroupSockets:
    """Sockets that hear the groups of a port. ``begin`` is called with each, ``end`` closes it."""

    def __init__(
        self,
        port: int,
        begin: Callable[[socket.socket], None],
        end: Callable[[socket.socket], None],
    ) -> None:
        self._port = port
        self._begin = begin
        self._end = end
        self._shared: dict[str, list[socket.socket]] = {}
        self._networks: dict[str, _Network] = {}

    @property
    def joined(self) -> list[str]:
        """The addresses on whose networks they are heard."""
        return list(self._networks)

    def open(self, families: Iterable[socket.AddressFamily]) -> None:
        """Hear the groups whose sockets are shared by networks. Raises OSError."""
        for group in (group for family in families for group in _SHARED[family]):
            self._shared[group] = [self._opened(group)]

    def join(self, addresses: Iterable[str]) -> list[str]:
        """Hear them on the networks of these own addresses alone; the addresses that are new."""
        present = {a for a in addresses if any(g in self._shared for g in groups_of(a))}
        gone = self._networks.keys() - present
        # Another address of a network that has gone may have had its membership for both.
        without = {a for a, network in self._networks.items() if gone and not network.memberships}
        for address in gone | without:
            self._leave(address)
        new = sorted(present - self._networks.keys())
        return [address for address in new if self._join(address)]

    def close(self) -> None:
        """Hear nothing any more."""
        self.join(())
        for socks in self._shared.values():
            for sock in socks:
                self._end(sock)
        self._shared.clear()

    def _join(self, address: str) -> bool:
        """Hear them on one network, if it is still there."""
        family = family_of(address)
        network = self._networks[address] = _Network()
        try:
            for group in _OF_LINK[family]:
                network.sockets.append(self._opened(group, address))
                join(network.sockets[-1], address)
            for group in _SHARED[family]:
                if membership := self._join_shared(group, address):
                    network.memberships.append(membership)
        except OSError:
            # Networks come and go: as it is not in `joined`, the next call tries it again.
            self._leave(address)
            return False
        return True

    def _join_shared(self, group: str, address: str) -> Membership | None:
        """Join a group by the first socket that has room for it. Raises OSError."""
        for sock in self._shared[group]:
            try:
                return join(sock, address)
            except OSError as error:
                if error.errno != errno.ENOBUFS:
                    raise
        sock = self._opened(group)
        try:
            membership = join(sock, address)
        except OSError:
            self._end(sock)
            raise
        self._shared[group].append(sock)
        return membership

    def _leave(self, address: str) -> None:
        network = self._networks.pop(address)
        for sock in network.sockets:
            self._end(sock)
        for membership in network.memberships:
            membership.end()

    def _opened(self, group: str, link_of: str = "") -> socket.socket:
        sock = group_socket(HostPort(group, self._port), link_of)
        self._begin(sock)
        return sock


def group_socket(group: HostPort, link_of: str = "") -> socket.socket:
    """A non-blocking socket that is bound to a group, and so gets nothing else. Raises OSError.

    Others on this machine may have the same. ``link_of`` is an own address on a group's link.
    """
    sock = socket.socket(family_of(group.host), socket.SOCK_DGRAM)
    try:
        sock.setblocking(False)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
        if sock.family == socket.AF_INET:
            with contextlib.suppress(OSError):  # else it hears more than it has to
                sock.setsockopt(socket.IPPROTO_IP, _IP_MULTICAST_ALL, 0)
        # A group of link scope is another one on each link: the scope id tells which (ipv6(7)).
        link = (0, interface_index(link_of)) if link_of else ()
        sock.bind((group.host, group.port, *link))
    except OSError:
        sock.close()
        raise
    return sock


def send_through(sock: socket.socket, address: str, loop: bool) -> None:
    """Have what a socket sends to groups leave by the network of an own address. Raises OSError.

    ``loop``: programs on this machine hear it as well.
    """
    if sock.family == socket.AF_INET6:
        sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_IF, interface_index(address))
        sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_LOOP, loop)
        return
    sock.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(address))
    sock.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, loop)


def join(sock: socket.socket, address: str) -> Membership | None:
    """Hear the group that a socket is bound to on the network of an own address. Raises OSError.

    None if the socket does already, by another address of that network.
    """
    packed = socket.inet_pton(sock.family, sock.getsockname()[0].partition("%")[0])
    if sock.family == socket.AF_INET6:
        level = socket.IPPROTO_IPV6
        option = socket.IPV6_JOIN_GROUP
        request = packed + interface_index(address).to_bytes(4, sys.byteorder)
    else:
        level = socket.IPPROTO_IP
        option = socket.IP_ADD_MEMBERSHIP
        request = packed + socket.inet_aton(address)
    try:
        sock.setsockopt(level, option, request)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            return None
        raise
    return Membership(sock, request)
