"""Multicast groups: sockets that receive from the groups, and that send to the groups on a network.

With IPv4, participants announce themselves to one group. With IPv6 there is no standard: Fast DDS
has a group of global scope (UDPv6Transport.cpp), Cyclone DDS a group of link scope (ddsi_udp.c). A
membership names the network by an address of this machine (IPv4), or by the index of the interface
(IPv6). A group of link scope has a separate socket for each link.

A membership stays with the socket when the network goes, and a socket has at most 20 memberships of
IPv4 (igmp_max_memberships). So memberships of former networks are ended. If a socket has no room,
the next socket gets the membership.
"""

import contextlib
import errno
import socket
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

from rosproxy.forwarding.datagrams import enlarge_receive_buffer, ignore_groups_of_others
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.machine.interfaces import interface_index

GROUP = "239.255.0.1"
"""The IPv4 group for announcements (DDSI-RTPS 2.5, 9.6.2.4.1)."""
GROUP_FAST_DDS6 = "ff1e::ffff:efff:1"
"""The IPv6 group for announcements of Fast DDS."""
GROUP_CYCLONE6 = "ff02::ffff:efff:1"
"""The IPv6 group for announcements of Cyclone DDS."""
_SHARED = {socket.AF_INET: (GROUP,), socket.AF_INET6: (GROUP_FAST_DDS6,)}
_OF_LINK = {socket.AF_INET: (), socket.AF_INET6: (GROUP_CYCLONE6,)}


def family_of(address: str) -> socket.AddressFamily:
    """The socket family for an address."""
    return socket.AF_INET6 if ":" in address else socket.AF_INET


def groups_of(address: str) -> tuple[str, ...]:
    """The groups on the network of an address of this machine."""
    family = family_of(address)
    return _SHARED[family] + _OF_LINK[family]


class Membership(NamedTuple):
    """The membership of a socket in a group on a network; ``request`` names group and network."""

    sock: socket.socket
    request: bytes

    def end(self) -> None:
        """End the membership, also if the network has gone."""
        is_v6 = self.sock.family == socket.AF_INET6
        level = socket.IPPROTO_IPV6 if is_v6 else socket.IPPROTO_IP
        option = socket.IPV6_LEAVE_GROUP if is_v6 else socket.IP_DROP_MEMBERSHIP
        with contextlib.suppress(OSError):
            self.sock.setsockopt(level, option, self.request)


@dataclass(slots=True)
class _Network:
    """The sockets for groups of link scope on a network, and the memberships of shared sockets."""

    sockets: list[socket.socket] = field(default_factory=list)
    memberships: list[Membership] = field(default_factory=list)


class GroupSockets:
    """Sockets that receive from the groups at a port.

    ``begin`` is called with each new socket. ``end`` is called to close a socket.
    """

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
        """The addresses of this machine on whose networks the groups are joined."""
        return list(self._networks)

    def open(self, families: Iterable[socket.AddressFamily]) -> None:
        """Open the sockets for the groups that networks share. Raises OSError."""
        for group in (group for family in families for group in _SHARED[family]):
            self._shared[group] = [self._opened(group)]

    def join(self, addresses: Iterable[str]) -> list[str]:
        """Join the groups on the networks of these addresses of this machine, and leave all others.

        Return the addresses whose networks are new.
        """
        present = {a for a in addresses if any(g in self._shared for g in groups_of(a))}
        gone = self._networks.keys() - present
        # On a network with two addresses, only one has the membership. If that one has gone, the
        # other has to join.
        without = {a for a, network in self._networks.items() if gone and not network.memberships}
        for address in gone | without:
            self._leave(address)
        new = sorted(present - self._networks.keys())
        return [address for address in new if self._join(address)]

    def close(self) -> None:
        """Leave all groups and close all sockets."""
        self.join(())
        for socks in self._shared.values():
            for sock in socks:
                self._end(sock)
        self._shared.clear()

    def _join(self, address: str) -> bool:
        """Join the groups on a network. Return False if the network has gone."""
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
            # Networks come and go. The address is not in `joined`, so the next call tries again.
            self._leave(address)
            return False
        return True

    def _join_shared(self, group: str, address: str) -> Membership | None:
        """Join a group with the first shared socket that has room, or with a new socket.

        None if the group is joined already on this network. Raises OSError.
        """
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
    """A non-blocking socket that is bound to a group, and receives nothing else. Raises OSError.

    Other programs on this machine may bind the same group. For a group of link scope, ``link_of``
    is an address of this machine on the link.
    """
    sock = socket.socket(family_of(group.host), socket.SOCK_DGRAM)
    try:
        sock.setblocking(False)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        enlarge_receive_buffer(sock)
        ignore_groups_of_others(sock)
        # The scope id selects the link of a group of link scope (ipv6(7)).
        link = (0, interface_index(link_of)) if link_of else ()
        sock.bind((group.host, group.port, *link))
    except OSError:
        sock.close()
        raise
    return sock


def send_through(sock: socket.socket, address: str, loop: bool) -> None:
    """Select the network on which a socket sends to groups, by an address of this machine.

    ``loop`` means that programs on this machine receive the datagrams as well. Raises OSError.
    """
    if sock.family == socket.AF_INET6:
        sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_IF, interface_index(address))
        sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_LOOP, loop)
        return
    sock.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(address))
    sock.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, loop)


def join(sock: socket.socket, address: str) -> Membership | None:
    """Join the group that a socket is bound to, on the network of an address of this machine.

    None if the socket has joined already, by another address on this network. Raises OSError.
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
