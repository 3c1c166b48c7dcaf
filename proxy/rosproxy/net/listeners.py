"""The ports of the range: bound from the start, listening only while leased.

Binding them all at once keeps the kernel from giving one of them to an outgoing connection, and
tells at start which are taken. A bound port that doesn't listen refuses connections.
"""

import logging
import socket
from collections.abc import Iterable

log = logging.getLogger(__name__)

BACKLOG = 256


def bind(address: str, port: int) -> socket.socket:
    """A bound, non-blocking TCP socket that does not listen yet. Raises OSError."""
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    sock = socket.socket(family, socket.SOCK_STREAM)
    try:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if family == socket.AF_INET6:
            sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)
        sock.bind((address, port))
    except OSError:
        sock.close()
        raise
    sock.setblocking(False)
    return sock


def listen(address: str, port: int) -> socket.socket:
    """A listening, non-blocking TCP socket. Raises OSError."""
    sock = bind(address, port)
    sock.listen(BACKLOG)
    return sock


class PortBank:
    """Sockets bound to the ports of a range."""

    def __init__(self, address: str) -> None:
        self._address = address
        self._bound: dict[int, socket.socket] = {}

    def reserve(self, ports: Iterable[int]) -> list[int]:
        """Bind all ports; returns those that another program holds."""
        return [port for port in ports if not self._reserve(port)]

    def open(self, port: int) -> socket.socket:
        """Let a reserved port listen. Raises OSError if another program took it meanwhile."""
        sock = self._bound.pop(port, None) or bind(self._address, port)
        try:
            sock.listen(BACKLOG)
        except OSError:
            sock.close()
            raise
        return sock

    def close(self, port: int, sock: socket.socket) -> None:
        """Stop listening and keep the port reserved."""
        sock.close()
        self._reserve(port)

    def close_all(self) -> None:
        """Give all reserved ports back."""
        for sock in self._bound.values():
            sock.close()
        self._bound.clear()

    def _reserve(self, port: int) -> bool:
        try:
            self._bound[port] = bind(self._address, port)
        except OSError as error:
            log.debug("port %d can't be reserved: %s", port, error)
            return False
        return True
