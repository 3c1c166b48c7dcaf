"""Multicast groups: sockets that hear them, and that send to them through some network.

Participants announce themselves to one group with IPv4, and to one of two with IPv6, which has no
standard there: Fast DDS has one of global scope (UDPv6Transport.cpp), Cyclone DDS one of link scope
(ddsi_udp.c). A membership is by an own address with IPv4, by the interface's index with IPv6, and
a group of link scope has a socket for each link.
"""

import errno
import socket
import sys
from collections.abc import Callable, Iterable

from rosproxy.net.addresses import HostPort
from rosproxy.net.interfaces import interface_index

GROUP, GROUP_FAST_DDS6, GROUP_CYCLONE6 = "239.255.0.1", "ff1e::ffff:efff:1", "ff02::ffff:efff:1"
"""Where participants announce themselves (DDSI-RTPS 2.5, 9.6.2.4.1)."""
_SHARED = {socket.AF_INET: (GROUP,), socket.AF_INET6: (GROUP_FAST_DDS6,)}
_OF_LINK = {socket.AF_INET: (), socket.AF_INET6: (GROUP_CYCLONE6,)}


def family_of(address: str) -> socket.AddressFamily:
    """The family of an address's sockets."""
    return socket.AF_INET6 if ":" in address else socket.AF_INET


def groups_of(address: str) -> tuple[str, ...]:
    """The groups of the network where this machine has an address."""
    family = family_of(address)
    return _SHARED[family] + _OF_LINK[family]


class GroupEars:
    """Sockets that hear the groups of a port. ``begin`` is called with each, ``end`` closes it."""

    def __init__(
        self,
        port: int,
        begin: Callable[[socket.socket], None],
        end: Callable[[socket.socket], None],
    ) -> None:
        self._port, self._begin, self._end = port, begin, end
        self._shared: dict[socket.AddressFamily, list[socket.socket]] = {}
        self._of_link: dict[str, list[socket.socket]] = {}

    @property
    def joined(self) -> list[str]:
        """The addresses on whose networks they are heard."""
        return list(self._of_link)

    def open(self, families: Iterable[socket.AddressFamily]) -> None:
        """Hear the groups that have one socket for all networks. Raises OSError."""
        for family in families:
            self._shared[family] = [self._opened(group) for group in _SHARED[family]]

    def join(self, addresses: Iterable[str]) -> list[str]:
        """Hear them on the networks of these own addresses alone; the addresses that are new."""
        present = {a for a in addresses if family_of(a) in self._shared}
        for address in self._of_link.keys() - present:
            for sock in self._of_link.pop(address):
                self._end(sock)
        new = sorted(present - self._of_link.keys())
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
        link_sockets = list[socket.socket]()
        try:
            link_sockets += (self._opened(group, address) for group in _OF_LINK[family])
            for sock in self._shared[family] + link_sockets:
                join(sock, address)
        except OSError:
            # Networks come and go: as it is not in `joined`, the next call tries it again.
            for sock in link_sockets:
                self._end(sock)
            return False
        self._of_link[address] = link_sockets
        return True

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


def join(sock: socket.socket, address: str) -> None:
    """Hear the group that a socket is bound to on the network of an own address. Raises OSError."""
    packed = socket.inet_pton(sock.family, sock.getsockname()[0].partition("%")[0])
    try:
        if sock.family == socket.AF_INET6:
            link = interface_index(address).to_bytes(4, sys.byteorder)
            sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_JOIN_GROUP, packed + link)
        else:
            member = packed + socket.inet_aton(address)
            sock.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
    except OSError as error:
        if error.errno != errno.EADDRINUSE:  # joined already, by another address of that network
            raise
