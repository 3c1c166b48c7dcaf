"""The receive buffers of a domain's sockets, and the datagrams that find no room there."""

import contextlib
import socket
import struct
from collections import deque

PERIOD_S = 60.0
"""Seconds of `ReceiveBuffers.overflowed_recently`."""
_SO_MEMINFO = 55
"""An option of asm-generic/socket.h, which Python's socket lacks."""
_COUNTERS = struct.Struct("=9I")
"""The value of SO_MEMINFO. The last counter is SK_MEMINFO_DROPS (linux/sock_diag.h)."""


class ReceiveBuffers:
    """Counts the datagrams that the kernel drops because a receive buffer is full.

    ``sockets`` are the open sockets of a domain that receive.
    """

    def __init__(self) -> None:
        self.sockets: set[socket.socket] = set()
        self._of_removed = 0
        self._samples: deque[tuple[float, int]] = deque()

    def remove(self, sock: socket.socket) -> None:
        """Remove a socket before it is closed. Its datagrams still count."""
        self.sockets.remove(sock)
        self._of_removed += overflowed(sock)

    @property
    def overflowed(self) -> int:
        """The number of dropped datagrams since the start."""
        return self._of_removed + sum(map(overflowed, self.sockets))

    @property
    def overflowed_recently(self) -> int:
        """The number of dropped datagrams in the last `PERIOD_S`, as of the last sample."""
        return self._samples[-1][1] - self._samples[0][1] if self._samples else 0

    @property
    def size_bytes(self) -> int:
        """The size that the kernel has granted; 0 without a socket."""
        sizes = (s.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) for s in self.sockets)
        return next(sizes, 0) // 2  # Linux doubles the size for its own records (socket(7))

    def sample(self, now: float) -> None:
        """Note the number of dropped datagrams. ``now`` is in seconds."""
        self._samples.append((now, self.overflowed))
        while now - self._samples[0][0] > PERIOD_S:
            self._samples.popleft()


def overflowed(sock: socket.socket) -> int:
    """The datagrams that the kernel has dropped at a socket; 0 if the kernel does not tell."""
    with contextlib.suppress(OSError):
        counters = sock.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, _COUNTERS.size)
        return int(_COUNTERS.unpack(counters)[-1])
    return 0
