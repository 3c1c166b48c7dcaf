"""Passing datagrams on, one way: from a port of the proxy to one host and port.

UDP knows no end of a connection. A relay ends when its target refuses: the program there has ended,
and its kernel says so (ICMP, port unreachable). Then the relay's own port refuses as well, by which
the sender learns of it in the same way. Nothing is kept here: what the target's kernel does not
take at once is lost, as datagrams are anywhere.
"""

import asyncio
import contextlib
import logging
import socket
from collections.abc import Callable, Collection

from rosproxy.net.addresses import HostPort, plain_address

log = logging.getLogger(__name__)

DATAGRAMS_PER_TURN = 64
"""Passed on before the loop looks at anything else."""
LARGEST_DATAGRAM = 65_536
RECEIVE_BUFFER = 1024 * 1024
"""Bytes that may wait while the loop is busy; Linux grants what its rmem_max allows."""


def bind(address: str, port: int) -> socket.socket:
    """A bound, non-blocking UDP socket; with port 0 at any free one. Raises OSError."""
    sock = _socket(address)
    try:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
        if sock.family == socket.AF_INET6:
            # `::` is for IPv4, too, whatever net.ipv6.bindv6only says (ipv6(7)).
            sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)
        sock.bind((address, port))
    except OSError:
        sock.close()
        raise
    return sock


class DatagramRelay:
    """Passes on what arrives at a bound socket, from some addresses to one target.

    ``sent`` are the bytes that were passed on, ``dropped`` the datagrams of others. ``ended`` is
    called when the target refuses, and has to `close` the relay. Raises OSError if the target
    can't be an address of UDP. Needs a running event loop.
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
        """Stop, and let the port refuse."""
        for sock in (self._in, self._out):
            with contextlib.suppress(AttributeError):  # not begun
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
        """A target says nothing, except that it refuses."""
        try:
            self._out.recv(LARGEST_DATAGRAM)
        except BlockingIOError:
            return
        except OSError as error:
            self._note_error(error)

    def _note_error(self, error: OSError) -> None:
        """End if the target has refused; any other trouble of a network may pass."""
        log.debug("datagrams at port %d: %s", self.port, error)
        if isinstance(error, ConnectionRefusedError):
            self._ended()


def _socket(address: str) -> socket.socket:
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    sock = socket.socket(family, socket.SOCK_DGRAM)
    sock.setblocking(False)
    return sock
