"""Datagram relays: from a port of the proxy to a single host and port, in one direction.

UDP has no end of a connection. If the program at the target has ended, the kernel there answers
with ICMP, port unreachable. The relay then ends, and its own port refuses, so the sender gets ICMP,
too. The relay keeps no datagrams: a datagram that the kernel does not take at once is lost.
"""

import asyncio
import contextlib
import logging
import socket
from collections.abc import Callable, Collection

from rosproxy.forwarding.buffer_sizes import UDP_RECEIVE_BUFFER_BYTES
from rosproxy.shared.addresses import HostPort, plain_address

log = logging.getLogger(__name__)

DATAGRAMS_PER_TURN = 64
"""Datagrams that a relay reads at most in a round of the event loop."""
LARGEST_DATAGRAM = 65_536
"""Bytes of a datagram that are read at most."""
_SO_RCVBUFFORCE = 33
"""An option of asm-generic/socket.h, which Python's socket lacks."""
_IP_MULTICAST_ALL = 49
"""An option of linux/in.h: whether a socket receives from networks on which only other sockets have
joined the group. A socket that has joined no group then receives from all groups of others."""
_IPV6_MULTICAST_ALL = 29
"""The same option for IPv6, of linux/in6.h. It has no effect on a socket that has joined the group
on any network: the kernel compares only the address (inet6_mc_check)."""


def bind(address: str, port: int) -> socket.socket:
    """A bound, non-blocking UDP socket; port 0 stands for any free port. Raises OSError.

    The socket receives from no multicast group. Its port may be the multicast port of another
    domain of ROS 2 (DDSI-RTPS 2.5, 9.6.2.3), whose group this process has joined.
    """
    sock = _socket(address)
    try:
        enlarge_receive_buffer(sock)
        ignore_groups_of_others(sock)
        if sock.family == socket.AF_INET6:
            # `::` accepts IPv4, too, with any value of net.ipv6.bindv6only (ipv6(7)).
            sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)
        sock.bind((address, port))
    except OSError:
        sock.close()
        raise
    return sock


def enlarge_receive_buffer(sock: socket.socket) -> None:
    """Set the receive buffer to `UDP_RECEIVE_BUFFER_BYTES`, or to as much as the kernel grants."""
    try:
        sock.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, UDP_RECEIVE_BUFFER_BYTES)
    except PermissionError:  # without NET_ADMIN (socket(7))
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, UDP_RECEIVE_BUFFER_BYTES)


def ignore_groups_of_others(sock: socket.socket) -> None:
    """Let a socket receive no multicast of networks on which only other sockets have joined."""
    with contextlib.suppress(OSError):  # without this option the socket receives too much
        sock.setsockopt(socket.IPPROTO_IP, _IP_MULTICAST_ALL, 0)
        if sock.family == socket.AF_INET6:
            sock.setsockopt(socket.IPPROTO_IPV6, _IPV6_MULTICAST_ALL, 0)


class DatagramRelay:
    """Forwards datagrams from the addresses ``sources`` to ``target``.

    ``sock`` is the bound socket that receives the datagrams. ``sent`` counts forwarded bytes,
    ``dropped`` the datagrams of other sources. If the target refuses, the relay calls ``ended``,
    which has to `close` the relay. If the kernel refuses the target, raises OSError and closes
    ``sock``. Needs a running event loop.
    """

    def __init__(
        self,
        sock: socket.socket,
        sources: Collection[str],
        target: HostPort,
        ended: Callable[[], None],
    ) -> None:
        self.port: int = sock.getsockname()[1]
        self.sent = self.dropped = 0
        self._sources = frozenset(sources)
        self._ended = ended
        self._in = sock
        self._out = _socket(target.host)
        try:
            # Linux passes ICMP errors to connected sockets only (net/ipv4/udp.c, __udp4_lib_err).
            self._out.connect((target.host, target.port))
        except OSError:
            self.close()
            raise
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(self._in, self._pass_on)
        self._loop.add_reader(self._out, self._read_error)

    def close(self) -> None:
        """Close both sockets, so that the port refuses."""
        for sock in (self._in, self._out):
            with contextlib.suppress(AttributeError):  # `__init__` has failed before `_loop`
                self._loop.remove_reader(sock)
            sock.close()

    def _pass_on(self) -> None:
        try:
            for _ in range(DATAGRAMS_PER_TURN):
                data, sender = self._in.recvfrom(LARGEST_DATAGRAM)
                if plain_address(sender[0]) not in self._sources:
                    self.dropped += 1
                    continue
                with contextlib.suppress(BlockingIOError):
                    self.sent += self._out.send(data)
        except BlockingIOError:
            return
        except OSError as error:
            self._note_error(error)

    def _read_error(self) -> None:
        """Read the socket to the target: the target sends no datagrams, only ICMP errors."""
        try:
            self._out.recv(LARGEST_DATAGRAM)
        except BlockingIOError:
            return
        except OSError as error:
            self._note_error(error)

    def _note_error(self, error: OSError) -> None:
        """End the relay if the target has refused; other errors of the network may pass."""
        log.debug("datagrams at port %d: %s", self.port, error)
        if isinstance(error, ConnectionRefusedError):
            self._ended()


def _socket(address: str) -> socket.socket:
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    sock = socket.socket(family, socket.SOCK_DGRAM)
    sock.setblocking(False)
    return sock
